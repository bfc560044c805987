"""Black-and-white photographs: tinted, they look to the reader like the ones it knows."""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt

Array32 = npt.NDArray[np.float32]

#: Mean a and b (CIE Lab) of the labelled photographs of mouths where their lightness is 0, 5, ...
#: 100: `tools/reader/tint.py`.
TINT = np.array([
    [1.9, 9.5, 15.9, 18.2, 20.5, 23.0, 24.8, 25.9, 26.2, 25.6, 24.3,
     22.2, 20.1, 17.9, 15.8, 12.8, 9.8, 6.7, 4.1, 1.3, -0.4],
    [0.5, 3.5, 7.0, 9.8, 11.3, 13.8, 15.1, 15.7, 16.3, 16.6, 16.7,
     16.3, 16.3, 15.8, 15.2, 13.7, 11.8, 9.7, 7.5, 5.2, 1.5],
])  # fmt: skip


#: Mean distance of colours from grey (CIE ab) below which a picture has none: an X-ray, or, where
#: all have none, a black-and-white photograph.
_LEAST_COLOUR = 4.0


def has_colour(image: Array32) -> bool:
    """Whether a picture [H, W, 3] float32 sRGB has colour."""
    small = cv2.resize(image, (64, 64), interpolation=cv2.INTER_AREA)
    lab = cv2.cvtColor(np.clip(small, 0, 1), cv2.COLOR_RGB2Lab)
    return float(np.linalg.norm(lab[..., 1:], axis=-1).mean()) >= _LEAST_COLOUR


def tinted(image: Array32) -> Array32:
    """A photograph with the colours that mouths mostly have at its lightness.

    Args:
        image: [H, W, 3] float32 sRGB in 0..1.
    """
    lab = cv2.cvtColor(np.clip(image, 0, 1), cv2.COLOR_RGB2Lab)
    lightness = np.linspace(0, 100, TINT.shape[1])
    for channel, values in enumerate(TINT, 1):
        lab[..., channel] = np.interp(lab[..., 0], lightness, values)
    return np.asarray(np.clip(cv2.cvtColor(lab, cv2.COLOR_Lab2RGB), 0, 1), np.float32)
