"""A lip or a finger that stands before teeth and gum in one photograph is none of the surface."""

from __future__ import annotations

import dataclasses
import functools

import numpy as np

from stages.init.dental.surface.dense import ArchSurface, dense_surface
from tests.stages.dental_arch_scene import GUM, outline, pieces, scene

TOOTH = 2


@functools.cache
def plain():  # type: ignore[no-untyped-def]
    return scene()


@functools.cache
def with_lip():  # type: ignore[no-untyped-def]
    """The patient's right side, where a lip as red as gum hides lower teeth of the left side."""
    images, valid, dentitions, fit, truth = plain()
    _, jaw, kind = truth[0]
    lower = (kind == TOOTH) & (jaw == 2)
    y, x = np.mgrid[: lower.shape[0], : lower.shape[1]]
    columns, rows = np.flatnonzero(lower.any(axis=0)), np.flatnonzero(lower.any(axis=1))
    edge = columns[-1] - 0.2 * len(columns)
    lip = (y > rows[0] + 3) & (x > edge - 10 * (y > rows[-1] + 4)) & ((kind != TOOTH) | lower)
    first, *rest = dentitions[0].lower
    whole = dataclasses.replace(first, outline=outline(lower & ~lip))
    on_jaws = pieces(((kind == 1) | (kind == TOOTH)) & ~lip)
    seen = dataclasses.replace(dentitions[0], lower=(whole, *rest), on_jaws=on_jaws)
    image = images[0].copy()
    image[lip] = GUM
    return [image, *images[1:]], valid, [seen, *dentitions[1:]], fit, truth, lip


@functools.cache
def surface(lip: bool) -> ArchSurface:
    return dense_surface(*(with_lip() if lip else plain())[:4], threads=2)


def test_the_lip_is_not_shown() -> None:
    covered = with_lip()[5] & (plain()[4][0][2] > 0)
    shown, before = (surface(lip).views[0].depth > 0 for lip in (True, False))
    assert before[covered].mean() > 0.5  # it stands before what would be seen
    assert shown[covered].mean() < 0.05
    elsewhere = before & ~with_lip()[5]
    assert shown[elsewhere].mean() > 0.93  # all but a rim beside it


def test_the_other_photographs_lose_nothing() -> None:
    for with_it, without in zip(surface(True).views[1:], surface(False).views[1:], strict=True):
        before = without.depth > 0
        assert (with_it.depth > 0)[before].mean() > 0.99


def test_where_nobody_told_everything_around_the_teeth_is_gum() -> None:
    images, valid, dentitions, fit, truth = plain()
    untold = [dataclasses.replace(dentition, on_jaws=None) for dentition in dentitions]
    shown = dense_surface(images, valid, untold, fit).views[0].depth > 0
    finger = truth[0][2] == 3
    assert shown[finger].sum() > (surface(False).views[0].depth > 0)[finger].sum()


def test_threads_change_nothing() -> None:
    again = dense_surface(*with_lip()[:4], threads=1)
    np.testing.assert_array_equal(again.views[0].depth, surface(True).views[0].depth)
    np.testing.assert_array_equal(again.colors, surface(True).colors)
