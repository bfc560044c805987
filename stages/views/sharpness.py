"""How many pixels photographs are worth: a blurred one gains nothing from more of them.

In a sharp photograph the finest octave holds about as much as the next one, since the power of
natural images falls with the square of the frequency (Field 1987, "Relations between the statistics
of natural images and the response properties of cortical cells"). Where it holds clearly less, blur
or an enlargement has left it empty.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
import numpy.typing as npt

from stages.views.working import Prepared, working_size

Floats = npt.NDArray[np.float32]

#: longer sides to choose from, pixels: half an octave each; the least is what cameras and matches
#: need
SIZES = (1024, 724, 512)
#: so many photographs may have the largest size; more share its pixels, for the sake of time
PHOTOGRAPHS = 4
#: power of the finest octave over that of the next one from which a photograph is sharp. Of 44 real
#: photographs of teeth and houses 43 have .7 to 2.7 at 1024 pixels; enlarged from half of that, 40
#: of them have .35 to .7, and with a blur of 1.5 pixels all have .2 to .3.
SHARP = 0.7
#: power (of 0..255, squared) of an octave that holds nothing
BLANK = 1e-3
#: noise as by Immerkaer 1996, "Fast Noise Variance Estimation", by the median: edges are no noise
LAPLACE = np.array([[1, -2, 1], [-2, 4, -2], [1, -2, 1]], np.float32)
MEDIAN_TO_SIGMA = 1 / (6 * 0.6745)


def best_size(pictures: Sequence[Prepared]) -> int:
    """The largest of `SIZES` at which the photographs are sharp, and that their number allows.

    Args:
        pictures: at the largest size; smaller ones count at theirs.
    """
    most = SIZES[0] * float(np.sqrt(min(1.0, PHOTOGRAPHS / max(len(pictures), 1))))
    greys = [picture.rgb.mean(-1, dtype=np.float32) for picture in pictures]
    for size in SIZES[:-1]:
        if size > most:
            continue
        if np.median([sharpness(_reduced(grey, size)) for grey in greys]) >= SHARP:
            return size
    return SIZES[-1]


def sharpness(grey: Floats) -> float:
    """Power of an image's [H, W] finest octave over that of the next one, noise taken off both."""
    variance = (
        float(np.median(np.abs(cv2.filter2D(grey, cv2.CV_32F, LAPLACE)))) * MEDIAN_TO_SIGMA
    ) ** 2
    fine, coarse = (
        max(float(np.square(band).mean()) - gain * variance, 0.0)
        for band, gain in zip(_octaves(grey), NOISE_GAINS, strict=True)
    )
    return fine / coarse if coarse > BLANK else 0.0


def _octaves(image: Floats) -> tuple[Floats, Floats]:
    """The two finest bands of an image."""
    first = np.asarray(cv2.GaussianBlur(image, (0, 0), 1.0), np.float32)
    return image - first, first - np.asarray(cv2.GaussianBlur(image, (0, 0), 2.0), np.float32)


def _reduced(grey: Floats, size: int) -> Floats:
    small = working_size(grey.shape[1], grey.shape[0], size)
    if small == grey.shape[1::-1]:
        return grey
    return np.asarray(cv2.resize(grey, small, interpolation=cv2.INTER_AREA))


def _noise_gains() -> tuple[float, float]:
    """What is left of white noise of variance 1 in each band."""
    impulse = np.zeros((33, 33), np.float32)
    impulse[16, 16] = 1
    fine, coarse = _octaves(impulse)
    return float(np.square(fine).sum()), float(np.square(coarse).sum())


NOISE_GAINS = _noise_gains()
