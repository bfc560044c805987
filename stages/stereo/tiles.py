"""The tiles of an image, each with the range of planes among which its depth is looked for."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float32]
Integers = npt.NDArray[np.int64]

#: Rows and columns of a tile, which is swept at once. Small: the depth in it varies little. With
#: the rim of the default window its rows are 32 pixels, whole registers.
TILE = (16, 28)
#: Planes added at either end of what the coarser level found: it is right within two of these
#: planes for 81 % of the pixels of a scan video, within four for 86 %, and hardly more beyond.
MARGIN = 4
#: Pixels of the coarser level around a tile that are asked too.
RING = 2
#: Share of these at either end that don't count: single pixels that went astray would have all of
#: the tile look everywhere.
STRAY = 0.02


class Buffer:
    """Memory for one volume after the other: fresh pages cost as much as the work done in them."""

    def __init__(self) -> None:
        self._values = np.empty(0, np.float32)

    def of(self, size: int) -> Array:
        """[size] float32 that hold anything; they end those before."""
        if size > len(self._values):  # room that is not used takes no pages
            self._values = np.empty(2 * size, np.float32)
        return self._values[:size]


@dataclass(frozen=True)
class Volume:
    """A number for every pixel at every plane of its tile's range.

    Attributes:
        values: [M] float32: tile after tile, in each the pixels of `TILE` row by row (of tiles
            that the image cuts as well), each with all planes of the tile's range.
        starts: [T] int64, where each tile's values begin.
        ranges: [T, 2] int64 for every tile, row by row, its first plane and the one after its last.
        shape: (H, W, D).
        tile: rows and columns of a tile.
    """

    values: Array
    starts: Integers
    ranges: Integers
    shape: tuple[int, int, int]
    tile: tuple[int, int] = TILE

    @classmethod
    def over(
        cls, ranges: Integers, shape: tuple[int, int, int], buffer: Buffer | None = None
    ) -> Volume:
        """One that holds anything: in a buffer, or in memory of its own."""
        sizes = TILE[0] * TILE[1] * (ranges[:, 1] - ranges[:, 0])
        ends = np.cumsum(sizes)
        return cls((buffer or Buffer()).of(int(ends[-1])), ends - sizes, ranges, shape)

    @classmethod
    def of(cls, whole: Array) -> Volume:
        """A volume [H, W, D] float32 with all of its planes: one tile."""
        height, width, planes = whole.shape
        starts, ranges = np.zeros(1, np.int64), np.array([[0, planes]], np.int64)
        return cls(
            np.ascontiguousarray(whole).ravel(), starts, ranges, whole.shape, (height, width)
        )

    def like(self, buffer: Buffer | None = None) -> Volume:
        """Another of the same pixels and planes, that holds anything."""
        return replace(self, values=(buffer or Buffer()).of(len(self.values)))

    @property
    def layout(self) -> tuple[Integers, Integers, tuple[int, int], tuple[int, int, int]]:
        """What kernels need beside the values to find their way."""
        return self.starts, self.ranges, self.tile, self.shape


def tile_grid(shape: tuple[int, int]) -> tuple[int, int]:
    """Rows and columns of the tiles that cover an image [H, W]."""
    return -(-shape[0] // TILE[0]), -(-shape[1] // TILE[1])


def full_ranges(shape: tuple[int, int], planes: int) -> Integers:
    """[T, 2] the range of all planes for every tile of an image [H, W]."""
    down, across = tile_grid(shape)
    return np.tile(np.array([0, planes], np.int64), (down * across, 1))


def ranges_around(
    position: Array, usable: npt.NDArray[np.bool_], shape: tuple[int, int], planes: int
) -> Integers:
    """The planes near those that a coarser level decided for.

    Args:
        position: [h, w] float32, of each pixel of the coarser level, where it lies between the
            first plane (0) and the last (1).
        usable: [h, w] bool, where that counts; where no pixel of a tile does, all of them do.
        shape: (H, W) of the image.
        planes: of the image.

    Returns:
        [T, 2] int64 for every tile of the image, row by row, its first plane and the one after its
        last.
    """
    down, across = tile_grid(shape)
    ranges = np.empty((down * across, 2), np.int64)
    high, wide = position.shape
    for tile in range(down * across):
        y, x = tile // across * TILE[0], tile % across * TILE[1]
        rows = _around(y, min(y + TILE[0], shape[0]), high, shape[0])
        columns = _around(x, min(x + TILE[1], shape[1]), wide, shape[1])
        found = position[rows, columns]
        some = usable[rows, columns]
        values = np.sort(found[some] if some.any() else found, axis=None)
        stray = int(STRAY * len(values))
        ranges[tile, 0] = np.floor(values[stray] * (planes - 1)) - MARGIN
        ranges[tile, 1] = np.ceil(values[-1 - stray] * (planes - 1)) + MARGIN + 1
    return np.clip(ranges, [0, 1], [planes - 1, planes])


def _around(first: int, end: int, coarse: int, fine: int) -> slice:
    """The pixels of a coarser image that show those of a finer one, and `RING` more."""
    return slice(max(first * coarse // fine - RING, 0), -(-(end * coarse) // fine) + RING)
