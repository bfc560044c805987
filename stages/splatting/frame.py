"""Carrying a scene over to another frame by a similarity."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from pipeline.artifacts.cameras import Camera
from pipeline.artifacts.gaussians import Gaussians, Light
from pipeline.artifacts.points import Points
from pipeline.geometry.world import move_camera
from stages.splatting.harmonics import harmonics

Array = npt.NDArray[np.float64]


def split_similarity(similarity: Array) -> tuple[float, Array, Array]:
    """Scale, rotation [3, 3] and translation [3] of a similarity [4, 4].

    Raises:
        ValueError: it is not a similarity (shear, reflection, uneven or zero scale).
    """
    matrix = np.asarray(similarity, np.float64)
    scale = float(np.cbrt(np.linalg.det(matrix[:3, :3])))
    if not scale > 0 or not np.isfinite(matrix).all():
        raise ValueError("not a similarity: it mirrors the scene or flattens it")
    rotation = matrix[:3, :3] / scale
    if np.abs(rotation @ rotation.T - np.eye(3)).max() > 1e-6:
        raise ValueError("not a similarity: it stretches the scene unevenly")
    return scale, rotation, matrix[:3, 3]


def harmonics_rotation(rotation: Array) -> Array:
    """[16, 16] matrix that turns coefficients so that the colours turn with the scene.

    Each degree only mixes with itself; its block is found by solving for the coefficients at well
    spread directions, which is exact because the rotated functions lie in the same space.
    """
    golden = np.pi * (3 - np.sqrt(5))
    step = np.arange(64)
    height = 1 - (2 * step + 1) / 64
    ring = np.sqrt(1 - height**2)
    directions = np.stack([ring * np.cos(golden * step), ring * np.sin(golden * step), height], 1)
    here, before = harmonics(directions), harmonics(directions @ rotation)  # R^T d
    matrix = np.zeros((16, 16))
    for degree in range(4):
        block = slice(degree**2, (degree + 1) ** 2)
        matrix[block, block] = np.linalg.lstsq(here[:, block], before[:, block], rcond=None)[0]
    return matrix


def move_gaussians(gaussians: Gaussians, similarity: Array) -> Gaussians:
    """The Gaussians in the frame that `similarity` [4, 4] leads to."""
    scale, rotation, translation = split_similarity(similarity)
    if np.array_equal(similarity, np.eye(4)):
        return gaussians
    quats = Rotation.from_quat(gaussians.quats_wxyz[:, [1, 2, 3, 0]].astype(np.float64))
    turned = (Rotation.from_matrix(rotation) * quats).as_quat()[:, [3, 0, 1, 2]]
    means = scale * gaussians.means.astype(np.float64) @ rotation.T + translation
    turn = harmonics_rotation(rotation)
    sh = np.zeros_like(gaussians.sh)
    for degree in range(4):  # unused degrees stay exactly zero
        block = slice(degree**2, (degree + 1) ** 2)
        if np.any(gaussians.sh[:, block]):
            sh[:, block] = turn[block, block] @ gaussians.sh[:, block].astype(np.float64)
    return Gaussians(
        means=means.astype(np.float32),
        quats_wxyz=turned.astype(np.float32),
        log_scales=(gaussians.log_scales + np.float32(np.log(scale))).astype(np.float32),
        logit_opacities=gaussians.logit_opacities,
        sh=sh,
        light=_moved_light(gaussians.light, scale, rotation),
        background=gaussians.background,
    )


def _moved_light(light: Light | None, scale: float, rotation: Array) -> Light | None:
    if light is None:
        return None
    normals = (light.normals @ rotation.T).astype(np.float32)
    return replace(light, normals=normals, distance=scale * light.distance)


def move_cameras(cameras: Iterable[Camera], similarity: Array) -> tuple[Camera, ...]:
    """The cameras in the frame that `similarity` [4, 4] leads to; their pictures stay the same."""
    motion = split_similarity(similarity)
    return tuple(move_camera(camera, motion) for camera in cameras)


def move_points(points: Points, similarity: Array) -> Points:
    """The points in the frame that `similarity` [4, 4] leads to."""
    scale, rotation, translation = split_similarity(similarity)
    return replace(
        points,
        positions=(scale * points.positions @ rotation.T + translation).astype(np.float32),
        normals=(points.normals @ rotation.T).astype(np.float32),
        scale=(points.scale * scale).astype(np.float32),
    )
