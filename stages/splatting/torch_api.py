"""The rasterizer as a torch function with the shape of `gsplat.rasterization`, on any backend.

    colors, alphas, meta = rasterization(means, quats, scales, opacities, sh, viewmats, Ks, w, h,
                                         sh_degree=3, render_mode="RGB+ED")

``cpu`` runs the kernels of `rasterizer` (float32, inputs of another type are converted), ``gsplat``
the library of that name on a CUDA card, ``reference`` plain torch (slow; in the precision of its
inputs). ``auto`` takes gsplat where it and a card are, else cpu.
"""

from __future__ import annotations

import importlib.util
from dataclasses import dataclass
from typing import Any, Literal, get_args

import numpy as np
import torch
from torch import Tensor

from pipeline.geometry.rigid import skew
from stages.splatting import reference
from stages.splatting.rasterizer import LOW_PASS, Rendering, Viewpoint, rasterize

Backend = Literal["auto", "cpu", "gsplat", "reference"]
RenderMode = Literal["RGB", "D", "ED", "RGB+D", "RGB+ED"]
RasterizeMode = Literal["classic", "antialiased"]
#: logarithms of scales and of odds are held there: what is beyond is 0 or 1 in float32
FARTHEST = 80.0


def choose_backend() -> Literal["cpu", "gsplat"]:
    """What ``auto`` stands for on this machine."""
    installed = importlib.util.find_spec("gsplat") is not None
    return "gsplat" if installed and torch.cuda.is_available() else "cpu"


def rasterization(
    means: Tensor, quats: Tensor, scales: Tensor, opacities: Tensor, colors: Tensor,
    viewmats: Tensor, Ks: Tensor, width: int, height: int, *, near_plane: float = 0.01,
    eps2d: float = LOW_PASS, sh_degree: int | None = None, backgrounds: Tensor | None = None,
    masks: Tensor | None = None, render_mode: RenderMode = "RGB",
    rasterize_mode: RasterizeMode = "classic", absgrad: bool = False, backend: Backend = "auto",
) -> tuple[Tensor, Tensor, dict[str, Any]]:  # fmt: skip
    """Render Gaussians in one or more cameras; differentiable in all tensors.

    Args:
        means: [N, 3] in the world.
        quats: [N, 4] wxyz, of any length.
        scales: [N, 3] standard deviations.
        opacities: [N] in 0..1.
        colors: [N, D] or [C, N, D] features of any number of channels, or with `sh_degree`
            [N, K, 3] or [C, N, K, 3] spherical harmonics.
        viewmats: [C, 4, 4] cam_from_world. On the CPU their gradient is that of the rigid motions:
            the one component of a free 4x4 matrix that keeps it a pose.
        Ks: [C, 3, 3] intrinsics in px; fx, fy, cx, cy get a gradient (not from gsplat).
        width, height: of the images.
        near_plane: Gaussians whose centre is nearer are not drawn.
        eps2d: variance added to every 2D covariance, px^2.
        sh_degree: 0..3, or None where `colors` are features.
        backgrounds: [C, D] what is behind everything.
        masks: [C, H, W] bool, pixels to render; the others are empty, in front of the background.
        render_mode: features, accumulated depth (D), depth divided by alpha (ED), or both.
        rasterize_mode: ``"antialiased"`` lowers the opacity of small Gaussians (Mip-Splatting).
        absgrad: have ``meta["means2d"].absgrad`` [C, N, 2] after the backward pass (AbsGS).
        backend: see above.

    Returns:
        Images [C, H, W, X], alphas [C, H, W, 1], and a dictionary with ``means2d`` [C, N, 2] (after
        the backward pass its ``grad`` is the sum over the pixels; with gsplat after
        ``retain_grad()``), ``radii`` [C, N, 2] px (0: not visible), ``depths`` [C, N], ``width``,
        ``height``, ``n_cameras`` and, from the fast backends, ``conics`` [C, N, 3] and
        ``opacities`` [C, N].

    Raises:
        ValueError: a shape or an option is wrong.
    """
    for name, value, allowed in (
        ("backend", backend, get_args(Backend)),
        ("render_mode", render_mode, get_args(RenderMode)),
        ("rasterize_mode", rasterize_mode, get_args(RasterizeMode)),
    ):
        if value not in allowed:
            raise ValueError(f"{name} must be one of {', '.join(allowed)}, got {value!r}")
    _check_shapes(means, quats, scales, opacities, colors, viewmats, Ks, sh_degree)
    if backend == "auto":
        backend = choose_backend()
    if backend == "gsplat":
        return _gsplat(
            means, quats, scales, opacities, colors, viewmats, Ks, width, height, masks,
            near_plane=near_plane, eps2d=eps2d, sh_degree=sh_degree, backgrounds=backgrounds,
            render_mode=render_mode, rasterize_mode=rasterize_mode, absgrad=absgrad,
        )  # fmt: skip
    request = _Request(
        width, height, near_plane, eps2d, sh_degree, rasterize_mode == "antialiased",
        "RGB" in render_mode, "D" in render_mode, absgrad,
    )  # fmt: skip
    per_camera = colors.dim() == (3 if sh_degree is None else 4)
    draw = _reference if backend == "reference" else _cpu
    images, alphas, metas = [], [], []
    for camera in range(len(viewmats)):
        planes, alpha, meta = draw(
            request, means, quats, scales, opacities, colors[camera] if per_camera else colors,
            viewmats[camera], Ks[camera], None if masks is None else masks[camera],
        )  # fmt: skip
        if backgrounds is not None and request.with_colour:
            channels = backgrounds.shape[1]
            behind = (1 - alpha) * backgrounds[camera, :, None, None]
            planes = torch.cat([planes[:channels] + behind, planes[channels:]])
        if render_mode.endswith("ED"):
            planes = torch.cat([planes[:-1], planes[-1:] / alpha.clamp(min=1e-10)])
        images.append(planes.permute(1, 2, 0))
        alphas.append(alpha[..., None])
        metas.append(meta)
    facts = {"width": width, "height": height, "n_cameras": len(viewmats)}
    return torch.stack(images), torch.stack(alphas), _merge(metas) | facts


