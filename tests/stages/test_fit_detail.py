"""Gaussians that are split for detail, and the sizes at which they are."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest

from stages.fit.config import FitConfig, FitSettings, resolve
from stages.fit.inputs.scene import prepare
from stages.fit.numerics.detail import APART, SHRINK, divide, fine, wide_axes, within
from stages.fit.parts.detail import Detail
from stages.fit.parts.start import coarse_factors, reduction
from tests.stages.fit_case import case


def packed(count: int) -> np.ndarray:
    result = np.zeros((count, 14), np.float32)
    result[:, 3] = 1
    result[:, 0] = np.arange(count)
    result[:, 7:10] = np.log([0.4, 0.2, 0.05])
    result[:, 11] = np.arange(count)
    return result


def test_images_grow_by_halves_and_end_at_full_size() -> None:
    settings = resolve(FitConfig(iterations=100, coarse_fraction=0.6, coarse_factor=4), 3, 0, None)
    assert coarse_factors(settings) == [4, 2]
    factors = [reduction(settings, k, 100) for k in range(1, 101)]
    assert factors == [4] * 30 + [2] * 30 + [1] * 40


@pytest.mark.parametrize("changes", [{"coarse_fraction": 0.0}, {"coarse_factor": 1}])
def test_no_small_images_where_none_are_wanted(changes: dict) -> None:
    settings = resolve(FitConfig(**changes), 3, 0, None)
    assert not coarse_factors(settings)
    assert reduction(settings, 1, 100) == 1


def test_a_gaussian_is_split_along_the_axes_asked_for() -> None:
    axes = np.zeros((3, 3), bool)
    axes[1, 0] = True
    axes[2, :2] = True
    result, source, fresh = divide(packed(3), axes)
    assert source.tolist() == [0, 1, 1, 2, 2, 2, 2]
    assert not fresh[source == 0].any() and fresh[source > 0].all()
    one, four = result[source == 1], result[source == 2]
    np.testing.assert_allclose(sorted(one[:, 0]), [1 - 0.4 * APART, 1 + 0.4 * APART], atol=1e-6)
    np.testing.assert_allclose(np.exp(one[:, 7]), 0.4 * SHRINK, rtol=1e-5)
    np.testing.assert_allclose(np.exp(one[:, 8]), 0.2, rtol=1e-5)
    np.testing.assert_allclose(four[:, :3].mean(0), [2, 0, 0], atol=1e-6)
    assert len(np.unique(four[:, :2].round(5), axis=0)) == 4
    assert (result[:, 11] == source).all()


def test_a_turned_gaussian_is_split_along_its_own_axis() -> None:
    one = packed(1)
    one[0, 3:7] = np.cos(np.pi / 4), 0, 0, np.sin(np.pi / 4)  # x is y now
    result, _, _ = divide(one, np.array([[True, False, False]]))
    np.testing.assert_allclose(np.ptp(result[:, 1]), 2 * 0.4 * APART, atol=1e-6)
    np.testing.assert_allclose(np.ptp(result[:, 0]), 0, atol=1e-6)


def test_only_what_is_wide_on_the_screen_is_split_and_never_the_thinnest_axis() -> None:
    wide = wide_axes(packed(2), np.array([0.01, 0.5], np.float32), 0.5)
    assert wide.tolist() == [[True, True, False], [True, False, False]]


def test_the_largest_errors_come_first() -> None:
    axes = np.ones((4, 3), bool)
    axes[:, 2] = False
    chosen = within(axes, np.array([1.0, 4.0, 3.0, 2.0]), 7)
    assert chosen.any(1).tolist() == [False, True, True, False]


def test_an_error_that_is_even_over_several_pixels_is_not_fine() -> None:
    mask = np.zeros((40, 60), np.float32)
    mask[:, :30] = 1
    even = np.full((3, 40, 60), 0.3, np.float32)
    assert np.abs(fine(even, mask)[:, :, :30]).max() < 1e-5  # at the mask's border, too
    stripes = np.tile(np.where(np.arange(60) % 2, 0.1, -0.1).astype(np.float32), (3, 40, 1))
    kept = fine(even + stripes, np.ones_like(mask))[:, 8:-8, 8:-8]
    np.testing.assert_allclose(np.abs(kept), 0.1, atol=2e-3)


@dataclass
class Course:
    """As much of a fit as the times of splits depend on."""

    settings: FitSettings
    iteration: int = 0

    @property
    def iterations(self) -> int:
        return self.settings.iterations

    def reduction(self, iteration: int) -> int:
        return reduction(self.settings, iteration, self.iterations)


@pytest.mark.parametrize(
    ("changes", "views", "held", "expected"),
    [
        ({}, 3, True, [100, 130, 160]),
        ({}, 3, False, [280, 316, 352]),
        ({"iterations": 100}, 12, False, [70]),
        ({"iterations": 100, "coarse_factor": 4, "detail_rounds": 1}, 12, False, [35, 70, 88]),
        ({"iterations": 100, "coarse_fraction": 0.0}, 3, False, [30, 60]),
        ({"iterations": 100, "coarse_fraction": 0.0, "detail_rounds": 0}, 3, False, []),
    ],
)
def test_the_last_steps_let_what_was_split_settle(changes, views, held, expected) -> None:  # type: ignore[no-untyped-def]
    settings = resolve(FitConfig(**changes), views, 0, held)
    fit = Course(settings)
    part = Detail.__new__(Detail)
    part.settings = settings
    courses = [Course(settings, iteration) for iteration in range(fit.iterations)]
    found = [course.iteration for course in courses if part._due(course)]  # type: ignore[arg-type]
    assert found == expected
    assert not expected or expected[-1] <= 0.88 * fit.iterations


def test_a_start_from_more_points_for_larger_pictures() -> None:
    small, large = (
        resolve(FitConfig(), 3, 0, True, pixels).initial_points
        for pixels in (512 * 384, 1024 * 768)
    )
    assert large == 2 * small
    assert resolve(FitConfig(initial_points=77), 3, 0, True, 10**6).initial_points == 77


def test_what_lacks_detail_is_split_and_what_hides_goes() -> None:
    """Stripes on the left ask for finer Gaussians, a shade that is off on the right does not."""
    views, cameras, points = case()
    # a sheet without gaps
    wanted = FitConfig(detail_density=5.0, detail_error=0.02, initial_scale=1.5)
    settings = resolve(wanted, 3, 0)
    scene = prepare(views.views, cameras.cameras, points, None, settings)
    fit = scene.trainer(settings, False)
    middle = np.argsort(np.abs(fit.packed[:, :2]).max(1))[:40]
    hidden = fit.packed[middle].copy()
    hidden[:, 2] += 0.2  # behind the sheet for all of the cameras
    fit.packed = np.concatenate([fit.packed, hidden])
    fit.adam.select(np.arange(len(fit.packed)) % 3000, np.zeros(len(fit.packed), bool))
    for part in fit.parts:
        part.select(np.arange(len(fit.packed)) % 3000, np.zeros(len(fit.packed), bool))
    for view, target in enumerate(fit.targets):
        shown = fit.composited(view, fit.render(view))
        width = shown.shape[2]
        shown[:, :, : width // 2] += np.where(np.arange(width // 2) % 2, 0.2, -0.2)
        shown[:, :, width // 2 :] += 0.2
        target[1].colour.target[:] = shown
    before = fit.packed.copy()
    source = np.arange(len(before))
    replaced = fit.replace

    def followed(packed: np.ndarray, rows: np.ndarray, fresh: np.ndarray) -> None:
        nonlocal source
        source = source[rows]
        replaced(packed, rows, fresh)

    fit.replace = followed  # type: ignore[method-assign]
    part = fit.find(Detail)
    assert part is not None
    part._split(fit, 1)
    counts = np.bincount(source, minlength=len(before))
    assert not counts[-40:].any() and (counts[middle] > 0).mean() > 0.9
    left, right = (counts[:-40][side] for side in (before[:-40, 0] < -0.1, before[:-40, 0] > 0.1))
    assert (left > 1).mean() > 0.5 and (right > 1).mean() < 0.05
