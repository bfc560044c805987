"""Silhouettes and slopes: what the charts are bent by where windows don't match by themselves."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from stages.init.dental.surface import grow as surface_grow
from stages.init.dental.surface.carve import carved, in_void
from stages.init.dental.surface.chart.grid import ChartGrid, normals_of
from stages.init.dental.surface.fit import fit_offsets
from stages.init.dental.surface.grow import best_bend
from stages.init.dental.surface.photos.tissue import find_void
from tests.stages.dental_surface_case import photo

OFFSETS = (np.arange(-20, 21) * 0.25).astype(np.float32)


def test_the_dark_beside_the_jaws_is_void_and_a_shadow_between_teeth_is_not() -> None:
    lightness = np.full((80, 120), 130, np.float32)
    lightness[:, 90:] = 12
    lightness[30:50, 20:70] = 200
    lightness[30:50, 44:46] = 12  # half a mm between two crowns
    tooth = lightness > 150
    void = find_void(lightness, tooth, density=4.0)
    assert void[:, 92:].all()
    assert not void[:, :89].any()
    assert not find_void(lightness, np.zeros_like(tooth), 4.0).any()


def test_what_one_photograph_shows_to_be_empty_is_ruled_out_along_its_rays() -> None:
    grid = ChartGrid(left=-10.0, top=5.0, density=2.0, shape=(21, 41))
    points = grid.points(np.full(grid.shape, 30.0, np.float32))
    normals = normals_of(points)
    side = photo(yaw=90.0)
    void = np.zeros(side.size, np.float32)
    void[:, :50] = 1  # from the side: whatever lies before the plane z = 0 that faces the front
    ruled_out = in_void(points, normals, OFFSETS, [dataclasses.replace(side, void=void)])
    moved = points[:, :, None] + OFFSETS[:, None] * normals[:, :, None]
    local = moved @ side.camera[:9].reshape(3, 3).T + side.camera[9:12]
    x = 150.0 * local[..., 0] / local[..., 2] + 50
    clear = np.abs(x - 50) > 0.01
    assert ruled_out.any()
    assert not ruled_out.all()
    np.testing.assert_array_equal(ruled_out[clear], (x < 50)[clear])
    assert not in_void(points, normals, OFFSETS, [side]).any()


def test_a_chart_is_bent_out_of_the_void_and_no_further() -> None:
    weight = np.zeros((48, 160), np.float32)
    weight[:, :60] = 1  # matched, at offset 0
    void = np.zeros((48, 160, len(OFFSETS)), bool)
    void[:, 100:, OFFSETS > -2] = True
    smooth = np.zeros_like(weight), weight, 5.0, 0.001, 0.6

    assert np.abs(fit_offsets(*smooth)).max() < 1e-6
    fitted = carved(*smooth, void, OFFSETS)
    assert np.abs(fitted[:, :40]).max() < 0.1
    assert fitted[:, 110:].max() < -1.8
    assert fitted[:, 110:].min() > -3.0
    # nothing to keep out of: the plain fit
    plain = carved(*smooth, np.zeros_like(void), OFFSETS)
    np.testing.assert_array_equal(plain, fit_offsets(*smooth))


def test_a_chart_stays_where_every_offset_is_ruled_out() -> None:
    weight = np.ones((24, 40), np.float32)
    smooth = np.full_like(weight, 0.5), weight, 5.0, 0.001, 0.6
    everywhere = np.ones((24, 40, len(OFFSETS)), bool)
    np.testing.assert_array_equal(carved(*smooth, everywhere, OFFSETS), fit_offsets(*smooth))


def test_the_bend_that_agrees_best_is_chosen_and_passed_on_to_where_nothing_agrees() -> None:
    bends = surface_grow._BENDS
    agreement = np.zeros((len(bends), 400))
    agreement[:, :200] = 0.3
    agreement[bends.index(0.5), :200] = 0.7
    bend = best_bend(agreement, density=4.0)
    assert bend[:190] == pytest.approx(0.5, abs=0.01)
    assert bend[200:280] == pytest.approx(0.5, abs=0.05)
    assert not best_bend(np.zeros((len(bends), 400)), 4.0).any()
    # all the same: straight on
    assert np.abs(best_bend(np.full((len(bends), 400), 0.5), 4.0)).max() < 1e-6
