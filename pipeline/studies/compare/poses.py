"""Cameras of each stage and of COLMAP against the truth, or against each other."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from pipeline.artifacts.cameras import Camera
from pipeline.geometry.pose_metrics import pose_figures
from pipeline.geometry.rigid import rotation_angle
from pipeline.geometry.similarity import camera_similarity, moved_camera
from pipeline.geometry.world import scene_depth

Array = npt.NDArray[np.float64]
Motion = tuple[float, Array, Array]


def scene_distance(cameras: Mapping[str, Camera], points: npt.NDArray[np.floating] | None) -> float:
    """Median over the cameras of the median depth of points [N, 3] in front of them.

    Without points: the largest distance between two cameras.
    """
    depth = scene_depth(points, cameras.values()) if points is not None else None
    if depth is not None:
        return depth
    centres = np.array([camera.centre for camera in cameras.values()])
    return float(np.linalg.norm(centres[:, None] - centres[None], axis=-1).max())


def alignment(
    found: Mapping[str, Camera], reference: Mapping[str, Camera], distance: float
) -> Motion:
    """Similarity that brings cameras onto those of the same names, by centres and orientations.

    Args:
        distance: from the cameras to the scene, in the world of `found` (`camera_similarity`).

    Raises:
        ValueError: fewer than two names are common, or all common cameras are at one place.
    """
    names = [name for name in reference if name in found]
    if len(names) < 2:
        raise ValueError("two common cameras are needed")
    return camera_similarity(_stacked(found, names), _stacked(reference, names), distance)


def score(
    found: Mapping[str, Camera], reference: Mapping[str, Camera], distance: float, unit: str
) -> dict[str, Any]:
    """Pose and focal errors of cameras after similarity alignment.

    Returns:
        The figures of `pose_figures`, and ``relative_rotation_deg`` (errors of the rotations
        between all pairs of views, which no alignment enters) and ``focal_percent`` (median, with
        its sign); empty where fewer than two cameras are common.
    """
    names = [name for name in reference if name in found]
    try:
        motion = alignment(found, reference, distance)
    except ValueError:
        return {}
    truth = _stacked(reference, names)
    moved = np.array([moved_camera(pose, *motion) for pose in _stacked(found, names)])
    ratios = np.array([_focal(found[name]) / _focal(reference[name]) for name in names])
    between = np.degrees(
        [
            rotation_angle(
                moved[a, :3, :3] @ moved[b, :3, :3].T @ truth[b, :3, :3] @ truth[a, :3, :3].T
            )
            for a in range(len(names))
            for b in range(a)
        ]
    )
    return {
        **pose_figures(moved, truth, ratios, len(reference), unit),
        "relative_rotation_deg": {
            "median": float(np.median(between)),
            "mean": float(between.mean()),
            "max": float(between.max()),
        },
        "focal_percent": 100 * float(np.median(ratios - 1)),
    }


def _stacked(cameras: Mapping[str, Camera], names: list[str]) -> Array:
    return np.array([cameras[name].cam_from_world for name in names], np.float64)


def _focal(camera: Camera) -> float:
    return float(np.sqrt(camera.fx * camera.fy)) / max(camera.width, camera.height)


def focal_per_side(cameras: Mapping[str, Camera]) -> float:
    """Median focal length over the long side of the image."""
    return float(np.median([_focal(camera) for camera in cameras.values()]))
