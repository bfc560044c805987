"""Similarities, focal lengths and poses from pointmaps with confidence."""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]


def similarity(source: Array, target: Array, weight: Array) -> tuple[float, Array, Array]:
    """Weighted least-squares similarity: target ~ s R source + t.

    Umeyama, "Least-squares estimation of transformation parameters", PAMI 1991.

    Args:
        source, target: [N, 3] corresponding points.
        weight: [N] >= 0.

    Returns:
        Scale, rotation [3, 3], translation [3].

    Raises:
        ValueError: fewer than 3 points have weight.
    """
    if (weight > 0).sum() < 3:
        raise ValueError("a similarity needs at least three points")
    share = weight / weight.sum()
    mean_source, mean_target = share @ source, share @ target
    a, b = source - mean_source, target - mean_target
    u, singular, vt = np.linalg.svd((share[:, None] * b).T @ a)
    sign = np.array([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    rotation = (u * sign) @ vt
    scale = float(singular @ sign) / max(float(share @ (a**2).sum(1)), 1e-30)
    return scale, rotation, mean_target - scale * rotation @ mean_source


def robust_similarity(
    source: Array, target: Array, weight: Array, rounds: int = 10
) -> tuple[float, Array, Array]:
    """`similarity` of least weighted distance (not squared): reweighted, so that outliers fade."""
    scale, rotation, shift = similarity(source, target, weight)
    for _ in range(rounds):
        residual = np.linalg.norm(target - scale * source @ rotation.T - shift, axis=1)
        floor = max(1e-3 * float(np.median(residual[weight > 0])), 1e-12)
        current = weight / np.maximum(residual, floor)
        scale, rotation, shift = similarity(source, target, current)
    return scale, rotation, shift


def pixel_grid(height: int, width: int) -> Array:
    """[H, W, 2] pixel centres (u, v)."""
    v, u = np.mgrid[:height, :width] + 0.5
    return np.stack([u, v], -1)


def weiszfeld_focal(points: npt.NDArray[np.floating], weight: Array, rounds: int = 10) -> float:
    """Focal length of a centred pinhole camera from a pointmap in its own frame.

    Minimises the weighted sum of ||pixel - f (x/z, y/z)|| (DUSt3R, section 3.3): a least-squares
    start, then Weiszfeld's reweighting.

    Args:
        points: [H, W, 3] points in the camera frame.
        weight: [H, W] >= 0.
        rounds: reweightings.

    Returns:
        Focal length in pixels; 0 if no point is in front of the camera.
    """
    height, width = points.shape[:2]
    pixels = pixel_grid(height, width) - (width / 2, height / 2)
    good = (weight > 0) & (points[..., 2] > 1e-9)
    if not good.any():
        return 0.0
    local = np.asarray(points[good], np.float64)
    ray = local[:, :2] / local[:, 2:]
    target, base = pixels[good], weight[good]
    share = base
    focal = 0.0
    for _ in range(rounds + 1):
        focal = float((share * (ray * target).sum(1)).sum() / (share * (ray**2).sum(1)).sum())
        distance = np.linalg.norm(target - focal * ray, axis=1)
        share = base / np.maximum(distance, 1e-3)
    return focal


def pose_from_points(
    world: npt.NDArray[np.floating], weight: Array, focal: float, samples: int = 3000
) -> Array | None:
    """Pose of a centred pinhole camera from the world points of its pixels (RANSAC, SQPNP, 5 px).

    Args:
        world: [H, W, 3] world points.
        weight: [H, W]; only pixels of at least the median positive weight are used.
        focal: in pixels.
        samples: at most this many pixels, evenly spread.

    Returns:
        [4, 4] `cam_from_world`, or None if there is no pose that enough points support.
    """
    height, width = weight.shape
    good = weight > 0
    if good.sum() < 6:
        return None
    good &= weight >= np.median(weight[good])
    chosen = np.flatnonzero(good)
    chosen = chosen[:: max(1, len(chosen) // samples)]
    pixels = pixel_grid(height, width).reshape(-1, 2)[chosen]
    points = np.asarray(world, np.float64).reshape(-1, 3)[chosen]
    matrix = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1.0]])
    cv2.setRNGSeed(0)
    found, rotation, shift, inliers = cv2.solvePnPRansac(
        points, pixels, matrix, None, iterationsCount=200, reprojectionError=5.0,
        flags=cv2.SOLVEPNP_SQPNP,
    )  # fmt: skip
    if not found or inliers is None or len(inliers) < 6:
        return None
    pose = np.eye(4)
    pose[:3, :3] = cv2.Rodrigues(rotation)[0]
    pose[:3, 3] = shift.ravel()
    return pose