@dataclass(frozen=True)
class _Request:
    """What all cameras share."""

    width: int
    height: int
    near: float
    low_pass: float
    degree: int | None
    antialiased: bool
    with_colour: bool
    with_depth: bool
    absgrad: bool


def _check_shapes(
    means: Tensor, quats: Tensor, scales: Tensor, opacities: Tensor, colors: Tensor,
    viewmats: Tensor, Ks: Tensor, sh_degree: int | None,
) -> None:  # fmt: skip
    n, cameras = len(means), len(viewmats)
    if cameras == 0:
        raise ValueError("viewmats holds no camera")
    for name, tensor, shape in (
        ("means", means, (n, 3)), ("quats", quats, (n, 4)), ("scales", scales, (n, 3)),
        ("opacities", opacities, (n,)), ("viewmats", viewmats, (cameras, 4, 4)),
        ("Ks", Ks, (cameras, 3, 3)),
    ):  # fmt: skip
        if tuple(tensor.shape) != shape:
            raise ValueError(f"{name} must have the shape {shape}, got {tuple(tensor.shape)}")
    inner = tuple(colors.shape)
    if len(inner) == (3 if sh_degree is None else 4) and inner[0] == cameras:
        inner = inner[1:]
    if sh_degree is None:
        if len(inner) != 2 or inner[0] != n:
            raise ValueError(f"colors must be [{n}, D] or [{cameras}, {n}, D], got {colors.shape}")
    elif len(inner) != 3 or inner[0] != n or inner[1] < (sh_degree + 1) ** 2 or inner[2] != 3:
        raise ValueError(
            f"colors of degree {sh_degree} must be [{n}, K, 3] or [{cameras}, {n}, K, 3] with "
            f"K >= {(sh_degree + 1) ** 2}, got {tuple(colors.shape)}"
        )


