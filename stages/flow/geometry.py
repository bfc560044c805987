"""What cameras and a point cloud say about flow: depth, predicted motion, occlusion."""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt

from pipeline.artifacts.cameras import Camera
from pipeline.kernels import kernel

Array = npt.NDArray[np.float32]
Mask = npt.NDArray[np.bool_]

#: Radius limits of a splatted point, in pixels: at least its own pixel, and never a big blot.
_SMALLEST_RADIUS = 0.71
_LARGEST_RADIUS = 5.0


@kernel()
def _splat(pixels: Array, depths: Array, radii: Array, buffer: Array) -> None:
    """Write each point as a disc into the z-buffer `buffer` (infinite where empty)."""
    height, width = buffer.shape
    for k in range(len(depths)):
        x, y, depth, radius = pixels[k, 0], pixels[k, 1], depths[k], radii[k]
        first_row, last_row = max(0, int(y - radius)), min(height - 1, int(y + radius))
        first_column, last_column = max(0, int(x - radius)), min(width - 1, int(x + radius))
        for row in range(first_row, last_row + 1):
            for column in range(first_column, last_column + 1):
                dx, dy = column + np.float32(0.5) - x, row + np.float32(0.5) - y
                if dx * dx + dy * dy <= radius * radius and depth < buffer[row, column]:
                    buffer[row, column] = depth


def splat_depth(
    points: npt.NDArray[np.floating], spacing: npt.NDArray[np.floating], camera: Camera
) -> Array:
    """Render the depth of a point cloud by a z-buffer of discs, holes and specks mended.

    Args:
        points: [N, 3] world points.
        spacing: [N] distance to the neighbouring points in world units (the disc's radius); where
            it is 0 (unknown), the spacing of as many points spread evenly over the image.
        camera: the view.

    Returns:
        [H, W] float32 depth (z), 0 where nothing is known.
    """
    empty = np.full((camera.height, camera.width), np.inf, np.float32)
    pixels, depth = camera.project(points)
    size = (camera.width, camera.height)
    margin = _LARGEST_RADIUS
    visible = (depth > 0) & ((pixels > -margin) & (pixels < np.add(size, margin))).all(-1)
    if not visible.any():
        return np.zeros_like(empty)
    pixels, depth = pixels[visible], depth[visible]
    focal = 0.5 * (camera.fx + camera.fy)
    even = np.sqrt(camera.width * camera.height / len(depth))
    known = np.asarray(spacing, np.float64)[visible]
    radii = np.where(known > 0, known * focal / depth, even)
    _splat(
        np.ascontiguousarray(pixels, np.float32),
        np.ascontiguousarray(depth, np.float32),
        np.clip(radii, _SMALLEST_RADIUS, _LARGEST_RADIUS).astype(np.float32),
        empty,
    )
    buffer = np.where(np.isinf(empty), np.float32(0), empty)
    # The median takes out lone specks and closes holes that known pixels surround.
    return np.asarray(cv2.medianBlur(buffer, 5), np.float32)


def pixel_grid(height: int, width: int) -> Array:
    """[H, W, 2] float32: column and row of every pixel."""
    rows, columns = np.mgrid[:height, :width].astype(np.float32)
    return np.stack([columns, rows], -1)


def predicted_flow(depth_i: Array, camera_i: Camera, camera_j: Camera) -> tuple[Array, Array]:
    """Flow from view i to view j of the surface that a depth map describes.

    Args:
        depth_i: [H, W] depth (z) in view i, 0 where unknown.
        camera_i, camera_j: the cameras; the images may differ in size.

    Returns:
        Flow [H, W, 2] in pixels (of j minus of i), and the depth [H, W] that each point has in
        view j; both 0 where unknown or behind camera j.
    """
    known = depth_i > 0
    world = camera_i.unproject(np.where(known, depth_i, 1.0))
    pixels, depth_in_j = camera_j.project(world.reshape(-1, 3))
    depth_in_j = depth_in_j.reshape(depth_i.shape)
    known &= depth_in_j > 0
    motion = pixels.reshape(*depth_i.shape, 2) - 0.5 - pixel_grid(*depth_i.shape)
    flow = np.where(known[..., None], motion, 0.0).astype(np.float32)
    return flow, np.where(known, depth_in_j, 0.0).astype(np.float32)


def extend(flow: Array, known: Mask, smoothing: float) -> Array:
    """Continue a flow field smoothly over the pixels where it is unknown, then blur it.

    Args:
        flow: [H, W, 2] pixels.
        known: [H, W] where `flow` means something.
        smoothing: sigma of the Gaussian in pixels; 0 for none.

    Returns:
        [H, W, 2] float32, defined everywhere (0 if nothing is known).
    """
    filled = _push_pull(flow * known[..., None], known.astype(np.float32))
    return np.asarray(cv2.GaussianBlur(filled, (0, 0), smoothing)) if smoothing > 0 else filled


def _push_pull(flow: Array, weight: Array) -> Array:
    """Fill from ever coarser averages of what is known (push-pull interpolation)."""
    height, width = weight.shape
    if max(height, width) == 1 or weight.min() > 0:
        return flow
    half = ((width + 1) // 2, (height + 1) // 2)
    coarse_weight = np.asarray(cv2.resize(weight, half, interpolation=cv2.INTER_AREA))
    coarse = np.asarray(cv2.resize(flow, half, interpolation=cv2.INTER_AREA))
    known = coarse_weight > 0
    average = np.asarray(coarse / np.where(known, coarse_weight, 1)[..., None], np.float32)
    coarse = _push_pull(average, known.astype(np.float32))
    upsampled = np.asarray(cv2.resize(coarse, (width, height), interpolation=cv2.INTER_LINEAR))
    return np.where((weight > 0)[..., None], flow, upsampled)


def occluded(flow: Array, depth_in_j: Array, depth_j: Array, tolerance: float) -> Mask:
    """Where a point seen in view i lies behind what view j sees in its place.

    Args:
        flow: [H_i, W_i, 2] predicted flow from i to j.
        depth_in_j: [H_i, W_i] depth of each point in view j (`predicted_flow`), 0 where unknown.
        depth_j: [H_j, W_j] depth map of view j, 0 where unknown.
        tolerance: relative depth difference that still counts as the same surface.

    Returns:
        [H_i, W_i] bool; False where either depth is unknown.
    """
    height, width = depth_j.shape
    # The deepest of the 3x3 neighbours: at edges, rounding must not make an occlusion.
    deepest = np.asarray(cv2.dilate(depth_j, np.ones((3, 3), np.uint8)))
    target = np.rint(pixel_grid(*flow.shape[:2]) + flow).astype(np.int64)
    inside = ((target >= 0) & (target < (width, height))).all(-1)
    columns = np.clip(target[..., 0], 0, width - 1)
    rows = np.clip(target[..., 1], 0, height - 1)
    seen = deepest[rows, columns]
    return np.asarray(
        inside & (depth_in_j > 0) & (seen > 0) & (depth_in_j > seen * (1 + tolerance))
    )
