"""A lip before the teeth in one photograph, told by the reader or by the other photographs."""

from __future__ import annotations

import dataclasses
import functools

import numpy as np
import pytest

from stages.init.dental.surface.dense import ArchSurface, dense_surface
from tests.stages.dental_arch_scene import GUM, outline, pieces, scene

TOOTH = 2
#: Redder and darker than the made-up gum, within what passes for gum.
LIP = np.array([0.55, 0.2, 0.24], np.float32)


@functools.cache
def plain():  # type: ignore[no-untyped-def]
    return scene()


@functools.cache
def with_lip(read: bool):  # type: ignore[no-untyped-def]
    """The patient's right side, where a lip covers the lower teeth and gum of the left side.

    Below the teeth it reaches further than any tooth can tell. `read`: the reader tells it from
    gum, of whose colour it is.
    """
    images, valid, dentitions, fit, truth = plain()
    _, jaw, kind = truth[0]
    lower = (kind == TOOTH) & (jaw == 2)
    y, x = np.mgrid[: lower.shape[0], : lower.shape[1]]
    columns, rows = np.flatnonzero(lower.any(axis=0)), np.flatnonzero(lower.any(axis=1))
    edge = columns[-1] - 0.2 * len(columns)
    lip = (y > rows[0] + 3) & (x > edge - 10 * (y > rows[-1] + 4)) & ((kind != TOOTH) | lower)
    first, *rest = dentitions[0].lower
    whole = dataclasses.replace(first, outline=outline(lower & ~lip))
    seen = dataclasses.replace(dentitions[0], lower=(whole, *rest))
    if read:
        on_jaws = pieces(((kind == 1) | (kind == TOOTH)) & ~lip)
        seen = dataclasses.replace(seen, on_jaws=on_jaws)
    rng = np.random.default_rng(0)
    image = images[0].copy()
    image[lip] = (GUM if read else LIP) + rng.normal(scale=0.01, size=(int(lip.sum()), 1)).astype(
        np.float32
    )
    return [image, *images[1:]], valid, [seen, *dentitions[1:]], fit, truth, lip


@functools.cache
def surface(read: bool | None) -> ArchSurface:
    """None: without a lip."""
    return dense_surface(*(plain() if read is None else with_lip(read))[:4], threads=2)


@pytest.mark.parametrize("read", [True, False])
def test_the_lip_is_not_gum(read: bool) -> None:
    lip = with_lip(read)[5]
    covered = lip & (plain()[4][0][2] > 0)
    shown, before = (surface(told).views[0].depth > 0 for told in (read, None))
    assert before[covered].mean() > 0.5  # it stands before what would be seen
    assert shown[covered].mean() < 0.05
    elsewhere = before & ~lip
    assert shown[elsewhere].mean() > 0.93  # all but a rim beside it


@pytest.mark.parametrize("read", [True, False])
def test_the_other_photographs_lose_nothing(read: bool) -> None:
    for with_it, without in zip(surface(read).views[1:], surface(None).views[1:], strict=True):
        before = without.depth > 0
        assert (with_it.depth > 0)[before].mean() > 0.99


def test_what_no_other_photograph_shows_better_is_kept() -> None:
    """One photograph alone can't tell."""
    images, valid, dentitions, fit, _, lip = with_lip(False)
    alone = dataclasses.replace(fit, views=[fit.views[0], None, None])
    result = dense_surface(images, valid, dentitions, alone)
    assert (result.views[0].depth > 0)[lip].any()


def test_threads_change_nothing() -> None:
    again = dense_surface(*with_lip(False)[:4], threads=1)
    np.testing.assert_array_equal(again.views[0].depth, surface(False).views[0].depth)
    np.testing.assert_array_equal(again.colors, surface(False).colors)


def test_where_nobody_told_everything_around_the_teeth_is_gum() -> None:
    images, valid, dentitions, fit, truth = plain()
    untold = [dataclasses.replace(dentition, on_jaws=None) for dentition in dentitions]
    shown = dense_surface(images, valid, untold, fit).views[0].depth > 0
    finger = truth[0][2] == 3
    assert shown[finger].sum() > (surface(None).views[0].depth > 0)[finger].sum()
