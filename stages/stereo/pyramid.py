"""Images at half, a quarter... of their size, for a sweep from coarse to fine."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
import numpy.typing as npt

from pipeline.artifacts.cameras import Camera

Array = npt.NDArray[np.float32]

#: Least long side of a level in pixels, and least number of planes: below, windows span whole teeth
#: and what is found says little about where to look in the next level.
LEAST_SIDE = 200
LEAST_PLANES = 24


@dataclass(frozen=True)
class Level:
    """A view at one size.

    Attributes:
        camera: at that size.
        gray: [H, W] float32 in 0..1.
        usable: [H, W] bool.
    """

    camera: Camera
    gray: Array
    usable: npt.NDArray[np.bool_]


def level_count(long_side: int, planes: int) -> int:
    """How often an image, and the number of planes in it, are halved."""
    count = 0
    while long_side >> (count + 1) >= LEAST_SIDE and planes >> (count + 1) >= LEAST_PLANES:
        count += 1
    return count


def planes_at(level: int, planes: int) -> int:
    """Planes of a level, for those of the full size (level 0)."""
    return -(-planes >> level)


def halved(level: Level) -> Level:
    """The level at half its size; pixels that are not usable are left out of the mean."""
    camera = level.camera
    size = max(camera.width // 2, 2), max(camera.height // 2, 2)
    weight = level.usable.astype(np.float32)
    share = cv2.resize(weight, size, interpolation=cv2.INTER_AREA)
    mean = cv2.resize(weight * level.gray, size, interpolation=cv2.INTER_AREA)
    x, y = size[0] / camera.width, size[1] / camera.height
    return Level(
        replace(
            camera, width=size[0], height=size[1], fx=camera.fx * x, fy=camera.fy * y,
            cx=camera.cx * x, cy=camera.cy * y,
        ),
        (mean / np.maximum(share, np.float32(1e-6))).astype(np.float32),
        share >= 0.5,
    )  # fmt: skip
