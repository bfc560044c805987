"""Do photographs show the same teeth and gums, by their colours?

One flash and one camera take a patient's photographs within a minute: whatever the exposure, enamel
and gum keep their hue, and their contrast to each other. Between patients all three differ. Where a
phone chooses a white balance for each photograph, hues say nothing any more: what stays is how much
darker the gum is than the enamel in each channel, which a gain for each channel does not change.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
import numpy.typing as npt

from pipeline.artifacts.teeth import Dentition
from stages.init.dental.surface.photos.braces import braces_in
from stages.photographs.srgb import linear

Array = npt.NDArray[np.float64]
Image = npt.NDArray[np.float32]
Mask = npt.NDArray[np.bool_]

#: Median distances between photographs of one patient (CIE Lab; 12 patients of two clinics): hue of
#: the enamel, hue of the gum, and lightness of one over the other. Between patients: 8, 12 and 6.
ENAMEL_HUE, GUM_HUE, CONTRAST = 2.2, 4.2, 2.2
#: Standard deviations between photographs of one patient (the same ones) of the logarithm of gum
#: over enamel: mean of the channels, green over red, blue over green.
LOG_CONTRASTS = np.array([0.157, 0.137, 0.069])
#: Enamel brighter than this is a highlight.
HIGHLIGHT = 95.0
#: A photograph of which more than this share of the teeth is so was lit too much (36 photographs of
#: twelve patients: .31 at most but for one of .58; a stop too bright half have .76 or more, a stop
#: and a half .83).
BURNT_OUT = 0.5
#: And one whose enamel has less than this share of the others' light was lit too little (the same
#: photographs: .5 to 2).
DARK_BESIDE = 0.4
#: The gum looked at lies between these distances from the teeth (shares of the band).
GUM_NEAR, GUM_FAR = 0.03, 0.12
#: From the upper to the lower gum line, mm: median of eight patients with permanent teeth (12 to
#: 17; of four children 9 to 10). It says how wide metal is that is looked for.
BAND = 14.0
#: Of fewer pixels nothing is said.
LEAST_PIXELS = 50
#: Light that counts as none, of 0..1.
DARK = 1e-4


@dataclass(frozen=True)
class Tissue:
    """What enamel and the gum beside it look like in a photograph.

    Attributes:
        lab: [6] median CIE Lab of either.
        contrasts: [3] logarithms of the gum's median over the enamel's in linear light: mean of the
            channels, green over red, blue over green.
    """

    lab: Array
    contrasts: Array


@dataclass(frozen=True)
class ColourDistance:
    """How far a photograph's colours are from those of the other most like it; 1 is what
    photographs of one patient differ by, 0 where nothing can be said.

    Attributes:
        one_light: if one light and one white balance took them all.
        any_light: whatever gain the camera gave each channel.
        white: share of its teeth that is as bright as a highlight.
        light: of its enamel over the median of the others', in linear light; 1 where nothing can
            be said.
    """

    one_light: float
    any_light: float
    white: float = 0.0
    light: float = 1.0


def tissue_colours(image: Image, dentition: Dentition, metal: Mask | None) -> Tissue | None:
    """Colours of enamel and of the gum beside it; None where too little is seen.

    Args:
        image: [H, W, 3] float32 sRGB in 0..1.
        dentition: the teeth in it.
        metal: [H, W] bool: brackets and wires, which are no enamel; None: there are none.
    """
    rgb = np.ascontiguousarray(np.clip(image, 0, 1))
    lab = cv2.cvtColor(rgb, cv2.COLOR_RGB2Lab)
    teeth = dentition.mask.astype(np.uint8)
    inside = _inside(dentition)
    enamel = inside & (lab[..., 0] < HIGHLIGHT)
    if metal is not None:
        enamel &= ~metal
    away = cv2.distanceTransform(1 - teeth, cv2.DIST_L2, 5) / max(dentition.band_height, 1.0)
    gum = (away > GUM_NEAR) & (away < GUM_FAR)
    # lips lie there too, and the dark of an open bite
    sure = gum & dentition.on_jaws_mask
    if sure.sum() >= LEAST_PIXELS:
        gum = sure
    if min(enamel.sum(), gum.sum()) < LEAST_PIXELS:
        return None
    logs = [np.log(np.maximum(linear(np.median(rgb[where], axis=0)), DARK))
            for where in (enamel, gum)]  # fmt: skip
    red, green, blue = logs[1] - logs[0]
    return Tissue(
        np.concatenate([np.median(lab[enamel], axis=0), np.median(lab[gum], axis=0)]),
        np.array([(red + green + blue) / 3, green - red, blue - green]),
    )


def white_share(image: Image, dentition: Dentition) -> float:
    """Share of the teeth in a photograph [H, W, 3] that is as bright as a highlight."""
    rgb = np.ascontiguousarray(np.clip(image, 0, 1))
    inside = cv2.cvtColor(rgb, cv2.COLOR_RGB2Lab)[..., 0][_inside(dentition)]
    return float((inside >= HIGHLIGHT).mean()) if inside.size else 0.0


def _inside(dentition: Dentition) -> Mask:
    """[H, W] where teeth are, but for their rim."""
    return cv2.erode(dentition.mask.astype(np.uint8), np.ones((5, 5), np.uint8)) > 0


def colour_distances(images: list[Image], dentitions: list[Dentition]) -> list[ColourDistance]:
    """How far each photograph's colours are from those of the other most like it.

    Of photographs with braces the nearer counts, with and without what is told to be metal: that is
    told by being darker and greyer than the enamel around, as shade between crowns may be.
    """
    found = [
        replace(distance, white=white_share(image, dentition))
        for distance, image, dentition in zip(
            _distances(images, dentitions, [None] * len(images)), images, dentitions, strict=True
        )
    ]
    crowns = [dentition.mask for dentition in dentitions]
    metal = braces_in(images, crowns, [dentition.band_height / BAND for dentition in dentitions])
    if metal is None:
        return found
    return [
        replace(a, one_light=min(a.one_light, b.one_light), any_light=min(a.any_light, b.any_light))
        for a, b in zip(found, _distances(images, dentitions, metal), strict=True)
    ]


def _distances(
    images: list[Image], dentitions: list[Dentition], metal: Sequence[Mask | None]
) -> list[ColourDistance]:
    tissues = [tissue_colours(*each) for each in zip(images, dentitions, metal, strict=True)]
    result = []
    for k, mine in enumerate(tissues):
        others = [t for j, t in enumerate(tissues) if j != k and t is not None]
        if mine is None or not others:
            result.append(ColourDistance(0.0, 0.0))
            continue
        result.append(
            ColourDistance(
                min(_distance(mine.lab, other.lab) for other in others),
                min(_contrast_distance(mine, other) for other in others),
                light=_light(mine) / max(float(np.median([_light(t) for t in others])), DARK),
            )
        )
    return result


def _light(tissue: Tissue) -> float:
    """Linear light of the enamel, of 0..1 (from its CIE lightness, but for the darkest)."""
    return float(((tissue.lab[0] + 16) / 116) ** 3)


def _distance(a: Array, b: Array) -> float:
    enamel = np.hypot(a[1] - b[1], a[2] - b[2]) / ENAMEL_HUE
    gum = np.hypot(a[4] - b[4], a[5] - b[5]) / GUM_HUE
    contrast = ((a[0] - a[3]) - (b[0] - b[3])) / CONTRAST
    return float(np.sqrt(enamel**2 + gum**2 + contrast**2))


def _contrast_distance(a: Tissue, b: Tissue) -> float:
    return float(np.linalg.norm((a.contrasts - b.contrasts) / LOG_CONTRASTS))
