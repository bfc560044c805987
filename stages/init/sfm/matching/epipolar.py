"""How far matches are from where two cameras allow them to be: from their epipolar lines."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from pipeline.artifacts.cameras import Camera
from pipeline.geometry.rigid import skew

Array = npt.NDArray[np.float64]


def fundamental_between(camera_i: Camera, camera_j: Camera) -> Array:
    """[3, 3] fundamental matrix of two known cameras."""
    j_from_i = camera_j.cam_from_world @ np.linalg.inv(camera_i.cam_from_world)
    essential = skew(j_from_i[:3, 3]) @ j_from_i[:3, :3]
    return fundamental_of(essential, camera_i.matrix, camera_j.matrix)


def fundamental_of(essential: Array, matrix_i: Array, matrix_j: Array) -> Array:
    """[3, 3] fundamental matrix of an essential one and two calibration matrices."""
    return np.asarray(np.linalg.inv(matrix_j).T @ essential @ np.linalg.inv(matrix_i))


def sampson_distance(fundamental: Array, pixels_i: Array, pixels_j: Array) -> Array:
    """[M] first-order distance in pixels of matches [M, 2] from an epipolar geometry."""
    ones = np.ones((len(pixels_i), 1))
    first, second = np.hstack([pixels_i, ones]), np.hstack([pixels_j, ones])
    line_j, line_i = first @ fundamental.T, second @ fundamental
    steepness = np.sqrt((line_j[:, :2] ** 2).sum(1) + (line_i[:, :2] ** 2).sum(1))
    return np.asarray(np.abs((second * line_j).sum(1)) / np.maximum(steepness, 1e-12))
