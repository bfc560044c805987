"""Errors of camera poses against the truth, after both are in one world.

Sturm et al., "A benchmark for the evaluation of RGB-D SLAM systems", IROS 2012 (ATE, RPE); Jin et
al., "Image matching across wide baselines", IJCV 2021 (AUC of relative poses).
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from pipeline.geometry.rigid import rotation_angle

Array = npt.NDArray[np.float64]

#: Thresholds of the AUC, degrees.
AUC_DEGREES = (5, 10, 30)


def centres_of(poses: Array) -> Array:
    """[N, 3] projection centres of cam_from_world [N, 4, 4]."""
    return np.asarray(-np.einsum("nji,nj->ni", poses[:, :3, :3], poses[:, :3, 3]))


def rotation_errors(estimated: Array, truth: Array) -> Array:
    """[N] degrees between the orientations of aligned cam_from_world [N, 4, 4]."""
    between = np.einsum("nij,nkj->nik", estimated[:, :3, :3], truth[:, :3, :3])
    return np.asarray(np.degrees(rotation_angle(between)))


def position_errors(estimated: Array, truth: Array) -> Array:
    """[N] distances between the centres of aligned cam_from_world [N, 4, 4], in their unit."""
    return np.asarray(np.linalg.norm(centres_of(estimated) - centres_of(truth), axis=1))


def root_mean_square(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2)))


def rpe(estimated: Array, truth: Array) -> tuple[float, float]:
    """Relative pose error between each camera and the next, root mean square.

    E = (T_i^-1 T_i+1)^-1 (S_i^-1 S_i+1) with T true and S estimated world_from_cam (Sturm et al.,
    equation 2, delta = 1).

    Args:
        estimated, truth: [N, 4, 4] aligned cam_from_world in order; N >= 2.

    Returns:
        Rotation in degrees, translation in the unit of the poses.
    """
    moved = [poses[1:] @ np.linalg.inv(poses[:-1]) for poses in (estimated, truth)]
    # world_from_cam of i, inverted, times that of i + 1 is the inverse of `moved`
    errors = moved[1] @ np.linalg.inv(moved[0])
    turns = np.degrees(rotation_angle(errors[:, :3, :3]))
    return root_mean_square(turns), root_mean_square(np.linalg.norm(errors[:, :3, 3], axis=1))


def relative_errors(estimated: Array, truth: Array) -> Array:
    """Error of the relative pose of each pair of cameras, in degrees.

    The larger of the errors of rotation and of the direction of translation; both are free of any
    alignment. The sign of the direction counts, since the poses (unlike an essential matrix) have
    one.

    Args:
        estimated, truth: [N, 4, 4] cam_from_world.

    Returns:
        [N (N - 1) / 2], pairs in the order 01, 02, ..., 12, ...
    """
    errors = []
    for i in range(len(truth)):
        for j in range(i + 1, len(truth)):
            ours = estimated[j] @ np.linalg.inv(estimated[i])
            true = truth[j] @ np.linalg.inv(truth[i])
            turn = float(rotation_angle(ours[:3, :3] @ true[:3, :3].T))
            errors.append(max(turn, _angle(ours[:3, 3], true[:3, 3])))
    return np.degrees(np.array(errors, np.float64))


def _angle(a: Array, b: Array) -> float:
    """Radians between two vectors; 0 where the true one, b, has no direction."""
    if np.linalg.norm(b) < 1e-12:
        return 0.0
    return float(np.arctan2(np.linalg.norm(np.cross(a, b)), a @ b))


def auc(errors: Array, threshold: float) -> float:
    """Area under the curve of recall over error, from 0 to the threshold, as a share of it.

    Args:
        errors: [N]; infinite for a pair with a camera that was not placed.
        threshold: in the unit of the errors.

    Returns:
        0..1: the mean of 1 - error / threshold, or 0 where that is negative, which is the exact
        area under the steps of the recall.
    """
    return float(np.mean(np.maximum(1 - errors / threshold, 0)))


def _spread(values: Array) -> dict[str, float]:
    return {
        "median": float(np.median(values)),
        "mean": float(values.mean()),
        "max": float(values.max()),
    }


def pose_figures(
    estimated: Array, truth: Array, focal_ratios: Array, views: int, unit: str
) -> dict[str, Any]:
    """All figures of the poses.

    Args:
        estimated, truth: [N, 4, 4] cam_from_world of the placed views, in order, the estimated ones
            already aligned with the true ones; N >= 2.
        focal_ratios: [N] estimated over true focal length.
        views: how many views have a true camera; those that were not placed count as wrong in the
            AUC, and only there.
        unit: of the true world.

    Returns:
        See `metrics.json`: names carry their units; `translation_percent` is of the largest
        distance between true cameras.
    """
    centres = centres_of(truth)
    largest = float(np.linalg.norm(centres[:, None] - centres[None], axis=-1).max())
    distance = position_errors(estimated, truth)
    rpe_rotation, rpe_translation = rpe(estimated, truth)
    relative = relative_errors(estimated, truth)
    missing = views * (views - 1) // 2 - len(relative)
    relative = np.concatenate([relative, np.full(missing, np.inf)])
    return {
        "rotation_deg": _spread(rotation_errors(estimated, truth)),
        "translation_percent": _spread(100 * distance / largest),
        "ate_rmse": root_mean_square(distance),
        "ate_unit": unit,
        "rpe_rotation_deg": rpe_rotation,
        "rpe_translation": rpe_translation,
        **{f"auc_{degrees}": auc(relative, degrees) for degrees in AUC_DEGREES},
        "focal_error_percent": float(100 * np.median(np.abs(focal_ratios - 1))),
        "views": views,
        "placed": len(estimated),
    }
