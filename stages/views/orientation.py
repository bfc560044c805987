"""The eight EXIF orientations, as maps of pixel coordinates and of arrays."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]

#: EXIF orientation -> rows of the map to upright coordinates, in terms of (x, y, 1) of the stored
#: grid, where "w" and "h" stand for its size.
_ROWS: dict[int, tuple[tuple[int, int, str], tuple[int, int, str]]] = {
    1: ((1, 0, ""), (0, 1, "")),
    2: ((-1, 0, "w"), (0, 1, "")),
    3: ((-1, 0, "w"), (0, -1, "h")),
    4: ((1, 0, ""), (0, -1, "h")),
    5: ((0, 1, ""), (1, 0, "")),
    6: ((0, -1, "h"), (1, 0, "")),
    7: ((0, -1, "h"), (-1, 0, "w")),
    8: ((0, 1, ""), (-1, 0, "w")),
}
_INVERSE = {6: 8, 8: 6}


def upright_from_stored(orientation: int, width: int, height: int) -> Array:
    """[3, 3] affine map of pixel coordinates (centres at .5) from the stored grid to upright.

    Args:
        orientation: EXIF tag 0x0112, 1..8.
        width, height: of the stored grid.
    """
    size = {"": 0.0, "w": float(width), "h": float(height)}
    rows = [[float(a), float(b), size[c]] for a, b, c in _ROWS[orientation]]
    return np.array([*rows, [0.0, 0.0, 1.0]])


def make_upright(pixels: npt.NDArray[Any], orientation: int) -> npt.NDArray[Any]:
    """Turn a stored array [H, W, ...] upright."""
    if orientation >= 5:
        pixels = np.swapaxes(pixels, 0, 1)
    if orientation in (2, 3, 6, 7):
        pixels = pixels[:, ::-1]
    if orientation in (3, 4, 7, 8):
        pixels = pixels[::-1]
    return np.ascontiguousarray(pixels)


def make_stored(pixels: npt.NDArray[Any], orientation: int) -> npt.NDArray[Any]:
    """The inverse of `make_upright`."""
    return make_upright(pixels, _INVERSE.get(orientation, orientation))


def orientation_from_rotation(degrees_counterclockwise: float) -> int:
    """EXIF orientation that does what a film's display matrix does (quarter turns)."""
    quarter = round(degrees_counterclockwise / 90) % 4
    return (1, 8, 3, 6)[quarter]


def orientation_from_matrix(rows: tuple[tuple[float, float], tuple[float, float]]) -> int:
    """EXIF orientation nearest to a film's display matrix, which may also mirror.

    Args:
        rows: right and down of the upright picture, in terms of right and down of the stored one.
    """

    (a, c), (b, d) = rows

    def fit(orientation: int) -> float:
        right, down = _ROWS[orientation]
        return right[0] * a + right[1] * c + down[0] * b + down[1] * d

    return max(_ROWS, key=fit)
