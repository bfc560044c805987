"""Suites, and which photographs the protocols choose."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
import yaml

from pipeline.config import read_yaml, validate
from pipeline.errors import RequestError
from pipeline.studies.benchmark.cells import Cell, plan_cells
from pipeline.studies.benchmark.splits import pictures_of, split_views
from pipeline.studies.benchmark.suite import Suite, load_suite, suites

SUITE: dict[str, Any] = {
    "title": "A title",
    "scenes": [{"name": "mouth", "images": "frames", "ground_truth": "transforms.json"}],
    "methods": [{"name": "default"}, {"name": "short", "overrides": {"fit.iterations": 9}}],
    "tables": [{"name": "one", "form": "views", "protocol": "test_every", "views": [3]}],
}


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A folder with the files that `SUITE` names (empty: nothing is read)."""
    (tmp_path / "frames").mkdir()
    for index in range(12):
        (tmp_path / "frames" / f"{index}.jpg").touch()
    (tmp_path / "transforms.json").touch()
    return tmp_path


def written(folder: Path, **changes: Any) -> Path:
    path = folder / "suite.yaml"
    path.write_text(yaml.safe_dump({**SUITE, **changes}))
    return path


def test_a_suite_becomes_cells(folder: Path) -> None:
    cells, tables = plan_cells(load_suite(written(folder)))
    assert tables == {"one": [cell.id for cell in cells]}
    assert [cell.id for cell in cells] == [
        "mouth-test_every_2-3_views-default-seed0",
        "mouth-test_every_2-3_views-short-seed0",
    ]
    first, second = cells
    assert first.photographs == ("0.jpg", "6.jpg", "11.jpg")  # of the pool 0, 2, 4, 6, 8, 10, 11
    assert first.held_out == ("1.jpg", "3.jpg", "5.jpg", "7.jpg", "9.jpg")
    assert [Path(path).name for path in first.images] == [
        "0.jpg", "1.jpg", "3.jpg", "5.jpg", "6.jpg", "7.jpg", "9.jpg", "11.jpg"
    ]  # fmt: skip
    assert first.workspace == second.workspace == "mouth/3_views"
    assert first.overrides["views.held_out"] == list(first.held_out)
    assert first.overrides["evaluate.ground_truth"] == str(folder / "transforms.json")
    assert second.overrides["fit.iterations"] == 9
    assert "export" not in first.stages and "evaluate" in first.stages
    assert Cell.from_dict(json.loads(json.dumps(first.to_dict()))) == first


def test_a_cell_of_two_tables_is_run_once(folder: Path) -> None:
    twice = [SUITE["tables"][0], {**SUITE["tables"][0], "name": "two", "methods": ["short"]}]
    cells, tables = plan_cells(load_suite(written(folder, tables=twice)))
    assert len(cells) == 2
    assert tables["two"] == [cells[1].id]


def test_overrides_come_in_order(folder: Path) -> None:
    scene = {**SUITE["scenes"][0], "overrides": {"views": {"long_side": 300}}}
    path = written(
        folder, scenes=[scene], overrides={"views.long_side": 200, "fit.iterations": 1}
    )  # fmt: skip
    cells, _ = plan_cells(load_suite(path))
    assert [c.overrides["fit.iterations"] for c in cells] == [1, 9]
    assert {c.overrides["views.long_side"] for c in cells} == {300}
    cells, _ = plan_cells(load_suite(path), {"fit.iterations": 5})
    assert [c.overrides["fit.iterations"] for c in cells] == [5, 5]


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"sceens": []}, "'sceens' is not a setting. Did you mean 'scenes'?"),
        ({"methods": [{"name": "a", "prest": "b"}]}, "Did you mean 'preset'?"),
        ({"methods": [{"name": "a/b"}]}, "methods.0.name='a/b' is not allowed"),
        ({"methods": [{"name": "a"}, {"name": "a"}]}, "two methods called 'a'"),
        ({"methods": [{"name": "a", "paper": "instantsplatt"}]}, "Did you mean 'instantsplat'?"),
        (
            {"tables": [{"name": "t", "form": "views", "methods": ["defalt"]}]},
            "Did you mean 'default'?",
        ),
        ({"tables": [{"name": "t", "form": "views", "ours": "none"}]}, "the method 'none'"),
        ({"tables": [{"name": "t", "form": "table"}]}, "'views', 'photos' or 'ablations'"),
        ({"tables": [{"name": "t", "form": "photos", "views": [3]}]}, "Leave `views` out"),
        (
            {"tables": [{"name": "t", "form": "photos", "protocol": "test_every"}]},
            "has no numbers of views",
        ),
        (
            {
                "scenes": [{"name": "mouth", "images": "frames"}],
                "tables": [{"name": "t", "form": "views", "known_cameras": True}],
            },
            "has no ground_truth",
        ),
        ({"scenes": [{"name": "mouth", "images": "pictures"}]}, "Say with --data where"),
    ],
)
def test_a_wrong_suite_is_explained(folder: Path, changes: dict[str, Any], text: str) -> None:
    with pytest.raises(RequestError) as error:
        load_suite(written(folder, **changes))
    assert text in str(error.value)
    assert "\n" not in str(error.value)


