"""Which files a request means, in which order, and what is said when it means none."""

from __future__ import annotations

import os
from collections.abc import Iterator
from fractions import Fraction
from pathlib import Path
from typing import Any

import pytest

from pipeline.errors import RequestError
from stages.views import find
from stages.views.find import find_images, find_masks
from stages.views.reading.exif import focal_in_pixels, read_orientation
from stages.views.sampling import is_sequence, natural_key, uniform_indices


def touch(folder: Path, *names: str) -> list[Path]:
    paths = [folder / name for name in names]
    for path in paths:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(b"x")
    return paths


def test_natural_order() -> None:
    names = [
        "img10.png",
        "img2.png",
        "IMG1.png",
        "a.png",
        "7.png",
        "img2b.png",
        "007.png",
        "img.png",
    ]
    ordered = [
        "007.png",
        "7.png",
        "a.png",
        "img.png",
        "IMG1.png",
        "img2.png",
        "img2b.png",
        "img10.png",
    ]
    assert sorted(names, key=natural_key) == ordered


def test_natural_order_of_odd_digits() -> None:
    assert sorted(["a².png", "a1.png"], key=natural_key) == ["a1.png", "a².png"]
    archive = ["1.2.840.100", "1.2.840.10", "1.2.840.9"]
    assert sorted(archive, key=natural_key) == archive[::-1]


@pytest.mark.parametrize(
    ("count", "wanted", "expected"),
    [
        (5, None, [0, 1, 2, 3, 4]),
        (5, 9, [0, 1, 2, 3, 4]),
        (5, 2, [0, 4]),
        (12, 3, [0, 6, 11]),
        (24, 12, [0, 2, 4, 6, 8, 10, 13, 15, 17, 19, 21, 23]),
    ],
)
def test_uniform_indices(count: int, wanted: int | None, expected: list[int]) -> None:
    assert uniform_indices(count, wanted) == expected


def test_uniform_indices_are_as_many_as_wanted() -> None:
    for count in range(2, 40):
        for wanted in range(2, count + 1):
            chosen = uniform_indices(count, wanted)
            assert len(chosen) == wanted
            assert (chosen[0], chosen[-1]) == (0, count - 1)


@pytest.mark.parametrize(
    ("names", "expected"),
    [
        ([f"{n:03d}.png" for n in range(12)], True),
        ([f"scan_{n}_x.png" for n in range(0, 60, 5)], True),
        ([f"{n:03d}.png" for n in uniform_indices(24, 9)], True),
        ([f"{n:03d}.png" for n in range(3)], False),  # too few to tell
        ([f"{n}.png" for n in (1, 2, 3, 4, 5, 9)], False),
        ([f"{n}.png" for n in (6, 5, 4, 3, 2, 1)], False),
        ([f"{n}_{n}.png" for n in range(6)], False),
        (["a.png", "b.png", "c.png", "d.png", "e.png", "f.png"], False),
        (["a1.png", "b2.png", "c3.png", "d4.png", "e5.png", "f6.png"], False),
    ],
)
def test_sequences(names: list[str], expected: bool) -> None:
    assert is_sequence(names) is expected


def test_folder(tmp_path: Path) -> None:
    touch(tmp_path, "img10.JPG", "img2.jpeg", ".hidden.png", "notes.txt", "depth/000.png", "b.HEIC")
    found = find_images([tmp_path])
    assert list(found) == ["b.HEIC", "img2.jpeg", "img10.JPG"]
    assert found["img2.jpeg"] == tmp_path / "img2.jpeg"


@pytest.mark.parametrize("pattern", ["*.jpg", "p [[]1]/*.jpg", "p [1]/*.jpg", "p*/*.jpg", "**/*"])
def test_folders_with_brackets_in_their_names(tmp_path: Path, pattern: str) -> None:
    touch(tmp_path, "a [2]/p [1]/x.jpg", "a 2/p 1/y.jpg")
    folder = tmp_path / "a [2]" / ("p [1]" if pattern == "*.jpg" else "")
    assert list(find_images([folder / pattern])) == ["x.jpg"]


