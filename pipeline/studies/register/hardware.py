"""Brackets and wires are no enamel: put on, taken off or renewed between visits, they say nothing
of what the tooth did."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np
import numpy.typing as npt

from pipeline.studies.register.visit import Look

Floats = npt.NDArray[np.float32]
Mask = npt.NDArray[np.bool_]

#: A visit has braces if they cover such a share of its crowns. Of a patient with braces .16, of 20
#: generated mouths with them .07 to .37; of eleven patients without .03 at most, all photographs
#: together, and of the generated mouths .03.
LEAST_SHARE = 0.06
#: How sure a pixel is hardware (0..1) from which on it counts, and how far around it surface and
#: shade are its as well, mm.
SURE, AROUND = 0.3, 0.4
#: Standard deviation of the blur that paints it over with what is around, mm.
PAINT = 1.0


def told_hardware(looks: Sequence[Look], pictures: Sequence[Floats]) -> list[Look]:
    """The photographs of a visit with braces, with what their brackets and wires cover.

    Args:
        looks: photographs, in mm.
        pictures: [H, W, 3] float32 sRGB in 0..1 of each.

    Returns:
        The looks, their `hardware` filled in; as they are where there are no braces.
    """
    masks = [_hardware(look, picture) for look, picture in zip(looks, pictures, strict=True)]
    covered = sum(
        int((mask & (look.labels > 0)).sum()) for mask, look in zip(masks, looks, strict=True)
    )
    crowns = sum(int((look.labels > 0).sum()) for look in looks)
    if covered < LEAST_SHARE * max(crowns, 1):
        return list(looks)
    return [
        replace(look, hardware=_grown(mask, AROUND * _density(look)))
        for mask, look in zip(masks, looks, strict=True)
    ]


def painted_over(look: Look) -> Floats:
    """[H, W] the photograph with the enamel around it in place of hardware."""
    if look.hardware is None or not _density(look):
        return look.image
    enamel = (look.enamel > 0).astype(np.float32)
    blur = (0, 0), PAINT * _density(look)
    mass = np.maximum(cv2.GaussianBlur(enamel, *blur), 1e-6)
    paint = cv2.GaussianBlur(look.image * enamel, *blur) / mass
    return np.where(look.hardware, paint, look.image).astype(np.float32)


def _density(look: Look) -> float:
    """Pixels per mm on the crowns; 0 where none is known."""
    depth = look.depth[(look.labels > 0) & (look.depth > 0)]
    return look.camera.fx / float(np.median(depth)) if len(depth) else 0.0


def _hardware(look: Look, picture: Floats) -> Mask:
    from stages.init.dental.surface.photos.tissue import find_hardware

    density = _density(look)
    if not density:
        return np.zeros(look.labels.shape, bool)
    lab = cv2.cvtColor(np.ascontiguousarray(picture, np.float32), cv2.COLOR_RGB2Lab)
    lab = (lab * np.array([2.55, 1, 1])).astype(np.float32)
    return np.asarray(find_hardware(lab, look.labels > 0, density) > SURE)


def _grown(mask: Mask, radius: float) -> Mask:
    size = 2 * max(round(radius), 1) + 1
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size))
    return np.asarray(cv2.dilate(mask.astype(np.uint8), disc) > 0)
