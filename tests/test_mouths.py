"""The generator of synthetic mouths: numbers, cameras, depth, and that it repeats itself."""

from __future__ import annotations

import importlib
import json
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import cv2
import numpy as np
import pytest

SAMPLES = Path(__file__).resolve().parents[1] / "data_samples"
ROLES = ("front", "right", "left", "upper", "lower")
TIDY = {
    "dentition": "permanent",
    "crowding": 0.0,
    "twist": 2.0,
    "shift": 0.1,
    "tilt": 1.0,
    "recession": 0.0,
    "bite": "normal",
    "conditions": (),
    "braces_upper": False,
    "braces_lower": False,
    "seed": 5,
}
WISDOM = (18, 28, 38, 48)
#: What gum is in the files of labels.
GUM = 1


@pytest.fixture(scope="module")
def mouths() -> Iterator[ModuleType]:
    sys.path.insert(0, str(SAMPLES))
    try:
        package = importlib.import_module("mouths")
    finally:
        sys.path.remove(str(SAMPLES))
    with pytest.MonkeyPatch.context() as patch:  # coarse shadows are enough here, and quick
        patch.setattr(importlib.import_module("mouths.mouth"), "RAYS", 3)
        yield package


@pytest.fixture(scope="module")
def mouth(mouths: ModuleType) -> Any:
    return mouths.random_mouth(np.random.default_rng(3), missing=(*WISDOM, 12, 46), **TIDY)


def take(mouths: ModuleType, mouth: Any, role: str, seed: int = 1, **overrides: Any) -> Any:
    rng = np.random.default_rng(seed)
    return mouths.photograph(mouth, rng, role, width=160, height=120, **overrides)


@pytest.fixture(scope="module")
def plain(mouths: ModuleType, mouth: Any) -> dict[str, Any]:
    return {role: take(mouths, mouth, role, plain=True) for role in ROLES}


def test_numbers_of_the_vertices_are_those_of_the_teeth(mouth: Any) -> None:
    expected = {10 * q + n for q in (1, 2, 3, 4) for n in range(1, 8)} - {12, 46}
    assert set(np.unique(mouth.fdi).tolist()) == expected | {0}
    assert {tooth.plan.fdi for tooth in mouth.teeth} == expected


def test_teeth_stand_where_their_numbers_say(mouth: Any) -> None:
    """World: x to the patient's left, y up, z out of the mouth."""
    centres = mouth.tooth_centres()
    for fdi, centre in centres.items():
        quadrant, number = divmod(fdi, 10)
        assert (centre[0] > 0) == (quadrant in (2, 3)), fdi
        assert (centre[1] > 0) == (quadrant in (1, 2)), fdi
        behind = centres.get(fdi + 1)
        if behind is not None and number < 7:
            assert behind[2] < centre[2] + 0.5, fdi
            assert abs(behind[0]) > abs(centre[0]) - 0.5, fdi


def test_vertices_lie_at_their_tooths_centre(mouth: Any) -> None:
    for fdi, centre in mouth.tooth_centres().items():
        used = np.unique(mouth.triangles[mouth.fdi[mouth.triangles[:, 0]] == fdi])
        assert np.linalg.norm(mouth.vertices[used].mean(0) - centre) < 2.5, fdi


@pytest.mark.parametrize("role", ROLES)
def test_labels_agree_with_projected_teeth(plain: dict[str, Any], mouth: Any, role: str) -> None:
    """Labelled pixels, carried into the world by depth and camera, lie on that tooth."""
    photo = plain[role]
    assert photo.view == role
    assert photo.image.shape == (120, 160, 3)
    assert photo.image.dtype == np.uint8
    assert photo.labels.dtype == np.uint8
    assert photo.depth.dtype == np.float32
    centres = mouth.tooth_centres(photo.opening)
    seen = [int(n) for n in np.unique(photo.labels) if n]
    assert len(seen) >= 5
    assert set(seen) <= set(centres)
    world_from_cam = np.linalg.inv(photo.cam_from_world)
    for fdi in seen:
        rows, columns = np.nonzero(photo.labels == fdi)
        z = photo.depth[rows, columns].astype(float)
        assert (z > 0).all()
        x = (columns + 0.5 - photo.cx) / photo.fx * z
        y = (rows + 0.5 - photo.cy) / photo.fy * z
        points = np.stack([x, y, z], -1) @ world_from_cam[:3, :3].T + world_from_cam[:3, 3]
        assert np.linalg.norm(points - centres[fdi], axis=1).max() < 11.0, fdi
        nearest = min(centres, key=lambda n: float(np.linalg.norm(points.mean(0) - centres[n])))
        if len(rows) > 60:
            assert nearest == fdi


