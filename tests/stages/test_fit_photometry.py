"""What a photograph does not show looks from there as that photograph would show it."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from pipeline.artifacts.cameras import Camera
from pipeline.artifacts.gaussians import Gaussians
from pipeline.artifacts.views import View, Views
from stages.fit import numerics
from stages.fit.numerics.photometry import EXPONENTS
from stages.fit.stage import FitStage
from stages.splatting.harmonics import harmonics
from stages.splatting.rasterizer import Viewpoint
from stages.splatting.rendering import render
from tests.stages.lit_fit_case import bump, case, context, looking

HELD = {"light": "none", "hold_surface": True}


def features(angles=(-0.4, 0.0, 0.4)) -> np.ndarray:
    points = bump(900, 4)
    return np.array(
        [
            numerics.photometry.features(
                points.positions.astype(float),
                points.normals.astype(float),
                Viewpoint.of(looking(angle, "")),
            )
            for angle in angles
        ]
    )


def photographed(exponents: np.ndarray, exposures: np.ndarray, noise: float = 0.0):
    """Light [V, N, 3] of three photographs, features, and the pixels of what each one shows.

    The second shows all, the others a third and a half of it.
    """
    rng = np.random.default_rng(5)
    of = features()
    surface = rng.normal(-of[1, :, 1:2] * EXPONENTS[1], 0.3, (of.shape[1], 3))
    light = (
        surface + exposures[:, None] + of @ exponents + rng.normal(0, noise, (3, *surface.shape))
    )
    pixels = np.full(of.shape[:2], 4.0)
    across = bump(900, 4).positions[:, 0]
    pixels[0, across > -10] = 0
    pixels[2, across < 0] = 0
    return light, of, pixels


def test_a_colour_is_the_light_that_it_came_from() -> None:
    colours = np.linspace(0, 1, 101)
    light = numerics.photometry.light_of(colours)
    assert (np.diff(light) > 0).all()
    np.testing.assert_allclose(numerics.photometry.colours_of(light), colours, atol=1e-12)
    assert np.isfinite(numerics.photometry.light_of(np.array([-3.0, 7.0]))).all()


def test_features_are_those_of_a_light_at_the_lens() -> None:
    view = Viewpoint.of(looking(0.0, ""))
    found = numerics.photometry.features(
        np.array([[0, 0, 100.0], [0, 0, 50.0], [10.0, 0, 100.0], [0, 0, 100.0]]),
        np.array([[0, 0, -1.0], [0, 0.6, -0.8], [0, 0, -1.0], [0, 0, 0]]), view,
    )  # fmt: skip
    np.testing.assert_allclose(found[0], [0, np.log(100), 0], atol=1e-9)
    np.testing.assert_allclose(found[1, :2], [np.log(0.8), np.log(50)])
    # a tenth of the way aside, seen with 1.2 times the width for a focal length
    np.testing.assert_allclose(found[2, 2], 0.12**2, atol=1e-6)
    np.testing.assert_array_equal(found[3], found[0])  # no normal: it faces the view


def test_exposures_and_falloff_are_found_and_foretell_what_is_not_shown() -> None:
    exponents = np.tile(np.array([0.35, -1.7, -1.2])[:, None], 3)
    exposures = np.array([[0.3, 0.1, -0.2], [0, 0, 0], [-0.4, -0.2, 0.1]])
    light, of, pixels = photographed(exponents, exposures, noise=0.02)
    truth = numerics.photometry.colours_of(light)
    wrong = np.where(pixels[..., None] > 0, light, 9.0)  # nothing is taken from where none sees it
    # highlights: one in twenty that a photograph shows is far too bright there
    wrong[:, ::20] += np.where(pixels[:, ::20, None] > 0, [[[2.0]], [[0.0]], [[0.0]]], 0)
    found = numerics.photometry.measured(wrong, of, pixels)
    apart = found.exposures - found.exposures[1]
    np.testing.assert_allclose(apart, exposures, atol=0.12)
    beyond = numerics.photometry.expected(wrong, of, pixels)
    unseen = pixels == 0
    assert unseen[0].any() and unseen[2].any() and not unseen[1].any()
    plain = numerics.photometry.colours_of(np.broadcast_to(light[1], light.shape))
    error, before = (np.abs(x - truth)[unseen].mean() for x in (beyond, plain))
    assert error < 0.02 < 0.05 < before


def test_what_nothing_tells_is_taken_from_nature() -> None:
    light, of, pixels = photographed(np.tile(np.array(EXPONENTS)[:, None], 3), np.zeros((3, 3)))
    pixels[0], pixels[2] = 0, 0
    found = numerics.photometry.measured(light, of, pixels)
    np.testing.assert_array_equal(found.exposures, 0)
    np.testing.assert_allclose(found.exponents, np.tile(np.array(EXPONENTS)[:, None], 3))
    beyond = numerics.photometry.expected(light, of, pixels)
    np.testing.assert_allclose(
        numerics.photometry.light_of(beyond), numerics.photometry.light_of(
            numerics.photometry.colours_of(light)), atol=1e-6,
    )  # fmt: skip


def test_harmonics_reach_what_is_wanted_and_keep_what_is_sure() -> None:
    rng = np.random.default_rng(6)
    towards = np.array([[-0.6, 0, 0.8], [0, 0, 1.0], [0.6, 0, 0.8]])
    basis = np.repeat(harmonics(towards)[:, None, :9], 50, 1)
    values = rng.normal(0, 0.5, (50, 9, 3)).astype(np.float32)
    seen = np.einsum("vnk,nkc->vnc", basis, values)
    sure = np.ones((3, 50))
    sure[0] = 0
    wanted = seen.copy()
    wanted[0] += 0.3
    found = np.einsum(
        "vnk,nkc->vnc", basis, numerics.harmonics.reaching(values, basis, wanted, sure)
    )
    np.testing.assert_allclose(found[1:], seen[1:], atol=1e-3)
    np.testing.assert_allclose(found[0], wanted[0], atol=0.01)
    # two views from one side that want different colours: the one that is sure keeps its own
    basis[0] = basis[1]
    found = np.einsum(
        "vnk,nkc->vnc", basis, numerics.harmonics.reaching(values, basis, wanted, sure)
    )
    np.testing.assert_allclose(found[1], seen[1], atol=0.02)
    assert np.isfinite(found).all()


def test_only_held_surfaces_without_a_light_have_it(tmp_path) -> None:
    views, cameras, points, _ = case(lit=False)
    few = Views(views=views.views[:3])
    for name, config, there in (
        ("held", HELD, True),
        ("lit", HELD | {"light": "camera"}, False),
        ("free", {"light": "none", "hold_surface": False}, False),
        ("off", HELD | {"photometry": False}, False),
    ):
        here = context(tmp_path / name, few, cameras, points, iterations=4, **config)
        FitStage().run(here)
        assert ("photometry" in here.figures["parts"].split(", ")) == there, name


def flashed(view: View, camera: Camera, painted: Gaussians, exposure: float) -> View:
    """A view of the painted sheet as a camera takes it that brings its light along."""
    depth = render(dataclasses.replace(painted, light=None), camera).depth
    positions = camera.unproject(depth).reshape(-1, 3)
    of = numerics.photometry.features(
        positions.astype(float), np.zeros_like(positions, float), Viewpoint.of(camera)
    )
    brighter = exposure + of @ np.array(EXPONENTS) - EXPONENTS[1] * np.log(100)
    light = numerics.photometry.light_of(view.image) + brighter.reshape(*depth.shape, 1)
    shown = np.clip(numerics.photometry.colours_of(light), 0, 1)
    return dataclasses.replace(view, image=np.where(depth[..., None] > 0, shown, 0).astype("f4"))


def test_a_photograph_goes_on_beyond_its_border(tmp_path) -> None:
    """The first of three photographs is darker, and half of it is masked."""
    views, cameras, points, painted = case(lit=False)
    photos = [
        flashed(view, camera, painted, exposure)
        for view, camera, exposure in zip(
            views.views[1:4], cameras.cameras[1:4], (-0.5, 0.0, 0.2), strict=True
        )
    ]
    truth = photos[0].image
    mask = np.arange(96) < np.full((72, 1), 48)
    photos[0] = dataclasses.replace(photos[0], mask=mask)
    beyond, kept = {}, {}
    for name in ("with", "without"):
        here = context(
            tmp_path / name, Views(views=tuple(photos)), cameras, points,
            photometry=name == "with", **HELD,
        )  # fmt: skip
        FitStage().run(here)
        camera = here.result("cameras").by_name()[photos[0].name]
        off = np.abs(np.clip(render(here.result("gaussians"), camera).image, 0, 1) - truth)
        beyond[name], kept[name] = off[8:-8, 52:-8].mean(), off[8:-8, 8:44].mean()
    assert beyond["with"] < 0.75 * beyond["without"]
    assert kept["with"] == pytest.approx(kept["without"], abs=0.002)
