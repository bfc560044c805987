"""The light beside the lens: its formula, and its gradients against finite differences."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.artifacts.cameras import Camera
from pipeline.artifacts.gaussians import Gaussians, Light
from pipeline.kernels.threads import in_threads
from stages.splatting.light import LitScene, coefficients, shade, shade_backward
from stages.splatting.rendering import Painter, render

C0 = 0.28209479177387814
COUNT = 600  # more than one chunk
LIGHT = np.array([0.8, 1.7, 60.0, 0.4, 12.0, 0.05, 1.1, 2.2])


def scene(seed: int = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """packed [N, 14], material [N, 6], pose [3, 4] and centre [3], float64; a tenth face away."""
    rng = np.random.default_rng(seed)
    packed = np.zeros((COUNT, 14))
    packed[:, :3] = rng.uniform(-0.4, 0.4, (COUNT, 3))
    rotation, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    rotation *= np.linalg.det(rotation)
    centre = rng.normal(size=3)
    centre /= np.linalg.norm(centre)
    pose = np.concatenate([rotation, -rotation @ centre[:, None]], 1)
    towards = centre - packed[:, :3]
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    normals = towards + 0.5 * rng.normal(size=(COUNT, 3))
    normals[::10] *= -1
    normals *= rng.uniform(0.5, 2, (COUNT, 1))
    return packed, np.concatenate([rng.uniform(0.1, 0.9, (COUNT, 3)), normals], 1), pose, centre


def formula(packed, material, centre, light) -> np.ndarray:
    """[N, 3] colours, straight from the docstring."""
    k, p, m1, s1, m2, s2, distance, gamma = light
    towards = centre - packed[:, :3]
    r = np.linalg.norm(towards, axis=1)
    n = material[:, 3:] / np.linalg.norm(material[:, 3:], axis=1, keepdims=True)
    c = (n * towards).sum(1) / r
    lobes = s1 * np.exp(m1 * (c - 1)) + s2 * np.exp(m2 * (c - 1))
    diffuse = 1 - k + k * np.maximum(c, 0)
    matte = material[:, :3] ** gamma * diffuse[:, None]
    return ((distance / r)[:, None] ** p * (matte + lobes[:, None])) ** (1 / gamma)


def test_colours_follow_the_formula_in_both_precisions() -> None:
    packed, material, _, centre = scene()
    wanted = formula(packed, material, centre, LIGHT)
    for kind, tolerance in ((np.float64, 1e-6), (np.float32, 1e-5)):
        lit = packed.astype(kind)
        shade(lit, material.astype(kind), centre.astype(kind), LIGHT.astype(kind))
        assert np.allclose(0.5 + C0 * lit[:, 11:], wanted, atol=tolerance)


def test_gradients_against_finite_differences() -> None:
    packed, material, pose, centre = scene(1)
    weight = np.random.default_rng(2).normal(size=(COUNT, 3))

    def loss(packed, material, centre, light) -> float:
        return float((formula(packed, material, centre, light) * weight).sum())

    lit = packed.copy()
    radiance = shade(lit, material, centre, LIGHT)
    gradient = np.zeros((COUNT, 14))
    gradient[:, 11:] = C0 * weight
    result = shade_backward(lit, material, centre, pose, LIGHT, radiance, gradient)

    step = 1e-6
    for row in range(0, COUNT, 23):
        for column in range(6):
            up, down = material.copy(), material.copy()
            up[row, column] += step
            down[row, column] -= step
            numeric = (loss(packed, up, centre, LIGHT) - loss(packed, down, centre, LIGHT)) / step
            assert result.material[row, column] == pytest.approx(numeric / 2, rel=1e-4, abs=1e-5)
        for column in range(3):
            up, down = packed.copy(), packed.copy()
            up[row, column] += step
            down[row, column] -= step
            numeric = loss(up, material, centre, LIGHT) - loss(down, material, centre, LIGHT)
            assert gradient[row, column] == pytest.approx(numeric / step / 2, rel=1e-4, abs=1e-5)
    for index in range(6):
        up, down = LIGHT.copy(), LIGHT.copy()
        up[index] += step
        down[index] -= step
        numeric = loss(packed, material, centre, up) - loss(packed, material, centre, down)
        assert result.light[index] == pytest.approx(numeric / step / 2, rel=1e-4, abs=1e-5)
    for axis in range(3):
        shift = np.zeros(3)
        shift[axis] = step
        moved = [centre - sign * pose[:, :3].T @ shift for sign in (1, -1)]
        numeric = loss(packed, material, moved[0], LIGHT) - loss(packed, material, moved[1], LIGHT)
        assert result.pose[axis] == pytest.approx(numeric / step / 2, rel=1e-4, abs=1e-5)
    assert not result.pose[3:].any()


def test_a_lit_scene_is_drawn_the_same_from_many_threads() -> None:
    rng = np.random.default_rng(4)
    means = rng.normal(size=(60, 3)).astype(np.float32) * 0.3 + np.array([0, 0, 3], np.float32)
    normals = -means / np.linalg.norm(means, axis=1, keepdims=True)
    light = Light(
        rng.random((60, 3)).astype(np.float32), normals, 0.5, 1.0, 3.0, (60.0, 12.0), (0.5, 0.05)
    )
    gaussians = Gaussians(
        means, np.tile(np.array([1, 0, 0, 0], np.float32), (60, 1)),
        np.full((60, 3), -2, np.float32), np.ones(60, np.float32),
        np.zeros((60, 16, 3), np.float32), light,
    )  # fmt: skip
    poses = [np.eye(4) for _ in range(8)]
    for k, pose in enumerate(poses):
        pose[0, 3] = 0.1 * k
    cameras = [Camera(f"{k}", 48, 36, 60.0, 60.0, 24, 18, pose) for k, pose in enumerate(poses)]
    painter = Painter(gaussians)
    together = in_threads(painter, cameras, 4)
    for camera, drawn in zip(cameras, together, strict=True):
        np.testing.assert_array_equal(drawn.image, render(gaussians, camera, threads=1).image)
    assert not np.array_equal(together[0].image, together[-1].image)


def test_lit_scene_shows_a_highlight_where_the_surface_faces_the_camera() -> None:
    count = 3
    normals = np.array([[0, 0, -1], [0.5, 0, -0.866], [0, 0, 1]], np.float32)
    light = Light(
        np.full((count, 3), 0.5, np.float32), normals, 0.9, 2.0, 1.0, (100.0, 15.0), (0.5, 0.04)
    )
    gaussians = Gaussians(
        np.array([[0, 0, 1]] * count, np.float32), np.array([[1, 0, 0, 0]] * count, np.float32),
        np.zeros((count, 3), np.float32), np.zeros(count, np.float32),
        np.zeros((count, 16, 3), np.float32), light,
    )  # fmt: skip
    colours = 0.5 + C0 * LitScene(gaussians).seen_from(np.zeros(3))[:, 11]
    assert colours[0] == pytest.approx((0.5**2.2 + 0.54) ** (1 / 2.2), abs=1e-4)
    assert colours[0] > 0.8 > 0.5 > colours[1] > colours[2] > 0.1
    assert coefficients(light).tolist()[:2] == pytest.approx([0.9, 2.0])


def test_shapes_are_checked() -> None:
    packed, material, _, centre = scene()
    with pytest.raises(ValueError, match="material"):
        shade(packed, material[:, :5], centre, LIGHT)
    bare = Gaussians(*(np.zeros((0, 3), np.float32),) * 5)
    with pytest.raises(ValueError, match="no light"):
        LitScene(bare)
