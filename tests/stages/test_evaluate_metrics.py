"""Image metrics on cases with a known answer, and against scikit-image."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt
import pytest

from stages.evaluate.images import rows
from stages.evaluate.images.flip import flip_map
from stages.evaluate.images.metrics import detail, psnr, ssim, ssim_map
from stages.evaluate.images.pictures import GAP, comparison, error_map, spread
from stages.evaluate.images.score import LARGEST_PSNR, score_view, summary_of

Image = npt.NDArray[np.uint8]


def noisy_pair(height: int = 61, width: int = 83, level: float = 20) -> tuple[Image, Image]:
    rng = np.random.default_rng(3)
    rows, columns = np.mgrid[:height, :width]
    base = (
        128 + 60 * np.sin(columns / 7.0)[..., None] * np.cos(rows / [5.0, 6.0, 9.0][0])[..., None]
    )
    truth = np.clip(base + rng.normal(0, 12, (height, width, 3)), 0, 255).astype(np.uint8)
    image = np.clip(truth + rng.normal(0, level, truth.shape), 0, 255).astype(np.uint8)
    return image, truth


@pytest.mark.parametrize("masked", [False, True])
@pytest.mark.parametrize("height", [rows.ROWS - 1, rows.ROWS, rows.ROWS + 1, 2 * rows.ROWS + 9])
def test_strips_of_a_picture_give_what_the_whole_does(
    height: int, masked: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    image, truth = noisy_pair(height)
    mask = np.random.default_rng(1).random(truth.shape[:2]) < 0.7 if masked else None
    strips = ssim_map(image, truth, mask), flip_map(image, truth)
    monkeypatch.setattr(rows, "ROWS", height)
    np.testing.assert_array_equal(strips[0], ssim_map(image, truth, mask))
    np.testing.assert_allclose(strips[1], flip_map(image, truth), atol=1e-6)


def test_psnr_of_a_known_error() -> None:
    truth = np.full((9, 7, 3), 100, np.uint8)
    # Every pixel is off by 51 = 0.2 of the range: 10 log10(1 / 0.04).
    assert psnr(truth + np.uint8(51), truth) == pytest.approx(13.979400, abs=1e-6)
    assert psnr(truth, truth) == math.inf


def test_psnr_counts_only_the_mask() -> None:
    truth = np.full((10, 10, 3), 100, np.uint8)
    image = truth.copy()
    image[:5] += 51
    image[5:] += 102
    top = np.zeros((10, 10), bool)
    top[:5] = True
    assert psnr(image, truth, top) == pytest.approx(13.979400, abs=1e-6)
    assert psnr(image, truth, ~top) == pytest.approx(-10 * math.log10(0.16), abs=1e-6)


def test_detail_is_the_share_of_the_power_that_is_left() -> None:
    """Half of a fine pattern's amplitude is a quarter of its power; what is even has no say."""
    checks = np.indices((40, 60)).sum(0) % 2 * 2 - 1
    truth, soft = (
        np.repeat((128 + size * checks)[..., None], 3, 2).astype(np.uint8) for size in (40, 20)
    )
    assert detail(truth, truth) == pytest.approx(1)
    assert detail(soft, truth) == pytest.approx(0.25, abs=1e-6)
    assert detail(soft + np.uint8(30), truth) == pytest.approx(0.25, abs=1e-6)
    assert detail(truth, np.full_like(truth, 128)) is None
    left = np.zeros((40, 60), bool)
    left[:, :30] = True
    half = np.where(left[..., None], soft, truth)
    assert detail(half, truth, left) == pytest.approx(0.25, abs=0.01)
    assert detail(half, truth, ~left) == pytest.approx(1, abs=0.01)


@pytest.mark.parametrize("level", [3, 20, 80])
@pytest.mark.parametrize("size", [(61, 83), (11, 40), (384, 256)])
def test_agrees_with_scikit_image(level: float, size: tuple[int, int]) -> None:
    metrics = pytest.importorskip("skimage.metrics")
    image, truth = noisy_pair(*size, level)
    expected = metrics.peak_signal_noise_ratio(truth, image, data_range=255)
    assert psnr(image, truth) == pytest.approx(expected, abs=1e-4)
    expected, expected_map = metrics.structural_similarity(
        truth, image, data_range=255, channel_axis=2, full=True,
        gaussian_weights=True, sigma=1.5, use_sample_covariance=False,
    )  # fmt: skip
    assert ssim(image, truth) == pytest.approx(expected, abs=1e-4)
    np.testing.assert_allclose(ssim_map(image, truth), expected_map, atol=1e-4)


