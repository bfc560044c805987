"""Brackets and wires are no enamel: put on, taken off or renewed between visits, they say nothing
of what the tooth did."""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float32]
Mask = npt.NDArray[np.bool_]

#: Standard deviation of the blur that paints it over with what is around, mm.
PAINT = 1.0


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
