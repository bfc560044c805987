"""Parts of the fit: sampling densification, held surfaces, filled points, the shared focal."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from pipeline.artifacts.cameras import Camera
from stages.fit.config import FitConfig, resolve
from stages.fit.inputs.initial import (
    Cloud,
    camera_share,
    headlight_harmonics,
    smooth_normals,
    thin,
)
from stages.fit.inputs.scene import out_of_place, prepare, trusted_points
from stages.fit.inputs.targets import Target, make_target
from stages.fit.numerics.density import add_noise, add_regularisers, relocate, rotations, shared
from stages.fit.parts.camera import Background, Focal, SharedFocal
from stages.fit.parts.surface import Surface, worth_holding
from stages.splatting.harmonics import harmonics
from stages.splatting.rasterizer import Viewpoint, rasterize
from tests.stages.fit_case import case


def packed_scene(count: int, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    packed = np.zeros((count, 14), np.float32)
    packed[:, :3] = rng.normal(size=(count, 3))
    packed[:, 3:7] = rng.normal(size=(count, 4))
    packed[:, 7:10] = np.log(rng.uniform(0.01, 0.1, (count, 3)))
    packed[:, 10] = rng.normal(size=count)
    return packed


def test_shared_gaussians_stop_as_much_light_as_the_one_did() -> None:
    opacity = np.array([0.9, 0.5, 0.05, 0.7])
    sharers = np.array([2, 5, 3, 1])
    share, factor = shared(opacity, sharers)
    assert 1 - (1 - share.astype(float)) ** sharers == pytest.approx(opacity, abs=1e-5)
    assert factor[3] == pytest.approx(1)
    # two of opacity a at scale f integrate to 2 a f - a^2 f / sqrt(2), as one of opacity 0.9 does
    a = float(share[0])
    assert float(factor[0]) * (2 * a - a**2 / np.sqrt(2)) == pytest.approx(0.9, abs=1e-5)


def test_relocation_moves_the_dead_and_keeps_to_the_cap() -> None:
    packed = packed_scene(400)
    packed[:40, 10] = -9  # dead
    random = np.random.default_rng(1)
    moved, source, fresh = relocate(packed, 0.005, 410, random)
    assert len(moved) == 410 == len(source) == len(fresh)
    assert not np.isin(source, np.arange(40)).any()
    assert (1 / (1 + np.exp(-moved[:, 10])) >= 0.0049).all()
    same = ~fresh
    assert np.array_equal(moved[same], packed[source[same]])
    counts = np.bincount(source, minlength=400)
    assert (counts[source[fresh]] > 1).all() and fresh.sum() > 50
    again = relocate(packed, 0.005, 410, np.random.default_rng(1))
    assert np.array_equal(again[0], moved)


def test_noise_moves_the_transparent_only() -> None:
    packed = packed_scene(200)
    packed[:100, 10] = 4
    packed[100:, 10] = -9
    before = packed.copy()
    add_noise(packed, 10.0, np.random.default_rng(0))
    step = np.abs(packed - before).max(1)
    assert step[:100].max() < 1e-6 < step[100:].min()
    assert np.array_equal(packed[:, 3:], before[:, 3:])


def test_regularisers_against_finite_differences() -> None:
    packed = packed_scene(50).astype(np.float64)
    gradient = np.zeros_like(packed)
    add_regularisers(packed, gradient, 0.3, 0.7)

    def value(p: np.ndarray) -> float:
        return 0.3 * (1 / (1 + np.exp(-p[:, 10]))).mean() + 0.7 * np.exp(p[:, 7:10]).mean()

    for column in (7, 9, 10):
        up, down = packed.copy(), packed.copy()
        up[5, column] += 1e-5
        down[5, column] -= 1e-5
        assert gradient[5, column] == pytest.approx((value(up) - value(down)) / 2e-5, rel=1e-4)


def test_gaussians_lie_along_their_normals_and_are_held_there() -> None:
    rng = np.random.default_rng(2)
    packed = packed_scene(300)
    packed[:, 3:7] = (1, 0, 0, 0)
    packed[:, 7:10] = np.log(0.05)
    normals = rng.normal(size=(300, 3))
    normals[:3] = [[0, 0, 1], [0, 0, -1], [0, 0, 0]]
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    normals /= np.where(length > 0, length, 1)
    confidence = np.full(300, 10.0)
    confidence[150:] = 1.0
    cloud = Cloud(packed[:, :3].astype(float), np.zeros((300, 3)), normals, confidence)
    settings = FitConfig(hold_flatness=0.25, hold_strength=0.5, hold_growth=3.0)
    fit = SimpleNamespace(settings=settings, cloud=cloud, packed=packed)
    held = Surface(fit)
    known = np.abs(normals).sum(1) > 0
    axes = rotations(packed[:, 3:7])[:, :, 2]
    assert np.allclose(axes[known], normals[known], atol=1e-5)
    assert np.allclose(np.exp(packed[known, 9]), 0.0125) and packed[2, 9] == packed[2, 7]
    start = packed.copy()
    packed[:, :3] += rng.normal(size=(300, 3)).astype(np.float32)
    packed[7, 7:10] = np.log(0.5)
    moved = packed.copy()
    held.follow(fit, None)
    assert np.allclose(packed[7, 7:9], np.log(0.15))  # no needle
    off = ((moved - start)[:, :3] * normals).sum(1)
    left = ((packed - start)[:, :3] * normals).sum(1)
    firm = known & (np.arange(300) < 150)
    assert np.allclose(left[firm], 0.5 * off[firm], atol=1e-5)
    across = packed[:, :3] - moved[:, :3] + (off - left)[:, None] * normals
    assert np.abs(across).max() < 1e-5  # along the surface they are free
    assert np.array_equal(packed[150:], moved[150:])  # and where nothing is sure
    assert np.array_equal(packed[2], moved[2])  # and without a normal


def test_normals_are_averaged_on_one_side_of_a_sheet_only() -> None:
    rng = np.random.default_rng(3)
    xy = rng.uniform(-1, 1, (400, 2))
    front = np.concatenate([xy, np.zeros((400, 1))], 1)
    back = front + np.array([0, 0, 0.01])
    noisy = np.array([0, 0, -1]) + 0.3 * rng.normal(size=(400, 3))
    normals = np.concatenate([noisy, [[0, 0, 1]] * 400])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    cloud = Cloud(np.concatenate([front, back]), np.zeros((800, 3)), normals, np.ones(800))
    smooth = smooth_normals(cloud, 16).normals
    assert np.allclose(np.linalg.norm(smooth, axis=1), 1)
    assert smooth[:400, 2].mean() < -0.97 > normals[:400, 2].mean() - 0.1
    assert (smooth[400:, 2] > 0.99).all()


def test_what_is_bright_loses_little_as_it_turns_away() -> None:
    """Enamel that is nearly white would else be grey from the side; without a shoulder it is."""
    colors = np.array([[0.4, 0.4, 0.4], [0.95, 0.95, 0.95], [0.9, 0.4, 0.4], [0.95, 0.95, 0.95]])
    normals = np.array([[0, 0, -1.0]] * 3 + [[0, 0, 0]])
    cosine = np.ones(4)
    rays = {at: np.tile([np.sqrt(1 - at**2), 0, at], (4, 1)) for at in (1.0, 0.5)}

    def seen(share: np.ndarray, at: float) -> np.ndarray:
        sh = headlight_harmonics(colors, normals, cosine, share, 2)
        return 0.5 + np.einsum("nk,nkc->nc", harmonics(rays[at])[:, :9], sh)

    share = camera_share(colors, 0.8, 1.0)
    assert np.allclose(seen(share, 1.0), colors, atol=1e-6)  # as they were seen
    turned = seen(share, 0.5) / colors
    assert turned[0] == pytest.approx(0.6)  # 1 - .8 + .8 * .5
    assert turned[1] == pytest.approx(0.8)
    assert turned[2] == pytest.approx([0.78, 0.6, 0.6])  # gum gets redder
    assert turned[3] == pytest.approx(1.0)  # whichever way it faces
    plain = seen(camera_share(colors, 0.8, 0.0), 0.5) / colors
    assert plain[:3] == pytest.approx(np.full((3, 3), 0.6))


def test_the_share_of_light_is_for_photographs_of_a_held_surface() -> None:
    held, free = (resolve(FitConfig(), 3, 0, held=held) for held in (True, False))
    assert (held.headlight, held.headlight_shoulder) == (0.8, 1.0)
    assert (free.headlight, free.headlight_shoulder) == (0.6, 0.0)


def test_thinning_keeps_confidence_a_confidence() -> None:
    rng = np.random.default_rng(4)
    cloud = Cloud(
        rng.uniform(size=(5000, 3)), rng.uniform(size=(5000, 3)),
        np.tile([0.0, 0, 1], (5000, 1)), rng.uniform(1, 7, 5000),
    )  # fmt: skip
    thinned = thin(cloud, 300)
    assert 200 < len(thinned) < 400
    assert thinned.weight.min() >= 1 and thinned.weight.max() <= 7


def test_what_was_measured_keeps_its_share_of_the_gaussians() -> None:
    views, cameras, points = case()
    across = points.positions[:, 0]
    aside = across > np.quantile(across, 0.75)
    points = replace(points, confidence=np.where(aside, 1.2, 5).astype(np.float32))
    settings = resolve(FitConfig(fill_share=1.0, initial_points=400, light="none"), 3, 0)
    start = prepare(views.views, cameras.cameras, points, None, settings).start(settings)
    assert 0.7 < (start.weight > 2).mean() < 0.9


def test_filled_points_that_a_view_contradicts_are_left_out() -> None:
    camera = Camera("000", 160, 120, 160.0, 160.0, 80.0, 60.0, np.eye(4))
    y, x = np.mgrid[-0.3:0.3:120j, -0.45:0.0:120j]
    wall = np.stack([x, y, np.ones_like(x)], -1).reshape(-1, 3)  # the left half
    filled = np.array(
        [[-0.1, 0, 0.5], [-0.2, 0, 1.01], [-0.3, 0, 1.5], [0.2, 0, 0.6], [9, 9, 1]], float
    )
    # before it, on it, behind it, beside it, and in no view
    wrong = out_of_place(filled, wall, [camera], 0.03)
    assert wrong.tolist() == [True, True, True, False, True]
    cloud = Cloud(filled, filled, filled, np.array([1, 1.2, 5, 6, 1.1]))
    assert trusted_points(cloud, 1.5).tolist() == [False, False, True, True, False]
    assert trusted_points(cloud, 100).all()  # confidence of another kind


def test_the_shared_focal_walks_to_where_its_gradient_ends() -> None:
    focal = SharedFocal()
    intrinsics = np.array([100, 120, 50, 40], np.float32)
    for _ in range(400):
        used = focal.apply(intrinsics)
        focal.step(float((used[0] - 104.0) * used[0]), 1e-3)
    assert focal.apply(intrinsics)[0] == pytest.approx(104, abs=0.2)
    assert focal.apply(intrinsics)[1] == pytest.approx(124.8, abs=0.3)
    assert focal.apply(intrinsics)[2:].tolist() == [50, 40]


def test_the_shared_focal_is_that_of_both_views_between_which_there_is_flow() -> None:
    packed = packed_scene(40)
    packed[:, :3] *= 0.5
    packed[:, 2] += 4
    pose = np.eye(4, dtype=np.float32)[:3]
    further = pose.copy()
    further[0, 3] = 1.5
    lens = np.array([60, 70, 30, 22], np.float32)
    weights = np.random.default_rng(1).uniform(0.5, 1, (44, 60)).astype(np.float32)

    def drawn(log_factor: float):
        wider = lens * np.exp([log_factor, log_factor, 0, 0]).astype(np.float32)
        here, there = (Viewpoint(p, wider, 60, 44) for p in (pose, further))
        options = {"degree": 0, "near": 0.1, "alpha_cut": 1e-4}
        return rasterize(packed, here, flow_to=there, **options), here, there

    def value(log_factor: float) -> float:
        return float((drawn(log_factor)[0].planes[3] * weights).sum(dtype=np.float64))

    rendering, here, there = drawn(0.0)
    by_planes = np.zeros_like(rendering.planes)
    by_planes[3] = weights
    gradients = rendering.backward(by_planes, np.zeros_like(weights))
    asked: list[float] = []
    fit: Any = SimpleNamespace(
        settings=FitConfig(), focal=SimpleNamespace(step=lambda by, rate: asked.append(by))
    )
    step: Any = SimpleNamespace(gradients=gradients, viewpoint=here, following=there)
    Focal(fit).follow(fit, step)
    assert asked[0] == pytest.approx((value(0.01) - value(-0.01)) / 0.02, rel=0.02)


def test_a_surface_is_held_where_few_views_are_far_apart() -> None:
    def held(angles: list[float]) -> bool:
        cameras = []
        for angle in np.radians(angles):
            c, s = np.cos(angle), np.sin(angle)
            pose = np.array([[c, 0, -s, 0], [0, 1, 0, 0], [s, 0, c, 1], [0, 0, 0, 1]], float)
            cameras.append(Camera(str(angle), 64, 48, 70.0, 70.0, 32.0, 24.0, pose))
        return worth_holding(cameras, np.zeros((5, 3)))

    assert held([-45, 0, 45])
    assert held([-45, -30, 45])  # two look alike, and the third is known by them alone
    assert not held([-21, 0, 20])
    assert not held([-60, -25, 10, 45])


def test_what_a_held_surface_changes_unless_the_user_says_otherwise() -> None:
    free = resolve(FitConfig(), 3, 0)
    held = resolve(FitConfig(), 3, 0, held=True)
    assert not free.hold_surface and held.hold_surface
    assert held.initial_points > free.initial_points
    off = resolve(FitConfig(hold_surface=False), 3, 0, held=True)
    assert off == free
    chosen = resolve(FitConfig(hold_surface=True, sh_degree=0), 3, 0)
    assert chosen.hold_surface and chosen.sh_degree == 0


def test_settings_follow_the_number_of_views() -> None:
    few, many, plenty = (resolve(FitConfig(), views, 0) for views in (3, 6, 9))
    assert few.fill_share > 0 and many.fill_share == plenty.fill_share == 0
    assert (few.densify, many.densify, plenty.densify) == (False, True, True)
    assert (few.sh_degree, many.sh_degree, plenty.sh_degree) == (1, 1, 2)
    held = resolve(FitConfig(), 3, 0, held=True)
    assert held.light_strength_lr == 0 < few.light_strength_lr
    assert held.light_strengths[0] < few.light_strengths[0]
    said = resolve(FitConfig(fill_share=0.5, light_strengths=(1.0, 0.1)), 9, 0)
    assert (said.fill_share, said.light_strengths) == (0.5, (1.0, 0.1))


def test_the_background_is_found_where_nothing_is_masked_out() -> None:
    camera = Camera("a", 16, 12, 20.0, 20.0, 8.0, 6.0, np.eye(4))
    image = np.full((12, 16, 3), 0.5, np.float32)
    whole = make_target(image, np.ones((12, 16), bool), camera, 1, None)
    masked = make_target(image, np.arange(12)[:, None] < np.full(16, 6), camera, 1, None)

    def behind(targets: list[dict[int, Target]], **config) -> Background:
        settings = resolve(FitConfig(background_lr=0.02, **config), 3, 0)
        return Background(SimpleNamespace(settings=settings, targets=targets))

    empty, clear = np.zeros((3, 12, 16), np.float32), np.ones((12, 16), np.float32)

    def step_towards(background: Background, shown: np.ndarray) -> None:
        gradient, drawn = whole.colour(shown, 0.0).gradient, SimpleNamespace(transmittance=clear)
        step = SimpleNamespace(d_planes=gradient, rendering=drawn, d_transmittance=0 * clear)
        background.compare(None, step)

    found = behind([{1: whole}])
    for _ in range(200):
        step_towards(found, found.show(0, empty, clear))
    assert found.values == pytest.approx(0.5, abs=0.03)
    again = behind([{1: whole}])
    again.restore(found.arrays())
    assert again.steps == 200 and np.array_equal(again.values, found.values)

    black = behind([{1: whole}, {1: masked}])
    step_towards(black, empty)
    assert not black.values.any()
    fixed = behind([{1: whole}], background=(0.2, 0.3, 0.4))
    step_towards(fixed, empty)
    assert fixed.values.tolist() == [0.2, 0.3, 0.4]
