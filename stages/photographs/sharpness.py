"""How sharp a photograph is.

The power of natural images falls with the square of the frequency (Field 1987, "Relations between
the statistics of natural images and the response properties of cortical cells"): in a sharp
photograph each octave holds about as much as the next one. Where a fine one holds clearly less,
blur or an enlargement has left it empty; a shaken camera does so in one direction only.
"""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt

from stages.photographs.noise import noise_level

Floats = npt.NDArray[np.float32]

#: power (of 0..255, squared) of an octave that holds nothing
BLANK = 1e-3
#: directions that are looked at
DIRECTIONS = 8
#: bounds of a coarse octave and the finer one after it, cycles per pixel: what features are made of
COARSE, FINE = (0.06, 0.12), (0.12, 0.24)
#: `weakest_direction` below which features find nothing. 234 real photographs of teeth and houses
#: have .032 or more at 512 and 1024 pixels (95 % .041, half .08); with a blur of 1.5 pixels .008 to
#: .038, shaken by 9 or 21 pixels .004 to .037 (half of them less than .02)
UNSHARP = 0.035
#: power of an octave up to which it holds nothing: over that of noise, and by itself, for
#: `noise_level` does not see rounding where all else is smooth, whose steps are coarse. 84 real
#: photographs have 390 times their noise or more, with a tenth of the light 19, with noise of 10
#: levels 2. Of twelve of them blurred by 8 to 21 pixels all have less than 1, with a twentieth of
#: the light none has.
ONLY_NOISE, ROUNDING = 1.5, 1.0


def sharpness(grey: Floats) -> float:
    """Power of an image's [H, W] finest octave over that of the next one, noise taken off both."""
    variance = noise_level(grey) ** 2
    fine, coarse = (
        max(float(np.square(band).mean()) - gain * variance, 0.0)
        for band, gain in zip(_octaves(grey), NOISE_GAINS, strict=True)
    )
    return fine / coarse if coarse > BLANK else 0.0


def weakest_direction(grey: Floats) -> float:
    """Power density of fine detail over that of coarse, in the direction that has least of it.

    Args:
        grey: [H, W] in 0..255, at the size that features are found at.

    Returns:
        About 1/12 for a sharp photograph; 0 for a blank one.
    """
    height, width = grey.shape
    window = np.outer(np.hanning(height), np.hanning(width)).astype(np.float32)
    spectrum = np.abs(np.fft.rfft2((grey - grey.mean()) * window)) ** 2 / np.square(window).sum()
    noise = noise_level(grey) ** 2
    power = np.maximum(spectrum - noise, 0)
    least = max(ONLY_NOISE * noise, ROUNDING)
    down, right = np.fft.fftfreq(height)[:, None], np.fft.rfftfreq(width)[None]
    frequency = np.hypot(down, right)
    turn = (np.arctan2(down, right) % np.pi) / np.pi * DIRECTIONS
    direction = np.round(turn).astype(np.int64) % DIRECTIONS
    ratios = []
    for number in range(DIRECTIONS):
        coarse, fine = (
            (direction == number) & (low <= frequency) & (frequency < high)
            for low, high in (COARSE, FINE)
        )
        if not (coarse.any() and fine.any()) or spectrum[coarse].mean() <= least:
            return 0.0
        ratios.append(float(power[fine].mean() / power[coarse].mean()))
    return min(ratios)


def _octaves(image: Floats) -> tuple[Floats, Floats]:
    """The two finest bands of an image."""
    first = np.asarray(cv2.GaussianBlur(image, (0, 0), 1.0), np.float32)
    return image - first, first - np.asarray(cv2.GaussianBlur(image, (0, 0), 2.0), np.float32)


def _noise_gains() -> tuple[float, float]:
    """What is left of white noise of variance 1 in each band."""
    impulse = np.zeros((33, 33), np.float32)
    impulse[16, 16] = 1
    fine, coarse = _octaves(impulse)
    return float(np.square(fine).sum()), float(np.square(coarse).sum())


NOISE_GAINS = _noise_gains()
