"""A picture that tells its corners apart, and files of it."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from PIL import Image

Bytes = npt.NDArray[np.uint8]
#: EXIF's tag.
ORIENTATION = 0x0112


def scene(width: int = 120, height: int = 80) -> Bytes:
    """[H, W, 3] smooth colours, different at each corner."""
    v, u = np.mgrid[:height, :width]
    return np.stack(
        [30 + 200 * u // width, 20 + 200 * v // height, 200 - 150 * u // width], -1
    ).astype(np.uint8)


def encode(image: Image.Image, kind: str, **options: Any) -> bytes:
    data = io.BytesIO()
    image.save(data, kind, **options)
    return data.getvalue()


def write(path: Path, pixels: Bytes, **options: Any) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(pixels).save(path, **options)
    return path
