"""The frame that a reconstruction without known cameras is given in."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from pipeline.artifacts.cameras import Camera
from pipeline.geometry.rigid import nearest_rotation
from pipeline.geometry.similarity import moved_camera

Array = npt.NDArray[np.float64]


def normalising_similarity(
    cameras: Sequence[Camera], points: npt.NDArray[np.floating],
    downs: Sequence[Array] | None = None,
) -> tuple[float, Array, Array]:  # fmt: skip
    """Similarity to a world with y down, z ahead, centre at the points' median, median depth 1.

    Args:
        cameras: at least one.
        points: [N, 3] world points, at least one.
        downs: one direction [3] or more of the world that lead down, of length 1; None: those of
            the photographs, as if none of them were rolled.

    Returns:
        (scale, rotation [3, 3], translation [3]) of new = s R old + t.
    """
    down = np.mean([c.rotation[1] for c in cameras] if downs is None else list(downs), axis=0)
    ahead = np.mean([camera.rotation[2] for camera in cameras], axis=0)
    if np.linalg.norm(down) < 1e-3:
        down = np.asarray(cameras[0].rotation[1] if downs is None else downs[0])
    down = down / np.linalg.norm(down)
    ahead = ahead - (ahead @ down) * down
    if np.linalg.norm(ahead) < 1e-3:  # cameras all around: the first one decides
        ahead = cameras[0].rotation[2] - (cameras[0].rotation[2] @ down) * down
    if np.linalg.norm(ahead) < 1e-6:  # it looks straight down
        ahead = cameras[0].rotation[0] - (cameras[0].rotation[0] @ down) * down
    ahead = ahead / np.linalg.norm(ahead)
    rotation = np.stack([np.cross(down, ahead), down, ahead])
    # The median goes by axis, so it is taken along the new ones.
    centre = np.median(np.asarray(points, np.float64) @ rotation.T, axis=0)
    depth = np.median([camera.project(centre[None] @ rotation)[1][0] for camera in cameras])
    scale = 1.0 / max(float(abs(depth)), 1e-12)
    return scale, rotation, -scale * centre


def similarity_between(
    cameras: Sequence[Camera], targets: Sequence[Camera]
) -> tuple[float, Array, Array]:
    """Similarity that brings cameras onto others of the same views, as well as it goes.

    The turn is the mean of those of the cameras, so that two of them, or a straight line, are
    enough. Where all stand at one place the scale stays 1.

    Args:
        cameras, targets: the same views in the same order, at least one.

    Returns:
        (scale, rotation [3, 3], translation [3]) of target = s R camera + t.
    """
    centres = np.array([camera.centre for camera in cameras])
    goals = np.array([camera.centre for camera in targets])
    centre, goal = centres.mean(0), goals.mean(0)
    spread, wanted = (float(np.linalg.norm(a - b)) for a, b in ((centres, centre), (goals, goal)))
    scale = wanted / spread if min(spread, wanted) > 1e-12 else 1.0
    # Orientations: R_target = R_camera R^T; the nearest rotation to all of them.
    product = sum(b.rotation.T @ a.rotation for a, b in zip(cameras, targets, strict=True))
    rotation = nearest_rotation(np.asarray(product))
    return scale, rotation, goal - scale * rotation @ centre


def move_camera(camera: Camera, motion: tuple[float, Array, Array]) -> Camera:
    """The camera in the world that (scale, rotation, translation) leads to, depths times scale."""
    return replace(camera, cam_from_world=moved_camera(camera.cam_from_world, *motion))


def scene_depth(points: npt.NDArray[np.floating], cameras: Iterable[Camera]) -> float | None:
    """Median over the cameras of the median depth of points [N, 3] ahead; None: nothing is."""
    depths = []
    for camera in cameras:
        z = np.asarray(points, np.float64) @ camera.rotation[2] + camera.translation[2]
        if (z > 0).any():
            depths.append(float(np.median(z[z > 0])))
    return float(np.median(depths)) if depths else None
