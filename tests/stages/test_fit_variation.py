"""Total variation of colours: what it is, how it slopes, and what it is good for."""

from __future__ import annotations

import dataclasses

import numba
import numpy as np
import pytest
from scipy.spatial import cKDTree

from pipeline.artifacts.views import View, Views
from stages.fit.numerics.total_variation import TotalVariation
from stages.fit.stage import FitStage
from tests.stages.lit_fit_case import case, context

WEIGHT, NEIGHBOURS, TOLERANCE, UNIT = 0.7, 5, 0.05, 0.3


def scene(count: int = 300, seed: int = 1) -> tuple[np.ndarray, np.ndarray]:
    random = np.random.default_rng(seed)
    positions = random.uniform(-1, 1, (count, 3)) * [1, 1, 0.05]
    values = random.uniform(0.1, 0.9, (count, 60))
    return positions.astype(np.float32), values.astype(np.float32)


def textbook(positions: np.ndarray, values: np.ndarray) -> float:
    """Huber's loss, summed over pairs of which one is among the nearest of the other."""
    distance = np.linalg.norm(positions[:, None] - positions[None], axis=2)
    np.fill_diagonal(distance, np.inf)
    near = np.zeros(distance.shape, bool)
    order = np.argsort(distance, axis=1)[:, :NEIGHBOURS]
    np.put_along_axis(near, order, True, axis=1)
    i, j = np.nonzero(np.triu(near | near.T))
    d = UNIT * np.abs(values[i] - values[j])
    huber = np.where(d < TOLERANCE, d**2 / (2 * TOLERANCE), d - TOLERANCE / 2)
    return WEIGHT * float(huber.sum()) / (len(values) * NEIGHBOURS)


@pytest.mark.parametrize("columns", [3, 12, 27, 48])
def test_the_slope_is_that_of_the_formula(columns: int) -> None:
    positions, values = scene()
    last = 2 + columns
    gradient = np.zeros_like(values)
    variation = TotalVariation(WEIGHT, NEIGHBOURS, TOLERANCE)
    variation.add(positions, values, 2, last, gradient, UNIT)
    colours = values[:, 2:last].astype(np.float64)
    assert not gradient[:, :2].any() and not gradient[:, last:].any()
    for row, column in ((0, 0), (17, 1), (123, 2), (299, columns - 1)):
        step = np.zeros_like(colours)
        step[row, column] = 1e-5
        up, down = textbook(positions, colours + step), textbook(positions, colours - step)
        expected = (up - down) / 2e-5
        assert gradient[row, 2 + column] == pytest.approx(expected, rel=2e-3, abs=1e-7)


@pytest.mark.parametrize("last", [3, 27])
def test_threads_change_nothing(last: int) -> None:
    positions, values = scene(5000)
    results = []
    before = numba.get_num_threads()
    for threads in (1, min(2, numba.config.NUMBA_NUM_THREADS)):
        numba.set_num_threads(threads)
        gradient = np.zeros_like(values)
        TotalVariation(WEIGHT, NEIGHBOURS, TOLERANCE).add(positions, values, 0, last, gradient)
        results.append(gradient.tobytes())
    numba.set_num_threads(before)
    assert results[0] == results[1]


def test_other_gaussians_get_other_neighbours() -> None:
    variation = TotalVariation(WEIGHT, NEIGHBOURS, TOLERANCE)
    positions, values = scene()
    variation.add(positions, values, 0, 3, np.zeros_like(values))
    variation.forget()
    gradient = np.zeros((3, 60), np.float32)  # fewer than the neighbours asked for
    variation.add(positions[:3], values[:3], 0, 3, gradient)
    assert gradient[:, :3].any()
    assert np.abs(gradient.sum(0)).max() < 1e-6  # what draws one up draws another down
    variation.forget()
    alone = np.zeros((1, 60), np.float32)
    variation.add(positions[:1], values[:1], 0, 3, alone)
    assert not alone.any()


def test_noise_of_the_photographs_stays_out_of_the_albedo(tmp_path) -> None:
    views, cameras, points, truth = case(lit=True)
    random = np.random.default_rng(5)

    def noisy(view: View) -> View:
        image = view.image + random.normal(0, 0.06, view.image.shape)
        return dataclasses.replace(view, image=np.clip(image, 0, 1).astype(np.float32))

    photographs = Views(tuple(noisy(view) for view in views.views))
    assert truth.light is not None
    errors = []
    for weight in (0.0, 0.2):
        here = context(tmp_path / str(weight), photographs, cameras, points, light="camera",
                       lambda_tv=weight)  # fmt: skip
        FitStage().run(here)
        found = here.result("gaussians")
        _, nearest = cKDTree(truth.means).query(found.means)
        off = found.light.albedo - truth.light.albedo[nearest]
        errors.append(float(np.abs(off - off.mean()).mean()))
    assert errors[1] < 0.8 * errors[0]
