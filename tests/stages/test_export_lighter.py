"""Fewer harmonics, and the same colours from where a scene was photographed."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from pipeline.artifacts.cameras import Camera
from pipeline.artifacts.gaussians import Gaussians
from stages.export.viewer.lighter import with_degree
from stages.splatting.rendering import seen_colors, used_degree

CENTRES = ([-3, 0, -5], [0, 0.5, -6], [3, 0, -5])


def camera(centre: list[float]) -> Camera:
    pose = np.hstack([np.eye(3), -np.array(centre, float)[:, None]])
    return Camera("a", 64, 48, 60.0, 60.0, 32.0, 24.0, pose)


def scene(count: int = 300, degree: int = 3) -> Gaussians:
    rng = np.random.default_rng(6)
    sh = np.zeros((count, 16, 3), np.float32)
    sh[:, 0] = rng.normal(0, 0.8, (count, 3))
    bands = (degree + 1) ** 2
    sh[:, 1:bands] = rng.normal(0, 0.1, (count, bands - 1, 3))
    turns = np.tile([1, 0, 0, 0], (count, 1)).astype(np.float32)
    return Gaussians(
        rng.uniform(-1, 1, (count, 3)).astype(np.float32), turns,
        np.full((count, 3), -3, np.float32), np.zeros(count, np.float32), sh,
    )  # fmt: skip


def off(made: Gaussians, true: Gaussians, centre: list[float]) -> float:
    """Root mean square of the colours' difference."""
    seen = (seen_colors(gaussians, camera(centre)) for gaussians in (made, true))
    return float(np.sqrt(np.mean(np.square(np.subtract(*seen)))))


def cut(gaussians: Gaussians, degree: int) -> Gaussians:
    sh = gaussians.sh.copy()
    sh[:, (degree + 1) ** 2 :] = 0
    return Gaussians(
        gaussians.means, gaussians.quats_wxyz, gaussians.log_scales, gaussians.logit_opacities, sh
    )


@pytest.mark.parametrize("degree", [1, 2])
def test_colours_stay_where_it_was_photographed_and_between(degree: int) -> None:
    true = scene()
    made = with_degree(true, [camera(list(c)) for c in CENTRES], degree)
    assert used_degree(made) == degree and used_degree(true) == 3
    between = [(np.array(a) + b) / 2 for a, b in pairwise(CENTRES)]
    for centre in (*CENTRES, *between):
        without = off(cut(true, degree), true, list(centre))
        assert off(made, true, list(centre)) < 0.25 * without
    beyond = [4.5, 0, -4]
    assert off(made, true, beyond) < off(cut(true, degree), true, beyond)


def test_all_else_stays_and_what_is_light_enough_stays_as_it_is() -> None:
    true, cameras = scene(), [camera(list(c)) for c in CENTRES]
    made = with_degree(true, cameras, 1)
    assert np.array_equal(made.means, true.means)
    assert np.array_equal(made.logit_opacities, true.logit_opacities)
    few = scene(degree=1)
    assert with_degree(few, cameras, 1) is few
    assert with_degree(true, cameras, 3) is true


def test_one_camera_is_enough() -> None:
    true = scene(20)
    made = with_degree(true, [camera([0, 0, -5])], 1)
    assert off(made, true, [0, 0, -5]) < 1e-2