def test_files_patterns_and_repeats(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    a, b, _ = touch(tmp_path, "b.png", "a.png", "notes.txt")
    assert list(find_images([a, b])) == ["a.png", "b.png"]
    assert list(find_images([str(tmp_path / "*.png")])) == ["a.png", "b.png"]
    assert list(find_images([str(tmp_path / "*"), a, tmp_path])) == ["a.png", "b.png"]
    odd = touch(tmp_path, "x[1].png")[0]
    assert list(find_images([odd, a])) == ["b.png", "x[1].png"]
    monkeypatch.chdir(tmp_path)
    assert list(find_images(["a.png", "./b.png", "../" + tmp_path.name + "/a.png"])) == [
        "a.png",
        "b.png",
    ]
    monkeypatch.setenv("HOME", str(tmp_path))
    assert len(find_images(["~/*.png"])) == 3


def test_folders_on_the_way_to_a_pattern_mean_themselves(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    touch(tmp_path, "clinic [2024]/b*b/1.png", "clinic [2024]/bob/2.png", "clinic 2/bob/3.png")
    assert list(find_images([tmp_path / "clinic [2024]" / "b*b" / "*.png"])) == ["1.png"]
    assert list(find_images([tmp_path / "clinic [2024]" / "**" / "*.png"])) == ["1.png", "2.png"]
    assert list(find_images([tmp_path / "clinic [0-9]" / "*" / "*.png"])) == ["3.png"]
    monkeypatch.chdir(tmp_path / "clinic [2024]")
    assert list(find_images([Path("bo?/*.png").absolute()])) == ["2.png"]
    assert list(find_images(["*/1.png"])) == ["1.png"]


def workspace(folder: Path) -> Path:
    """A workspace with pictures in results, in a stage's folder, and photographs of the user's."""
    touch(folder, "request.json", "fit/current.json", "fit/0123456789ab/renders/a.png")
    touch(folder, "export/.lock", "export/0123456789ab/exports/preview.png", "photos/mine.png")
    (folder / "results").symlink_to("export/0123456789ab/exports")
    return folder


def test_what_runs_have_made_is_no_photograph(tmp_path: Path) -> None:
    touch(
        tmp_path, "photos/a.png", "photos/results/b.png", "x/results/scene.json", "x/results/c.png"
    )
    own = workspace(tmp_path / "w")
    told: list[str] = []
    found = find_images([tmp_path / "**" / "*.png"], told.append)
    assert sorted(found) == ["a.png", "b.png", "mine.png"]
    assert len(told) == 1 and "4 pictures" in told[0] and "fit/, results/ of a w" in told[0]
    for named in (own / "results", own / "results" / "*.png", tmp_path / "*" / "results" / "p*"):
        assert list(find_images([named], told.append)) == ["preview.png"]
    assert len(find_images([own / "fit" / "**" / "*.png"], told.append)) == 1
    assert len(told) == 1
    with pytest.raises(RequestError, match=r"only what earlier runs have made .results/ of a"):
        find_images([own / "*s" / "pre*.png"])


def test_a_workspace_in_place_of_photographs(tmp_path: Path) -> None:
    own = workspace(tmp_path / "w")
    with pytest.raises(RequestError, match=r"Did you mean the folder in it: .*w/photos"):
        find_images([own])
    (own / "photos" / "mine.png").unlink()
    with pytest.raises(RequestError, match=r"To go on with a workspace: pipeline run -w .*/w"):
        find_images([own])
    touch(own, "1.png")
    assert list(find_images([own])) == ["1.png"]
    touch(own, "dicom/1.dcm")  # an archive's, beside what runs have made
    assert list(find_images([tmp_path / "**" / "*.dcm"])) == ["1.dcm"]
    (own / "dicom" / "1.dcm").rename(own / "dicom" / "preview.dcm")
    with pytest.raises(RequestError, match="only what earlier runs have made"):
        find_images([tmp_path / "**" / "*.dcm"])


def test_equal_names_get_their_folders(tmp_path: Path) -> None:
    touch(tmp_path, "p/left/1.png", "p/right/1.png", "q/right/1.png", "p/2.png", "p/masks/3.png",
          "q/masks/2.png")  # fmt: skip
    files = sorted(tmp_path.rglob("*.png"))
    found = find_images(files)
    assert sorted(found) == [
        "3.png", "images/masks/2.png", "left/1.png", "p/2.png", "p/right/1.png", "q/right/1.png",
    ]  # fmt: skip
    assert all(str(path).endswith(label.removeprefix("images/")) for label, path in found.items())


def refused(request: list[Any]) -> str:
    with pytest.raises(RequestError) as caught:
        find_images(request)
    return str(caught.value)


def test_what_is_missing(tmp_path: Path) -> None:
    touch(tmp_path, "photos/a.png", "photos/notes.txt", "photos/b.png")
    message = refused([tmp_path / "photo"])
    assert "photo" in message
    assert "Did you mean 'photos'?" in message
    assert "matches nothing" in refused([str(tmp_path / "photos" / "*.jpg")])
    assert "none of them a photograph" in refused([str(tmp_path / "photos" / "*.txt")])
    assert "notes.txt" in refused([tmp_path / "photos" / "notes.txt"])
    assert "No photograph was named" in refused([])
    assert "There is no file" in refused([tmp_path / ("x" * 5000)])


def test_folders_without_photographs(tmp_path: Path) -> None:
    empty = tmp_path / "empty"
    empty.mkdir()
    assert "it is empty" in refused([empty])
    touch(tmp_path, "case/readme.txt", "case/images/a.png", "film/x.mp4", "film/y.txt")
    message = refused([tmp_path / "case"])
    assert "readme.txt" in message
    assert str(tmp_path / "case" / "images") in message
    assert str(tmp_path / "film" / "x.mp4") in refused([tmp_path / "film"])


def test_the_folder_that_was_meant_is_named(tmp_path: Path) -> None:
    touch(tmp_path, "depth/0.png", "frames/0.png", "masks/0.png")
    assert refused([tmp_path]).endswith(str(tmp_path / "frames"))


def test_a_video_is_alone(tmp_path: Path) -> None:
    video, other, image = touch(tmp_path, "x.MP4", "y.mov", "a.png")
    assert find_images([video]) == {"x.MP4": video}
    for name in ("a.m2ts", "a.ts"):  # a camcorder's film, as it is called on a computer
        assert list(find_images(touch(tmp_path, name))) == [name]
    assert "photographs" in refused([video, image])
    assert "other videos" in refused([video, other])


def test_unreadable_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def forbidden(path: Any) -> Iterator[os.DirEntry[str]]:
        raise PermissionError(13, "Permission denied", str(path))

    touch(tmp_path, "a.png", "b.png")
    monkeypatch.setattr(find.os, "scandir", forbidden)
    message = refused([tmp_path])
    assert str(tmp_path) in message
    assert "permission denied" in message


def test_unreachable_parent_and_broken_disk(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def forbidden(self: Path, **options: Any) -> os.stat_result:
        raise PermissionError(13, "Permission denied", str(self))

    def broken(path: Any) -> Iterator[os.DirEntry[str]]:
        raise OSError(5, "Input/output error", str(path))

    with monkeypatch.context() as patch:
        patch.setattr(find.os, "scandir", broken)
        assert "Input/output error" in refused([tmp_path])
    with monkeypatch.context() as patch:
        patch.setattr(Path, "stat", forbidden)
        assert "permission denied" in refused([tmp_path / "a.png"])


def test_masks(tmp_path: Path) -> None:
    masks = tmp_path / "m"
    touch(masks, "a.png", "b.jpg.png", ".hidden.png", "notes.txt")
    found = find_masks(masks, ["a.jpg", "left/b.jpg", "c.jpg"])
    assert found == {"a.jpg": masks / "a.png", "left/b.jpg": masks / "b.jpg.png"}


@pytest.mark.parametrize(
    ("files", "labels", "message"),
    [
        (["z.png"], ["a.jpg", "b.jpg"], "mask z.png .* fits no photograph"),
        (["a.png", "a.tif"], ["a.jpg", "b.jpg"], "Two masks"),
        (["a.png"], ["l/a.jpg", "r/a.jpg"], "several photographs"),
        (["a.txt"], ["a.jpg"], "holds no masks .*a.txt"),
        ([], ["a.jpg"], "does not exist"),
    ],
)
def test_masks_that_do_not_fit(
    tmp_path: Path, files: list[str], labels: list[str], message: str
) -> None:
    touch(tmp_path / "m", *files)
    with pytest.raises(RequestError, match=message):
        find_masks(tmp_path / "m", labels)


def test_orientation_tag() -> None:
    assert [read_orientation({0x0112: n}) for n in range(1, 9)] == list(range(1, 9))
    for nonsense in (0, 9, "6a", None, (1, 2), 2.5):
        assert read_orientation({0x0112: nonsense}) == 1


def test_focal_from_the_35_mm_equivalent() -> None:
    # 50 mm on 36x24: the same share of the diagonal on any sensor.
    assert focal_in_pixels({0xA405: 50}, 3600, 2400) == pytest.approx(5000, rel=1e-6)
    assert focal_in_pixels({0xA405: 50}, 2400, 3600) == pytest.approx(5000, rel=1e-6)


def test_focal_from_the_sensor() -> None:
    # A 5.85 mm lens on pixels of 2 um; the file has half the size it was taken with.
    details = {0x920A: 5.85, 0xA20E: Fraction(5000), 0xA210: 3, 0xA002: 2832, 0xA003: 2124}
    assert focal_in_pixels(details, 1416, 1062) == pytest.approx(5.85 * 500 / 2)
    assert focal_in_pixels(details, 1062, 1416) == pytest.approx(5.85 * 500 / 2)
    inches = {0x920A: 5.85, 0xA20E: 12700.0}
    assert focal_in_pixels(inches, 2832, 2124) == pytest.approx(2925)


@pytest.mark.parametrize(
    "details",
    [
        {},
        {0x920A: 5.85},
        {0xA405: 0},
        {0xA405: "unknown"},
        {0xA405: float("nan")},
        {0xA405: 2},  # 2 mm of 43: no such lens
        {0xA405: 50, 0xA002: 4000, 0xA003: 3000},  # cropped to 16:9 afterwards
    ],
)
def test_no_focal(details: dict[int, Any]) -> None:
    assert focal_in_pixels(details, 1600, 900) is None


def test_pictures_in_other_formats_are_not_passed_by_without_a_word(tmp_path: Path) -> None:
    for name in ("right.jfif", "front.jpg", "left.AVIF", "front.cr2", "notes.txt"):
        (tmp_path / name).touch()
    told: list[str] = []
    assert list(find_images([tmp_path], told.append)) == ["front.jpg", "right.jfif"]
    (note,) = told
    assert note.startswith(f"left.AVIF in {tmp_path}: left out") and "save it as JPEG" in note


def test_a_film_beside_photographs_is_not_passed_by_without_a_word(tmp_path: Path) -> None:
    for name in ("1.jpg", "2.jpg", "2.MOV", "sweep.mp4"):  # phones write a film beside a photograph
        (tmp_path / name).touch()
    told: list[str] = []
    assert list(find_images([tmp_path], told.append)) == ["1.jpg", "2.jpg"]
    (note,) = told
    assert note.startswith(f"sweep.mp4 in {tmp_path}: left out")
    assert note.endswith(f"name it: {tmp_path / 'sweep.mp4'}")