def test_unknown_suite() -> None:
    with pytest.raises(RequestError, match="Did you mean 'smoke'"):
        load_suite("smok")


def test_missing_data(folder: Path) -> None:
    with pytest.raises(RequestError, match=r"needs images .*frames, which is not there\. Check"):
        load_suite(written(folder), data=folder / "elsewhere")
    moved = folder / "elsewhere"
    moved.mkdir()
    (folder / "frames").rename(moved / "frames")
    (folder / "transforms.json").rename(moved / "transforms.json")
    assert len(plan_cells(load_suite(written(folder), data=moved))[0]) == 2


@pytest.mark.parametrize("name", sorted(suites()))
def test_suites_that_come_with_dentalsplat(name: str, tmp_path: Path) -> None:
    """Each can be planned with its presets, where its data are."""
    suite = validate(Suite, read_yaml(suites()[name], "suite"), "")
    for scene in suite.scenes:
        for path in scene.images:
            place = tmp_path / path
            if place.suffix:
                place.parent.mkdir(parents=True, exist_ok=True)
                place.touch()
            else:
                place.mkdir(parents=True)
                for index in range(24):
                    (place / f"{index:03d}.png").touch()
        for path in filter(None, (scene.ground_truth, scene.masks, scene.mesh)):
            (tmp_path / path).parent.mkdir(parents=True, exist_ok=True)
            (tmp_path / path).touch()
    cells, tables = plan_cells(load_suite(name, data=tmp_path))
    assert set(tables) == {table.name for table in suite.tables}
    assert len({cell.id for cell in cells}) == len(cells)
    if name == "paper":
        assert len(cells) == 24


def test_names_with_brackets_are_no_patterns(folder: Path) -> None:
    data = folder / "data [1]"
    (data / "frames").mkdir(parents=True)
    for name in ("a[2].png", "b.png", "b1²2.png"):
        (data / "frames" / name).write_bytes(b"")
    for images, names in {
        "frames/*.png": ["a[2].png", "b.png", "b1²2.png"], "frames/a[2].png": ["a[2].png"],
    }.items():  # fmt: skip
        loaded = load_suite(written(folder, scenes=[{"name": "mouth", "images": images}]), data)
        found = pictures_of(loaded.images(loaded.suite.scenes[0]))
        assert [path.name for path in found] == names


# -- protocols -------------------------------------------------------------------------------------


def names(paths: tuple[Path, ...]) -> list[int]:
    return [int(path.stem) for path in paths]


@pytest.mark.parametrize(
    ("views", "chosen"),
    [
        (3, [0, 11, 23]),
        (6, [0, 5, 9, 13, 17, 23]),
        (9, [0, 3, 5, 9, 11, 13, 17, 19, 23]),
        (12, [0, 3, 5, 7, 9, 11, 13, 15, 17, 19, 21, 23]),
    ],
)
def test_the_papers_video_protocol(views: int, chosen: list[int]) -> None:
    split = split_views([Path(f"{k:03d}.png") for k in range(24)], "video24", views)
    assert names(split.photographs) == chosen
    assert names(split.held_out) == [1, 2, 4, 6, 8, 10, 12, 14, 16, 18, 20, 22]


def test_longer_videos_are_sampled_uniformly() -> None:
    split = split_views([Path(f"{k:03d}.png") for k in range(47)], "video24", 12)
    assert names(split.photographs)[0] == 0 and names(split.photographs)[-1] == 46
    assert names(split.held_out)[:3] == [2, 4, 8]


def test_too_few_photographs() -> None:
    files = [Path(f"{k}.png") for k in range(9)]
    with pytest.raises(RequestError, match="needs 24 frames, and there are 9"):
        split_views(files, "video24", 3)
    with pytest.raises(RequestError, match="leaves 5 of 9"):
        split_views(files, "test_every", 6)


def test_ends_are_never_held_out() -> None:
    files = [Path(f"{k}.png") for k in range(9)]
    split = split_views(files, "test_every", None, test_every=3)
    assert names(split.held_out) == [1, 4, 7]
    assert names(split.photographs) == [0, 2, 3, 5, 6, 8]
    assert split_views(files, "all", None).held_out == ()


def test_pictures_in_number_order(tmp_path: Path) -> None:
    for name in ("10.JPG", "9.jpg", "transforms.json", ".hidden.jpg"):
        (tmp_path / name).touch()
    assert [path.name for path in pictures_of([tmp_path])] == ["9.jpg", "10.JPG"]
    (tmp_path / "9.png").touch()
    with pytest.raises(RequestError, match="two photographs are called 9"):
        pictures_of([tmp_path])
    assert [path.name for path in pictures_of([tmp_path / "*.png"])] == ["9.png"]
    with pytest.raises(RequestError, match="no photographs"):
        pictures_of([tmp_path / "nowhere"])