class _Kernels(torch.autograd.Function):
    """One camera on the CPU backend; `holder` takes the `Rendering` out."""

    @staticmethod
    def forward(
        ctx: Any, request: _Request, holder: list[Rendering], mask: Tensor | None, handle: Tensor,
        means: Tensor, quats: Tensor, scales: Tensor, opacities: Tensor, colors: Tensor,
        viewmat: Tensor, K: Tensor,
    ) -> tuple[Tensor, Tensor]:  # fmt: skip
        arrays = [_array(value) for value in (means, quats, scales, opacities, colors)]
        centre, quat, scale, opacity, colour = arrays
        # a scale of 0 and an opacity of 1 are infinite here, which the kernels don't draw
        with np.errstate(divide="ignore", invalid="ignore"):
            logs = np.log(scale), np.log(opacity / (1 - opacity))[:, None]
        columns = [centre, quat, *(np.clip(log, -FARTHEST, FARTHEST) for log in logs)]
        if request.with_colour and request.degree is not None:
            columns.append(colour.reshape(len(colour), 3 * colour.shape[1]))
        pose, k = _array(viewmat), _array(K)
        viewpoint = Viewpoint(
            np.ascontiguousarray(pose[:3]), np.array([k[0, 0], k[1, 1], k[0, 2], k[1, 2]]),
            request.width, request.height,
        )  # fmt: skip
        plain = request.with_colour and request.degree is None
        rendering = rasterize(
            np.ascontiguousarray(np.concatenate(columns, 1)), viewpoint,
            degree=request.degree if request.with_colour else None, near=request.near,
            depth=request.with_depth, features=colour if plain else None,
            low_pass=request.low_pass, antialiased=request.antialiased,
            mask=None if mask is None else mask.detach().cpu().numpy().astype(bool),
        )  # fmt: skip
        holder.append(rendering)
        ctx.request, ctx.rendering, ctx.scale, ctx.pose = request, rendering, scale, pose
        ctx.handle, ctx.depth_first = handle, plain and request.with_depth
        ctx.kinds = [(x.dtype, x.device, x.shape) for x in (means, colors)]
        planes = rendering.planes
        if ctx.depth_first:
            planes = np.concatenate([planes[1:], planes[:1]])
        return means.new_tensor(planes), means.new_tensor(1 - rendering.transmittance)

    @staticmethod
    def backward(ctx: Any, *outputs: Tensor) -> Any:
        d_planes, d_alpha = (_array(value) for value in outputs)
        if ctx.depth_first:
            d_planes = np.concatenate([d_planes[-1:], d_planes[:-1]])
        g = ctx.rendering.backward(np.ascontiguousarray(d_planes), np.ascontiguousarray(-d_alpha))
        if ctx.request.absgrad:
            before = getattr(ctx.handle, "absgrad", None)
            now = torch.from_numpy(np.ascontiguousarray(g.absolute))
            ctx.handle.absgrad = now if before is None else before + now
        by_scale = np.divide(g.packed[:, 7:10], ctx.scale, where=ctx.scale > 0,
                             out=np.zeros_like(ctx.scale))  # fmt: skip
        by_K = np.zeros((3, 3))
        by_K[[0, 1, 0, 1], [0, 1, 2, 2]] = np.concatenate([g.focal, g.principal_point])
        (dtype, device, _), (_, _, colour_shape) = ctx.kinds
        if not ctx.request.with_colour:
            by_colour = np.zeros(colour_shape, np.float32)
        elif ctx.request.degree is None:
            by_colour = g.features[:, int(ctx.depth_first) :]
        else:
            by_colour = g.packed[:, 11:].reshape(colour_shape)
        gradients = (
            g.packed[:, 0:3], g.packed[:, 3:7], by_scale, g.opacities, by_colour,
            pose_gradient(ctx.pose, g.pose), by_K,
        )  # fmt: skip
        return (
            None, None, None, torch.from_numpy(g.centres),
            *(torch.tensor(value, dtype=dtype, device=device) for value in gradients),
        )  # fmt: skip


def pose_gradient(pose: np.ndarray, twist: np.ndarray) -> np.ndarray:
    """[4, 4] gradient of a rigid cam_from_world from that of a twist (v, w) from the left.

    Of all matrices with the same effect on rigid motions, the one without a part along others:
    with G = [a]x R / 2 the inner product with [w]x R is a w.
    """
    v, w = twist[:3], twist[3:]
    a = 0.5 * (w - np.cross(pose[:3, 3].astype(np.float64), v))
    result = np.zeros((4, 4))
    result[:3, :3] = skew(a) @ pose[:3, :3]
    result[:3, 3] = v
    return result


def _array(tensor: Tensor) -> np.ndarray:
    """Contiguous float32 on the CPU."""
    return np.ascontiguousarray(tensor.detach().cpu().numpy(), np.float32)


def _cpu(
    request: _Request, means: Tensor, quats: Tensor, scales: Tensor, opacities: Tensor,
    colors: Tensor, viewmat: Tensor, K: Tensor, mask: Tensor | None,
) -> tuple[Tensor, Tensor, dict[str, Tensor]]:  # fmt: skip
    handle = torch.zeros(len(means), 2, requires_grad=True)
    holder: list[Rendering] = []
    planes, alpha = _Kernels.apply(
        request, holder, mask, handle, means, quats, scales, opacities, colors, viewmat, K
    )
    screen, visible = holder[0].screen, holder[0].visible[:, None]
    with torch.no_grad():
        handle.copy_(torch.from_numpy(np.where(visible, screen[:, :2], 0)))
    meta = {
        "means2d": handle,
        "radii": torch.from_numpy(np.where(visible, np.ceil(screen[:, 6:8]), 0).astype(np.int32)),
        "depths": torch.from_numpy(screen[:, 8].copy()),
        "conics": torch.from_numpy(np.where(visible, screen[:, 2:5], 0)),
        "opacities": torch.from_numpy(np.where(visible[:, 0], screen[:, 5], 0)),
    }
    return planes, alpha, meta


