"""Brackets and wires are no enamel: put on, taken off or renewed between visits, they say nothing
of what the tooth did."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float32]
Labels = npt.NDArray[np.uint8]
Mask = npt.NDArray[np.bool_]

#: A visit has braces if they cover such a share of its crowns. Of a patient with braces .17, of 20
#: generated mouths with them .07 to .37; of eleven patients without .03 at most, all photographs
#: together, and of the generated mouths .03.
LEAST_SHARE = 0.06
#: How sure a pixel is hardware (0..1) from which on it counts, and how far around it surface and
#: shade are its as well, mm.
SURE, AROUND = 0.3, 0.4
#: Standard deviation of the blur that paints it over with what is around, mm.
PAINT = 1.0


def braces_in(
    pictures: Sequence[Floats], labels: Sequence[Labels], densities: Sequence[float]
) -> list[Mask] | None:
    """What brackets and wires cover in the photographs of a visit; None where there are no braces.

    Args:
        pictures: [H, W, 3] float32 sRGB in 0..1 of each photograph.
        labels: [H, W] uint8 of each, the number of the crown at each pixel, 0: none.
        densities: pixels per mm on the crowns of each; 0 where that is not known.

    Returns:
        [H, W] bool for each.
    """
    masks = [_hardware(*each) for each in zip(pictures, labels, densities, strict=True)]
    pairs = list(zip(masks, labels, strict=True))
    covered = sum(int((mask & (numbers > 0)).sum()) for mask, numbers in pairs)
    if covered < LEAST_SHARE * max(sum(int((k > 0).sum()) for k in labels), 1):
        return None
    return [_grown(mask, AROUND * near) for mask, near in zip(masks, densities, strict=True)]


def painted_over(image: Floats, hardware: Mask, enamel: Mask, density: float) -> Floats:
    """[H, W] a grey photograph with the enamel around it in place of hardware.

    Args:
        image: [H, W] float32.
        hardware, enamel: [H, W] bool.
        density: pixels per mm.
    """
    if not density:
        return image
    weight = enamel.astype(np.float32)
    blur = (0, 0), PAINT * density
    mass = np.maximum(cv2.GaussianBlur(weight, *blur), 1e-6)
    paint = cv2.GaussianBlur(image * weight, *blur) / mass
    return np.where(hardware, paint, image).astype(np.float32)


def _hardware(picture: Floats, labels: Labels, density: float) -> Mask:
    from stages.init.dental.surface.photos.tissue import eight_bit_lab, find_hardware

    if not density:
        return np.zeros(labels.shape, bool)
    return np.asarray(find_hardware(eight_bit_lab(picture), labels > 0, density) > SURE)


def _grown(mask: Mask, radius: float) -> Mask:
    from stages.init.dental.surface.photos.tissue import disc

    return np.asarray(cv2.dilate(mask.astype(np.uint8), disc(round(radius))) > 0)
