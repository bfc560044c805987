"""What a finished fit does without."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pipeline.errors import ReconstructionError
from stages.fit.parts.density import before_lens, contribution
from stages.fit.stage import FitStage
from stages.splatting.rasterizer import Viewpoint, pack, rasterize
from tests.stages.fit_case import case, context

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
    empty = np.zeros_like(mask)
    empty[24:] = 1
    area, inside, unseen = contribution(rasterize(packed, VIEW, degree=0, near=0.05), mask, empty)
    assert area[0] > 10 and inside[0] == area[0]
    assert area[1] > 10 and inside[1] == 0
    assert 0.3 < inside[2] / area[2] < 0.7
    assert area[3] == inside[3] == unseen[3] == 0
    np.testing.assert_allclose(unseen, inside / 2, atol=0.01 * area.max())


def test_only_what_is_near_and_in_the_picture_is_before_the_lens() -> None:
    dot = (0.01, 0.01, 0.01)
    packed = gaussians([(0, 0, 0.2), (0, 0, 1), (5, 0, 0.2), (0, 0, -0.2)], [dot] * 4)
    assert before_lens(packed, [VIEW], [0.5]).tolist() == [True, False, False, False]


def with_a_dark_side(confidence: float):
    """Views of a surface that ends in the dark, and points that go on there."""
    views, cameras, points = case()
    dark = np.array([0.12, 0.05, 0.04], np.float32)
    shown = []
    for view in views.views:
        image = view.image.copy()
        image[:, 40:] = dark
        shown.append(replace(view, image=image))
    sure = np.where(points.positions[:, 0] < 5, np.float32(5), np.float32(confidence))
    return replace(views, views=tuple(shown)), cameras, replace(points, confidence=sure), dark


def test_a_fit_that_is_pruned_away_names_the_setting_that_may_have_done_it(tmp_path) -> None:
    with pytest.raises(ReconstructionError, match=r"fit\.final_prune_contribution or another"):
        FitStage().run(context(tmp_path, *case(), light="none", final_prune_contribution=1e6))


@pytest.mark.parametrize(
    ("confidence", "settings", "left"),
    [(1.2, {}, False), (1.2, {"final_prune_empty": 1.0}, True), (5.0, {}, True)],
    ids=["filled in", "kept", "measured"],
)
def test_nothing_is_left_where_photographs_show_the_background(
    tmp_path, confidence, settings, left
) -> None:
    views, cameras, points, dark = with_a_dark_side(confidence)
    asked = context(
        tmp_path, views, cameras, points, background=tuple(map(float, dark)), light="none",
        optimize_poses=False, **settings,
    )  # fmt: skip
    FitStage().run(asked)
    x = asked.result("gaussians").means[:, 0]
    assert (x < 0).sum() > 300
    assert bool((x > 20).any()) is left
