"""As many pixels as the photographs are sharp for."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from stages.photographs.noise import noise_level
from stages.photographs.sharpness import UNSHARP, sharpness, weakest_direction
from stages.views.sharpness import SHARP, SIZES, best_size, largest_size
from stages.views.working import Prepared


def scene(seed: int, width: int = 1024, height: int = 768) -> np.ndarray:
    """[H, W] float32 0..255 with the spectrum of natural images."""
    random = np.random.default_rng(seed)
    fy, fx = np.fft.fftfreq(height)[:, None], np.fft.rfftfreq(width)[None]
    falloff = 1 / np.maximum(np.hypot(fx, fy), 1 / width) ** 1.3
    spectrum = falloff * np.exp(2j * np.pi * random.random(falloff.shape))
    image = np.fft.irfft2(spectrum, (height, width))
    return np.clip(128 + 40 * image / image.std(), 0, 255).astype(np.float32)


def picture(grey: np.ndarray) -> Prepared:
    rgb = np.repeat(np.rint(np.clip(grey, 0, 255)).astype(np.uint8)[..., None], 3, 2)
    return Prepared(rgb, None, np.eye(3), grey.shape[::-1], None)


def enlarged(grey: np.ndarray, factor: float) -> np.ndarray:
    size = grey.shape[::-1]
    small = cv2.resize(grey, None, fx=1 / factor, fy=1 / factor, interpolation=cv2.INTER_AREA)
    return np.asarray(cv2.resize(small, size, interpolation=cv2.INTER_CUBIC))


def test_sharp_photographs_are_used_at_full_size() -> None:
    assert best_size([picture(scene(k)) for k in range(3)]) == SIZES[0]


def test_blurred_and_enlarged_ones_are_not() -> None:
    blurred = [picture(cv2.GaussianBlur(scene(k), (0, 0), 3)) for k in range(3)]
    assert best_size(blurred) == SIZES[-1]
    assert best_size([picture(enlarged(scene(k), 4)) for k in range(3)]) == SIZES[-1]
    assert best_size([picture(enlarged(scene(k), 2)) for k in range(3)]) < SIZES[0]


def test_noise_is_no_sharpness() -> None:
    rng = np.random.default_rng(5)
    blurred = cv2.GaussianBlur(scene(1), (0, 0), 2.5)
    noisy = blurred + rng.normal(0, 3, blurred.shape).astype(np.float32)
    assert sharpness(noisy) < SHARP


def test_more_photographs_are_smaller() -> None:
    one = picture(scene(1))
    numbers = 3, 4, 6, 12, 24
    assert [best_size([one] * n) for n in numbers] == [1024, 1024, 724, 512, 512]
    assert [largest_size(n) for n in numbers] == [1024, 1024, 724, 512, 512]


@pytest.mark.parametrize("level", [0, 128, 255])
def test_a_blank_picture_has_no_detail(level: int) -> None:
    assert sharpness(np.full((90, 120), level, np.float32)) == 0


def test_noise_is_told_from_texture() -> None:
    rng = np.random.default_rng(5)
    v, u = np.mgrid[:120, :160].astype(np.float32)
    smooth = 0.5 + 0.2 * np.sin(u / 17 + v / 23)
    smooth[40:60, 40:90] = 0.9  # an edge is no noise
    noisy = smooth + rng.normal(0, 0.02, smooth.shape).astype(np.float32)
    everywhere = np.ones(smooth.shape, np.float32)
    assert noise_level(smooth, everywhere) < 0.001
    assert noise_level(noisy) == pytest.approx(0.02, rel=0.1)
    assert noise_level(noisy, everywhere) == pytest.approx(0.02, rel=0.1)
    assert noise_level(noisy, 0 * everywhere) == 0


def shaken(grey: np.ndarray, length: int, degrees: float) -> np.ndarray:
    """As if the camera had moved along a line while the shutter was open."""
    across = np.zeros((length, length), np.float32)
    across[length // 2] = 1 / length
    turn = cv2.getRotationMatrix2D((length / 2 - 0.5, length / 2 - 0.5), degrees, 1.0)
    kernel = cv2.warpAffine(across, turn, (length, length))
    return np.asarray(cv2.filter2D(grey, cv2.CV_32F, kernel / kernel.sum()))


@pytest.mark.parametrize("degrees", [0, 30, 45, 90, 130])
def test_a_shaken_camera_leaves_one_direction_empty(degrees: float) -> None:
    sharp = scene(3, 512, 384)
    assert weakest_direction(sharp) > 1.5 * UNSHARP
    assert weakest_direction(shaken(sharp, 9, degrees)) < UNSHARP
    assert weakest_direction(shaken(sharp, 31, degrees)) < UNSHARP


def test_out_of_focus_is_unsharp_in_all_directions_and_noise_does_not_hide_it() -> None:
    rng = np.random.default_rng(4)
    soft = cv2.GaussianBlur(scene(3, 512, 384), (0, 0), 2.5)
    noisy = soft + rng.normal(0, 2, soft.shape).astype(np.float32)
    assert weakest_direction(soft) < UNSHARP
    assert weakest_direction(noisy) < UNSHARP
    assert weakest_direction(np.full((90, 120), 128, np.float32)) == 0


@pytest.mark.parametrize("blur", [6, 12, 20])
def test_the_rounding_of_what_is_very_soft_is_no_detail(blur: float) -> None:
    soft = cv2.GaussianBlur(scene(3, 1024, 768), (0, 0), blur)
    assert weakest_direction(np.rint(soft)) < UNSHARP
    colours = np.rint(np.stack([soft, 0.7 * soft, 0.6 * soft], -1)).astype(np.uint8)
    grey = cv2.cvtColor(cv2.GaussianBlur(colours, (0, 0), 2), cv2.COLOR_RGB2GRAY)
    assert weakest_direction(grey.astype(np.float32)) < UNSHARP
