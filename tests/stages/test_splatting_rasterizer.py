"""The rasterizer against the slow reference in float64, and that against finite differences."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
import torch
from kornia.geometry.liegroup import Se3

from stages.splatting import reference
from stages.splatting.rasterizer import Viewpoint, rasterize

WIDTH, HEIGHT = 40, 28
INTRINSICS = (38.0, 36.0, 19.0, 15.0)
NEXT_INTRINSICS = (41.0, 43.0, 21.0, 13.0)
NEAR = 0.2
#: pixels that come nearer than this to a contribution being left out or not may go either way
DOUBT = 1e-3


@pytest.fixture(autouse=True)
def one_torch_thread():
    """The tensors are too small for more."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


def exponential(twist: torch.Tensor) -> torch.Tensor:
    """exp of a twist (translation, rotation) as a 4x4 matrix."""
    return Se3.exp(twist).matrix()


def scene(seed: int, count: int = 60) -> np.ndarray:
    """Gaussians before, beside and behind the camera, near its plane, huge, tiny, long and thin."""
    rng = np.random.default_rng(seed)
    packed = np.zeros((count, 59), np.float32)
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
    packed[:, 14:] = 0.3 * rng.normal(size=(count, 45))
    return packed


def deep_scene(count: int) -> np.ndarray:
    """Gaussians behind one another, so faint that light comes through most of them."""
    rng = np.random.default_rng(11)
    packed = scene(11, count)
    packed[:, 2] = 1 + 2 * rng.permutation(count) / count
    packed[:, 0:2] = rng.uniform(-0.6, 0.6, (count, 2)) * packed[:, 2:3]
    packed[:, 7:10] = np.log(rng.uniform(0.6, 1.5, (count, 3)))
    packed[:, 10] = rng.uniform(-5.5, -4.8, count)
    return packed


@dataclass(frozen=True)
class Variant:
    """What is rendered."""

    degree: int | None = 1
    depth: bool = False
    flow: bool = False
    features: int = 0
    antialiased: bool = False
    masked: bool = False
    alpha_cut: float = 1 / 255


VARIANTS = [
    Variant(degree=0, depth=True, flow=True),
    Variant(degree=1),
    Variant(degree=2, features=2, masked=True),
    Variant(degree=3, depth=True, flow=True, antialiased=True),
    Variant(degree=None, features=1, antialiased=True),
    Variant(degree=None, features=9, depth=True, flow=True, masked=True, antialiased=True),
    Variant(degree=0, features=37, alpha_cut=1e-5),
]


def poses() -> tuple[np.ndarray, np.ndarray]:
    first = exponential(torch.tensor([0.1, -0.05, 0.2, 0.1, -0.2, 0.05], dtype=torch.float64))
    second = exponential(torch.tensor([-0.2, 0.1, 0.3, 0.0, 0.15, -0.1], dtype=torch.float64))
    return first.detach().numpy(), second.detach().numpy()


def viewpoint(pose: np.ndarray, intrinsics: tuple[float, ...] = INTRINSICS) -> Viewpoint:
    return Viewpoint(
        np.ascontiguousarray(pose[:3], np.float32), np.array(intrinsics, np.float32), WIDTH, HEIGHT
    )


