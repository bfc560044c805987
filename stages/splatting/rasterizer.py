"""The differentiable rasterizer: Gaussians and a camera in, images out, and back again.

The shape of it follows `gsplat.rasterization`: arrays in, image, alpha and what densification needs
out; `Rendering.backward` takes the gradients of the outputs and gives those of every input.
Kerbl et al. 2023 (3DGS), Zwicker et al. 2001 (EWA splatting), Ye et al. 2024 (absolute gradients),
Yu et al. 2024 (Mip-Splatting: the antialiased variant).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from pipeline.artifacts.cameras import Camera
from pipeline.artifacts.gaussians import SH_COEFFICIENTS, Gaussians
from stages.splatting.kernels.compositing import (
    aligned_empty,
    composite_backward,
    composite_forward,
    slot_columns,
)
from stages.splatting.kernels.features import features_backward, features_forward
from stages.splatting.kernels.gathering import gather
from stages.splatting.kernels.projection import (
    CAMERA_GRADIENTS,
    CHUNK,
    HARMONICS,
    SCREEN_COLUMNS,
    SCREEN_GRADIENTS,
    project_forward,
)
from stages.splatting.kernels.projection_back import project_backward
from stages.splatting.kernels.tiles import TILE, count_tiles, fill_tiles, list_tiles, order_by_depth
from stages.splatting.threads import KERNELS, use_threads, workers

__all__ = ["Gradients", "Rendering", "Viewpoint", "pack", "rasterize", "unpack", "use_threads"]

Floats = npt.NDArray[np.float32]
Doubles = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int32]
F = np.float32

#: variance added to every 2D covariance, px^2 (3DGS)
LOW_PASS = 0.3
#: alpha below which a contribution is left out (3DGS). Tests against finite differences lower it.
ALPHA_CUT = 1 / 255
#: the kernels composite at least this many features; what is missing is padded
COLOURS = 3


@dataclass(frozen=True)
class Viewpoint:
    """A camera as the kernels want it.

    Attributes:
        pose: [3, 4] float32 cam_from_world.
        intrinsics: [4] float32 fx, fy, cx, cy in pixels.
        width, height: image size.
    """

    pose: Floats
    intrinsics: Floats
    width: int
    height: int

    @classmethod
    def of(cls, camera: Camera) -> Viewpoint:
        return cls(
            np.ascontiguousarray(camera.cam_from_world[:3], np.float32),
            np.array([camera.fx, camera.fy, camera.cx, camera.cy], np.float32),
            camera.width, camera.height,
        )  # fmt: skip

    @property
    def centre(self) -> Floats:
        """[3] float32 projection centre in the world."""
        pose = self.pose.astype(np.float64)
        return np.ascontiguousarray(-pose[:, :3].T @ pose[:, 3], np.float32)


def pack(
    means: Floats, quats_wxyz: Floats, log_scales: Floats, logit_opacities: Floats, sh: Floats
) -> Floats:
    """Put the arrays of `Gaussians` into one matrix [N, 11 + 3 K] float32 (see `projection`)."""
    columns = [means, quats_wxyz, log_scales, logit_opacities[:, None], sh.reshape(len(sh), -1)]
    return np.ascontiguousarray(np.concatenate(columns, 1), np.float32)


def unpack(packed: Floats) -> Gaussians:
    """The inverse of `pack`; quaternions are normalised, missing harmonics are zero."""
    count, terms = len(packed), (packed.shape[1] - HARMONICS) // 3
    sh = np.zeros((count, SH_COEFFICIENTS, 3), np.float32)
    sh[:, :terms] = packed[:, HARMONICS:].reshape(count, terms, 3)
    quats = packed[:, 3:7]
    return Gaussians(
        means=packed[:, :3].copy(),
        quats_wxyz=quats / np.linalg.norm(quats, axis=1, keepdims=True),
        log_scales=packed[:, 7:10].copy(),
        logit_opacities=packed[:, 10].copy(),
        sh=sh,
    )


@dataclass(frozen=True)
class Gradients:
    """Attributes:
    packed: [N, 11 + 3 K] gradient of the scene.
    opacities: [N] float32 gradient of the opacity itself, of which `packed` has the logit's.
    pose: [6] float64 of a twist (translation 3, rotation 3) applied to cam_from_world from the
        left: cam_from_world <- exp(twist) cam_from_world.
    focal: [2] float64 of fx, fy.
    principal_point: [2] float64 of cx, cy.
    next_pose: [6] float64, twist of the camera that the flow leads to.
    next_focal, next_principal_point: [2] float64 of that camera.
    centres: [N, 2] float32 gradient of the projected centres, px^-1.
    absolute: [N, 2] float32 sums of its absolute per-pixel values (AbsGS).
    features: [N, C] float32 gradient of what was composited, in the order of the planes.
    """

    packed: Floats
    opacities: Floats
    pose: Doubles
    focal: Doubles
    principal_point: Doubles
    next_pose: Doubles
    next_focal: Doubles
    next_principal_point: Doubles
    centres: Floats
    absolute: Floats
    features: Floats


@dataclass(frozen=True)
class _Pass:
    """What the backward pass needs of the forward pass."""

    packed: Floats
    viewpoint: Viewpoint
    following: Viewpoint
    degree: int
    near: float
    low_pass: float
    alpha_cut: float
    antialiased: int
    with_depth: int
    with_flow: int
    tiles_x: int
    tiles_y: int
    offsets: Ints
    members: Ints
    first_slot: Ints
    slots: Ints
    stop: Ints
    blocks: npt.NDArray[np.int64]
    features: Floats


@dataclass(frozen=True)
class Rendering:
    """One pass through the rasterizer, planar, without background.

    Attributes:
        planes: [C, H, W] float32, composited and not divided by alpha: colour 3 (with harmonics),
            depth 1 and flow 2 (where asked for), then the given features.
        transmittance: [H, W] float32, 1 - alpha.
        screen: [N, 16] float32 projected Gaussians (see `projection`).
    """

    planes: Floats
    transmittance: Floats
    screen: Floats
    _forward: _Pass

    @property
    def visible(self) -> npt.NDArray[np.bool_]:
        """[N] bool, Gaussians that touch a tile."""
        return np.asarray(self.screen[:, 6] >= 0)

    @property
    def intersections(self) -> int:
        """Number of pairs of tile and Gaussian."""
        return len(self._forward.members)

    def backward(self, d_planes: Floats, d_transmittance: Floats) -> Gradients:
        """Gradients of all inputs.

        Args:
            d_planes: [C, H, W] float32 contiguous, gradient of `planes`.
            d_transmittance: [H, W] float32.
        """
        with KERNELS:
            return self._backward(d_planes, d_transmittance)

    def _backward(self, d_planes: Floats, d_transmittance: Floats) -> Gradients:
        f = self._forward
        view, after = f.viewpoint, f.following
        channels, padded = len(self.planes), f.features.shape[1]
        if padded > channels:
            d_planes = np.concatenate(
                [d_planes, np.zeros((padded - channels, *d_planes.shape[1:]), np.float32)]
            )
        width = SCREEN_GRADIENTS + padded
        slot_sums = aligned_empty(len(f.members), slot_columns(padded))
        composite_backward(
            workers(), f.tiles_x, f.offsets, f.members, f.slots, self.screen, f.features,
            F(f.alpha_cut), self.transmittance[None], f.stop, f.blocks, d_planes,
            d_transmittance[None], slot_sums,
        )  # fmt: skip
        count = len(self.screen)
        by_screen = np.empty((count, width), np.float32)
        gather(f.first_slot, slot_sums, self.screen, by_screen)
        centres = by_screen[:, 0:2].copy()
        if f.with_flow:
            # flow = next centre - this centre
            column = SCREEN_GRADIENTS + 3 * (f.degree >= 0) + f.with_depth
            by_screen[:, 0:2] -= by_screen[:, column : column + 2]
        gradient = np.empty_like(f.packed)
        chunks = -(-count // CHUNK)
        camera_parts, next_parts = np.zeros((2, chunks, CAMERA_GRADIENTS), np.float32)
        project_backward(
            f.packed, view.pose, view.intrinsics, view.width, view.height, F(f.low_pass),
            f.antialiased, self.screen, by_screen, gradient, camera_parts,
        )  # fmt: skip
        features_backward(
            f.packed, f.degree, view.centre, view.pose, self.screen, after.pose, after.intrinsics,
            f.with_depth, f.with_flow, F(f.near), f.features, by_screen, gradient, camera_parts,
            next_parts,
        )  # fmt: skip
        camera = camera_parts.sum(0, dtype=np.float64)
        following = next_parts.sum(0, dtype=np.float64)
        return Gradients(
            packed=gradient,
            opacities=self._opacity_gradient(by_screen[:, 5]),
            pose=camera[:6],
            focal=camera[6:8],
            principal_point=camera[8:10],
            next_pose=following[:6],
            next_focal=following[6:8],
            next_principal_point=following[8:10],
            centres=centres,
            absolute=by_screen[:, 6:8],
            features=by_screen[:, SCREEN_GRADIENTS : SCREEN_GRADIENTS + channels],
        )

    def _opacity_gradient(self, by_effective: Floats) -> Floats:
        """Gradient of the opacities before the compensation of the antialiased variant."""
        if not self._forward.antialiased:
            return by_effective.copy()
        opacity = 1 / (1 + np.exp(-self._forward.packed[:, 10]))
        share = np.where(self.visible, self.screen[:, 5], 0) / np.maximum(opacity, F(1e-30))
        return np.asarray(by_effective * share, np.float32)


def rasterize(
    packed: Floats,
    viewpoint: Viewpoint,
    *,
    degree: int | None,
    near: float,
    depth: bool = False,
    flow_to: Viewpoint | None = None,
    features: Floats | None = None,
    low_pass: float = LOW_PASS,
    alpha_cut: float = ALPHA_CUT,
    antialiased: bool = False,
    mask: npt.NDArray[np.bool_] | None = None,
) -> Rendering:
    """Render colour, depth, flow and any other features of a packed scene in one pass.

    Args:
        packed: [N, 11 + 3 K] float32 contiguous (see `pack`).
        viewpoint: the camera.
        degree: of the spherical harmonics, 0..3, or None for no colour from harmonics.
        near: near plane in world units; Gaussians whose centre is nearer are not drawn.
        depth: also composite the depth z of the centres.
        flow_to: also composite the motion of the centres on the screen, px, to this camera.
        features: [N, C] float32 to composite as they are, for any C, or None.
        low_pass: variance added to every 2D covariance, px^2.
        alpha_cut: alpha below which a contribution is left out.
        antialiased: lower the opacity of small Gaussians by what the low-pass adds to their area.
        mask: [H, W] bool, pixels to render; the others stay empty and give no gradient.

    Raises:
        ValueError: an array has the wrong shape or type.
    """
    if packed.ndim != 2 or packed.dtype != np.float32 or not packed.flags.c_contiguous:
        raise ValueError(
            f"packed must be a contiguous float32 [N, 11 + 3 K], got {packed.dtype} {packed.shape}"
        )
    terms = 0 if degree is None else (degree + 1) ** 2
    if packed.shape[1] < HARMONICS + 3 * terms:
        raise ValueError(f"degree {degree} needs more columns than packed {packed.shape} has")
    if features is not None and (features.ndim != 2 or len(features) != len(packed)):
        raise ValueError(f"features must be [{len(packed)}, C], got {features.shape}")
    if mask is not None and mask.shape != (viewpoint.height, viewpoint.width):
        raise ValueError(
            f"mask must be [{viewpoint.height}, {viewpoint.width}] as the image, got {mask.shape}"
        )
    with KERNELS:
        return _rasterize(
            packed, viewpoint, -1 if degree is None else degree, near, depth, flow_to, features,
            low_pass, alpha_cut, int(antialiased), mask,
        )  # fmt: skip


def _rasterize(
    packed: Floats,
    viewpoint: Viewpoint,
    degree: int,
    near: float,
    depth: bool,
    flow_to: Viewpoint | None,
    given: Floats | None,
    low_pass: float,
    alpha_cut: float,
    antialiased: int,
    mask: npt.NDArray[np.bool_] | None,
) -> Rendering:
    count = len(packed)
    width, height = viewpoint.width, viewpoint.height
    near32, cut = F(near), F(alpha_cut)
    screen = aligned_empty(count, SCREEN_COLUMNS)
    project_forward(
        packed, viewpoint.pose, viewpoint.intrinsics, width, height, near32, F(low_pass), cut,
        antialiased, screen,
    )  # fmt: skip
    tiles_x, tiles_y = -(-width // TILE), -(-height // TILE)
    bounds, touched = np.empty((count, 4), np.int32), np.empty(count, np.int32)
    count_tiles(screen, tiles_x, tiles_y, cut, bounds, touched)
    order = order_by_depth(np.ascontiguousarray(screen[:, 8]).view(np.uint32), touched)
    first_slot = np.zeros(count + 1, np.int32)
    np.cumsum(touched, out=first_slot[1:])
    tile_of_slot = np.empty(int(first_slot[-1]), np.int32)
    list_tiles(screen, bounds, first_slot, tiles_x, cut, tile_of_slot)
    offsets, members, slots = fill_tiles(order, first_slot, tile_of_slot, tiles_x * tiles_y)
    with_depth, with_flow = int(depth), int(flow_to is not None)
    own = 3 * (degree >= 0) + with_depth + 2 * with_flow
    channels = own + (0 if given is None else given.shape[1])
    features = np.zeros((count, max(channels, COLOURS)), np.float32)
    if given is not None:
        features[:, own:channels] = given
    following = flow_to or viewpoint
    features_forward(
        packed, degree, viewpoint.centre, screen, following.pose, following.intrinsics,
        with_depth, with_flow, near32, features,
    )  # fmt: skip
    planes = np.empty((features.shape[1], height, width), np.float32)
    transmittance = np.empty((1, height, width), np.float32)
    stop = np.empty((1, height, width), np.int32)
    blocks = np.empty(len(members), np.int64)
    shown = np.empty((0, 0), np.bool_) if mask is None else np.ascontiguousarray(mask, np.bool_)
    composite_forward(
        workers(), tiles_x, offsets, members, screen, features, cut, shown, planes, transmittance,
        stop, blocks,
    )  # fmt: skip
    forward = _Pass(
        packed, viewpoint, following, degree, near, low_pass, alpha_cut, antialiased, with_depth,
        with_flow, tiles_x, tiles_y, offsets, members, first_slot, slots, stop, blocks,
        features,
    )  # fmt: skip
    return Rendering(planes[:channels], transmittance[0], screen, forward)
