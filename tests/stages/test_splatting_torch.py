"""The torch function: the CPU backend against the reference through autograd, and its options."""

from __future__ import annotations

import sys
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from stages.splatting import torch_api
from stages.splatting.torch_api import pose_gradient, rasterization
from tests.stages.splatting_case import HEIGHT, WIDTH, inputs, rotation, sure_pixels


@pytest.fixture(autouse=True)
def one_torch_thread():
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


CASES = [
    (True, {"sh_degree": 3}),
    (True, {"sh_degree": 1, "render_mode": "RGB+ED", "rasterize_mode": "antialiased"}),
    (False, {"render_mode": "RGB+D"}),
    (False, {"render_mode": "ED"}),
    (False, {"render_mode": "D", "rasterize_mode": "antialiased"}),
    (False, {"render_mode": "RGB+ED", "masked": True}),
]


@pytest.mark.parametrize(("sh", "options"), CASES)
def test_cpu_and_reference_agree(sh: bool, options: dict) -> None:
    options = dict(options)
    rng = np.random.default_rng(3)
    if options.pop("masked", False):
        options["masks"] = torch.tensor(rng.random((2, HEIGHT, WIDTH)) < 0.7)
    results, weights = {}, None
    for backend, dtype in (("reference", torch.float64), ("cpu", torch.float32)):
        leaves = inputs(dtype, sh)
        images, alphas, meta = rasterization(
            **leaves, width=WIDTH, height=HEIGHT, near_plane=0.2, absgrad=True, backend=backend,
            **options,
        )  # fmt: skip
        if weights is None:
            sure = sure_pixels(leaves, options)[..., None]
            # alpha close to 0 makes depth / alpha what float32 has left of it
            sure = sure & (alphas.detach() > 0.02)
            assert sure.double().mean() > 0.5
            weights = [torch.tensor(rng.normal(size=x.shape)) * sure for x in (images, alphas)]
        total = (images * weights[0].to(dtype)).sum() + (alphas * weights[1].to(dtype)).sum()
        total.backward()
        results[backend] = (images, alphas, meta, leaves)
    truth, ours = results["reference"], results["cpu"]
    assert ours[0].shape == truth[0].shape and ours[1].shape == (2, HEIGHT, WIDTH, 1)
    for a, b in zip(ours[:2], truth[:2], strict=True):
        assert ((a.double() - b).abs() * sure).max() < 1e-4 * max(1, float(b.abs().max()))
    for name, leaf in ours[3].items():
        expected = truth[3][name].grad
        if expected is None:
            assert leaf.grad is None or not leaf.grad.any(), name
            continue
        mine = leaf.grad.double()
        if name == "viewmats":
            # a free matrix: only what moves it as a pose can be compared
            generators = twist_directions(truth[3][name].detach())
            mine, expected = ((g[:, None] * generators).sum((2, 3)) for g in (mine, expected))
        if name == "Ks":
            assert not mine[:, 0, 1].any() and not mine[:, 2].any()
        error = torch.linalg.norm(mine - expected)
        assert error <= 1e-3 * torch.linalg.norm(expected), name
    for name in ("grad", "absgrad"):
        mine, expected = (getattr(r[2]["means2d"], name).double() for r in (ours, truth))
        assert torch.linalg.norm(mine - expected) <= 1e-3 * torch.linalg.norm(expected), name
    assert torch.allclose(ours[2]["depths"].double(), truth[2]["depths"], atol=1e-5)
    seen = (ours[2]["radii"] > 0).all(-1)
    near = ours[2]["means2d"].data.double() - truth[2]["means2d"].data
    assert (near[seen].abs() < 1e-3).all() and seen.any() and not seen[:, 0].any()


def twist_directions(viewmats: torch.Tensor) -> torch.Tensor:
    """[C, 6, 4, 4] how each pose moves under the six twists from the left."""
    generators = torch.zeros(6, 4, 4, dtype=torch.float64)
    for k in range(3):
        generators[k, k, 3] = 1
        i, j = (k + 1) % 3, (k + 2) % 3
        generators[3 + k, i, j], generators[3 + k, j, i] = -1, 1
    return generators @ viewmats[:, None]


