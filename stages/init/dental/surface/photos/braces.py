"""Whether photographs show braces, and what brackets and wires cover of the crowns."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
import numpy.typing as npt

from stages.init.dental.surface.photos.tissue import disc, eight_bit_lab, find_hardware

Floats = npt.NDArray[np.float32]
Mask = npt.NDArray[np.bool_]

#: Photographs show braces if these cover such a share of the crowns. Of a patient with braces .17,
#: of 20 generated mouths with them .07 to .37; of eleven patients without .03 at most, all
#: photographs together, and of the generated mouths .03.
LEAST_SHARE = 0.06
#: How sure a pixel is hardware (0..1) from which on it counts, and how far around it surface and
#: shade are its as well, mm.
SURE, AROUND = 0.3, 0.4


def braces_in(
    pictures: Sequence[Floats], crowns: Sequence[Mask], densities: Sequence[float]
) -> list[Mask] | None:
    """What brackets and wires cover in a patient's photographs; None where there are no braces.

    Args:
        pictures: [H, W, 3] float32 sRGB in 0..1 of each photograph.
        crowns: [H, W] bool of each.
        densities: pixels per mm on the crowns of each; 0 where that is not known.

    Returns:
        [H, W] bool for each.
    """
    masks = [_hardware(*each) for each in zip(pictures, crowns, densities, strict=True)]
    pairs = list(zip(masks, crowns, strict=True))
    covered = sum(int((mask & crown).sum()) for mask, crown in pairs)
    if covered < LEAST_SHARE * max(sum(int(crown.sum()) for crown in crowns), 1):
        return None
    return [_grown(mask, AROUND * near) for mask, near in zip(masks, densities, strict=True)]


def _hardware(picture: Floats, crowns: Mask, density: float) -> Mask:
    if not density:
        return np.zeros(crowns.shape, bool)
    return np.asarray(find_hardware(eight_bit_lab(picture), crowns, density) > SURE)


def _grown(mask: Mask, radius: float) -> Mask:
    return np.asarray(cv2.dilate(mask.astype(np.uint8), disc(round(radius))) > 0)
