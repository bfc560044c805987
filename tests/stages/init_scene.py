"""Points on a bumpy surface photographed from an orbit: projections, noise, false matches."""

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from pipeline.geometry.rigid import angle_between
from stages.init.sfm.mapping import MappingInput
from stages.init.sfm.matching.two_view import Correspondences, Lens, coherent_matches

WIDTH, HEIGHT, FOCAL = 512, 384, 700.0


def orbit(angles):
    """Cameras that look at the origin from 5 away, at the yaw angles given (degrees)."""
    poses = []
    for angle in angles:
        pose = np.eye(4)
        pose[:3, :3] = Rotation.from_euler("xy", [4, angle], degrees=True).as_matrix()
        pose[:3, 3] = (0.1, 0, 5)
        poses.append(pose)
    return poses


def make_scene(angles, count=400, noise=0.3, false_share=0.2, seed=0, zoom=()):
    """Matches among all views of points on a bumpy surface, with noise and false matches.

    `zoom` is a factor of the focal length of each view.
    """
    rng = np.random.default_rng(seed)
    flat = rng.uniform(-1, 1, (count, 2)) * (1.6, 1.1)
    depth = 0.5 * np.sin(2 * flat[:, 0]) * np.cos(3 * flat[:, 1]) - 0.4 * flat[:, 0] ** 2
    points = np.column_stack([flat, depth])
    poses = orbit(angles)
    pixels = []
    for pose, factor in zip(poses, zoom or [1.0] * len(poses), strict=True):
        local = points @ pose[:3, :3].T + pose[:3, 3]
        exact = local[:, :2] / local[:, 2:] * FOCAL * factor + (WIDTH / 2, HEIGHT / 2)
        pixels.append(exact + rng.normal(0, noise, exact.shape))
    correspondences = {}
    for i in range(len(poses)):
        for j in range(i + 1, len(poses)):
            match = np.stack([np.arange(count)] * 2, 1)
            wrong = rng.random(count) < false_share
            match[wrong, 1] = rng.permutation(match[wrong, 1])
            pair = (pixels[i][match[:, 0]], pixels[j][match[:, 1]])
            correspondences[i, j] = Correspondences(match, *pair, coherent_matches(*pair, 40.0))
    given = MappingInput(
        lenses=[Lens(WIDTH, HEIGHT)],
        lens_of_view=[0] * len(poses),
        positions=pixels,
        points=[np.arange(count)] * len(poses),
        correspondences=correspondences,
    )
    return given, poses


def worst_rotation(solution, poses):
    """Largest error in degrees of the rotations between the first placed view and the others."""
    first, *others = sorted(solution.poses)
    return max(
        angle_between(
            solution.poses[k][:3, :3] @ solution.poses[first][:3, :3].T,
            poses[k][:3, :3] @ poses[first][:3, :3].T,
        )
        for k in others
    )


def texture(seed=0, size=(160, 200)):
    """Smooth random grey levels [H, W] uint8 of several scales."""
    rng = np.random.default_rng(seed)
    image = sum(cv2.GaussianBlur(rng.normal(0, 1, size), (0, 0), s) * s for s in (1, 2, 4))
    return np.clip(128 + 40 * image / image.std(), 0, 255).astype(np.uint8)