def test_pose_gradient_has_the_effect_of_the_twist_and_none_other() -> None:
    rng = np.random.default_rng(0)
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation((0.3, -0.5, 0.2)).numpy(), rng.normal(size=3)
    twist = rng.normal(size=6)
    gradient = pose_gradient(pose, twist)
    directions = twist_directions(torch.tensor(pose)[None])[0].numpy()
    assert np.allclose((directions * gradient).sum((1, 2)), twist)
    shear = gradient[:3, :3] @ pose[:3, :3].T
    assert np.allclose(shear, -shear.T)


def test_colors_per_camera() -> None:
    leaves = inputs(torch.float32, sh=False)
    single = rasterization(**leaves, width=WIDTH, height=HEIGHT, backend="cpu")[0]
    both = leaves["colors"].detach()
    leaves["colors"] = torch.stack([both, 2 * both]).requires_grad_(True)
    leaves["backgrounds"] = torch.zeros(2, 5)
    images, *_ = rasterization(**leaves, width=WIDTH, height=HEIGHT, backend="cpu")
    assert images.shape == single.shape
    images.sum().backward()
    assert leaves["colors"].grad.shape == (2, 40, 5)


def test_what_is_opaque_or_flat_is_drawn() -> None:
    """As inputs of a torch optimiser may be: opacities of exactly 1, scales of exactly 0."""
    leaves = inputs(torch.float32, sh=False)
    with torch.no_grad():
        leaves["opacities"][::2], leaves["scales"][1::3, 2] = 1.0, 0.0
    size = {"width": WIDTH, "height": HEIGHT, "near_plane": 0.2}
    images, alphas, meta = rasterization(**leaves, **size, backend="cpu")
    exact = {name: value.detach().double() for name, value in leaves.items()}
    truth, opaque, _ = rasterization(**exact, **size, backend="reference")
    sure = sure_pixels(exact, {})[..., None]
    assert ((images.double() - truth).abs() * sure).max() < 1e-4 * float(truth.abs().max())
    assert ((alphas.double() - opaque).abs() * sure).max() < 1e-4
    assert (meta["radii"] > 0).all(-1)[:, 2::2].any()
    (images.sum() + alphas.sum()).backward()
    for name in ("opacities", "scales", "means"):
        assert torch.isfinite(leaves[name].grad).all(), name


def test_wrong_options_and_shapes_are_refused() -> None:
    leaves = inputs(torch.float32, sh=False)
    size = {"width": WIDTH, "height": HEIGHT}
    with pytest.raises(ValueError, match="backend must be one of"):
        rasterization(**leaves, **size, backend="metal")
    with pytest.raises(ValueError, match="render_mode"):
        rasterization(**leaves, **size, render_mode="rgb")
    with pytest.raises(ValueError, match="quats"):
        rasterization(**{**leaves, "quats": leaves["quats"][:, :3]}, **size)
    with pytest.raises(ValueError, match="K >= 16"):
        rasterization(**leaves, **size, sh_degree=3)


def test_gsplat_is_chosen_where_it_and_a_card_are(monkeypatch: pytest.MonkeyPatch) -> None:
    """The adapter's call, against a stand-in: the library itself needs a card."""
    calls = []

    def stand_in(*arguments, **options):
        calls.append((arguments, options))
        return torch.ones(2, HEIGHT, WIDTH, 5), torch.ones(2, HEIGHT, WIDTH, 1), {"n_cameras": 2}

    monkeypatch.setitem(sys.modules, "gsplat", SimpleNamespace(rasterization=stand_in))
    monkeypatch.setattr(torch_api.importlib.util, "find_spec", lambda name: object())
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert torch_api.choose_backend() == "cpu"
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    assert torch_api.choose_backend() == "gsplat"
    monkeypatch.setattr(torch_api.torch, "device", lambda name: "cpu")
    leaves = {name: value.detach() for name, value in inputs(torch.float32, sh=False).items()}
    mask = torch.zeros(2, HEIGHT, WIDTH, dtype=torch.bool)
    mask[:, 5:] = True
    images, alphas, _ = rasterization(
        **leaves, width=WIDTH, height=HEIGHT, absgrad=True, masks=mask
    )
    arguments, options = calls[0]
    assert arguments[-2:] == (WIDTH, HEIGHT) and options["packed"] is False
    assert options["absgrad"] and options["sh_degree"] is None and options["eps2d"] == 0.3
    assert (images[:, :5] == leaves["backgrounds"][:, None, None]).all() and not alphas[:, :5].any()
    leaves["Ks"].requires_grad_(True)
    with pytest.raises(ValueError, match="gradient of Ks"):
        rasterization(**leaves, width=WIDTH, height=HEIGHT)