def test_every_role_sees_its_side(plain: dict[str, Any]) -> None:
    def largest(role: str) -> int:
        labels = plain[role].labels
        return int(np.bincount(labels[labels > 0]).argmax()) // 10

    assert largest("right") in (1, 4)
    assert largest("left") in (2, 3)
    assert set(np.unique(plain["upper"].labels) // 10) <= {0, 1, 2}
    assert set(np.unique(plain["lower"].labels) // 10) <= {0, 3, 4}
    front = plain["front"].labels
    columns = {n: np.nonzero(front == n)[1].mean() for n in (11, 21)}
    assert columns[11] < columns[21]  # the patient's right is on the left of the picture
    assert plain["upper"].bite == plain["lower"].bite == "open"


def test_gum_surrounds_the_teeth_and_is_none_of_them(plain: dict[str, Any]) -> None:
    for role in ("front", "right", "left"):
        photo = plain[role]
        assert photo.gum.dtype == bool
        assert not (photo.gum & (photo.labels > 0)).any()
        assert (photo.depth[photo.gum] > 0).all()
        ring = cv2.dilate((photo.labels > 0).astype(np.uint8), np.ones((5, 5))) > 0
        assert photo.gum[ring & (photo.labels == 0)].mean() > 0.5, role


def test_missing_teeth_are_absent(plain: dict[str, Any]) -> None:
    for photo in plain.values():
        assert not np.isin(photo.labels, (12, 46, *WISDOM)).any()


def test_the_same_seed_gives_the_same_bytes(mouths: ModuleType, mouth: Any) -> None:
    again = mouths.random_mouth(np.random.default_rng(3), missing=(*WISDOM, 12, 46), **TIDY)
    assert np.array_equal(again.vertices, mouth.vertices)
    first, second = take(mouths, mouth, "left", 7), take(mouths, again, "left", 7)
    assert np.array_equal(first.image, second.image)
    assert np.array_equal(first.labels, second.labels)
    assert np.array_equal(first.depth, second.depth)
    assert not np.array_equal(first.image, take(mouths, mouth, "left", 8).image)


def test_what_stands_in_front_is_not_labelled(mouths: ModuleType, mouth: Any) -> None:
    """Lips and hands take labels and depth away; they never add any."""
    camera = take(mouths, mouth, "front", plain=True).camera
    bare = take(mouths, mouth, "front", camera=camera, bite="closed", plain=True)
    taken = 0
    for seed in range(2):
        dressed = take(mouths, mouth, "front", seed, camera=camera, bite="closed")
        kept = dressed.depth > 0
        assert not dressed.labels[~kept].any()
        assert not (dressed.gum & ~bare.gum).any()
        assert dressed.gum.sum() < bare.gum.sum()
        same = dressed.labels[kept] == bare.labels[kept]
        assert same.mean() > 0.999
        taken += int((~kept & (bare.depth > 0)).sum())
    assert taken > 0


def test_opening_moves_the_lower_jaw_only(mouth: Any) -> None:
    closed, apart = mouth.tooth_centres(0.0), mouth.tooth_centres(20.0)
    assert np.array_equal(closed[11], apart[11])
    assert 15 < closed[41][1] - apart[41][1] < 25


def test_brackets_count_as_their_crowns(mouths: ModuleType) -> None:
    options = {**TIDY, "braces_upper": True}
    mouth = mouths.random_mouth(np.random.default_rng(3), missing=WISDOM, **options)
    bracket = mouth.tissue == 5
    assert set(np.unique(mouth.fdi[bracket])) >= {11, 21, 13, 23}
    wire = mouth.tissue == 6
    assert wire.any()
    assert not mouth.fdi[wire].any()
    assert not mouth.lower[bracket].any()


@pytest.mark.parametrize("dentition", ["primary", "mixed"])
def test_milk_teeth_have_their_own_numbers(mouths: ModuleType, dentition: str) -> None:
    rng = np.random.default_rng(4)
    mouth = mouths.random_mouth(rng, dentition=dentition, missing=(), seed=9, size=1.0)
    numbers = {tooth.plan.fdi for tooth in mouth.teeth}
    milk = {n for n in numbers if n > 50}
    if dentition == "primary":
        assert numbers == {10 * q + n for q in (5, 6, 7, 8) for n in range(1, 6)}
    else:
        assert {55, 65, 75, 85} <= milk
        assert {16, 26, 36, 46, 11, 21, 31, 41} <= numbers
    widths = {tooth.plan.fdi: tooth.plan.width for tooth in mouth.teeth}
    assert widths[55] == pytest.approx(8.8, rel=0.2)
    photo = take(mouths, mouth, "front", plain=True)
    assert set(np.unique(photo.labels).tolist()) <= numbers | {0}


def test_options_are_sampled_and_checked(mouths: ModuleType) -> None:
    rng = np.random.default_rng(0)
    many = [mouths.random_options(rng) for _ in range(200)]
    assert {o.dentition for o in many} == {"permanent", "primary", "mixed"}
    assert {o.bite for o in many} == {"normal", "deep", "open", "edge", "reverse", "overjet"}
    assert any(o.braces_upper for o in many)
    assert any(o.missing and o.dentition == "primary" for o in many)
    for o in many:
        assert all(n > 50 for n, _ in o.conditions) or o.dentition == "permanent"
    with pytest.raises(TypeError, match="no such options"):
        mouths.random_options(rng, teeth=3)


def test_wrong_arguments_are_refused(mouths: ModuleType, mouth: Any) -> None:
    with pytest.raises(ValueError, match="no such role"):
        take(mouths, mouth, "back")
    with pytest.raises(TypeError, match="no such overrides"):
        take(mouths, mouth, "front", colour="red")


def test_command_line_writes_pictures_labels_and_index(mouths: ModuleType, tmp_path: Path) -> None:
    batch = importlib.import_module(f"{mouths.__name__}.batch")
    for name in ("a", "b"):
        batch.main(["--count", "2", "--out", str(tmp_path / name), "--seed", "3", "--width", "96"])
    index = json.loads((tmp_path / "a" / "index.json").read_text())
    assert sorted(index) == ["0", "1"]
    for name, entry in index.items():
        image = cv2.imread(str(tmp_path / "a" / f"{name}.jpg"))
        labels = cv2.imread(str(tmp_path / "a" / f"{name}.png"), cv2.IMREAD_UNCHANGED)
        assert image is not None
        assert labels is not None
        assert image.shape[:2] == labels.shape == (entry["height"], entry["width"])
        assert labels.dtype == np.uint8
        assert sorted(n for n in np.unique(labels).tolist() if n > GUM) == entry["teeth"]
        assert entry["view"] in ROLES
        assert entry["bite"] in ("closed", "open")
        assert isinstance(entry["primary"], bool)
    for file in (tmp_path / "a").iterdir():
        assert file.read_bytes() == (tmp_path / "b" / file.name).read_bytes()


def test_whose_mouth_it_is_chooses_some_options(mouths: ModuleType) -> None:
    batch = importlib.import_module(f"{mouths.__name__}.batch")
    made = {
        whose: [batch.options_of(whose, np.random.default_rng(k)) for k in range(60)]
        for whose in batch.PATIENTS
    }
    assert not any(made["anybody"])
    assert {options["dentition"] for options in made["children"]} == {"primary", "mixed"}
    braces = [options["braces_upper"] for options in made["orthodontic"]]
    assert 0.5 < np.mean(braces) < 0.9
    for options in made["orthodontic"]:
        assert (
            options["dentition"] == "permanent"
            and options["braces_upper"] >= (options["braces_lower"])
        )
        mouths.options.random_options(np.random.default_rng(0), **options)
