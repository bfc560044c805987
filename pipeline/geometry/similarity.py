"""Similarities, focal lengths and poses from pointmaps with confidence."""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt

from pipeline.geometry.rigid import nearest_rotation

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


def camera_similarity(source: Array, target: Array, lever: float) -> tuple[float, Array, Array]:
    """Least-squares similarity between the worlds of cameras, by their centres and orientations.

    Centres alone leave the rotation open where they lie near a line, and fit any error away where
    they are few. So each camera's axes count too, as if points at a distance of `lever` along them
    had been seen: at the scene's distance, an error of the orientation and of the centre that move
    the picture alike weigh alike. The scale is of the centres alone.

    Args:
        source, target: [N, 4, 4] cam_from_world of the same cameras in two worlds; N >= 2.
        lever: distance in the source world, about that from cameras to scene.

    Returns:
        Scale, rotation [3, 3], translation [3] of target ~ s R source + t.

    Raises:
        ValueError: fewer than two cameras, or all at one place.
    """
    centres_a, centres_b = (
        -np.einsum("nji,nj->ni", poses[:, :3, :3], poses[:, :3, 3]) for poses in (source, target)
    )
    mean_a, mean_b = centres_a.mean(0), centres_b.mean(0)
    a, b = centres_a - mean_a, centres_b - mean_b
    spread_a, spread_b = float(np.sqrt((a**2).sum())), float(np.sqrt((b**2).sum()))
    if len(a) < 2 or spread_a <= 1e-12 * lever or spread_b == 0:
        raise ValueError("the cameras of a similarity must be at two places at least")
    turns = np.einsum("nji,njk->ik", target[:, :3, :3], source[:, :3, :3])
    rotation = nearest_rotation(b.T @ a * (spread_a / spread_b) + lever**2 * turns)
    scale = float((b * (a @ rotation.T)).sum()) / spread_a**2
    if scale <= 0:  # the orientations say the opposite of the centres
        scale = spread_b / spread_a
    return scale, rotation, mean_b - scale * rotation @ mean_a


def moved_camera(cam_from_world: Array, scale: float, rotation: Array, shift: Array) -> Array:
    """[4, 4] cam_from_world of the same camera after its world is moved: x -> s R x + t."""
    turned = cam_from_world[:3, :3] @ rotation.T
    pose = np.eye(4)
    pose[:3, :3] = turned
    pose[:3, 3] = scale * cam_from_world[:3, 3] - turned @ shift
    return pose


def pixel_grid(height: int, width: int) -> Array:
    """[H, W, 2] pixel centres (u, v)."""
    v, u = np.mgrid[:height, :width] + 0.5
    return np.stack([u, v], -1)


def weiszfeld_focal(
    points: npt.NDArray[np.floating],
    weight: Array,
    rounds: int = 10,
    pixels: Array | None = None,
) -> float:
    """Focal length of a centred pinhole camera from a pointmap in its own frame.

    As DUSt3R (section 3.3): least squares, then Weiszfeld's reweighting, so that the weighted sum
    of distances counts. Unlike there, x/z is fitted to pixel / f and not the reverse: the noise is
    in the points, and a regression on what is noisy makes the focal length too short (by 1.4 % at
    1 % of noise).

    Args:
        points: [..., 3] points in the camera frame, [H, W, 3] unless `pixels` are given.
        weight: [...] >= 0.
        rounds: reweightings.
        pixels: [..., 2] pixels from the principal point; None: a grid centred on it.

    Returns:
        Focal length in pixels; 0 if no point is in front of the camera.
    """
    if pixels is None:
        height, width = points.shape[:2]
        pixels = pixel_grid(height, width) - (width / 2, height / 2)
    good = (weight > 0) & (points[..., 2] > 1e-9)
    if not good.any():
        return 0.0
    local = np.asarray(points[good], np.float64)
    ray = local[:, :2] / local[:, 2:]
    target, base = pixels[good], weight[good]
    share = base
    inverse = 0.0
    for _ in range(rounds + 1):
        inverse = float(
            (share * (ray * target).sum(1)).sum()
            / max(float((share * (target**2).sum(1)).sum()), 1e-30)
        )
        distance = np.linalg.norm(ray - inverse * target, axis=1)
        share = base / np.maximum(distance, 1e-3 * float(np.median(np.abs(ray))) + 1e-12)
    return 1 / inverse if inverse > 1e-12 else 0.0


