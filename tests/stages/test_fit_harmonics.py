"""Harmonics spread to where no photograph tells how colours turn with the view."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.artifacts.views import Views
from stages.fit import numerics
from stages.fit.parts.harmonics import Harmonics
from stages.fit.stage import FitStage
from stages.splatting.harmonics import harmonics
from stages.splatting.rasterizer import use_threads
from tests.stages.fit_case import run_until
from tests.stages.lit_fit_case import case, context


def strip(count: int = 60) -> dict[str, np.ndarray]:
    """A row of Gaussians that a first view shows, and of whose first half a second one shows more.

    From there these are brighter by .2; all differ in colour.
    """
    rng = np.random.default_rng(1)
    positions = np.zeros((count, 3), np.float32)
    positions[:, 0] = np.arange(count)
    towards = np.array([[0, 0, 1.0], [0.6, 0, 0.8]])
    basis = np.repeat(harmonics(towards)[:, None, :4], count, 1)  # [V, N, K]
    pixels = np.full((2, count), 5.0)
    pixels[1, count // 2 :] = 0
    values = np.zeros((count, 4, 3), np.float32)
    values[:, 0] = rng.uniform(0.5, 2, (count, 3))
    # along the difference of both looks: +.2 from the second
    off = basis[1, 0] - basis[0, 0]
    turn = off - (off @ basis[0, 0]) / (basis[0, 0] @ basis[0, 0]) * basis[0, 0]
    values[: count // 2] += (0.2 * turn / (turn @ basis[1, 0]))[None, :, None].astype(np.float32)
    return {"positions": positions, "basis": basis, "pixels": pixels, "values": values}


def spread(of: dict[str, np.ndarray], steps: int = 300) -> np.ndarray:
    near = numerics.total_variation.connected(of["positions"], 4)
    return numerics.harmonics.spread(of["values"], of["basis"], of["pixels"], *near, 100.0, steps)


def test_what_one_photograph_shows_turns_like_what_two_show_beside_it() -> None:
    of = strip()
    found = spread(of)
    seen_before = np.einsum("vnk,nkc->vnc", of["basis"], of["values"])
    seen = np.einsum("vnk,nkc->vnc", of["basis"], found)
    known = of["pixels"] > 0
    assert np.abs(seen - seen_before)[known].max() < 2e-3  # photographs keep their colours
    brighter = (seen[1] - seen[0]) - (seen_before[1] - seen_before[0])
    assert np.abs(brighter[:30]).max() < 4e-3
    # 0 before: half of the row had no idea of it
    change = seen[1, 30:] - seen[0, 30:]
    plain = seen_before[1, 30:] - seen_before[0, 30:]
    assert np.abs(plain).max() < 1e-6
    assert change.mean() == pytest.approx(0.2, abs=0.02)


def test_harmonics_nearest_to_what_views_see_are_those_of_least_squares() -> None:
    rng = np.random.default_rng(4)
    count, terms, views = 700, 9, 5
    given, trust = rng.normal(size=(count, terms, 3)), rng.uniform(1e-3, 0.3, terms)
    basis, wanted = rng.normal(size=(views, count, terms)), rng.normal(size=(views, count, 3))
    nearest = numerics.harmonics.Nearest(given, trust)
    for one, seen in zip(basis, wanted, strict=True):
        nearest.add(one, seen)
    stacked = np.moveaxis(basis, 0, 1)  # [N, V, K]
    gram = np.swapaxes(stacked, 1, 2) @ stacked + np.diag(trust)
    right = np.swapaxes(stacked, 1, 2) @ np.moveaxis(wanted, 0, 1) + trust[:, None] * given
    np.testing.assert_allclose(nearest.found, np.linalg.solve(gram, right), atol=1e-9)


def test_it_is_the_membrane_that_a_dense_solver_finds() -> None:
    of = strip(16)
    of["values"][:, 1:] += np.random.default_rng(2).normal(0, 0.3, (16, 3, 3))
    near, starts = numerics.total_variation.connected(of["positions"], 3)
    found = numerics.harmonics.spread(
        of["values"], of["basis"], of["pixels"], near, starts, 2.0, 200
    )
    count, terms = 16, 4
    rows, right = [], []
    for view, i in np.ndindex(2, count):  # what photographs show stays
        row = np.zeros((count, terms))
        row[i] = of["basis"][view, i]
        rows.append(np.sqrt(2.0 * of["pixels"][view, i]) * row.ravel())
        right.append(rows[-1] @ of["values"].reshape(count * terms, 3))
    for i in range(count):  # and neighbours are alike but for the constant
        for j in near[starts[i] : starts[i + 1]]:
            for k in range(1, terms):
                row = np.zeros((count, terms))
                row[i, k], row[j, k] = np.sqrt(0.5), -np.sqrt(0.5)
                rows.append(row.ravel())
                right.append(np.zeros(3))
    system, goal = np.array(rows), np.array(right)
    best = np.linalg.lstsq(system, goal, rcond=None)[0]

    def energy(values: np.ndarray) -> float:
        return float(((system @ values.reshape(count * terms, 3) - goal) ** 2).sum())

    # what all could turn by together, with constants that make it good, is left where it was
    assert energy(found) < 1.001 * energy(best) < 0.5 * energy(of["values"])


def test_threads_do_not_change_it() -> None:
    of = strip(2000)
    found = []
    for threads in (1, 2):
        use_threads(threads)
        found.append(spread(of, 20))
    use_threads(None)
    np.testing.assert_array_equal(*found)


def test_a_gaussian_that_nothing_shows_follows_its_neighbours() -> None:
    of = strip()
    of["pixels"][:, 10] = 0
    of["values"][10, 1:] = 3.0
    found = spread(of)
    np.testing.assert_allclose(found[10, 1:], found[9, 1:], atol=0.02)
    np.testing.assert_allclose(found[10, 0], of["values"][10, 0], atol=1e-3)


def test_only_held_surfaces_without_a_light_have_it(tmp_path) -> None:
    views, cameras, points, _ = case(lit=False)
    few = Views(views=views.views[:3])
    for name, config, there in (
        ("held", {"light": "none", "hold_surface": True}, True),
        ("lit", {"light": "camera", "hold_surface": True}, False),
        ("free", {"light": "none", "hold_surface": False}, False),
        ("off", {"light": "none", "hold_surface": True, "harmonics_at": 0.0}, False),
    ):
        here = context(tmp_path / name, few, cameras, points, iterations=4, **config)
        FitStage().run(here)
        assert ("harmonics" in here.figures["parts"].split(", ")) == there, name


@pytest.mark.parametrize(
    ("iterations", "changes"),
    [
        (1, {"coarse_fraction": 0.5}),  # before the first iteration
        (6, {"harmonics_at": 1.0}),
        # far from right at .35, so that there are twice as many: .3 of these comes later
        (10, {"harmonics_at": 0.3, "extension": 1.0, "extension_psnr": (80, 90)}),
    ],
)
def test_it_is_done_once_at_any_share_of_any_number_of_iterations(
    tmp_path, monkeypatch, iterations: int, changes: dict
) -> None:
    views, cameras, points, _ = case(lit=False)
    when: list[int] = []
    monkeypatch.setattr(Harmonics, "_spread", _noting(when, Harmonics._spread))
    config = {"light": "none", "hold_surface": True, "iterations": iterations, **changes}
    few = Views(views=views.views[:3])
    here = context(tmp_path, few, cameras, points, **config)
    FitStage().run(here)
    assert here.figures["iterations"] == iterations * (1 + ("extension" in changes))
    assert when == [{1: 0, 6: 5, 10: 3}[iterations]]


def _noting(when: list[int], really):
    def spread_at(part, fit):
        when.append(fit.iteration)
        really(part, fit)

    return spread_at


def test_a_stopped_fit_with_it_resumes_to_the_same_bytes(tmp_path) -> None:
    views, cameras, points, _ = case(lit=False)
    few = Views(views=views.views[:3])
    config = {"light": "none", "hold_surface": True, "iterations": 30}
    whole = context(tmp_path / "a", few, cameras, points, threads=1, **config)
    FitStage().run(whole)
    plain = context(tmp_path / "b", few, cameras, points, threads=1, harmonics_at=0.0, **config)
    FitStage().run(plain)
    stopped = context(tmp_path / "c", few, cameras, points, checkpoint_every=4, **config)
    run_until(stopped, 20)
    again = context(tmp_path / "c", few, cameras, points, **config)
    FitStage().run(again)
    found, without, resumed = (c.result("gaussians").sh for c in (whole, plain, again))
    np.testing.assert_array_equal(found, resumed)
    assert not np.array_equal(found, without)