def test_ssim_of_gray_images_agrees_too() -> None:
    metrics = pytest.importorskip("skimage.metrics")
    image, truth = (picture[..., 1] for picture in noisy_pair())
    expected = metrics.structural_similarity(
        truth, image, data_range=255,
        gaussian_weights=True, sigma=1.5, use_sample_covariance=False,
    )  # fmt: skip
    assert ssim(image, truth) == pytest.approx(expected, abs=1e-4)


def test_ssim_of_equal_images_is_one_and_of_flat_ones_known() -> None:
    image, _ = noisy_pair()
    assert ssim(image, image) == pytest.approx(1, abs=1e-12)
    dark, bright = np.full((30, 30, 3), 51, np.uint8), np.full((30, 30, 3), 204, np.uint8)
    # Without structure only the means compare: (2 * .2 * .8 + C1) / (.04 + .64 + C1).
    assert ssim(dark, bright) == pytest.approx((0.32 + 1e-4) / (0.68 + 1e-4), abs=1e-9)


def test_ssim_ignores_what_lies_outside_the_mask() -> None:
    image, truth = noisy_pair()
    mask = np.zeros(image.shape[:2], bool)
    mask[12:40, 20:60] = True
    spoiled_image, spoiled_truth = image.copy(), truth.copy()
    spoiled_image[~mask], spoiled_truth[~mask] = 255, 0
    assert ssim(spoiled_image, spoiled_truth, mask) == ssim(image, truth, mask)
    assert ssim(spoiled_image, spoiled_truth) < ssim(image, truth) - 0.1
    everything = np.ones_like(mask)
    assert ssim(image, truth, everything) == pytest.approx(ssim(image, truth), abs=1e-12)


def test_ssim_of_images_smaller_than_its_window() -> None:
    image, truth = noisy_pair(5, 30)
    assert -1 < ssim(image, truth) < 1
    assert ssim(truth, truth) == pytest.approx(1, abs=1e-12)


def test_metrics_refuse_what_they_cannot_compare() -> None:
    image, truth = noisy_pair()
    with pytest.raises(ValueError, match="different shape"):
        psnr(image[1:], truth)
    with pytest.raises(ValueError, match="8-bit"):
        ssim(image.astype(np.float32), truth)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="mask"):
        psnr(image, truth, np.zeros(image.shape[:2], bool))


def test_score_of_a_view() -> None:
    image, truth = noisy_pair()
    alpha = np.zeros(image.shape[:2], np.float32)
    alpha[:, : image.shape[1] // 2] = 0.9
    mask = np.ones(image.shape[:2], bool)
    figures = score_view(image, truth, alpha, mask)
    assert figures["psnr"] == psnr(image, truth)
    assert figures["coverage"] == pytest.approx((image.shape[1] // 2) / image.shape[1])
    assert figures["pixels"] == 1
    assert score_view(truth, truth, alpha, mask)["psnr"] == LARGEST_PSNR


def test_summary_is_the_mean_of_the_views_and_names_the_worst() -> None:
    views = {
        "000": {"psnr": 20.0, "ssim": 0.5, "coverage": 1.0, "pixels": 1.0},
        "001": {"psnr": 30.0, "ssim": 0.4, "coverage": 0.5, "pixels": 0.1},
    }
    summary = summary_of(views)
    assert summary["mean"] == pytest.approx({"psnr": 25.0, "ssim": 0.45, "coverage": 0.75})
    assert summary["worst"]["psnr"] == {"view": "000", "value": 20.0}
    assert summary["worst"]["ssim"] == {"view": "001", "value": 0.4}


def test_comparison_shows_photo_render_and_error() -> None:
    render, photo = noisy_pair(20, 30)
    mask = np.ones((20, 30), bool)
    mask[:, :10] = False
    picture = comparison(render, photo, 0.25, mask)
    assert picture.shape == (20, 3 * 30 + 2 * GAP, 3)
    np.testing.assert_array_equal(picture[:, :30], photo)
    np.testing.assert_array_equal(picture[:, 30 + GAP : 60 + GAP], render)
    error = picture[:, 60 + 2 * GAP :]
    assert (error[:, :10] == error[0, 0]).all()
    assert (error_map(photo, photo, 0.25).max(-1) < 10).all()  # no error is black
    assert (error_map(photo * 0, photo * 0 + 255, 0.25) > 100).all(-1).any()


def test_spread_keeps_the_ends() -> None:
    assert spread(3, 24) == [0, 1, 2]
    assert spread(100, 4) == [0, 33, 66, 99]
