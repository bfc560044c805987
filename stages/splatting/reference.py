"""The rasterizer again: slow, in plain torch, one Gaussian after the other, for tests only.

It says what `rasterizer.rasterize` has to give, in whatever precision its inputs have; autograd
gives the gradients. Nothing is culled, sorted into tiles or approximated here.
Kerbl et al. 2023 (3DGS), Zwicker et al. 2001 (EWA splatting), Yu et al. 2024 (Mip-Splatting).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import torch
from torch import Tensor

#: as `compositing.ALPHA_MAX`, `TRANSMITTANCE_MIN` and `rasterizer.LOW_PASS`, `ALPHA_CUT`
ALPHA_MAX = 0.999
TRANSMITTANCE_MIN = 1e-4
LOW_PASS = 0.3
ALPHA_CUT = 1 / 255
#: the projection is linearised at most this far outside the image, as a share of its size
MARGIN = 0.15


@dataclass
class ReferenceRendering:
    """Attributes:
    planes: [C, H, W] composited features, not divided by alpha.
    transmittance: [H, W], 1 - alpha.
    visible: [N] bool, in front of the near plane with an opacity above the cut.
    margin: [H, W] how near a pixel came to having one of its yes-or-no decisions turned (a
        contribution left out, a pixel finished), relative: below the precision of an
        implementation, that implementation may come out on the other side.
    per_pixel: per drawn Gaussian the centre as every pixel sees it, [H, W, 2].
    """

    planes: Tensor
    transmittance: Tensor
    visible: Tensor
    margin: Tensor
    per_pixel: dict[int, Tensor] = field(repr=False)

    def screen_gradients(self) -> tuple[Tensor, Tensor]:
        """Signed and absolute gradients [N, 2] of the centres, after backward (`track_screen`)."""
        signed = self.planes.new_zeros(len(self.visible), 2)
        absolute = torch.zeros_like(signed)
        for i, centre in self.per_pixel.items():
            if centre.grad is not None:
                signed[i] = centre.grad.sum((0, 1))
                absolute[i] = centre.grad.abs().sum((0, 1))
        return signed, absolute


def rotation_matrices(quats: Tensor) -> Tensor:
    """[N, 3, 3] of quaternions wxyz [N, 4] of any length."""
    w, x, y, z = torch.nn.functional.normalize(quats, dim=1).unbind(1)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return torch.stack([torch.stack(row, 1) for row in rows], 1)


def harmonics(directions: Tensor, degree: int) -> Tensor:
    """[N, (degree + 1)^2] real spherical harmonics of unit vectors, signs and order of 3DGS."""
    x, y, z = directions.unbind(1)
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


def colours(means: Tensor, sh: Tensor, pose: Tensor, degree: int) -> Tensor:
    """[N, 3] colours of harmonics `sh` [N, K, 3] seen from a camera."""
    eye = -pose[:3, :3].T @ pose[:3, 3]
    basis = harmonics(torch.nn.functional.normalize(means - eye, dim=1), degree)
    return ((basis[..., None] * sh[:, : basis.shape[1]]).sum(1) + 0.5).clamp(min=0)


def project(
    means: Tensor, pose: Tensor, intrinsics: Tensor, near: float
) -> tuple[Tensor, Tensor, Tensor]:
    """Centres in the camera [N, 3] and on the screen [N, 2]; depth is held at `near` there."""
    local = means @ pose[:3, :3].T + pose[:3, 3]
    z = local[:, 2].clamp(min=near)
    return local, local[:, :2] / z[:, None] * intrinsics[:2] + intrinsics[2:], z


def covariances(
    quats: Tensor, scales: Tensor, local: Tensor, z: Tensor, pose: Tensor, intrinsics: Tensor,
    width: int, height: int,
) -> Tensor:  # fmt: skip
    """[N, 2, 2] on the screen, without the low-pass; the projection is linearised at the centre.

    Outside the image (plus 15 %) the Jacobian of its border is taken.
    """
    size = intrinsics.new_tensor([width, height])
    lowest = -intrinsics[2:] - MARGIN * size
    highest = size - intrinsics[2:] + MARGIN * size
    offset = local[:, :2] / z[:, None] * intrinsics[:2]
    offset = torch.minimum(torch.maximum(offset, lowest), highest) / z[:, None]
    jacobian = offset.new_zeros(len(z), 2, 3)
    jacobian[:, 0, 0] = intrinsics[0] / z
    jacobian[:, 1, 1] = intrinsics[1] / z
    jacobian[:, :, 2] = -offset
    half = jacobian @ pose[:3, :3] @ (rotation_matrices(quats) * scales[:, None])
    return half @ half.transpose(1, 2)


def rasterize(
    means: Tensor, quats: Tensor, scales: Tensor, opacities: Tensor, features: Tensor,
    pose: Tensor, intrinsics: Tensor, width: int, height: int, *, near: float,
    low_pass: float = LOW_PASS, alpha_cut: float = ALPHA_CUT, antialiased: bool = False,
    mask: Tensor | None = None, track_screen: bool = False,
) -> ReferenceRendering:  # fmt: skip
    """Composite features of Gaussians, front to back.

    Args:
        means: [N, 3], quats: [N, 4] wxyz, scales: [N, 3], opacities: [N]; as they are, without
            logarithms.
        features: [N, C], any number of channels.
        pose: [3 or 4, 4] cam_from_world.
        intrinsics: [4] fx, fy, cx, cy.
        width, height: of the image.
        near, low_pass, alpha_cut, antialiased: as for `rasterizer.rasterize`.
        mask: [H, W] bool, pixels to render, or None for all.
        track_screen: keep what `screen_gradients` needs.
    """
    local, centres, z = project(means, pose, intrinsics, near)
    drawn = local[:, 2] > near
    plain = covariances(quats, scales, local, z, pose, intrinsics, width, height)
    # without a gradient through what is not drawn
    plain = torch.where(drawn[:, None, None], plain, torch.eye(2, dtype=plain.dtype))
    smoothed = plain + low_pass * torch.eye(2, dtype=plain.dtype)
    if antialiased:
        ratio = torch.linalg.det(plain) / torch.linalg.det(smoothed)
        opacities = opacities * torch.sqrt(ratio.clamp(min=torch.finfo(ratio.dtype).tiny))
    visible = drawn & (opacities > alpha_cut)
    inverse = torch.linalg.inv(smoothed)
    v, u = torch.meshgrid(
        torch.arange(height, dtype=means.dtype) + 0.5, torch.arange(width, dtype=means.dtype) + 0.5,
        indexing="ij",
    )  # fmt: skip
    pixels = torch.stack([u, v], 2)
    planes = means.new_zeros(features.shape[1], height, width)
    left = means.new_ones(height, width)
    done = torch.zeros(height, width, dtype=torch.bool) if mask is None else ~mask.bool()
    margin = means.new_full((height, width), math.inf)
    per_pixel: dict[int, Tensor] = {}
    for i in torch.argsort(local[:, 2].detach(), stable=True).tolist():
        if not visible[i]:
            continue
        centre = centres[i].expand(height, width, 2).clone()
        if track_screen:
            centre.retain_grad()
            per_pixel[i] = centre
        d = pixels - centre
        power = -0.5 * torch.einsum("hwi,ij,hwj->hw", d, inverse[i], d)
        raw = (opacities[i] * power.exp()).clamp(max=ALPHA_MAX)
        alpha = torch.where(raw >= alpha_cut, raw, torch.zeros_like(raw))
        after = left * (1 - alpha)
        with torch.no_grad():
            close = torch.minimum(
                (raw / alpha_cut - 1).abs(), (after / TRANSMITTANCE_MIN - 1).abs()
            )
            margin = torch.where(done, margin, torch.minimum(margin, close))
        done = done | (after < TRANSMITTANCE_MIN)
        weight = torch.where(done, torch.zeros_like(alpha), alpha * left)
        planes = planes + weight * features[i, :, None, None]
        left = left - weight
    return ReferenceRendering(planes, left, visible, margin, per_pixel)
