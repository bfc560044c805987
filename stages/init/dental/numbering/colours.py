"""Do photographs show the same teeth and gums, by their colours?

One flash and one camera take a patient's photographs within a minute: whatever the exposure, enamel
and gum keep their hue, and their contrast to each other. Between patients all three differ.
"""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt

from pipeline.artifacts.teeth import Dentition

Array = npt.NDArray[np.float64]
Image = npt.NDArray[np.float32]

#: Median distances between photographs of one patient (CIE Lab; 12 patients of two clinics): hue of
#: the enamel, hue of the gum, and lightness of one over the other. Between patients: 8, 12 and 6.
ENAMEL_HUE, GUM_HUE, CONTRAST = 2.2, 4.2, 2.2
#: Enamel brighter than this is a highlight.
HIGHLIGHT = 95.0
#: The gum looked at lies between these distances from the teeth (shares of the band).
GUM_NEAR, GUM_FAR = 0.03, 0.12


def tissue_colours(image: Image, dentition: Dentition) -> Array | None:
    """[6] median CIE Lab of enamel and of the gum beside it; None where too little is seen.

    Args:
        image: [H, W, 3] float32 sRGB in 0..1.
        dentition: the teeth in it.
    """
    lab = cv2.cvtColor(np.ascontiguousarray(np.clip(image, 0, 1)), cv2.COLOR_RGB2Lab)
    teeth = dentition.mask.astype(np.uint8)
    inside = cv2.erode(teeth, np.ones((5, 5), np.uint8)) > 0
    enamel = inside & (lab[..., 0] < HIGHLIGHT)
    away = cv2.distanceTransform(1 - teeth, cv2.DIST_L2, 5) / max(dentition.band_height, 1.0)
    gum = (away > GUM_NEAR) & (away < GUM_FAR)
    if min(enamel.sum(), gum.sum()) < 50:
        return None
    return np.concatenate([np.median(lab[enamel], axis=0), np.median(lab[gum], axis=0)])


def colour_distances(images: list[Image], dentitions: list[Dentition]) -> list[float]:
    """How far each photograph's colours are from those of the other most like it.

    1 is what photographs of one patient differ by; 0 where nothing can be said.
    """
    colours = [tissue_colours(*pair) for pair in zip(images, dentitions, strict=True)]
    result = []
    for k, mine in enumerate(colours):
        others = [c for j, c in enumerate(colours) if j != k and c is not None]
        near = [] if mine is None else [_distance(mine, other) for other in others]
        result.append(min(near, default=0.0))
    return result


def _distance(a: Array, b: Array) -> float:
    enamel = np.hypot(a[1] - b[1], a[2] - b[2]) / ENAMEL_HUE
    gum = np.hypot(a[4] - b[4], a[5] - b[5]) / GUM_HUE
    contrast = ((a[0] - a[3]) - (b[0] - b[3])) / CONTRAST
    return float(np.sqrt(enamel**2 + gum**2 + contrast**2))