class Both:
    """One scene and variant for both implementations."""

    def __init__(self, packed: np.ndarray, variant: Variant, seed: int = 0) -> None:
        rng = np.random.default_rng(seed)
        self.packed, self.variant = packed, variant
        self.pose, self.next_pose = poses()
        self.features = rng.normal(size=(len(packed), variant.features)).astype(np.float32)
        self.mask = None
        if variant.masked:
            self.mask = np.ones((HEIGHT, WIDTH), bool)
            self.mask[:18, :20] = False
            self.mask[::3, 30] = False

    def fast(self):
        v = self.variant
        return rasterize(
            self.packed, viewpoint(self.pose), degree=v.degree, near=NEAR, depth=v.depth,
            flow_to=viewpoint(self.next_pose, NEXT_INTRINSICS) if v.flow else None,
            features=self.features if v.features else None, alpha_cut=v.alpha_cut,
            antialiased=v.antialiased, mask=self.mask,
        )  # fmt: skip

    def leaves(self) -> dict[str, torch.Tensor]:
        """The inputs of the reference, in float64."""
        values = {
            "packed": self.packed, "features": self.features, "twist": np.zeros(6),
            "next_twist": np.zeros(6), "k": np.array(INTRINSICS),
            "next_k": np.array(NEXT_INTRINSICS),
        }  # fmt: skip
        return {
            name: torch.tensor(value, dtype=torch.float64, requires_grad=True)
            for name, value in values.items()
        }

    def slow(self, leaves: dict[str, torch.Tensor], track: bool = False):
        v = self.variant
        packed, k = leaves["packed"], leaves["k"]
        pose = exponential(leaves["twist"]) @ torch.tensor(self.pose)
        next_pose = exponential(leaves["next_twist"]) @ torch.tensor(self.next_pose)
        means = packed[:, :3]
        local, centre, _ = reference.project(means, pose, k, NEAR)
        columns = []
        if v.degree is not None:
            sh = packed[:, 11:].reshape(len(packed), -1, 3)
            columns.append(reference.colours(means, sh, pose, v.degree))
        if v.depth:
            columns.append(local[:, 2:])
        if v.flow:
            _, after, _ = reference.project(means, next_pose, leaves["next_k"], NEAR)
            columns.append(after - centre)
        columns.append(leaves["features"])
        return reference.rasterize(
            means, packed[:, 3:7], packed[:, 7:10].exp(), torch.sigmoid(packed[:, 10]),
            torch.cat(columns, 1), pose, k, WIDTH, HEIGHT, near=NEAR, alpha_cut=v.alpha_cut,
            antialiased=v.antialiased, mask=None if self.mask is None else torch.tensor(self.mask),
            track_screen=track,
        )  # fmt: skip

    def scales(self) -> np.ndarray:
        """What is one unit of each plane: flow is in pixels."""
        v = self.variant
        size = [1.0] * (3 * (v.degree is not None) + v.depth) + [40.0] * (2 * v.flow)
        return np.array(size + [1.0] * v.features)[:, None, None]


@pytest.mark.parametrize("variant", VARIANTS)
def test_images_agree_with_the_reference(variant: Variant) -> None:
    both = Both(scene(3), variant)
    ours = both.fast()
    with torch.no_grad():
        truth = both.slow(both.leaves())
    left = truth.transmittance.numpy()
    assert left.min() < 0.05 and left.max() > 0.1  # the scene is neither empty nor full
    sure = truth.margin.numpy() > DOUBT
    assert sure.mean() > 0.9
    error = np.abs(ours.planes - truth.planes.numpy()) / both.scales()
    assert error[:, sure].max() < 1e-4
    # on either side of the cut: 1/255 of a colour
    assert error.max() < 2e-2
    assert np.abs(ours.transmittance - left)[sure].max() < 1e-4
    if both.mask is not None:
        assert not ours.planes[:, ~both.mask].any()
        assert (ours.transmittance[~both.mask] == 1).all()


def check_gradients(both: Both, seed: int) -> None:
    rng = np.random.default_rng(seed)
    leaves = both.leaves()
    truth = both.slow(leaves, track=True)
    sure = truth.margin.numpy() > DOUBT
    d_planes = (rng.normal(size=truth.planes.shape) * sure / both.scales()).astype(np.float32)
    d_left = (rng.normal(size=(HEIGHT, WIDTH)) * sure).astype(np.float32)
    total = (truth.planes * torch.tensor(d_planes)).sum()
    (total + (truth.transmittance * torch.tensor(d_left)).sum()).backward()
    ours = both.fast().backward(d_planes, d_left)

    def rows_agree(mine: np.ndarray, expected: np.ndarray, name: str) -> None:
        error = np.linalg.norm(mine - expected, axis=1)
        size = np.linalg.norm(expected, axis=1)
        # absolutely, a float32 gradient is exact to its largest summand
        bad = error > 1e-3 * size + 1e-5 * np.quantile(size, 0.9)
        assert not bad.any(), (name, np.flatnonzero(bad), error[bad], size[bad])

    by_packed = leaves["packed"].grad.numpy()
    groups = {"mean": (0, 3), "quat": (3, 7), "scale": (7, 10), "opacity": (10, 11)}
    for name, (start, stop) in {**groups, "sh": (11, 59)}.items():
        rows_agree(ours.packed[:, start:stop], by_packed[:, start:stop], name)
    sigmoid = 1 / (1 + np.exp(-both.packed[:, 10].astype(np.float64)))
    by_opacity = by_packed[:, 10] / (sigmoid * (1 - sigmoid))
    rows_agree(ours.opacities[:, None], by_opacity[:, None], "opacities")
    if both.variant.features:
        given = ours.features[:, -both.variant.features :]
        rows_agree(given, leaves["features"].grad.numpy(), "features")
    signed, absolute = (value.numpy() for value in truth.screen_gradients())
    rows_agree(ours.centres, signed, "centres")
    rows_agree(ours.absolute, absolute, "absolute")
    cameras = {
        "pose": (ours.pose, leaves["twist"].grad),
        "intrinsics": (np.concatenate([ours.focal, ours.principal_point]), leaves["k"].grad),
    }
    if both.variant.flow:
        next_k = np.concatenate([ours.next_focal, ours.next_principal_point])
        cameras["next pose"] = (ours.next_pose, leaves["next_twist"].grad)
        cameras["next intrinsics"] = (next_k, leaves["next_k"].grad)
    for name, (mine, expected) in cameras.items():
        error = np.linalg.norm(mine - expected.numpy()) / np.linalg.norm(expected.numpy())
        assert error < 1e-3, (name, error)


