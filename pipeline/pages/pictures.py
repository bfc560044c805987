"""Pictures for a page: scaled down, packed as data URIs; flow and points made visible."""

from __future__ import annotations

import base64
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import cv2
import numpy as np
import numpy.typing as npt

from pipeline.artifacts.views import View, jpeg_bytes, read_png, to_uint8
from pipeline.pages.remembered import remembered

Image = npt.NDArray[np.uint8]

#: Quality of the JPEGs.
QUALITY = 78
#: Long side in pixels of a picture that is looked at by itself, and of one among many.
LARGE, SMALL = 640, 320
#: How dark masked pixels are shown.
MASKED = 0.3
#: White gap in pixels between the parts of a comparison.
COMPARISON_GAP = 6


@dataclass(frozen=True)
class Picture:
    """A picture on the page.

    Attributes:
        uri: ``data:image/jpeg;base64,...``.
        width, height: pixels.
        alt: what it shows, for those who can't see it.
        caption: beneath it.
    """

    macro: ClassVar[str] = "tile"
    uri: str
    width: int
    height: int
    alt: str
    caption: str = ""


@remembered
def picture(image: Image, alt: str, caption: str = "", long_side: int = LARGE) -> Picture:
    """Pack an image [H, W, 3] uint8 (or grey [H, W]), scaled down to `long_side` if larger."""
    rgb = image if image.ndim == 3 else np.repeat(image[..., None], 3, 2)
    small = shrunk(rgb[..., :3], long_side)
    height, width = small.shape[:2]
    return Picture(jpeg_uri(small, QUALITY), width, height, alt, caption)


def jpeg_uri(image: Image, quality: int) -> str:
    """`data:` address of an RGB image [H, W, 3] as JPEG."""
    return "data:image/jpeg;base64," + base64.b64encode(jpeg_bytes(image, quality)).decode("ascii")


def shrunk(image: Image, long_side: int) -> Image:
    """Scale an image down so that its long side is at most `long_side`."""
    height, width = image.shape[:2]
    scale = long_side / max(height, width)
    if scale >= 1:
        return image
    size = (max(1, round(width * scale)), max(1, round(height * scale)))
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)


def from_file(path: Path, alt: str, caption: str = "", long_side: int = LARGE) -> Picture:
    """Pack a PNG file."""
    return picture(read_png(path), alt, caption, long_side)


def masked(view: View) -> Image:
    """A view [H, W, 3] uint8 with what its mask leaves out darkened."""
    image = to_uint8(view.image)
    if view.mask is None:
        return image
    dark = (image * MASKED).astype(np.uint8)
    return np.where(view.mask[..., None], image, dark)


def thirds(image: Image) -> tuple[Image, Image, Image] | None:
    """Take photograph | render | error apart; None where the picture is not made that way."""
    width = image.shape[1] - 2 * COMPARISON_GAP
    if width <= 0 or width % 3:
        return None
    part = width // 3
    gaps = [image[:, (k + 1) * part + k * COMPARISON_GAP :][:, :COMPARISON_GAP] for k in (0, 1)]
    if not all((gap == 255).all() for gap in gaps):
        return None
    first, second, third = (image[:, k * (part + COMPARISON_GAP) :][:, :part] for k in range(3))
    return first, second, third


@remembered
def points_image(
    positions: npt.NDArray[np.floating], colors: npt.NDArray[np.floating],
    rotation: npt.NDArray[np.float64], size: tuple[int, int] = (640, 460),
    background: float = 0.11,
) -> Image:  # fmt: skip
    """Draw points as small squares, nearest on top.

    Args:
        positions: [N, 3] world.
        colors: [N, 3] in 0..1.
        rotation: [3, 3] to the frame looked from (x right, y down, z ahead).
        size: (width, height) of the picture.
        background: grey behind them, 0..1.

    Returns:
        [height, width, 3] uint8.
    """
    width, height = size
    canvas = np.full((height, width, 3), round(255 * background), np.uint8)
    finite = np.isfinite(positions).all(1)
    local = np.asarray(positions, np.float64)[finite] @ rotation.T
    if not len(local):
        return canvas
    low, high = np.percentile(local, 1, axis=0), np.percentile(local, 99, axis=0)
    centre, extent = (low + high) / 2, np.maximum(high - low, 1e-9)
    local -= centre
    distance = 2.2 * float(extent.max())
    depth = local[:, 2] + distance
    ahead = depth > 0.2 * distance
    # The box at its nearest side, with a margin, fills the picture.
    near = distance - extent[2] / 2
    focal = 0.9 * near * min(width / extent[0], height / extent[1])
    pixel = local[ahead, :2] / depth[ahead, None] * focal + (width / 2, height / 2)
    order = np.argsort(-depth[ahead], kind="stable")
    cells = np.floor(pixel[order]).astype(np.int64)
    shown = to_uint8(np.asarray(colors)[finite][ahead][order])
    side = 1 if len(cells) > 3 * width * height else 2 if len(cells) > 20_000 else 3
    square = np.stack(np.meshgrid(np.arange(side), np.arange(side)), -1).reshape(-1, 2)
    # All cells of a point before those of the next: nearer ones overwrite farther ones.
    x, y = (cells[:, None] + square).reshape(-1, 2).T
    shown = np.repeat(shown, len(square), axis=0)
    inside = (x >= 0) & (x < width) & (y >= 0) & (y < height)
    canvas[y[inside], x[inside]] = shown[inside]
    return canvas
