"""The differentiable rasterizer: Gaussians and a camera in, images out, and back again.

The shape of it follows `gsplat.rasterization`: arrays in, image, alpha and what densification needs
out; `Rendering.backward` takes the gradients of the outputs and gives those of every input.
Kerbl et al. 2023 (3DGS), Zwicker et al. 2001 (EWA splatting), Ye et al. 2024 (absolute gradients).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from pipeline.artifacts.cameras import Camera
from pipeline.artifacts.gaussians import SH_COEFFICIENTS, Gaussians
from stages.splatting.harmonics import features_backward, features_forward
from stages.splatting.projection import (
    CHUNK,
    HARMONICS,
    SCREEN_COLUMNS,
    SCREEN_GRADIENTS,
    project_backward,
    project_forward,
)
from stages.splatting.raster import composite_backward, composite_forward, gather, tile_stride
from stages.splatting.threads import KERNELS, use_threads
from stages.splatting.tiles import TILE, count_tiles, fill_tiles, order_by_depth

__all__ = ["Gradients", "Rendering", "Viewpoint", "pack", "rasterize", "unpack", "use_threads"]

Floats = npt.NDArray[np.float32]
Ints = npt.NDArray[np.int32]
F = np.float32

#: variance added to every 2D covariance, px^2 (3DGS)
LOW_PASS = 0.3
#: alpha below which a contribution is left out (3DGS). Tests against finite differences lower it.
ALPHA_CUT = 1 / 255


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
    pose: [6] float64 of a twist (translation 3, rotation 3) applied to cam_from_world from the
        left: cam_from_world <- exp(twist) cam_from_world.
    focal: [2] float64 of fx, fy.
    next_pose: [6] float64, twist of the camera that the flow leads to.
    centres: [N, 2] float32 gradient of the projected centres, px^-1.
    absolute: [N, 2] float32 sums of its absolute per-pixel values (AbsGS).
    features: [N, C] float32 gradient of the composited features (colour, depth, flow).
    """

    packed: Floats
    pose: npt.NDArray[np.float64]
    focal: npt.NDArray[np.float64]
    next_pose: npt.NDArray[np.float64]
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
    alpha_cut: float
    with_depth: int
    with_flow: int
    tiles_x: int
    tiles_y: int
    offsets: Ints
    members: Ints
    first_slot: Ints
    slots: Ints
    stop: Ints
    end: Ints
    features: Floats


