"""Which views saw a place of the scene: it is in their picture, and nothing is before it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from pipeline.artifacts.cameras import Camera
from pipeline.kernels import each, kernel

Array = npt.NDArray[np.float64]
Bools = npt.NDArray[np.bool_]

#: Points that are looked up at a time.
_CHUNK = 16384


@dataclass(frozen=True)
class SeenSurface:
    """What one input view shows of the scene.

    Attributes:
        camera: of the view.
        depth: [H, W] rendered z; 0 where nothing is rendered or the pixel may not be used.
    """

    camera: Camera
    depth: npt.NDArray[np.float32]


def supporting_views(
    points: Array, surfaces: Sequence[SeenSurface], tolerance: float
) -> npt.NDArray[np.int64]:
    """How many input views saw each point: it is in their picture, and nothing is before it.

    Args:
        points: [N, 3] world.
        surfaces: of the input views.
        tolerance: relative difference of depth within which it is the same surface. The nearest of
            the four pixels around counts, so that edges do not.

    Returns:
        [N] counts.
    """
    count = np.zeros(len(points), np.int64)
    places = np.ascontiguousarray(points, np.float64)
    for surface in surfaces:
        camera = surface.camera
        each(
            _count_chunk, -(-len(places) // _CHUNK), places,
            np.ascontiguousarray(camera.cam_from_world, np.float64),
            np.array([camera.fx, camera.fy, camera.cx, camera.cy], np.float64),
            np.ascontiguousarray(surface.depth, np.float32), float(tolerance), count,
        )  # fmt: skip
    return count


@kernel(nogil=True)
def _count_chunk(  # type: ignore[no-untyped-def]
    chunk, points, pose, lens, depth, tolerance, count
):  # fmt: skip
    """Add one to `count` of those of some points that a view sees; see `supporting_views`."""
    height, width = depth.shape
    for i in range(chunk * _CHUNK, min(len(points), (chunk + 1) * _CHUNK)):
        x, y, z = points[i]
        ahead = pose[2, 0] * x + pose[2, 1] * y + pose[2, 2] * z + pose[2, 3]
        if not ahead > 0:
            continue
        across = pose[0, 0] * x + pose[0, 1] * y + pose[0, 2] * z + pose[0, 3]
        down = pose[1, 0] * x + pose[1, 1] * y + pose[1, 2] * z + pose[1, 3]
        u, v = lens[0] * across / ahead + lens[2], lens[1] * down / ahead + lens[3]
        if not (0 <= u < width and 0 <= v < height):
            continue
        left, top = int(np.floor(u - 0.5)), int(np.floor(v - 0.5))
        for column in (max(left, 0), min(left + 1, width - 1)):
            for row in (max(top, 0), min(top + 1, height - 1)):
                seen = np.float64(depth[row, column])
                if seen > 0 and abs(seen - ahead) < tolerance * ahead:
                    count[i] += 1
                    break
            else:
                continue
            break


def seen_surface(
    camera: Camera,
    depth: npt.NDArray[np.floating],
    rendered: Bools,
    valid: Bools,
) -> SeenSurface:
    """What an input view shows: its rendered depth [H, W], where it may be used.

    A pixel at the edge of a hole in the render has no sure depth: one pixel around is left out.
    """
    sure = cv2.erode((rendered & valid).astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    return SeenSurface(camera, np.where(sure, depth, 0).astype(np.float32))
