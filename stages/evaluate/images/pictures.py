"""Pictures for people: photograph, render and error side by side."""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt

Image = npt.NDArray[np.uint8]
Mask = npt.NDArray[np.bool_]

#: Width in pixels of the white gap between the pictures.
GAP = 6
#: Grey of the pixels that do not count in the error map.
_MASKED = 96


def error_map(render: Image, photo: Image, largest: float, mask: Mask | None = None) -> Image:
    """Colour the mean absolute error of the channels: black for 0, pale yellow for `largest`.

    Args:
        render, photo: [H, W, 3] uint8.
        largest: the error, in 0..1, that gets the brightest colour.
        mask: [H, W] pixels that count; the others turn grey.

    Returns:
        [H, W, 3] uint8 RGB.
    """
    error = np.abs(render.astype(np.float64) - photo.astype(np.float64)).mean(-1) / 255
    level = np.rint(np.clip(error / largest, 0, 1) * 255).astype(np.uint8)
    colored = np.asarray(cv2.applyColorMap(level, cv2.COLORMAP_INFERNO))[..., ::-1]
    if mask is not None:
        colored = np.where(mask[..., None], colored, np.uint8(_MASKED))
    return np.ascontiguousarray(colored, np.uint8)


def comparison(render: Image, photo: Image, largest: float, mask: Mask | None = None) -> Image:
    """Put photograph | render | error map side by side.

    Args:
        render, photo: [H, W, 3] uint8.
        largest: see `error_map`.
        mask: [H, W] pixels that count, or None for all.

    Returns:
        [H, 3 W + 2 GAP, 3] uint8 RGB.
    """
    gap = np.full((photo.shape[0], GAP, 3), 255, np.uint8)
    return np.concatenate([photo, gap, render, gap, error_map(render, photo, largest, mask)], 1)


def spread(count: int, most: int) -> list[int]:
    """Indices of at most `most` of `count` items, spread evenly, first and last among them."""
    if count <= most:
        return list(range(count))
    return sorted(set(np.linspace(0, count - 1, most).round().astype(int).tolist()))
