"""A random scene for the torch function, and the pixels of it that are sure."""

from __future__ import annotations

import numpy as np
import torch

WIDTH, HEIGHT = 36, 20


def rotation(axis: tuple[float, float, float]) -> torch.Tensor:
    x, y, z = axis
    return torch.linalg.matrix_exp(torch.tensor([[0, -z, y], [z, 0, -x], [-y, x, 0]]).double())


def inputs(dtype: torch.dtype, sh: bool, channels: int = 5, cameras: int = 2):
    """Leaves of a random scene; the same numbers for every type."""
    rng = np.random.default_rng(2)
    count = 40
    means = np.concatenate([rng.uniform(-1, 1, (count, 2)), rng.uniform(0.3, 3, (count, 1))], 1)
    means[:4, 2] = (-1, 0.1, 0.21, 0.25)
    viewmats = torch.eye(4).double().repeat(cameras, 1, 1)
    for camera in range(cameras):
        viewmats[camera, :3, :3] = rotation((0.1 * camera, -0.2, 0.05))
        viewmats[camera, :3, 3] = torch.tensor([0.1, 0.05 * camera, 0.2])
    values = {
        "means": means, "quats": rng.normal(size=(count, 4)),
        "scales": rng.uniform(0.02, 0.3, (count, 3)), "opacities": rng.uniform(0.05, 0.95, count),
        "colors": rng.normal(size=(count, 16, 3) if sh else (count, channels)),
        "viewmats": viewmats.numpy(),
        "Ks": np.tile([[30.0, 0, 17], [0, 33, 11], [0, 0, 1]], (cameras, 1, 1)),
        "backgrounds": rng.uniform(size=(cameras, 3 if sh else channels)),
    }  # fmt: skip
    # numbers that float32 holds exactly, so that both types see the same scene
    return {
        name: torch.tensor(value.astype(np.float32), dtype=dtype, requires_grad=True)
        for name, value in values.items()
    }


def sure_pixels(leaves, options) -> torch.Tensor:
    """[C, H, W] pixels that no contribution at the edge of being left out can turn."""
    from stages.splatting import reference

    antialiased = options.get("rasterize_mode") == "antialiased"
    margins = []
    for viewmat, K in zip(leaves["viewmats"], leaves["Ks"], strict=True):
        k = torch.stack([K[0, 0], K[1, 1], K[0, 2], K[1, 2]]).detach()
        result = reference.rasterize(
            leaves["means"].detach(), leaves["quats"].detach(), leaves["scales"].detach(),
            leaves["opacities"].detach(), leaves["means"].detach(), viewmat.detach(), k, WIDTH,
            HEIGHT, near=0.2, antialiased=antialiased,
        )  # fmt: skip
        margins.append(result.margin > 1e-3)
    return torch.stack(margins)