def _reference(
    request: _Request, means: Tensor, quats: Tensor, scales: Tensor, opacities: Tensor,
    colors: Tensor, viewmat: Tensor, K: Tensor, mask: Tensor | None,
) -> tuple[Tensor, Tensor, dict[str, Tensor]]:  # fmt: skip
    intrinsics = torch.stack([K[0, 0], K[1, 1], K[0, 2], K[1, 2]])
    local, centres, _ = reference.project(means, viewmat, intrinsics, request.near)
    columns = []
    if request.with_colour:
        colour = colors if request.degree is None else reference.colours(
            means, colors, viewmat, request.degree
        )  # fmt: skip
        columns.append(colour)
    if request.with_depth:
        columns.append(local[:, 2:])
    result = reference.rasterize(
        means, quats, scales, opacities, torch.cat(columns, 1), viewmat, intrinsics, request.width,
        request.height, near=request.near, low_pass=request.low_pass,
        antialiased=request.antialiased, mask=mask, track_screen=means.requires_grad,
    )  # fmt: skip
    handle = centres.detach().clone().requires_grad_(True)
    handle.grad = torch.zeros_like(handle)
    if request.absgrad:
        handle.absgrad = torch.zeros_like(handle)  # type: ignore[attr-defined]

    def collect(index: int, gradient: Tensor) -> None:
        assert handle.grad is not None
        handle.grad[index] += gradient.sum((0, 1))
        if request.absgrad:
            handle.absgrad[index] += gradient.abs().sum((0, 1))  # type: ignore[attr-defined]

    for i, centre in result.per_pixel.items():
        centre.register_hook(lambda gradient, i=i: collect(i, gradient))
    radii = result.visible[:, None].expand(-1, 2).to(torch.int32)
    meta = {"means2d": handle, "radii": radii, "depths": local[:, 2].detach()}
    return result.planes, 1 - result.transmittance, meta


def _merge(metas: list[dict[str, Tensor]]) -> dict[str, Any]:
    """Stack what there is of each camera."""
    merged: dict[str, Any] = {
        name: torch.stack([meta[name].detach() for meta in metas])
        for name in metas[0]
        if name != "means2d"
    }
    merged["means2d"] = ScreenCentres([meta["means2d"] for meta in metas])
    return merged


class ScreenCentres:
    """Centres on the screen [C, N, 2] whose gradients the backward pass leaves here."""

    def __init__(self, cameras: list[Tensor]) -> None:
        self._cameras = cameras

    @property
    def data(self) -> Tensor:
        """[C, N, 2] px."""
        return torch.stack([camera.detach() for camera in self._cameras])

    @property
    def grad(self) -> Tensor:
        """[C, N, 2] sums over the pixels."""
        return torch.stack([camera.grad for camera in self._cameras])  # type: ignore[misc]

    @property
    def absgrad(self) -> Tensor:
        """[C, N, 2] sums of absolute values over the pixels."""
        return torch.stack([camera.absgrad for camera in self._cameras])  # type: ignore[attr-defined]

    def retain_grad(self) -> None:
        """For code written for gsplat; the gradient is kept anyway."""


def _gsplat(
    means: Tensor, quats: Tensor, scales: Tensor, opacities: Tensor, colors: Tensor,
    viewmats: Tensor, Ks: Tensor, width: int, height: int, masks: Tensor | None, **options: Any,
) -> tuple[Tensor, Tensor, dict[str, Any]]:  # fmt: skip
    """Hand everything to gsplat on the card, and bring the images back to where the means are."""
    try:
        import gsplat
    except ImportError as error:
        raise ValueError(
            "backend 'gsplat' needs the package gsplat and a CUDA card: install dentalsplat[gpu], "
            "or take the backend 'cpu'."
        ) from error
    if Ks.requires_grad:
        raise ValueError("gsplat gives no gradient of Ks; take the backend 'cpu' for that.")
    card = torch.device("cuda")
    backgrounds = options.pop("backgrounds")
    tensors = (means, quats, scales, opacities, colors, viewmats, Ks)
    images, alphas, meta = gsplat.rasterization(
        *(value.to(card) for value in tensors), width, height, packed=False,
        backgrounds=None if backgrounds is None else backgrounds.to(card), **options,
    )  # fmt: skip
    images, alphas = images.to(means.device), alphas.to(means.device)
    if masks is not None:
        shown = masks[..., None].to(means.device)
        behind = torch.zeros_like(images)
        if backgrounds is not None and "RGB" in options["render_mode"]:
            channels = backgrounds.shape[1]
            behind[..., :channels] = backgrounds[:, None, None].to(means.device)
        images = torch.where(shown, images, behind)
        alphas = alphas * shown
    return images, alphas, meta
