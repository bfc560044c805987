"""A wall is told from teeth, however blurred these are."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from stages.photographs.detail import BURNT_OUT, shows_nothing, white_share

SAMPLES = Path(__file__).parents[2] / "data_samples"
DATA = Path("/work/shared/data")


def rounded(grey: np.ndarray) -> np.ndarray:
    return np.rint(np.clip(grey, 0, 255)).astype(np.float32)


def wall(level: float, lit: float, corners: float, noise: float, grain: float) -> np.ndarray:
    """A painted wall [384, 512].

    Args:
        level: grey level of its middle.
        lit: grey levels between its left and its right side.
        corners: share of the light that is missing in the corners.
        noise: standard deviation; grain: blur of the noise, as cameras that hide it leave.
    """
    y, x = np.mgrid[:384, :512].astype(np.float32)
    x, y = x / 512 - 0.5, y / 512 - 0.375
    grains = np.random.default_rng(2).normal(size=x.shape).astype(np.float32)
    if grain:
        grains = cv2.GaussianBlur(grains, (0, 0), grain)
    light = (level + lit * (x + 0.5 * y)) * (1 - corners * (x**2 + y**2) / 0.39)
    return rounded(light + noise * grains / grains.std())


@pytest.mark.parametrize("level", [60, 128, 200])
@pytest.mark.parametrize("lit", [0, 60])
@pytest.mark.parametrize("corners", [0, 0.5])
@pytest.mark.parametrize(("noise", "grain"), [(0, 0), (2, 3), (5, 1.5), (10, 0)])
def test_walls_show_nothing(
    level: float, lit: float, corners: float, noise: float, grain: float
) -> None:
    assert shows_nothing(wall(level, lit, corners, noise, grain))


def test_nor_does_a_covered_lens() -> None:
    assert shows_nothing(np.zeros((384, 512), np.float32))
    assert shows_nothing(wall(3, 0, 0, 2, 0))
    assert shows_nothing(np.full((384, 512), 255, np.float32))


def spoiled(grey: np.ndarray) -> dict[str, np.ndarray]:
    """What may have become of a photograph of teeth."""
    soft = {blur: cv2.GaussianBlur(grey, (0, 0), blur * max(grey.shape) / 512) for blur in (6, 12)}
    return {
        "sharp": grey, "blurred": soft[6], "much blurred": soft[12], "dark": grey / 4,
        "dark and blurred": soft[6] / 4, "pale and blurred": 100 + soft[6] / 2,
    }  # fmt: skip


def check(photos: list[Path]) -> None:
    for path in photos:
        grey = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        scale = min(1.0, 512 / max(grey.shape))
        small = cv2.resize(grey, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
        for how, image in spoiled(small.astype(np.float32)).items():
            assert not shows_nothing(rounded(image)), (path.name, how)


def test_teeth_show_something_however_blurred_or_dark() -> None:
    photos = sorted(SAMPLES.rglob("*_buccal.jpg")) + sorted(SAMPLES.rglob("frontal.jpg"))
    assert len(photos) >= 3
    check(photos)


@pytest.mark.real_data
def test_real_photographs_show_something() -> None:
    if not DATA.is_dir():
        pytest.skip("the photographs are not here")
    check([*sorted((DATA / "triads").rglob("*.jpg")), *sorted((DATA / "castle").rglob("*.jpg"))])


def test_light_that_is_far_too_strong_leaves_white() -> None:
    grey = rounded(np.tile(np.linspace(0, 255, 200, dtype=np.float32), (50, 1)))
    assert white_share(grey) < BURNT_OUT < white_share(rounded(1.5 * grey))