@dataclass(frozen=True)
class Rendering:
    """One pass through the rasterizer, planar, without background.

    Attributes:
        planes: [3 + depth + 2 flow, H, W] float32, composited and not divided by alpha.
        transmittance: [H, W] float32, 1 - alpha.
        screen: [N, 9] float32 projected Gaussians (see `projection`).
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
        width = SCREEN_GRADIENTS + len(self.planes)
        slot_gradient = np.empty((len(f.members), width), np.float32)
        composite_backward(
            f.tiles_x, f.tiles_y, tile_stride(f.tiles_x * f.tiles_y), f.offsets, f.members,
            self.screen, f.features, F(f.alpha_cut), self.transmittance, f.stop, f.end, d_planes,
            d_transmittance, slot_gradient,
        )  # fmt: skip
        count = len(self.screen)
        by_screen = np.empty((count, width), np.float32)
        gather(f.first_slot, f.slots, slot_gradient, by_screen)
        centres = by_screen[:, 0:2].copy()
        if f.with_flow:
            # flow = next centre - this centre
            by_screen[:, 0:2] -= by_screen[:, width - 2 :]
        gradient = np.empty_like(f.packed)
        chunks = -(-count // CHUNK)
        camera_parts = np.zeros((chunks, 8), np.float32)
        next_parts = np.zeros((chunks, 6), np.float32)
        project_backward(
            f.packed, view.pose, view.intrinsics, view.width, view.height, self.screen, by_screen,
            gradient, camera_parts,
        )  # fmt: skip
        features_backward(
            f.packed, f.degree, view.centre, view.pose, self.screen, after.pose, after.intrinsics,
            f.with_depth, f.with_flow, F(f.near), f.features, by_screen, gradient, camera_parts,
            next_parts,
        )  # fmt: skip
        camera = camera_parts.sum(0, dtype=np.float64)
        return Gradients(
            packed=gradient,
            pose=camera[:6],
            focal=camera[6:],
            next_pose=next_parts.sum(0, dtype=np.float64),
            centres=centres,
            absolute=by_screen[:, 6:8],
            features=by_screen[:, SCREEN_GRADIENTS:],
        )


def rasterize(
    packed: Floats,
    viewpoint: Viewpoint,
    *,
    degree: int,
    near: float,
    depth: bool = False,
    flow_to: Viewpoint | None = None,
    low_pass: float = LOW_PASS,
    alpha_cut: float = ALPHA_CUT,
) -> Rendering:
    """Render colour, and optionally depth and flow, of a packed scene.

    Args:
        packed: [N, 11 + 3 K] float32 contiguous (see `pack`).
        viewpoint: the camera.
        degree: of the spherical harmonics, 0..3.
        near: near plane in world units; Gaussians whose centre is nearer are not drawn.
        depth: also composite the depth z of the centres.
        flow_to: also composite the motion of the centres on the screen, px, to this camera.
        low_pass: variance added to every 2D covariance, px^2.
        alpha_cut: alpha below which a contribution is left out.

    Raises:
        ValueError: an array has the wrong shape or type.
    """
    if packed.ndim != 2 or packed.dtype != np.float32 or not packed.flags.c_contiguous:
        raise ValueError(
            f"packed must be a contiguous float32 [N, 11 + 3 K], got {packed.dtype} {packed.shape}"
        )
    if packed.shape[1] < HARMONICS + 3 * (degree + 1) ** 2:
        raise ValueError(f"degree {degree} needs more columns than packed {packed.shape} has")
    with KERNELS:
        return _rasterize(packed, viewpoint, degree, near, depth, flow_to, low_pass, alpha_cut)


def _rasterize(
    packed: Floats,
    viewpoint: Viewpoint,
    degree: int,
    near: float,
    depth: bool,
    flow_to: Viewpoint | None,
    low_pass: float,
    alpha_cut: float,
) -> Rendering:
    count = len(packed)
    width, height = viewpoint.width, viewpoint.height
    near32, cut = F(near), F(alpha_cut)
    screen = np.empty((count, SCREEN_COLUMNS), np.float32)
    project_forward(
        packed, viewpoint.pose, viewpoint.intrinsics, width, height, near32, F(low_pass), cut,
        screen,
    )  # fmt: skip
    tiles_x, tiles_y = -(-width // TILE), -(-height // TILE)
    stride = tile_stride(tiles_x * tiles_y)
    bounds, touched = np.empty((count, 4), np.int32), np.empty(count, np.int32)
    count_tiles(screen, tiles_x, tiles_y, cut, bounds, touched)
    order = order_by_depth(np.ascontiguousarray(screen[:, 8]).view(np.uint32), touched)
    offsets, members, first_slot, slots = fill_tiles(
        screen, order, bounds, touched, tiles_x, tiles_y, cut
    )
    with_depth, with_flow = int(depth), int(flow_to is not None)
    channels = 3 + with_depth + 2 * with_flow
    features = np.zeros((count, channels), np.float32)
    following = flow_to or viewpoint
    features_forward(
        packed, degree, viewpoint.centre, screen, following.pose, viewpoint.intrinsics,
        following.intrinsics, with_depth, with_flow, near32, features,
    )  # fmt: skip
    planes = np.empty((channels, height, width), np.float32)
    transmittance = np.empty((height, width), np.float32)
    stop = np.empty((height, width), np.int32)
    end = np.empty(tiles_x * tiles_y, np.int32)
    composite_forward(
        tiles_x, tiles_y, stride, offsets, members, screen, features, cut, planes, transmittance,
        stop, end,
    )  # fmt: skip
    forward = _Pass(
        packed, viewpoint, following, degree, near, alpha_cut, with_depth, with_flow,
        tiles_x, tiles_y, offsets, members, first_slot, slots, stop, end, features,
    )  # fmt: skip
    return Rendering(planes, transmittance, screen, forward)