@pytest.mark.parametrize("variant", VARIANTS)
def test_gradients_agree_with_autograd(variant: Variant) -> None:
    check_gradients(Both(scene(4), variant), 4)


def test_thousands_deep_agree_with_the_reference() -> None:
    both = Both(deep_scene(3000), Variant(degree=0, depth=True, alpha_cut=1e-6))
    ours = both.fast()
    with torch.no_grad():
        truth = both.slow(both.leaves())
    # no contribution at this cut matters, and some pixels are finished before the last Gaussian
    assert truth.transmittance.min() < 1.1e-4
    assert (np.diff(ours._forward.offsets) > 2000).all()
    assert np.abs(ours.planes - truth.planes.numpy()).max() < 1e-4 * 3  # depths are up to 3
    assert np.abs(ours.transmittance - truth.transmittance.numpy()).max() < 1e-4


def test_gradients_thousands_deep_agree_with_autograd() -> None:
    check_gradients(Both(deep_scene(2000), Variant(degree=0, alpha_cut=1e-7)), 12)


@pytest.mark.parametrize("antialiased", [False, True])
def test_the_reference_agrees_with_finite_differences(antialiased: bool) -> None:
    rng = np.random.default_rng(21)
    pose, _ = poses()

    def render(means, quats, scales, opacities, sh, twist, k):
        moved = exponential(twist) @ torch.tensor(pose)
        result = reference.rasterize(
            means, quats, scales, opacities, reference.colours(means, sh, moved, 1), moved, k,
            5, 4, near=NEAR, alpha_cut=1e-14, antialiased=antialiased,
        )  # fmt: skip
        return result.planes, result.transmittance

    count = 3
    inputs = [
        np.concatenate([rng.uniform(-0.5, 0.5, (count, 2)), rng.uniform(1, 3, (count, 1))], 1),
        rng.normal(size=(count, 4)), rng.uniform(0.1, 0.6, (count, 3)),
        rng.uniform(0.2, 0.8, count), 0.2 * rng.normal(size=(count, 4, 3)), np.zeros(6),
        np.array([5.0, 4.0, 3.0, 2.0]),
    ]  # fmt: skip
    tensors = [torch.tensor(x, dtype=torch.float64, requires_grad=True) for x in inputs]
    assert torch.autograd.gradcheck(render, tensors, eps=1e-6, atol=1e-6, rtol=1e-4)


def test_the_antialiased_variant_keeps_the_light_of_a_tiny_gaussian() -> None:
    """A Gaussian far smaller than a pixel covers its own area, not that of the low-pass."""
    packed = np.zeros((1, 14), np.float32)
    packed[0, :3] = (0, 0, 10)
    packed[0, 3] = 1
    sigma_px = 0.2
    packed[0, 7:10] = np.log(sigma_px * 10 / 100)
    packed[0, 10] = 9
    view = Viewpoint(
        np.eye(4, dtype=np.float32)[:3], np.array([100, 100, 20, 20], np.float32), 40, 40
    )
    covered = [
        float((1 - rasterize(packed, view, degree=0, near=0.1, alpha_cut=1e-6,
                             antialiased=antialiased).transmittance).sum())
        for antialiased in (False, True)
    ]  # fmt: skip
    area = 2 * np.pi * sigma_px**2
    smoothed = area * (sigma_px**2 + 0.3) / sigma_px**2
    assert covered[0] == pytest.approx(smoothed, rel=0.05)
    # sqrt of the ratio of the determinants: the area of the 2D Gaussian stays
    assert covered[1] == pytest.approx(area, rel=0.05)


def test_a_mask_or_features_of_another_size_are_refused() -> None:
    packed = scene(0)
    view = viewpoint(poses()[0])
    with pytest.raises(ValueError, match="mask"):
        rasterize(packed, view, degree=0, near=NEAR, mask=np.ones((3, 4), bool))
    with pytest.raises(ValueError, match="features"):
        rasterize(packed, view, degree=0, near=NEAR, features=np.zeros((3, 4), np.float32))
