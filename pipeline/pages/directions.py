"""Directions to look from, and bringing cameras of two stages into one frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from pipeline.artifacts.cameras import Camera
from pipeline.geometry.rigid import angle_between
from pipeline.geometry.world import similarity_between

Array = npt.NDArray[np.float64]


def scene_frame(cameras: Sequence[Camera]) -> Array:
    """[3, 3] rotation from the world to a frame with the cameras' mean right, down and ahead."""
    if not cameras:
        return np.eye(3)
    ahead = np.mean([camera.rotation[2] for camera in cameras], axis=0)
    if np.linalg.norm(ahead) < 1e-3:  # cameras all around
        ahead = cameras[0].rotation[2]
    ahead = ahead / np.linalg.norm(ahead)
    down = np.mean([camera.rotation[1] for camera in cameras], axis=0)
    down = down - (down @ ahead) * ahead
    if np.linalg.norm(down) < 1e-3:
        down = cameras[0].rotation[1] - (cameras[0].rotation[1] @ ahead) * ahead
    down = down / np.linalg.norm(down)
    return np.stack([np.cross(down, ahead), down, ahead])


def three_quarter(frame: Array, azimuth: float = 35.0, elevation: float = 18.0) -> Array:
    """[3, 3] the frame turned to look from the side and from above, degrees."""
    a, e = np.radians(azimuth), np.radians(elevation)
    side = np.array([[np.cos(a), 0, np.sin(a)], [0, 1, 0], [-np.sin(a), 0, np.cos(a)]])
    above = np.array([[1, 0, 0], [0, np.cos(e), -np.sin(e)], [0, np.sin(e), np.cos(e)]])
    return np.asarray(above @ side @ frame)


@dataclass(frozen=True)
class Similarity:
    """new = scale * rotation @ old + shift."""

    scale: float
    rotation: Array
    shift: Array

    def points(self, points: npt.NDArray[np.floating]) -> Array:
        """Move points [N, 3]."""
        return np.asarray(
            self.scale * np.asarray(points, np.float64) @ self.rotation.T + self.shift
        )

    def camera_rotation(self, camera: Camera) -> Array:
        """[3, 3] the camera's rotation from the new world."""
        return np.asarray(camera.rotation @ self.rotation.T)


def similarity_onto(cameras: Sequence[Camera], targets: Sequence[Camera]) -> Similarity:
    """`similarity_between`, to be applied to points and cameras."""
    return Similarity(*similarity_between(cameras, targets))


def movement(
    cameras: Sequence[Camera], targets: Sequence[Camera]
) -> list[tuple[str, float, float]]:
    """How far each camera moved: (view, degrees, percent of the largest distance of two cameras).

    Args:
        cameras, targets: before and after, by any order; views that both have are compared.
    """
    after = {camera.name: camera for camera in targets}
    pairs = [(camera, after[camera.name]) for camera in cameras if camera.name in after]
    if not pairs:
        return []
    onto = similarity_onto([a for a, _ in pairs], [b for _, b in pairs])
    goals = np.array([b.centre for _, b in pairs])
    size = float(np.linalg.norm(goals[:, None] - goals[None], axis=-1).max()) or 1.0
    found = []
    for before, goal in pairs:
        turn = angle_between(onto.camera_rotation(before), goal.rotation)
        shift = float(np.linalg.norm(onto.points(before.centre[None])[0] - goal.centre))
        found.append((before.name, turn, 100 * shift / size))
    return found


def frustum(camera: Camera, onto: Similarity | None, depth: float) -> Array:
    """The 5 corners [5, 3] of a camera's pyramid in the world: centre, then the image's corners."""
    halves = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * (
        camera.width / 2 / camera.fx, camera.height / 2 / camera.fy,
    )  # fmt: skip
    local = np.vstack([np.zeros(3), np.column_stack([halves, np.ones(4)]) * depth])
    moved = onto or Similarity(1.0, np.eye(3), np.zeros(3))
    rotation = moved.camera_rotation(camera)
    return np.asarray(local @ rotation + moved.points(camera.centre[None]))
