"""How many pixels photographs are worth: a blurred one gains nothing from more of them."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
import numpy.typing as npt

from stages.photographs.sharpness import sharpness
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


def largest_size(number: int) -> int:
    """The largest of `SIZES` that so many photographs may have."""
    most = SIZES[0] * float(np.sqrt(min(1.0, PHOTOGRAPHS / max(number, 1))))
    return next((size for size in SIZES if size <= most), SIZES[-1])


def best_size(pictures: Sequence[Prepared]) -> int:
    """The largest of `SIZES` at which the photographs are sharp, and that their number allows.

    Args:
        pictures: at the size that their number allows, or larger; smaller ones count at theirs.
    """
    most = largest_size(len(pictures))
    greys: list[Floats] = []
    for size in SIZES[:-1]:
        if size > most:
            continue
        greys = greys or [picture.rgb.mean(-1, dtype=np.float32) for picture in pictures]
        if np.median([sharpness(_reduced(grey, size)) for grey in greys]) >= SHARP:
            return size
    return SIZES[-1]


def _reduced(grey: Floats, size: int) -> Floats:
    small = working_size(grey.shape[1], grey.shape[0], size)
    if small == grey.shape[1::-1]:
        return grey
    return np.asarray(cv2.resize(grey, small, interpolation=cv2.INTER_AREA))
