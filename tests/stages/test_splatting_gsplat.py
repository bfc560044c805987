"""Our rasterizer against gsplat: its formulas in torch anywhere, its kernels where a card is."""

from __future__ import annotations

import inspect
import sys

import pytest
import torch

from stages.splatting import torch_api
from stages.splatting.torch_api import rasterization
from tests.stages.splatting_case import HEIGHT, WIDTH, inputs, sure_pixels

gsplat = pytest.importorskip("gsplat")
formulas = pytest.importorskip("gsplat.cuda._torch_impl")

CASES = [
    {"sh_degree": 3},
    {"sh_degree": 1, "rasterize_mode": "antialiased"},
    {"sh_degree": None, "render_mode": "RGB+ED"},
]


def by_formulas(leaves, options) -> tuple[torch.Tensor, torch.Tensor]:
    """Images [C, H, W, X] and alphas [C, H, W]: gsplat's projection and harmonics, composited
    Gaussian by Gaussian with its limits on alpha and transmittance."""
    covariances, _ = formulas._quat_scale_to_covar_preci(leaves["quats"], leaves["scales"])
    viewmats = leaves["viewmats"]
    radii, centres, depths, conics, kept = formulas._fully_fused_projection(
        leaves["means"], covariances, viewmats, leaves["Ks"], WIDTH, HEIGHT, near_plane=0.2,
        calc_compensations=options.get("rasterize_mode") == "antialiased",
    )  # fmt: skip
    y, x = torch.meshgrid(torch.arange(HEIGHT) + 0.5, torch.arange(WIDTH) + 0.5, indexing="ij")
    images, alphas = [], []
    for camera, viewmat in enumerate(viewmats):
        colors = leaves["colors"]
        if options["sh_degree"] is not None:
            directions = leaves["means"] - torch.linalg.inv(viewmat)[:3, 3]
            shown = formulas._spherical_harmonics(options["sh_degree"], directions, colors)
            colors = (shown + 0.5).clamp(min=0)
        if "D" in options.get("render_mode", "RGB"):
            colors = torch.cat([colors, depths[camera][:, None]], 1)
        opacities = leaves["opacities"] if kept is None else leaves["opacities"] * kept[camera]
        image = torch.zeros(HEIGHT, WIDTH, colors.shape[1], dtype=colors.dtype)
        left = torch.ones(HEIGHT, WIDTH, dtype=colors.dtype)
        going = torch.ones(HEIGHT, WIDTH, dtype=torch.bool)
        for i in depths[camera].argsort().tolist():
            if not radii[camera, i].all():
                continue
            dx, dy = x - centres[camera, i, 0], y - centres[camera, i, 1]
            a, b, c = conics[camera, i]
            sigma = (a * dx**2 + c * dy**2) / 2 + b * dx * dy
            alpha = (opacities[i] * torch.exp(-sigma)).clamp(max=0.999)
            counts = going & (alpha >= 1 / 255)
            after = left * (1 - alpha)
            going = going & ~(counts & (after <= 1e-4))
            counts = counts & going
            image = image + torch.where(counts, alpha * left, 0)[..., None] * colors[i]
            left = torch.where(counts, after, left)
        if "ED" in options.get("render_mode", "RGB"):
            depth = image[..., -1:] / (1 - left)[..., None].clamp(min=1e-10)
            image = torch.cat([image[..., :-1], depth], 2)
        channels = leaves["backgrounds"].shape[1]
        behind = left[..., None] * leaves["backgrounds"][camera]
        images.append(torch.cat([image[..., :channels] + behind, image[..., channels:]], 2))
        alphas.append(1 - left)
    return torch.stack(images), torch.stack(alphas)


def compared(leaves, options, backend: str):
    images, alphas, _ = rasterization(
        **leaves, width=WIDTH, height=HEIGHT, near_plane=0.2, backend=backend, **options
    )
    return images, alphas[..., 0]


def agree(theirs, ours, sure) -> None:
    """Images to 1e-4, gradients to 1e-3 of the largest."""
    weights = None
    gradients = []
    for (images, _), leaves in (theirs, ours):
        if weights is None:
            generator = torch.Generator().manual_seed(4)
            weights = torch.rand(images.shape, generator=generator) * sure[..., None]
        (images * weights.to(images)).sum().backward()
        gradients.append({name: leaf.grad for name, leaf in leaves.items() if name != "Ks"})
    (first, first_alphas), (second, second_alphas) = theirs[0], ours[0]
    assert (first - second)[sure].abs().max() < 1e-4 * max(
        1, float(first[sure].detach().abs().max())
    )
    assert (first_alphas - second_alphas)[sure].abs().max() < 1e-4
    for name in ("means", "quats", "scales", "opacities", "colors", "backgrounds"):
        wanted, found = gradients[0][name].double(), gradients[1][name].double()
        assert (wanted - found).abs().max() < 1e-3 * wanted.abs().max(), name


@pytest.mark.parametrize("options", CASES)
def test_our_kernels_draw_what_its_formulas_say(options: dict) -> None:
    sh = options["sh_degree"] is not None
    precise, ours = inputs(torch.float64, sh), inputs(torch.float32, sh)
    for leaves in (precise, ours):  # up to the limit of alpha
        leaves["opacities"].data[::7] = 0.9999
    theirs = by_formulas(precise, options)
    sure = sure_pixels(precise, options) & (theirs[1] > 0.02)
    assert sure.double().mean() > 0.4
    agree((theirs, precise), (compared(ours, options, "cpu"), ours), sure)


def test_it_takes_what_we_hand_it(monkeypatch: pytest.MonkeyPatch) -> None:
    signature = inspect.signature(gsplat.rasterization)

    def stand_in(*arguments, **options):
        signature.bind(*arguments, **options)
        return torch.ones(2, HEIGHT, WIDTH, 6), torch.ones(2, HEIGHT, WIDTH, 1), {}

    monkeypatch.setattr(sys.modules["gsplat"], "rasterization", stand_in)
    monkeypatch.setattr(torch_api.torch, "device", lambda name: "cpu")
    leaves = {name: value.detach() for name, value in inputs(torch.float32, sh=False).items()}
    images, alphas, _ = rasterization(
        **leaves, width=WIDTH, height=HEIGHT, near_plane=0.2, absgrad=True, render_mode="RGB+ED",
        rasterize_mode="antialiased", backend="gsplat",
    )  # fmt: skip
    assert images.shape == (2, HEIGHT, WIDTH, 6) and alphas.shape == (2, HEIGHT, WIDTH, 1)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs an NVIDIA card")
@pytest.mark.parametrize("options", CASES)
def test_its_kernels_draw_what_ours_do(options: dict) -> None:
    sh = options["sh_degree"] is not None
    theirs, ours = inputs(torch.float32, sh), inputs(torch.float32, sh)
    theirs["Ks"] = theirs["Ks"].detach()
    found = compared(theirs, options, "gsplat")
    sure = sure_pixels(ours, options) & (found[1].detach() > 0.02)
    agree((found, theirs), (compared(ours, options, "cpu"), ours), sure)
