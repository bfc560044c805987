"""Images as a model wants them, and its maps back in the pixels of the view.

A model sees a resized, cropped or padded copy of the view. The affine map of pixels that led there
is kept, so that what it says comes out at the view's own pixels; what it did not see is unknown.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from pipeline.artifacts.views import View, to_uint8
from stages.pointmaps.interface import PreparedView

Array = npt.NDArray[np.float32]
Matrix = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Framing:
    """How one image is resized and cropped.

    Attributes:
        resized: (width, height) that the whole view is resampled to.
        crop: (left, top, width, height) of what is cut out of that.
    """

    resized: tuple[int, int]
    crop: tuple[int, int, int, int]


def centred_crop(resized: tuple[int, int], width: int, height: int) -> Framing:
    """Cut a window of `width` x `height` out of the middle of a resized image."""
    left, top = (resized[0] - width) // 2, (resized[1] - height) // 2
    return Framing(resized, (left, top, width, height))


def multiple_of_patch(width: int, height: int, long_side: int, patch: int = 16) -> Framing:
    """As DUSt3R, MASt3R and MUSt3R: the long side to a length, the sides cut to whole patches.

    Weights for 224 pixels (`long_side` 224) see the square in the middle instead.
    """
    if long_side == 224:
        scale = long_side / min(width, height)
        resized = (max(224, round(width * scale)), max(224, round(height * scale)))
        return centred_crop(resized, 224, 224)
    scale = long_side / max(width, height)
    resized = (round(width * scale), round(height * scale))
    sides = [max(patch, side // patch * patch) for side in resized]
    if sides[0] == sides[1]:
        sides[1] = max(patch, round(0.75 * sides[0]) // patch * patch)
    resized = (max(resized[0], sides[0]), max(resized[1], sides[1]))
    return centred_crop(resized, sides[0], sides[1])


def fixed_width(width: int, height: int, target: int = 518, patch: int = 14) -> Framing:
    """As VGGT: the width to 518, the height rounded to whole patches and cut at 518."""
    scaled = max(patch, round(height * target / width / patch) * patch)
    return centred_crop((target, scaled), target, min(scaled, target))


def nearest_shape(
    width: int, height: int, aspect: float, shapes: Sequence[tuple[int, int]]
) -> Framing:
    """As MapAnything: cover the listed shape nearest to `aspect`, cut what stands over."""
    target = min(shapes, key=lambda shape: (abs(shape[0] / shape[1] - aspect), shape))
    scale = max(target[0] / width, target[1] / height)
    resized = (max(target[0], round(width * scale)), max(target[1], round(height * scale)))
    return centred_crop(resized, *target)


def prepare(view: View, index: int, framing: Framing) -> PreparedView:
    """Resample a view for a model."""
    image = to_uint8(view.image)
    shrinks = framing.resized[0] < view.width
    resized = cv2.resize(
        image, framing.resized, interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_CUBIC
    )
    left, top, width, height = framing.crop
    cut = resized[top : top + height, left : left + width]
    matrix = np.array(
        [
            [framing.resized[0] / view.width, 0, -left],
            [0, framing.resized[1] / view.height, -top],
            [0, 0, 1],
        ],
        np.float64,
    )
    return PreparedView(
        view.name, index, cut.astype(np.float32) / np.float32(255), matrix,
        (view.width, view.height),
    )  # fmt: skip


def padded_alike(views: Sequence[PreparedView]) -> list[PreparedView]:
    """Give all images the size of the largest by a white border, for models that stack them."""
    height = max(view.image.shape[0] for view in views)
    width = max(view.image.shape[1] for view in views)
    result = []
    for view in views:
        h, w = view.image.shape[:2]
        top, left = (height - h) // 2, (width - w) // 2
        image = np.ones((height, width, 3), np.float32)
        image[top : top + h, left : left + w] = view.image
        shift = np.array([[1.0, 0, left], [0, 1, top], [0, 0, 1]])
        result.append(
            PreparedView(view.name, view.index, image, shift @ view.model_from_view, view.view_size)
        )
    return result


def resample_map(
    points: Array,
    confidence: Array,
    map_from_view: Matrix,
    view_size: tuple[int, int],
    edge_jump: float,
) -> tuple[Array, Array]:
    """Bring a pointmap to the pixels of the view.

    Interpolated linearly where the four pixels around lie on one surface, else the nearest one is
    taken: a mean of foreground and background is a point in the air.

    Args:
        points: [h, w, 3].
        confidence: [h, w], >= 1.
        map_from_view: [3, 3] affine map of pixels (centres at .5).
        view_size: (width, height).
        edge_jump: largest distance of neighbours on a surface, over their distance from the frame.

    Returns:
        [H, W, 3] and [H, W] float32; outside the map the confidence is 1 and the points 0.
    """
    width, height = view_size
    h, w = confidence.shape
    u = np.arange(width) + 0.5
    v = np.arange(height) + 0.5
    x = map_from_view[0, 0] * u[None] + map_from_view[0, 1] * v[:, None] + map_from_view[0, 2]
    y = map_from_view[1, 0] * u[None] + map_from_view[1, 1] * v[:, None] + map_from_view[1, 2]
    inside = (x >= 0) & (y >= 0) & (x <= w) & (y <= h)
    column, row = np.clip(x - 0.5, 0, w - 1), np.clip(y - 0.5, 0, h - 1)
    left, top = np.floor(column).astype(np.int64), np.floor(row).astype(np.int64)
    right, bottom = np.minimum(left + 1, w - 1), np.minimum(top + 1, h - 1)
    a, b = (column - left).astype(np.float32), (row - top).astype(np.float32)
    near = (np.where(b < 0.5, top, bottom), np.where(a < 0.5, left, right))
    nearest_point = points[near]
    out_points, out_confidence = np.zeros_like(nearest_point), np.zeros_like(confidence[near])
    smooth = np.ones((height, width), bool)
    reach = edge_jump * np.linalg.norm(nearest_point, axis=-1)
    for i, j, weight in (
        (top, left, (1 - a) * (1 - b)),
        (top, right, a * (1 - b)),
        (bottom, left, (1 - a) * b),
        (bottom, right, a * b),
    ):
        corner = points[i, j]
        smooth &= (np.linalg.norm(corner - nearest_point, axis=-1) <= reach) & (
            confidence[i, j] > 1
        )
        out_points += weight[..., None] * corner
        out_confidence += weight * confidence[i, j]
    out_points = np.where(smooth[..., None], out_points, nearest_point)
    out_confidence = np.where(smooth, out_confidence, confidence[near])
    out_points[~inside] = 0
    out_confidence[~inside] = 1
    return (
        np.ascontiguousarray(out_points, np.float32),
        np.maximum(out_confidence, 1).astype(np.float32),
    )


def clean_map(
    points: npt.NDArray[np.floating], confidence: npt.NDArray[np.floating]
) -> tuple[Array, Array]:
    """float32 without NaN and infinities: where a value is bad, nothing is known."""
    points = np.asarray(points, np.float32)
    confidence = np.asarray(confidence, np.float32)
    good = np.isfinite(points).all(-1) & np.isfinite(confidence)
    return (
        np.where(good[..., None], points, np.float32(0)),
        np.where(good, np.maximum(confidence, np.float32(1)), np.float32(1)),
    )
