"""Which views look at what a view shows from nearby."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from pipeline.artifacts.cameras import Camera

#: Points of a view that are asked where they are seen: enough for shares of a twentieth.
_ASKED = 400
#: A view that sees less of these than this share shows another part of the scene.
_LEAST_SHARE = 0.05


def nearest_views(
    index: int, cameras: list[Camera], points: npt.NDArray[np.floating], most: int
) -> npt.NDArray[np.int64]:
    """The views that see what one sees, under the smallest angles against it.

    Args:
        index: the view in question.
        cameras: V cameras.
        points: [M, 3] world points that it sees.
        most: how many views at most.

    Returns:
        Rising indices of other views; all of them where there are no more than `most`.
    """
    others = [view for view in range(len(cameras)) if view != index]
    if len(others) <= most or len(points) == 0:
        return np.array(others[:most] if len(points) == 0 else others, np.int64)
    some = np.asarray(points[:: -(-len(points) // _ASKED)], np.float64)
    rays = some - cameras[index].centre
    rays /= np.maximum(np.linalg.norm(rays, axis=1, keepdims=True), 1e-12)
    ranked = []
    for view in others:
        camera = cameras[view]
        pixels, depth = camera.project(some)
        seen = (depth > 0) & (pixels >= 0).all(1)
        seen &= (pixels < (camera.width, camera.height)).all(1)
        towards = some - camera.centre
        towards /= np.maximum(np.linalg.norm(towards, axis=1, keepdims=True), 1e-12)
        ranked.append((seen.mean() < _LEAST_SHARE, -np.median((rays * towards).sum(1)), view))
    return np.array(sorted(view for _, _, view in sorted(ranked)[:most]), np.int64)
