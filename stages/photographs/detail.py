"""Whether a photograph shows anything at all, however blurred: a wall does not.

Blur takes the fine detail of a photograph of teeth, not its light and dark places; an even surface
has none of these. What is left of one, in a small copy, is slow: light that falls off to one side,
dark corners, a lamp. Low polynomials hold that.
"""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float32]

#: long side of the small copy, pixels, and blur in it: noise is evened out
SIDE, BLUR = 64, 1.0
#: degree of the polynomials (in x and y together) that light and dark corners may be
DEGREE = 4
#: standard deviation of the rest, in grey levels of 255 and as a share of the mean, below both of
#: which nothing is shown. 84 real photographs of teeth and houses leave 11 levels and .090 of the
#: mean or more, at 512 pixels with a blur of 12 pixels 8.0 and .064, of 20 pixels 5.9 and .046. The
#: share lets dark ones pass (a quarter of the light: 2.8 levels, .090), the levels pale ones (half
#: of the contrast, blur of 6 pixels: 5.0 levels, .031).
#: Of made walls (light from a side, dark corners or a lamp's spot; noise of up to 10 levels, in
#: grains of 1.5 pixels 5, of 3 pixels 2) 394 of 405 of 60 to 200 levels are below both, 76 of 135
#: of 20 levels, 108 of 135 of 245, which light from a side overexposes.
LEAST_LEVELS, LEAST_SHARE = 4.0, 0.045
#: and below which nothing is shown in any case: the noise of darkness has no mean to be a share of
DARKNESS = 0.5
#: grey level from which a place is white, nothing to be seen there, and the share of a photograph
#: that is so where it was lit too much: of 253 real photographs of teeth two have more than .07;
#: a stop and a half too bright half of 36 have .25 or more, four in five .1
WHITE, BURNT_OUT = 250, 0.1


def shows_nothing(grey: Floats) -> bool:
    """Is an image [H, W] in 0..255 an even surface, but for its light and its noise?"""
    scale = SIDE / max(grey.shape)
    size = (max(1, round(grey.shape[1] * scale)), max(1, round(grey.shape[0] * scale)))
    small = cv2.GaussianBlur(cv2.resize(grey, size, interpolation=cv2.INTER_AREA), (0, 0), BLUR)
    values = np.asarray(small, np.float64).ravel()
    y, x = np.mgrid[: size[1], : size[0]] + 0.5
    x, y = (2 * x / size[0] - 1).ravel(), (2 * y / size[1] - 1).ravel()
    slow = np.stack(
        [x**i * y**j for i in range(DEGREE + 1) for j in range(DEGREE + 1 - i)], axis=1
    )  # fmt: skip
    rest = values - slow @ np.linalg.lstsq(slow, values, rcond=None)[0]
    return bool(rest.std() < max(DARKNESS, min(LEAST_LEVELS, LEAST_SHARE * values.mean())))


def white_share(grey: Floats) -> float:
    """Share of an image [H, W] in 0..255 that is plain white."""
    return float((grey >= WHITE).mean())
