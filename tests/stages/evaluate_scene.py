"""Cameras and a scene with known truth, for the tests of `evaluate`."""

from __future__ import annotations

import cv2
import numpy as np

from pipeline.artifacts.gaussians import Gaussians
from pipeline.geometry.rigid import exponential
from pipeline.geometry.similarity import moved_camera


def rotation(axis: tuple[float, float, float], degrees: float) -> np.ndarray:
    direction = np.array(axis, float) / np.linalg.norm(axis)
    return exponential(np.concatenate([np.zeros(3), np.radians(degrees) * direction]))[0]


def pose(turn: np.ndarray, centre: np.ndarray) -> np.ndarray:
    """cam_from_world [4, 4]."""
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = turn, -turn @ np.asarray(centre, float)
    return matrix


def arc(angles: list[float], distance: float = 10.0) -> np.ndarray:
    """Cameras on a circle about the origin, looking at it."""
    poses = []
    for angle in np.radians(angles):
        turn = rotation((0, 1, 0), np.degrees(angle))
        poses.append(pose(turn, turn.T @ (0, 0, -distance)))
    return np.array(poses)


def moved_world(poses: np.ndarray, scale: float, turn: np.ndarray, shift: np.ndarray) -> np.ndarray:
    return np.array([moved_camera(one, scale, turn, shift) for one in poses])


def textured_scene() -> Gaussians:
    """A wavy coloured wall of small opaque Gaussians."""
    random = np.random.default_rng(5)
    x, y = np.meshgrid(np.linspace(-1.3, 1.3, 70), np.linspace(-1, 1, 54))
    means = np.stack([x, y, 0.25 * np.sin(3 * x) * np.cos(2 * y)], -1).reshape(-1, 3)
    noise = cv2.GaussianBlur(random.uniform(-4, 5, (54, 70, 3)), (0, 0), 2.0)
    sh = np.zeros((len(means), 16, 3), np.float32)
    sh[:, 0] = noise.reshape(-1, 3)
    count = len(means)
    return Gaussians(
        means.astype(np.float32), np.tile([1, 0, 0, 0], (count, 1)).astype(np.float32),
        np.full((count, 3), np.log(0.03), np.float32), np.full(count, 3, np.float32), sh,
    )  # fmt: skip
