"""One unrolled chart per jaw: the teeth as a single function of angle and height.

A chart gives the distance r(angle, y) from a vertical axis inside the arch. All views share it, so
that there is one layer by construction; two jaws need two charts, or the step between the upper
and the lower incisors is smeared.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

Array32 = npt.NDArray[np.float32]
Array64 = npt.NDArray[np.float64]

#: The axis lies this far behind the upper incisors' edges (mm): amid the curve of the front
#: teeth and still well inside the molars, so that lines from it meet every crown's outer face.
AXIS_DEPTH = 26.0
#: An angle times this is a length along the arch (mm): the typical distance of teeth from the axis.
MEAN_RADIUS = 30.0
#: No tooth lies further round than this.
WIDEST_ANGLE = np.radians(130.0)


@dataclass(frozen=True)
class ChartGrid:
    """Where the samples of a chart lie.

    Attributes:
        left: arc length (angle from straight ahead x `MEAN_RADIUS`, mm, positive towards the
            patient's left) of the first column.
        top: y of the first row, mm; rows run downwards.
        density: samples per mm, in both directions.
        shape: rows, columns.
    """

    left: float
    top: float
    density: float
    shape: tuple[int, int]

    @property
    def arcs(self) -> Array64:
        """[W] arc length of each column, mm."""
        return self.left + np.arange(self.shape[1]) / self.density

    @property
    def heights(self) -> Array64:
        """[H] y of each row, mm."""
        return self.top - np.arange(self.shape[0]) / self.density

    def points(self, radius: Array32) -> Array32:
        """[H, W, 3] float32 positions of a chart's samples, from its radius [H, W]."""
        angle = (self.arcs / MEAN_RADIUS).astype(np.float32)[None]
        height = np.broadcast_to(self.heights.astype(np.float32)[:, None], radius.shape)
        depth = radius * np.cos(angle) - np.float32(AXIS_DEPTH)
        return np.stack([radius * np.sin(angle), height, depth], -1).astype(np.float32)

    def radius_of(self, points: Array32) -> Array32:
        """Chart of samples that have been moved.

        Args:
            points: [H, W, 3] one position per sample, not far from where the sample was.

        Returns:
            [H, W] float32 radius at the samples' own angles and heights.
        """
        arc, radius = unroll(points)
        rows, cols = np.mgrid[: self.shape[0], : self.shape[1]].astype(np.float32)
        shift_x = ((arc - self.arcs[None]) * self.density).astype(np.float32)
        shift_y = ((self.heights[:, None] - points[..., 1]) * self.density).astype(np.float32)
        x, y = cols, rows
        # Fixed point: which sample has been moved to here?
        for _ in range(6):
            x, y = cols - _sample(shift_x, x, y), rows - _sample(shift_y, x, y)
        return _sample(radius.astype(np.float32), x, y)

    def resized(self, density: float) -> ChartGrid:
        """The same area with another density."""
        rows, cols = ((n - 1) / self.density * density for n in self.shape)
        return ChartGrid(self.left, self.top, density, (int(rows) + 1, int(cols) + 1))

    def resample(self, values: Array32, to: ChartGrid) -> Array32:
        """Values [H, W] or [H, W, C] float32 at the samples of another grid (linear)."""
        if to == self:
            return values
        x = ((to.arcs - self.left) * self.density).astype(np.float32)
        y = ((self.top - to.heights) * self.density).astype(np.float32)
        grid_x, grid_y = np.meshgrid(x, y)
        return _sample(np.ascontiguousarray(values, np.float32), grid_x, grid_y)


def _sample(values: Array32, x: Array32, y: Array32) -> Array32:
    return np.asarray(
        cv2.remap(values, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE), np.float32
    )


def unroll(points: npt.NDArray[np.floating]) -> tuple[Array64, Array64]:
    """Arc length (mm) and distance from the axis (mm) of points [..., 3]; the height is their y."""
    depth = points[..., 2] + AXIS_DEPTH
    angle = np.arctan2(points[..., 0], depth)
    return angle * MEAN_RADIUS, np.hypot(points[..., 0], depth)


def grid_around(points: Array64, margin: float, density: float) -> ChartGrid:
    """The grid of a chart that holds points [N, 3] and a margin (mm) all around."""
    arc, _ = unroll(points)
    widest = WIDEST_ANGLE * MEAN_RADIUS
    left = max(float(arc.min()) - margin, -widest)
    right = min(float(arc.max()) + margin, widest)
    top, bottom = float(points[:, 1].max()) + margin, float(points[:, 1].min()) - margin
    shape = (int((top - bottom) * density) + 1, int((right - left) * density) + 1)
    return ChartGrid(left, top, density, shape)


def normals_of(points: Array32) -> Array32:
    """Unit normals [H, W, 3] float32, away from the axis, of a chart's samples [H, W, 3]."""
    along = np.gradient(points, axis=1)
    down = np.gradient(points, axis=0)
    normal = np.cross(down, along)
    normal /= np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-9)
    return normal.astype(np.float32)


def faces_of(used: npt.NDArray[np.bool_]) -> npt.NDArray[np.int32]:
    """Triangles [F, 3] int32 (indices of samples, row by row) whose three corners are used [H, W].

    Counter-clockwise seen from outside.
    """
    index = np.arange(used.size, dtype=np.int32).reshape(used.shape)
    a, b, c, d = index[:-1, :-1], index[1:, :-1], index[:-1, 1:], index[1:, 1:]
    both = np.concatenate(
        [np.stack([a, b, c], -1).reshape(-1, 3), np.stack([b, d, c], -1).reshape(-1, 3)]
    )
    return both[used.ravel()[both].all(axis=1)]
