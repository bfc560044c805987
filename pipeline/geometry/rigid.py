"""Rigid motions: small ones by a twist, the nearest rotation, and the angle of one."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]


def skew(vector: Array) -> Array:
    """[3, 3] matrix of the cross product with a vector [3]."""
    x, y, z = vector
    return np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])


def exponential(twist: Array) -> tuple[Array, Array]:
    """Rotation [3, 3] and translation [3] of exp(twist), twist = (translation 3, rotation 3)."""
    angle = float(np.linalg.norm(twist[3:]))
    cross = skew(twist[3:])
    if angle < 1e-8:
        return np.eye(3) + cross, twist[:3] + 0.5 * cross @ twist[:3]
    a, b = np.sin(angle) / angle, (1 - np.cos(angle)) / angle**2
    c = (1 - a) / angle**2
    rotation = np.eye(3) + a * cross + b * cross @ cross
    return rotation, (np.eye(3) + b * cross + c * cross @ cross) @ twist[:3]


def moved_by(twist: Array, pose: Array) -> Array:
    """exp(twist) pose, for a pose [3, 4] or [4, 4]: a step of the camera in its own frame."""
    rotation, translation = exponential(twist)
    moved = pose.copy()
    moved[:3, :3] = rotation @ pose[:3, :3]
    moved[:3, 3] = rotation @ pose[:3, 3] + translation
    # rounding must not turn a rotation into something else over thousands of steps
    moved[:3, :3] = nearest_rotation(moved[:3, :3])
    return moved


def nearest_rotation(matrix: npt.NDArray[np.floating]) -> Array:
    """The rotation [3, 3] that a matrix [3, 3] comes nearest to (Frobenius norm; Arun 1987).

    For a sum of products b a^T this is the rotation that brings the a best onto the b.
    """
    u, _, vt = np.linalg.svd(matrix)
    return np.asarray(u @ np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vt))]) @ vt)


def rotation_angle(rotation: Array) -> Array:
    """Angle in radians of rotations [..., 3, 3], exact for small ones too."""
    r = np.asarray(rotation, np.float64)
    sine = np.stack(
        [
            r[..., 2, 1] - r[..., 1, 2],
            r[..., 0, 2] - r[..., 2, 0],
            r[..., 1, 0] - r[..., 0, 1],
        ],
        -1,
    )
    trace = np.trace(r, axis1=-2, axis2=-1)
    return np.asarray(np.arctan2(np.linalg.norm(sine, axis=-1), trace - 1))


def angle_between(first: npt.NDArray[np.floating], second: npt.NDArray[np.floating]) -> float:
    """Degrees of the rotation that leads from one rotation [3, 3] to the other."""
    return float(np.degrees(rotation_angle(np.asarray(first) @ np.asarray(second).T)))
