"""What the fit compares with: each view's image, mask, depth and flow, at full and coarse size."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import cv2
import numpy as np

from pipeline.artifacts.cameras import Camera
from stages.fit.arrays import Array, Bools, Floats
from stages.splatting.loss import ColourLoss


@dataclass(frozen=True)
class FlowTarget:
    """Attributes:
    to: index of the view that the flow leads to.
    flow: [2, H, W] float32 px at this size.
    mask: [H, W] float32, 1 where it can be trusted.
    """

    to: int
    flow: Floats
    mask: Floats


@dataclass
class Target:
    """One view at one size.

    Attributes:
        width, height: in pixels.
        intrinsics: [4] float32 fx, fy, cx, cy at this size.
        colour: the colour loss against its image.
        depth: [H, W] float32 depth of the points seen there, 0 where there is none.
        flows: to the next views.
    """

    width: int
    height: int
    intrinsics: Floats
    colour: ColourLoss
    depth: Floats
    flows: list[FlowTarget] = field(default_factory=list)


def point_depth(
    positions: Array, camera: Camera, width: int, height: int, tolerance: float = 0.02
) -> Floats:
    """Depth map [height, width] of a cloud in a camera, 0 where no point is seen.

    A point counts where it is not hidden: not deeper than the nearest point within two pixels by
    more than `tolerance` of its depth.
    """
    pixels, depth = camera.resized(width, height).project(positions)
    column, row = np.floor(pixels[:, 0]), np.floor(pixels[:, 1])
    inside = (depth > 0) & (column >= 0) & (column < width) & (row >= 0) & (row < height)
    index = (row[inside] * width + column[inside]).astype(np.int64)
    buffer = np.full(width * height, np.inf, np.float32)
    np.minimum.at(buffer, index, depth[inside].astype(np.float32))
    nearest = buffer.reshape(height, width)
    front = cv2.erode(
        np.where(np.isfinite(nearest), nearest, np.float32(1e30)), np.ones((5, 5), np.uint8)
    )
    hidden = ~np.isfinite(nearest) | (nearest > front * np.float32(1 + tolerance))
    return np.ascontiguousarray(np.where(hidden, np.float32(0), nearest))


def make_target(
    image: Floats,
    valid: Bools,
    camera: Camera,
    factor: int,
    positions: Array | None,
) -> Target:
    """A view reduced by a whole factor.

    Args:
        image: [H, W, 3] float32, valid: [H, W] mask, camera: at full size.
        factor: 1 for full size.
        positions: [N, 3] points for the depth, or None for no depth.
    """
    height, width = max(1, valid.shape[0] // factor), max(1, valid.shape[1] // factor)
    mask = valid.astype(np.float32)
    if factor > 1:
        image = np.asarray(cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA))
        mask = np.asarray(cv2.resize(mask, (width, height), interpolation=cv2.INTER_AREA))
        mask = (mask > 0.999).astype(np.float32)
    scale_x, scale_y = width / camera.width, height / camera.height
    intrinsics = np.array(
        [camera.fx * scale_x, camera.fy * scale_y, camera.cx * scale_x, camera.cy * scale_y],
        np.float32,
    )
    planar = np.ascontiguousarray(image.transpose(2, 0, 1), np.float32)
    if positions is None:
        depth = np.zeros((height, width), np.float32)
    else:
        depth = point_depth(positions, camera, width, height) * mask
    return Target(width, height, intrinsics, ColourLoss(planar, np.ascontiguousarray(mask)), depth)


def make_flow_target(flow: Floats, mask: Bools, to: int, target: Target) -> FlowTarget:
    """Flow [H, W, 2] and its mask at a target's size."""
    height, width = flow.shape[:2]
    size = (target.width, target.height)
    small = np.asarray(cv2.resize(flow, size, interpolation=cv2.INTER_AREA), np.float32)
    trusted = cv2.resize(mask.astype(np.float32), size, interpolation=cv2.INTER_AREA) > 0.999
    small = small * np.array([target.width / width, target.height / height], np.float32)
    return FlowTarget(
        to,
        np.ascontiguousarray(small.transpose(2, 0, 1), np.float32),
        np.ascontiguousarray(trusted * target.colour.mask, np.float32),
    )


def make_pyramids(
    images: Sequence[Floats],
    masks: Sequence[Bools],
    cameras: Sequence[Camera],
    factors: Sequence[int],
    positions: Array | None,
    flows: Mapping[int, Sequence[tuple[int, Floats, Bools]]],
) -> list[dict[int, Target]]:
    """For each view, factor -> target; `flows` maps a view to (next view, flow, mask) of each."""
    pyramids = []
    for view, (image, mask, camera) in enumerate(zip(images, masks, cameras, strict=True)):
        levels = {f: make_target(image, mask, camera, f, positions) for f in sorted(set(factors))}
        for to, flow, trusted in flows.get(view, ()):
            for target in levels.values():
                target.flows.append(make_flow_target(flow, trusted, to, target))
        pyramids.append(levels)
    return pyramids
