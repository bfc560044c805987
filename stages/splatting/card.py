"""The rasterizer of a fit on a graphics card: what `rasterizer` does, by gsplat through torch.

Arrays go in and come out, so that a fit need not know which of the two it has. Colour, depth and
motion on the screen are worked out per Gaussian in plain torch and composited in one pass. Sums on
a card have no fixed order: results agree with those of the processor, but are not the same bytes.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from stages.splatting import reference
from stages.splatting.kernels.projection import HARMONICS
from stages.splatting.rasterizer import Viewpoint
from stages.splatting.torch_api import Backend, rasterization

Array = npt.NDArray[np.float64]
Floats = npt.NDArray[np.float32]


@dataclass(frozen=True)
class CardGradients:
    """What a fit takes of `rasterizer.Gradients`, under the same names."""

    packed: Floats
    pose: Array
    next_pose: Array
    centres: Floats
    absolute: Floats


@dataclass(frozen=True)
class CardRendering:
    """What a fit takes of `rasterizer.Rendering`, under the same names."""

    planes: Floats
    transmittance: Floats
    visible: npt.NDArray[np.bool_]
    _leaves: dict[str, Tensor]
    _outputs: tuple[Tensor, Tensor]
    _centres: Tensor

    def backward(self, d_planes: Floats, d_transmittance: Floats) -> CardGradients:
        """Gradients of all inputs; see `rasterizer.Rendering.backward`."""
        images, alphas = self._outputs
        given = [
            _sent(d_planes, images.device).permute(1, 2, 0)[None],
            -_sent(d_transmittance, alphas.device)[None, ..., None],
        ]
        torch.autograd.backward([images, alphas], given)
        found = {name: _array(_gradient(leaf)) for name, leaf in self._leaves.items()}
        return CardGradients(
            packed=found["packed"],
            pose=found["twist"].astype(np.float64),
            next_pose=found["next_twist"].astype(np.float64),
            centres=_array(_gradient(self._centres)).reshape(-1, 2),
            absolute=_array(self._centres.absgrad).reshape(-1, 2),  # type: ignore[attr-defined]
        )


def rasterize_on_card(
    packed: Floats,
    viewpoint: Viewpoint,
    *,
    degree: int,
    near: float,
    depth: bool = False,
    flow_to: Viewpoint | None = None,
    device: str = "cuda",
    backend: Backend = "gsplat",
) -> CardRendering:
    """Render colour, depth and flow of a packed scene in one pass.

    Args:
        packed, viewpoint, degree, near, depth, flow_to: as `rasterizer.rasterize` has them.
        device: where torch works.
        backend: of `torch_api.rasterization`.
    """
    leaves = {
        "packed": _sent(packed, torch.device(device)),
        "twist": torch.zeros(6, device=device),
        "next_twist": torch.zeros(6, device=device),
    }
    for leaf in leaves.values():
        leaf.requires_grad_(True)
    scene = leaves["packed"]
    means, sh = scene[:, :3], scene[:, HARMONICS:].reshape(len(scene), -1, 3)
    pose = _moved(viewpoint, leaves["twist"])
    intrinsics = torch.from_numpy(viewpoint.intrinsics).to(device)
    features = [_colours(means, sh, pose, degree, backend)]
    if depth or flow_to is not None:
        _, centres, z = reference.project(means, pose, intrinsics, near)
    if depth:
        features.append(z[:, None])
    if flow_to is not None:
        further = torch.from_numpy(flow_to.intrinsics).to(device)
        there = _moved(flow_to, leaves["next_twist"])
        features.append(reference.project(means, there, further, near)[1] - centres)
    fx, fy, cx, cy = viewpoint.intrinsics.tolist()
    images, alphas, meta = rasterization(
        means, scene[:, 3:7], scene[:, 7:10].exp(), scene[:, 10].sigmoid(),
        torch.cat(features, 1), pose[None],
        torch.tensor([[[fx, 0, cx], [0, fy, cy], [0, 0, 1]]], device=device),
        viewpoint.width, viewpoint.height, near_plane=near, absgrad=True, backend=backend,
    )  # fmt: skip
    meta["means2d"].retain_grad()
    radii = meta["radii"].detach().reshape(len(scene), -1)
    return CardRendering(
        planes=_array(images[0].permute(2, 0, 1)),
        transmittance=_array(1 - alphas[0, ..., 0]),
        visible=_array((radii > 0).all(dim=1)),
        _leaves=leaves, _outputs=(images, alphas), _centres=meta["means2d"],
    )  # fmt: skip


def _colours(means: Tensor, sh: Tensor, pose: Tensor, degree: int, backend: Backend) -> Tensor:
    """[N, 3] of harmonics [N, K, 3] towards a camera; by gsplat in one kernel for a hundred."""
    if backend != "gsplat":
        return reference.colours(means, sh, pose, degree)
    from gsplat import spherical_harmonics

    directions = means + pose[:3, :3].T @ pose[:3, 3]
    return (spherical_harmonics(degree, directions, sh) + 0.5).clamp(min=0)


def _moved(viewpoint: Viewpoint, twist: Tensor) -> Tensor:
    """[4, 4] cam_from_world after a small twist (v, w) from the left, whose gradient is wanted."""
    pose = torch.eye(4, device=twist.device)
    pose[:3] = torch.from_numpy(viewpoint.pose).to(twist.device)
    v, (x, y, z) = twist[:3], twist[3:]
    zero = torch.zeros_like(x)
    hat = torch.stack(
        [
            torch.stack([zero, -z, y, v[0]]),
            torch.stack([z, zero, -x, v[1]]),
            torch.stack([-y, x, zero, v[2]]),
            torch.zeros_like(torch.cat([v, x[None]])),
        ]
    )
    return pose + hat @ pose


def _gradient(tensor: Tensor) -> Tensor:
    return torch.zeros_like(tensor) if tensor.grad is None else tensor.grad


def _sent(array: npt.NDArray[Any], device: torch.device) -> Tensor:
    """A copy of an array on the device."""
    here = torch.from_numpy(np.ascontiguousarray(array))
    return here.clone() if device.type == "cpu" else here.pin_memory().to(device, non_blocking=True)


def _array(tensor: Tensor) -> npt.NDArray[Any]:
    """What a tensor holds, contiguous, in memory that the card writes to by itself (pinned)."""
    held = tensor.detach().contiguous()
    if held.device.type == "cpu":
        return np.asarray(held.numpy())
    fetched = torch.empty(held.shape, dtype=held.dtype, pin_memory=True)
    return np.asarray(fetched.copy_(held).numpy())
