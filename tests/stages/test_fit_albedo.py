"""Even albedo: what it costs, how it slopes, and what it is good for."""

from __future__ import annotations

import dataclasses

import numba
import numpy as np
import pytest
from scipy.spatial import cKDTree

from pipeline.artifacts.views import View, Views
from stages.fit.even_albedo import EvenAlbedo
from stages.fit.stage import FitStage
from tests.stages.test_fit_light import case, context

WEIGHT, NEIGHBOURS, TOLERANCE = 0.7, 5, 0.05


def scene(count: int = 300, seed: int = 1) -> tuple[np.ndarray, np.ndarray]:
    random = np.random.default_rng(seed)
    positions = random.uniform(-1, 1, (count, 3)) * [1, 1, 0.05]
    material = random.uniform(0.1, 0.9, (count, 6))
    return positions.astype(np.float32), material.astype(np.float32)


def textbook(positions: np.ndarray, albedo: np.ndarray) -> float:
    """Huber's loss, summed over pairs of which one is among the nearest of the other."""
    distance = np.linalg.norm(positions[:, None] - positions[None], axis=2)
    np.fill_diagonal(distance, np.inf)
    near = np.zeros(distance.shape, bool)
    order = np.argsort(distance, axis=1)[:, :NEIGHBOURS]
    np.put_along_axis(near, order, True, axis=1)
    i, j = np.nonzero(np.triu(near | near.T))
    d = np.abs(albedo[i] - albedo[j])
    huber = np.where(d < TOLERANCE, d**2 / (2 * TOLERANCE), d - TOLERANCE / 2)
    return WEIGHT * float(huber.sum()) / (len(albedo) * NEIGHBOURS)


def test_loss_and_slope_are_those_of_the_formula() -> None:
    positions, material = scene()
    gradient = np.zeros_like(material)
    even = EvenAlbedo(WEIGHT, NEIGHBOURS, TOLERANCE)
    loss = even.add(positions, material, gradient)
    albedo = material[:, :3].astype(np.float64)
    assert loss == pytest.approx(textbook(positions, albedo), rel=1e-4)
    assert not gradient[:, 3:].any()
    for row, channel in ((0, 0), (17, 1), (123, 2), (299, 0)):
        step = np.zeros_like(albedo)
        step[row, channel] = 1e-5
        up, down = textbook(positions, albedo + step), textbook(positions, albedo - step)
        assert gradient[row, channel] == pytest.approx((up - down) / 2e-5, rel=1e-3, abs=1e-8)


def test_threads_change_nothing() -> None:
    positions, material = scene(5000)
    results = []
    before = numba.get_num_threads()
    for threads in (1, min(2, numba.config.NUMBA_NUM_THREADS)):
        numba.set_num_threads(threads)
        gradient = np.zeros_like(material)
        loss = EvenAlbedo(WEIGHT, NEIGHBOURS, TOLERANCE).add(positions, material, gradient)
        results.append((loss, gradient.tobytes()))
    numba.set_num_threads(before)
    assert results[0] == results[1]


def test_other_gaussians_get_other_neighbours() -> None:
    even = EvenAlbedo(WEIGHT, NEIGHBOURS, TOLERANCE)
    positions, material = scene()
    even.add(positions, material, np.zeros_like(material))
    some = slice(0, 3)  # fewer than the neighbours asked for
    even.forget()
    gradient = np.zeros((3, 6), np.float32)
    assert even.add(positions[some], material[some], gradient) > 0
    assert np.abs(gradient[:, :3].sum(0)).max() < 1e-6  # what draws one up draws another down
    even.forget()
    assert even.add(positions[:1], material[:1], np.zeros((1, 6), np.float32)) == 0


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
                       lambda_albedo=weight)  # fmt: skip
        FitStage().run(here)
        found = here.result("gaussians")
        _, nearest = cKDTree(truth.means).query(found.means)
        off = found.light.albedo - truth.light.albedo[nearest]
        errors.append(float(np.abs(off - off.mean()).mean()))
    assert errors[1] < 0.8 * errors[0]