def pose_from_points(
    world: npt.NDArray[np.floating],
    weight: Array,
    focal: float,
    samples: int = 3000,
    pixels: Array | None = None,
) -> Array | None:
    """Pose of a centred pinhole camera from the world points of its pixels.

    SQPNP within RANSAC (5 px), then refined on all points by reweighted Gauss-Newton steps, since
    the points of a model may be much noisier than that.

    Args:
        world: [..., 3] world points, [H, W, 3] unless `pixels` are given.
        weight: [...]; only pixels of at least the median positive weight are used.
        focal: in pixels.
        samples: at most this many pixels, evenly spread.
        pixels: [..., 2] pixels from the principal point; None: a grid centred on it.

    Returns:
        [4, 4] `cam_from_world`, or None if there is no pose that enough points support.
    """
    if pixels is None:
        height, width = weight.shape
        pixels = pixel_grid(height, width) - (width / 2, height / 2)
    good = weight > 0
    if good.sum() < 6:
        return None
    good &= weight >= np.median(weight[good])
    chosen = np.flatnonzero(good)
    chosen = chosen[:: max(1, len(chosen) // samples)]
    image = np.ascontiguousarray(pixels.reshape(-1, 2)[chosen])
    points = np.asarray(world, np.float64).reshape(-1, 3)[chosen]
    matrix = np.diag([focal, focal, 1.0])
    cv2.setRNGSeed(0)
    found, rotation, shift, inliers = cv2.solvePnPRansac(
        points, image, matrix, None, iterationsCount=200, reprojectionError=5.0,
        flags=cv2.SOLVEPNP_SQPNP,
    )  # fmt: skip
    if not found or inliers is None or len(inliers) < 6:
        return None
    pose = np.eye(4)
    pose[:3, :3] = cv2.Rodrigues(rotation)[0]
    pose[:3, 3] = shift.ravel()
    return refined_pose(pose, points, image / focal)


def refined_pose(pose: Array, points: Array, rays: Array, rounds: int = 15) -> Array:
    """Improve a pose so that points [N, 3] project to rays [N, 2] (x/z, y/z).

    Huber's loss at the median residual, by reweighted Gauss-Newton steps.
    """
    pose = pose.copy()
    for _ in range(rounds):
        local = points @ pose[:3, :3].T + pose[:3, 3]
        ahead = local[:, 2] > 1e-9
        if ahead.sum() < 6:
            return pose
        x, y, z = local[ahead].T
        residual = np.stack([x / z, y / z], -1) - rays[ahead]
        size = np.linalg.norm(residual, axis=1)
        weight = np.sqrt(1 / np.maximum(size, max(float(np.median(size)), 1e-12)))
        zero = np.zeros_like(x)
        # Of (x/z, y/z) to a small rotation and shift in the camera frame.
        jacobian = np.stack(
            [
                np.stack([-x * y / z**2, 1 + (x / z) ** 2, -y / z, 1 / z, zero, -x / z**2], -1),
                np.stack([-1 - (y / z) ** 2, x * y / z**2, x / z, zero, 1 / z, -y / z**2], -1),
            ],
            1,
        )
        jacobian *= weight[:, None, None]
        step = np.linalg.lstsq(
            jacobian.reshape(-1, 6), -(weight[:, None] * residual).ravel(), rcond=None
        )[0]
        turn = cv2.Rodrigues(step[:3])[0]
        pose[:3, :3] = turn @ pose[:3, :3]
        pose[:3, 3] = turn @ pose[:3, 3] + step[3:]
        if np.abs(step[:3]).max() < 1e-9:
            break
    return pose
