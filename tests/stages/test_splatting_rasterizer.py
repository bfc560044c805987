"""The rasterizer against a slow reference in torch, float64, whose gradients autograd gives."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from stages.splatting.rasterizer import Viewpoint, rasterize

WIDTH, HEIGHT = 40, 28
INTRINSICS = (38.0, 36.0, 19.0, 15.0)
NEAR = 0.2


def rotation_matrix(quats: torch.Tensor) -> torch.Tensor:
    w, x, y, z = torch.nn.functional.normalize(quats, dim=1).unbind(1)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return torch.stack([torch.stack(row, 1) for row in rows], 1)


def exponential(twist: torch.Tensor) -> torch.Tensor:
    """exp of a twist (translation, rotation) as a 4x4 matrix."""
    v, w = twist[:3], twist[3:]
    zero = torch.zeros((), dtype=twist.dtype)
    matrix = torch.stack(
        [
            torch.stack([zero, -w[2], w[1], v[0]]),
            torch.stack([w[2], zero, -w[0], v[1]]),
            torch.stack([-w[1], w[0], zero, v[2]]),
            torch.stack([zero, zero, zero, zero]),
        ]
    )
    return torch.linalg.matrix_exp(matrix)


def harmonics(d: torch.Tensor, degree: int) -> torch.Tensor:
    x, y, z = d.unbind(1)
    c = math.sqrt(1 / math.pi)
    terms = [0.5 * c * torch.ones_like(x)]
    if degree >= 1:
        c1 = math.sqrt(3) / 2 * c
        terms += [-c1 * y, c1 * z, -c1 * x]
    if degree >= 2:
        c2 = math.sqrt(15) / 2 * c
        terms += [
            c2 * x * y, -c2 * y * z, math.sqrt(5) / 4 * c * (3 * z * z - 1), -c2 * x * z,
            c2 / 2 * (x * x - y * y),
        ]  # fmt: skip
    if degree >= 3:
        terms += [
            -math.sqrt(35 / 32) * c * y * (3 * x * x - y * y),
            math.sqrt(105) / 2 * c * x * y * z,
            -math.sqrt(21 / 32) * c * y * (5 * z * z - 1),
            math.sqrt(7) / 4 * c * z * (5 * z * z - 3),
            -math.sqrt(21 / 32) * c * x * (5 * z * z - 1),
            math.sqrt(105) / 4 * c * z * (x * x - y * y),
            -math.sqrt(35 / 32) * c * x * (x * x - 3 * y * y),
        ]
    return torch.stack(terms, 1)


def project(points: torch.Tensor, pose: torch.Tensor, k: torch.Tensor) -> tuple:
    local = points @ pose[:3, :3].T + pose[:3, 3]
    pixels = local[:, :2] / local[:, 2:].clamp(min=NEAR) * k[:2] + k[2:]
    return local, pixels


def reference(packed, pose, k, degree, next_pose, next_k, alpha_cut):
    """[6, H, W] colour, depth, flow and [H, W] transmittance; one Gaussian after the other."""
    fx, fy = k[:2]
    local, centre = project(packed[:, :3], pose, k)
    _, next_centre = project(packed[:, :3], next_pose, next_k)
    x, y, z = local.unbind(1)
    keep = z > NEAR
    f = k.detach()
    limit_x = (-f[2] / f[0] - 0.15 * WIDTH / f[0], (WIDTH - f[2] + 0.15 * WIDTH) / f[0])
    limit_y = (-f[3] / f[1] - 0.15 * HEIGHT / f[1], (HEIGHT - f[3] + 0.15 * HEIGHT) / f[1])
    zs = torch.where(keep, z, torch.ones_like(z))
    # beyond the limits the slope is held, times the focal length: a constant in pixels
    tx, ty = fx * x / zs, fy * y / zs
    tx = torch.where(x / zs < limit_x[0], f[0] * limit_x[0], tx)
    tx = torch.where(x / zs > limit_x[1], f[0] * limit_x[1], tx)
    ty = torch.where(y / zs < limit_y[0], f[1] * limit_y[0], ty)
    ty = torch.where(y / zs > limit_y[1], f[1] * limit_y[1], ty)
    zero = torch.zeros_like(zs)
    jacobian = torch.stack(
        [torch.stack([fx / zs, zero, -tx / zs], 1), torch.stack([zero, fy / zs, -ty / zs], 1)], 1
    )
    axes = rotation_matrix(packed[:, 3:7]) * packed[:, None, 7:10].exp()
    a = jacobian @ pose[:3, :3] @ axes
    covariance = a @ a.transpose(1, 2) + 0.3 * torch.eye(2, dtype=a.dtype)
    conic = torch.linalg.inv(covariance)
    opacity = torch.sigmoid(packed[:, 10])
    eye = -pose[:3, :3].T @ pose[:3, 3]
    basis = harmonics(torch.nn.functional.normalize(packed[:, :3] - eye, dim=1), degree)
    sh = packed[:, 11 : 11 + 3 * basis.shape[1]].reshape(len(packed), -1, 3)
    colour = ((basis[..., None] * sh).sum(1) + 0.5).clamp(min=0)
    features = torch.cat([colour, z[:, None], next_centre - centre], 1)
    v, u = torch.meshgrid(
        torch.arange(HEIGHT, dtype=a.dtype) + 0.5, torch.arange(WIDTH, dtype=a.dtype) + 0.5,
        indexing="ij",
    )  # fmt: skip
    planes = torch.zeros(features.shape[1], HEIGHT, WIDTH, dtype=a.dtype)
    left = torch.ones(HEIGHT, WIDTH, dtype=a.dtype)
    done = torch.zeros(HEIGHT, WIDTH, dtype=torch.bool)
    for i in torch.argsort(z.detach(), stable=True).tolist():
        if not keep[i]:
            continue
        dx, dy = u - centre[i, 0], v - centre[i, 1]
        power = -0.5 * (conic[i, 0, 0] * dx**2 + conic[i, 1, 1] * dy**2) - conic[i, 0, 1] * dx * dy
        alpha = (opacity[i] * power.exp()).clamp(max=0.99)
        alpha = torch.where(alpha >= alpha_cut, alpha, torch.zeros_like(alpha))
        done = done | (left * (1 - alpha) < 1e-4)
        weight = torch.where(done, torch.zeros_like(alpha), alpha * left)
        planes = planes + weight * features[i, :, None, None]
        left = left - weight
    return planes, left


def scene(seed: int, count: int, coefficients: int) -> np.ndarray:
    """Gaussians before, beside and behind the camera, near its plane, huge, tiny, long and thin."""
    rng = np.random.default_rng(seed)
    packed = np.zeros((count, 11 + 3 * coefficients), np.float32)
    packed[:, 0:2] = rng.uniform(-2, 2, (count, 2))
    packed[:, 2] = rng.uniform(-0.5, 4, count)
    packed[:6, 2] = (0.19, 0.201, 0.21, 0.25, 0.3, -1.0)
    packed[:, 3:7] = rng.normal(size=(count, 4))
    packed[:, 7:10] = np.log(rng.uniform(0.01, 0.3, (count, 3)))
    packed[6:9, 7:10] = np.log(3.0)
    packed[9:12, 7:10] = np.log(1e-5)
    packed[12:15, 7:10] = np.log((1.0, 1e-4, 1e-4))
    packed[:, 10] = rng.normal(size=count)
    packed[15:18, 10] = (-9.0, 9.0, 6.0)
    packed[:, 11:14] = rng.normal(size=(count, 3))
    packed[:, 14:] = 0.3 * rng.normal(size=(count, 3 * coefficients - 3))
    return packed


def poses() -> tuple[np.ndarray, np.ndarray]:
    first = exponential(torch.tensor([0.1, -0.05, 0.2, 0.1, -0.2, 0.05], dtype=torch.float64))
    second = exponential(torch.tensor([-0.2, 0.1, 0.3, 0.0, 0.15, -0.1], dtype=torch.float64))
    return first.numpy(), second.numpy()


def viewpoint(pose: np.ndarray, width: int = WIDTH, height: int = HEIGHT) -> Viewpoint:
    intrinsics = np.array(INTRINSICS, np.float32)
    return Viewpoint(np.ascontiguousarray(pose[:3], np.float32), intrinsics, width, height)


@pytest.mark.parametrize(("degree", "seed"), [(0, 0), (1, 1), (2, 2), (3, 3)])
def test_image_depth_and_flow_agree_with_the_reference(degree: int, seed: int) -> None:
    packed = scene(seed, 60, 16)
    pose, next_pose = poses()
    ours = rasterize(
        packed, viewpoint(pose), degree=degree, near=NEAR, depth=True,
        flow_to=viewpoint(next_pose), alpha_cut=1 / 255,
    )  # fmt: skip
    planes, left = reference(
        torch.tensor(packed, dtype=torch.float64), torch.tensor(pose),
        torch.tensor(INTRINSICS, dtype=torch.float64), degree, torch.tensor(next_pose),
        torch.tensor(INTRINSICS, dtype=torch.float64), 1 / 255,
    )  # fmt: skip
    assert left.min() < 0.05 and left.max() > 0.1  # the scene is neither empty nor full
    # a contribution at the cut may fall on either side of it in float32: 1/255 of a colour
    for mine, truth, scale in (
        (ours.planes[:4], planes[:4].numpy(), 1.0),
        (ours.planes[4:], planes[4:].numpy(), 40.0),
        (ours.transmittance, left.numpy(), 1.0),
    ):
        error = np.abs(mine - truth) / scale
        assert np.quantile(error, 0.995) < 1e-4
        assert error.max() < 2e-2


def test_gradients_agree_with_autograd() -> None:
    for degree, seed in ((0, 4), (1, 5), (2, 6), (3, 7)):
        packed = scene(seed, 50, 16)
        pose, next_pose = poses()
        rng = np.random.default_rng(seed)
        d_planes = rng.normal(size=(6, HEIGHT, WIDTH)).astype(np.float32)
        d_planes[4:] *= 0.05
        d_left = rng.normal(size=(HEIGHT, WIDTH)).astype(np.float32)
        cut = 1e-7
        ours = rasterize(
            packed, viewpoint(pose), degree=degree, near=NEAR, depth=True,
            flow_to=viewpoint(next_pose), alpha_cut=cut,
        ).backward(d_planes, d_left)  # fmt: skip
        inputs = {
            "packed": torch.tensor(packed, dtype=torch.float64),
            "twist": torch.zeros(6, dtype=torch.float64),
            "next_twist": torch.zeros(6, dtype=torch.float64),
            "k": torch.tensor(INTRINSICS, dtype=torch.float64),
        }
        for value in inputs.values():
            value.requires_grad_(True)
        planes, left = reference(
            inputs["packed"], exponential(inputs["twist"]) @ torch.tensor(pose), inputs["k"],
            degree, exponential(inputs["next_twist"]) @ torch.tensor(next_pose),
            torch.tensor(INTRINSICS, dtype=torch.float64), cut,
        )  # fmt: skip
        ((planes * torch.tensor(d_planes)).sum() + (left * torch.tensor(d_left)).sum()).backward()
        truth = inputs["packed"].grad.numpy()
        groups = {"mean": (0, 3), "quat": (3, 7), "scale": (7, 10), "opacity": (10, 11)}
        for name, (start, stop) in {**groups, "sh": (11, 59)}.items():
            a, b = ours.packed[:, start:stop], truth[:, start:stop]
            error = np.linalg.norm(a - b, axis=1)
            size = np.linalg.norm(b, axis=1)
            assert (error <= 1e-3 * size + 1e-6 * size.max()).all(), (degree, name)
        relative = lambda a, b: np.linalg.norm(a - b) / np.linalg.norm(b)  # noqa: E731
        assert relative(ours.pose, inputs["twist"].grad.numpy()) < 1e-3
        assert relative(ours.focal, inputs["k"].grad.numpy()[:2]) < 1e-3
        assert relative(ours.next_pose, inputs["next_twist"].grad.numpy()) < 1e-3
