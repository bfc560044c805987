"""Image metrics. One code path for all figures: 8-bit images as written to disk, optional mask."""

from __future__ import annotations

import math

import cv2
import numpy as np
import numpy.typing as npt

from stages.evaluate.images.rows import by_rows

Image = npt.NDArray[np.uint8]
Mask = npt.NDArray[np.bool_]
Array = npt.NDArray[np.float64]

#: SSIM's window: a Gaussian of this sigma, cut to 11 x 11 pixels.
SSIM_SIGMA = 1.5
SSIM_WINDOW = 11
#: SSIM's constants for a dynamic range of 1.
SSIM_C1 = 0.01**2
SSIM_C2 = 0.03**2
#: Blur, in pixels, that takes the finest octave away, and its window.
FINE_SIGMA, FINE_WINDOW = 1.0, 9
#: Variance of rounding to 8 bits: less than that is no detail.
ROUNDING = 1 / 255**2 / 12


def psnr(image: Image, truth: Image, mask: Mask | None = None) -> float:
    """Peak signal-to-noise ratio, 10 log10(1 / mean squared error) with the range as 1.

    The error is averaged over pixels and channels, as in 3DGS and scikit-image.

    Args:
        image, truth: [H, W, 3] or [H, W] uint8.
        mask: [H, W] pixels that count; None for all.

    Returns:
        Decibels; infinite for equal images.

    Raises:
        ValueError: the shapes differ, or the mask has no pixel.
    """
    first, second = _pair(image, truth, mask)
    error = (first - second) ** 2
    mean = float((error if mask is None else error[mask]).mean())
    return math.inf if mean == 0 else -10.0 * math.log10(mean)


def detail(image: Image, truth: Image, mask: Mask | None = None) -> float | None:
    """How sharp an image is: the power of its fine detail over that of the truth's.

    Fine is what a blur of `FINE_SIGMA` takes away, in the mean of the channels: about the finest
    octave. It says nothing about whether that detail is in the right place, as PSNR and SSIM do.

    Args:
        image, truth: [H, W, 3] or [H, W] uint8.
        mask: [H, W] pixels that count, where all of their surroundings do; None for all.

    Returns:
        1 for equal images, below 1 for a softer one; None where the truth has no fine detail.

    Raises:
        ValueError: the shapes differ, or the mask has no pixel.
    """
    counted = np.ones(truth.shape[:2], bool) if mask is None else mask
    window = np.ones((FINE_WINDOW, FINE_WINDOW), np.uint8)
    counted = cv2.erode(counted.astype(np.uint8), window) > 0
    powers = []
    for pixels in _pair(image, truth, mask):
        grey = pixels if pixels.ndim == 2 else pixels.mean(2)
        fine = grey - cv2.GaussianBlur(grey, (FINE_WINDOW, FINE_WINDOW), FINE_SIGMA)
        powers.append(float(np.square(fine[counted]).mean()) if counted.any() else 0.0)
    return powers[0] / powers[1] if powers[1] > ROUNDING else None


def ssim(image: Image, truth: Image, mask: Mask | None = None) -> float:
    """Structural similarity (Wang et al., IEEE TIP 2004), the mean of `ssim_map`.

    Averaged over channels and over the pixels whose window lies inside the image, as scikit-image
    does with ``gaussian_weights=True, use_sample_covariance=False, sigma=1.5``. 3DGS has the same
    window and constants, but pads with black and averages up to the border.

    Args:
        image, truth: [H, W, 3] or [H, W] uint8.
        mask: [H, W] pixels that count; None for all.

    Returns:
        -1..1; 1 for equal images.

    Raises:
        ValueError: the shapes differ, or the mask has no pixel.
    """
    values = ssim_map(image, truth, mask)
    margin = SSIM_WINDOW // 2
    counted = np.ones(values.shape[:2], bool) if mask is None else mask
    if min(counted.shape) > 2 * margin:
        interior = counted[margin:-margin, margin:-margin]
        if interior.any():
            return float(values[margin:-margin, margin:-margin][interior].mean())
    return float(values[counted].mean())  # nothing but border: better than no figure


def ssim_map(image: Image, truth: Image, mask: Mask | None = None) -> Array:
    """SSIM per pixel and channel: (2 m m' + C1)(2 cov + C2) / ((m² + m'² + C1)(var + var' + C2)).

    Window 11 x 11, Gaussian of sigma 1.5, C1 = .01², C2 = .03² (range 1); borders reflected.
    With a mask the window's weights are those of the pixels inside it, renormalised, so that what
    lies outside has no influence.

    Returns:
        [H, W, 3] or [H, W] float64; outside the mask the values mean nothing.

    Raises:
        ValueError: the shapes differ, or the mask has no pixel.
    """
    _check(image, truth, mask)
    return by_rows(_ssim, SSIM_WINDOW // 2, image, truth, mask)


def _ssim(image: Image, truth: Image, mask: Mask | None) -> Array:
    first, second = _unit(image), _unit(truth)
    if mask is None:
        smooth = _window
    else:
        inside = mask.astype(np.float64)
        weight = np.maximum(_window(inside), 1e-12)
        if first.ndim == 3:
            inside, weight = inside[..., None], weight[..., None]

        def smooth(values: Array) -> Array:
            return np.asarray(_window(values * inside) / weight)

    mean_1, mean_2 = smooth(first), smooth(second)
    variance_1 = smooth(first * first) - mean_1 * mean_1
    variance_2 = smooth(second * second) - mean_2 * mean_2
    covariance = smooth(first * second) - mean_1 * mean_2
    similar = (2 * mean_1 * mean_2 + SSIM_C1) * (2 * covariance + SSIM_C2)
    scale = (mean_1**2 + mean_2**2 + SSIM_C1) * (variance_1 + variance_2 + SSIM_C2)
    return np.asarray(similar / scale)


def _window(values: Array) -> Array:
    size = (SSIM_WINDOW, SSIM_WINDOW)
    blurred = cv2.GaussianBlur(values, size, SSIM_SIGMA, borderType=cv2.BORDER_REFLECT)
    return np.asarray(blurred, np.float64)


def _pair(image: Image, truth: Image, mask: Mask | None) -> tuple[Array, Array]:
    _check(image, truth, mask)
    return _unit(image), _unit(truth)


def _unit(image: Image) -> Array:
    """Values of 8 bits as 0..1."""
    return image.astype(np.float64) / 255


def _check(image: Image, truth: Image, mask: Mask | None) -> None:
    if image.dtype != np.uint8 or truth.dtype != np.uint8:
        raise ValueError(f"metrics are of 8-bit images, not of {image.dtype} and {truth.dtype}")
    if image.shape != truth.shape:
        raise ValueError(f"images of different shape: {image.shape} and {truth.shape}")
    if mask is not None and (mask.shape != image.shape[:2] or not mask.any()):
        raise ValueError(f"the mask {mask.shape} fits no image {image.shape}, or is empty")
