"""A world that a viewer can stand upright: centred, scaled, its axes along the cameras'."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]


def world_similarity(poses: list[Array], points: Array) -> tuple[float, Array, Array]:
    """The similarity that leads to the normalised world.

    Its origin is the median of the points; the median depth of the points in the cameras is 1; y
    points down in the photographs, z along the mean viewing direction, x to the right.

    Args:
        poses: [4, 4] cam_from_world of each camera.
        points: [P, 3].

    Returns:
        scale, rotation [3, 3], centre [3]: ``new = scale * rotation @ (old - centre)``.
    """
    centre = np.median(points, axis=0)
    depths = [(points @ pose[2, :3] + pose[2, 3]) for pose in poses]
    in_front = np.concatenate([depth[depth > 0] for depth in depths])
    scale = 1.0 / float(np.median(in_front))
    down = np.sum([pose[1, :3] for pose in poses], axis=0)
    forward = np.sum([pose[2, :3] for pose in poses], axis=0)
    if np.linalg.norm(down) < 1e-3 * len(poses):
        down = poses[0][1, :3]
    down = down / np.linalg.norm(down)
    forward = forward - (forward @ down) * down
    if np.linalg.norm(forward) < 1e-3 * len(poses):  # cameras all around: the first one decides
        forward = poses[0][2, :3] - (poses[0][2, :3] @ down) * down
    if np.linalg.norm(forward) < 1e-6:  # it looks straight down
        forward = poses[0][0, :3] - (poses[0][0, :3] @ down) * down
    forward = forward / np.linalg.norm(forward)
    return scale, np.stack([np.cross(down, forward), down, forward]), centre


def moved_points(points: Array, scale: float, rotation: Array, centre: Array) -> Array:
    """Points [P, 3] in the world that the similarity leads to."""
    return np.asarray(scale * (points - centre) @ rotation.T)


def moved_pose(pose: Array, scale: float, rotation: Array, centre: Array) -> Array:
    """A [4, 4] cam_from_world for the world that the similarity leads to."""
    moved = np.eye(4)
    moved[:3, :3] = pose[:3, :3] @ rotation.T
    moved[:3, 3] = scale * (pose[:3, :3] @ centre + pose[:3, 3])
    return moved
