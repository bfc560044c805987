"""A photograph and a row of teeth for parts of the dense surface."""

from __future__ import annotations

import numpy as np

from stages.init.dental.landmarks import Landmark
from stages.init.dental.surface.chart.grid import AXIS_DEPTH
from stages.init.dental.surface.photos.photo import Photo


def photo(
    yaw: float = 0.0, size: tuple[int, int] = (60, 100), seed: int = 0, focal: float = 150.0
) -> Photo:
    a = np.radians(yaw)
    toward = np.array([np.sin(a), 0, np.cos(a)])
    rotation = np.stack([[np.cos(a), 0, -np.sin(a)], [0, -1, 0], -toward])
    translation = -rotation @ (100 * toward)
    camera = np.array(
        [*rotation.ravel(), *translation, focal, size[1] / 2, size[0] / 2], np.float64
    )
    rng = np.random.default_rng(seed)
    plain = np.zeros(size, np.float32)
    return Photo(
        index=0, camera=camera, size=size, density=focal / 100,
        image=np.zeros((*size, 3), np.float32),
        texture=rng.normal(size=size).astype(np.float32),
        upper=plain, lower=plain, upper_gum=plain, lower_gum=plain, dull=plain + 1,
        void=plain, covered=plain, hardware=plain,
        valid=np.ones(size, bool),
    )  # fmt: skip


def row_of_teeth() -> dict[Landmark, np.ndarray]:
    """Flat upper crowns 13 to 23 on a circle of 26 mm, 7 mm wide and 9 mm high."""
    marks = {}
    teeth = (13, 12, 11, 21, 22, 23)

    def at(angle: float, y: float, inward: float) -> np.ndarray:
        r = 26 - inward
        return np.array([r * np.sin(angle), y, r * np.cos(angle) - AXIS_DEPTH])

    for k, tooth in enumerate(teeth):
        angle = (k - 2.5) * 0.27
        marks[Landmark("zenith", tooth)] = at(angle, 9, 0)
        marks[Landmark("tip", tooth)] = at(angle, 0, 0)
        if k < 5:
            pair = (tooth, teeth[k + 1])
            marks[Landmark("papilla", *pair)] = at(angle + 0.135, 5, 1.5)
            marks[Landmark("embrasure", *pair)] = at(angle + 0.135, 1.5, 1.5)
    return marks
