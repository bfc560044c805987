"""A chart seen by a camera: z-buffer of its mesh."""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt

from pipeline.kernels import helper, kernel
from stages.init.dental.surface.photos.photo import Photo

Array32 = npt.NDArray[np.float32]
Mask = npt.NDArray[np.bool_]

#: Share from which a sample counts as one of a mask's.
_HALF = 0.5


@helper
def draw_triangle(ax, ay, az, bx, by, bz, cx, cy, cz, corners, depth, values):  # type: ignore[no-untyped-def]
    """Draw a triangle into a z-buffer, for kernels.

    Args:
        ax, ay, az, ...: float64, pixel and z-depth of each corner, counter-clockwise as seen.
        corners: [3, K] float64 values at the corners; linear in the image between them.
        depth: [H, W] z-depth so far, 0: nothing; changed in place.
        values: [H, W, K] of what is nearest; changed in place.
    """
    area = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
    # Counter-clockwise is negative where y runs down; the rest is seen from behind.
    if area > -1e-9:
        return
    height, width = depth.shape
    left = max(int(np.ceil(min(ax, bx, cx) - 0.5)), 0)
    right = min(int(np.floor(max(ax, bx, cx) - 0.5)), width - 1)
    top = max(int(np.ceil(min(ay, by, cy) - 0.5)), 0)
    bottom = min(int(np.floor(max(ay, by, cy) - 0.5)), height - 1)
    for y in range(top, bottom + 1):
        for x in range(left, right + 1):
            px, py = x + 0.5, y + 0.5
            u = ((bx - px) * (cy - py) - (by - py) * (cx - px)) / area
            v = ((cx - px) * (ay - py) - (cy - py) * (ax - px)) / area
            w = 1.0 - u - v
            # A hair outside is inside: no cracks between neighbours.
            if u < -1e-6 or v < -1e-6 or w < -1e-6:
                continue
            z = 1.0 / (u / az + v / bz + w / cz)
            if depth[y, x] == 0.0 or z < depth[y, x]:
                depth[y, x] = z
                for k in range(values.shape[2]):
                    values[y, x, k] = u * corners[0, k] + v * corners[1, k] + w * corners[2, k]


@kernel(nogil=True)
def _raster(pixels, depths, used, depth, place):  # type: ignore[no-untyped-def]
    rows, cols = used.shape
    corners = np.zeros((3, 2))
    for i in range(rows - 1):
        for j in range(cols - 1):
            for half in range(2):
                i0, j0 = (i, j) if half == 0 else (i + 1, j)
                i1, j1 = (i + 1, j) if half == 0 else (i + 1, j + 1)
                i2, j2 = i, j + 1
                if not (used[i0, j0] and used[i1, j1] and used[i2, j2]):
                    continue
                if min(depths[i0, j0], depths[i1, j1], depths[i2, j2]) <= 1.0:
                    continue
                corners[0, 0], corners[0, 1] = j0, i0
                corners[1, 0], corners[1, 1] = j1, i1
                corners[2, 0], corners[2, 1] = j2, i2
                draw_triangle(
                    np.float64(pixels[i0, j0, 0]), np.float64(pixels[i0, j0, 1]),
                    np.float64(depths[i0, j0]),
                    np.float64(pixels[i1, j1, 0]), np.float64(pixels[i1, j1, 1]),
                    np.float64(depths[i1, j1]),
                    np.float64(pixels[i2, j2, 0]), np.float64(pixels[i2, j2, 1]),
                    np.float64(depths[i2, j2]),
                    corners, depth, place,
                )  # fmt: skip


def raster_chart(photo: Photo, points: Array32, used: Mask) -> tuple[Array32, Array32]:
    """Render a chart's mesh into a photograph.

    Args:
        photo: camera and size.
        points: [H, W, 3] float32 samples of the chart, mm.
        used: [H, W] bool; triangles with a corner that is not used are left out.

    Returns:
        z-depth [h, w] float32 (0: nothing) and the place on the chart [h, w, 2] float32:
        column, row.
    """
    pixels, depths = photo.project(points)
    depth = np.zeros(photo.size, np.float32)
    place = np.zeros((*photo.size, 2), np.float32)
    _raster(pixels, depths, used, depth, place)
    return depth, place


def at_places(samples: Mask | Array32, place: Array32) -> Mask:
    """[h, w] bool: whether samples [H, W] of a chart, 0..1, are more than half at places on it.

    Args:
        samples: of the chart.
        place: [h, w, 2] float32 column and row, of `raster_chart`.
    """
    x, y = np.ascontiguousarray(place[..., 0]), np.ascontiguousarray(place[..., 1])
    return np.asarray(cv2.remap(samples.astype(np.float32), x, y, cv2.INTER_LINEAR) > _HALF)


def sees(photo: Photo, nearest: Array32, points: Array32, tolerance: float) -> Mask:
    """[...] bool: points [..., 3] that project into the photograph and are not hidden.

    Args:
        photo: camera.
        nearest: [h, w] float32 z-depth of the nearest surface, 0 where there is none.
        points: positions, mm.
        tolerance: mm that a point may lie behind the nearest surface.
    """
    pixels, depth = photo.project(points)
    x = np.floor(pixels[..., 0]).astype(np.int64)
    y = np.floor(pixels[..., 1]).astype(np.int64)
    height, width = photo.size
    inside = (x >= 2) & (y >= 2) & (x < width - 2) & (y < height - 2) & (depth > 1)
    front = nearest[np.clip(y, 0, height - 1), np.clip(x, 0, width - 1)]
    return inside & ((front == 0) | (depth < front + np.float32(tolerance)))


def nearest_of(depths: list[Array32]) -> Array32:
    """[h, w] float32 least z-depth over several maps, 0 where all are 0."""
    stack = np.stack([np.where(d > 0, d, np.inf) for d in depths])
    least = stack.min(axis=0)
    return np.where(np.isfinite(least), least, 0).astype(np.float32)
