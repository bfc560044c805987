"""From where a mouth is photographed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from anatomy import turn

from .mouth import Mouth

Array = npt.NDArray[np.float64]
ROLES = ("front", "right", "left", "upper", "lower")
#: Degrees from the front beyond which a photograph is one of a side.
SIDEWAYS = 20.0


@dataclass(frozen=True)
class Camera:
    """A pinhole camera without distortion.

    Attributes:
        width, height: of the picture, pixels.
        fx, fy, cx, cy: pixels; pixel centres at .5.
        cam_from_world: [4, 4] OpenCV camera from world, mm.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    cam_from_world: Array

    def project(self, points: Array) -> Array:
        """Pixels [N, 2] and depth: [N, 3] from world points [N, 3], mm."""
        local = points @ self.cam_from_world[:3, :3].T + self.cam_from_world[:3, 3]
        u = self.fx * local[:, 0] / local[:, 2] + self.cx
        v = self.fy * local[:, 1] / local[:, 2] + self.cy
        return np.stack([u, v, local[:, 2]], -1)

    def rays(self, pixels: Array) -> npt.NDArray[np.float32]:
        """[..., 6] origins and directions (1 long along the axis) through pixels [..., 2]."""
        u, v = pixels[..., 0], pixels[..., 1]
        local = np.stack([(u - self.cx) / self.fx, (v - self.cy) / self.fy, np.ones_like(u)], -1)
        rotation, translation = self.cam_from_world[:3, :3], self.cam_from_world[:3, 3]
        origin = np.broadcast_to(-rotation.T @ translation, local.shape)
        return np.concatenate([origin, local @ rotation], -1).astype(np.float32)


def role_at(yaw: float) -> str:
    """Role of a photograph taken so many degrees from the front, the patient's left positive."""
    if yaw < -SIDEWAYS:
        return "right"
    return "left" if yaw >= SIDEWAYS else "front"


def look(yaw: float, elevation: float, roll: float, distance: float, pivot: Array) -> Array:
    """[4, 4] camera from world that looks at a pivot (world, mm); angles in degrees.

    Yaw: positive from the patient's left. Elevation: positive from above.
    """
    flip = np.diag([1.0, -1.0, -1.0])
    matrix = np.eye(4)
    matrix[:3, :3] = turn(2, roll) @ flip @ turn(0, elevation) @ turn(1, -yaw)
    matrix[:3, 3] = -matrix[:3, :3] @ pivot + (0, 0, distance)
    return matrix


def random_camera(
    mouth: Mouth, role: str, opening: float, width: int, height: int, rng: np.random.Generator
) -> Camera:
    """A camera for a role that sees the teeth that such photographs show.

    Raises:
        ValueError: for an unknown role.
    """
    if role not in ROLES:
        raise ValueError(f"no such role: {role!r}; there are {ROLES}")
    centres = mouth.tooth_centres(opening)
    points = np.array(list(centres.values()))
    numbers = np.array(list(centres))
    upper = np.isin(numbers // 10, (1, 2, 5, 6))
    left = np.isin(numbers // 10, (2, 3, 6, 7))
    roll = float(rng.normal() * 3)
    elevation = float(rng.normal() * 6)
    if role == "front":
        yaw = float(np.clip(rng.normal() * 5, -10, 10))
        shown = (numbers % 10) <= int(rng.choice([3, 5, 7], p=[0.15, 0.35, 0.5]))
        fill = rng.uniform(0.72, 1.1)
    elif role in ("right", "left"):
        sign = 1.0 if role == "left" else -1.0
        yaw = sign * float(rng.uniform(35, 70))
        roll = float(np.clip(rng.normal() * 14, -45, 45))
        shown = (left == (role == "left")) & ((numbers % 10) <= int(rng.choice([5, 6, 7])))
        if rng.random() < 0.5:
            shown |= numbers % 10 <= 2
        fill = rng.uniform(0.75, 1.25)
    else:
        yaw = float(rng.normal() * 5)
        elevation = float(rng.uniform(50, 88)) * (-1 if role == "upper" else 1)
        roll = float(rng.normal() * 6) + (180.0 if rng.random() < 0.08 else 0.0)
        shown = upper == (role == "upper")
        fill = rng.uniform(0.6, 0.95)
    if not shown.any():
        shown[:] = True
    focus = points[shown]
    pivot = (focus.min(0) + focus.max(0)) / 2 + rng.normal(size=3) * 1.5
    distance = float(np.exp(rng.uniform(np.log(95), np.log(320))))
    view = look(yaw, elevation, roll, distance, pivot)
    flat = Camera(width, height, 1.0, 1.0, 0.0, 0.0, view).project(focus)
    low, high = flat[:, :2].min(0), flat[:, :2].max(0)
    margin = 5.0 / distance  # half a crown on either side
    span = high - low + 2 * margin
    focal = fill * min(width / span[0], height / (span[1] + 2 * margin))
    middle = (low + high) / 2 * focal
    slack = np.maximum(np.array([width, height]) - span * focal, 0) / 2
    jitter = rng.uniform(-0.8, 0.8, 2) * slack
    jitter += rng.normal(size=2) * 0.03 * np.array([width, height])
    cx, cy = np.array([width, height]) / 2 - middle + jitter
    return Camera(width, height, float(focal), float(focal), float(cx), float(cy), view)
