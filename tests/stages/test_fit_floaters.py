"""What a finished fit does without."""

from __future__ import annotations

import numpy as np

from stages.fit.parts.density import before_lens, contribution
from stages.splatting.rasterizer import Viewpoint, pack, rasterize

VIEW = Viewpoint(
    np.eye(4, dtype=np.float32)[:3].copy(), np.array([50, 50, 32, 24], np.float32), 64, 48
)


def gaussians(means: list[tuple[float, float, float]], sigmas: list[tuple[float, float, float]]):
    count = len(means)
    quats = np.tile(np.array([1, 0, 0, 0], np.float32), (count, 1))
    return pack(
        np.array(means, np.float32), quats, np.log(np.array(sigmas, np.float32)),
        np.full(count, 3, np.float32), np.zeros((count, 1, 3), np.float32),
    )  # fmt: skip


def test_contribution_is_the_area_that_a_gaussian_colours() -> None:
    dot = (0.04, 0.04, 0.04)
    packed = gaussians(
        [(-0.3, 0, 1), (0.3, 0, 1), (0, 0, 1), (0, 0, -1)],  # left, right, on the border, behind
        [dot, dot, (0.3, 0.02, 0.02), dot],
    )
    mask = np.zeros((48, 64), np.float32)
    mask[:, :32] = 1
    area, inside = contribution(rasterize(packed, VIEW, degree=0, near=0.05), mask)
    assert area[0] > 10 and inside[0] == area[0]
    assert area[1] > 10 and inside[1] == 0
    assert 0.3 < inside[2] / area[2] < 0.7
    assert area[3] == inside[3] == 0


def test_only_what_is_near_and_in_the_picture_is_before_the_lens() -> None:
    dot = (0.01, 0.01, 0.01)
    packed = gaussians([(0, 0, 0.2), (0, 0, 1), (5, 0, 0.2), (0, 0, -0.2)], [dot] * 4)
    assert before_lens(packed, [VIEW], [0.5]).tolist() == [True, False, False, False]
