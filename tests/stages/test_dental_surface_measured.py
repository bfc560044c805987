"""The surface of the teeth as it goes on from depth that stereo has measured."""

from __future__ import annotations

import functools
from dataclasses import replace

import numpy as np
import pytest

from pipeline.errors import ReconstructionError
from stages.init.dental.surface.dense import completed_surface, dense_surface, started_surface
from stages.init.dental.surface.options import SurfaceOptions
from tests.stages.dental_arch_scene import scene

TOOTH = 2
OPTIONS = SurfaceOptions(rounds=(), only_clear=False, carve=True, gum_trust=1.0)


@functools.cache
def inputs():  # type: ignore[no-untyped-def]
    return scene()


def measured(off: float = 0.0, wide: float = 0.5) -> list[np.ndarray]:
    """The true depth, moved by `off` mm, in so much of each photograph's middle."""
    parts = []
    for depth, _, kind in inputs()[4]:
        part = np.where(kind == TOOTH, depth + off, 0).astype(np.float32)
        columns = part.shape[1]
        beside = abs(np.arange(columns) - columns / 2) > wide * columns / 2
        part[:, beside] = 0
        parts.append(part)
    return parts


def errors(views, where) -> np.ndarray:  # type: ignore[no-untyped-def]
    """Depth errors in mm on the teeth that `where` [H, W] of each view picks."""
    parts = []
    for view, (depth, _, kind), picked in zip(views, inputs()[4], where, strict=True):
        shown = (kind == TOOTH) & picked & (view.depth > 0)
        parts.append(np.abs(view.depth - depth)[shown])
    return np.concatenate(parts)


def completed(depths, threads: int, options=OPTIONS):  # type: ignore[no-untyped-def]
    """The crown shapes, bent to these depths, as each photograph sees them."""
    return completed_surface(started_surface(*inputs()[:4], options, threads), depths, threads, ())


def test_crowns_are_bent_to_what_is_measured_and_better_beyond_it() -> None:
    depths = measured()
    shapes = dense_surface(*inputs()[:4], options=OPTIONS, threads=2).views
    bent = completed(depths, 2)
    there, beyond = [part > 0 for part in depths], [part == 0 for part in depths]
    assert np.median(errors(bent, there)) < 0.5 * np.median(errors(shapes, there))
    assert np.median(errors(bent, beyond)) < np.median(errors(shapes, beyond))
    for view, (_, _, kind) in zip(bent, inputs()[4], strict=True):
        assert view is not None
        assert (view.depth > 0)[kind == TOOTH].mean() > 0.9


def test_what_is_measured_is_surer_than_what_goes_on_from_it() -> None:
    depths = measured(wide=0.3)
    for view, part in zip(completed(depths, 1), depths, strict=True):
        assert view is not None
        shown = view.depth > 0
        assert np.median(view.confidence[shown & (part > 0)]) > 3
        assert np.percentile(view.confidence[shown], 5) == pytest.approx(1 + np.exp(-1.6), abs=0.02)


def test_some_wrong_depth_does_not_bend_the_crowns() -> None:
    depths = measured(wide=1.0)
    right = completed(depths, 1)
    rng = np.random.default_rng(0)
    for part in depths:
        part[(rng.random(part.shape) < 0.1) & (part > 0)] += 4
    wrong = completed(depths, 1)
    everywhere = [part > 0 for part in depths]
    assert np.median(errors(wrong, everywhere)) < np.median(errors(right, everywhere)) + 0.15


@pytest.mark.parametrize("off", [-4.0, 4.0])
def test_depth_that_is_not_of_the_crowns_is_refused(off: float) -> None:
    with pytest.raises(ReconstructionError, match=r"crowns would lie -?[34]\.\d mm from"):
        completed(measured(off, 1.0), 1)


def test_nothing_measured_leaves_the_crown_shapes() -> None:
    nothing = [np.zeros_like(part) for part in measured()]
    shapes = dense_surface(*inputs()[:4], options=replace(OPTIONS, carve=False), threads=1).views
    same = completed(nothing, 1, replace(OPTIONS, carve=False))
    for a, b in zip(same, shapes, strict=True):
        assert a is not None
        assert b is not None
        shown = b.depth > 0
        np.testing.assert_allclose(a.depth[shown], b.depth[shown], atol=0.02)
        # but for gum beyond the even rim of the cloud, which this has none of
        assert ((a.depth > 0) & ~shown).sum() < 0.01 * shown.sum()
