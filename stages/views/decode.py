"""Read one photograph of any common format as 8-bit sRGB, on its stored pixel grid."""

from __future__ import annotations

import io
import struct
import threading
import warnings
import zlib
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
import pillow_heif
from PIL import Image, ImageCms, UnidentifiedImageError

from stages.views.exif import EXIF_IFD, focal_in_pixels, read_orientation
from stages.views.orientation import make_stored, make_upright

Bytes = npt.NDArray[np.uint8]

MAX_PIXELS = 300_000_000
#: Above this, one at a time whatever the number of threads: decoding takes ten bytes a pixel.
LARGE = 60_000_000
KNOWN = "JPEG, PNG, TIFF, WebP, HEIC or BMP"
#: What Pillow and its plugins raise on damaged files.
DAMAGED = (
    OSError, SyntaxError, ValueError, RuntimeError, EOFError, LookupError, TypeError,
    struct.error, zlib.error, ImageCms.PyCMSError,
)  # fmt: skip

_one_large = threading.Lock()

pillow_heif.register_heif_opener()


class UnusableImage(Exception):  # noqa: N818
    """Why a file can't be used, as the end of a sentence that starts with its name."""


@dataclass(frozen=True)
class Photo:
    """A decoded photograph on the stored pixel grid, before the EXIF orientation is applied.

    Attributes:
        rgb: [H, W, 3] uint8 sRGB.
        valid: [H, W] bool from the alpha channel, or None where there is none.
        orientation: EXIF orientation 1..8, still to be applied.
        focal_px: focal length in stored pixels, or None.
    """

    rgb: Bytes
    valid: npt.NDArray[np.bool_] | None
    orientation: int
    focal_px: float | None


@contextmanager
def large_images_allowed() -> Iterator[None]:
    """Lift Pillow's own limit on sizes, as `decode_photo` has one, and hush its warnings.

    It changes settings of the whole process: enter it once, around all threads that decode.
    """
    before, Image.MAX_IMAGE_PIXELS = Image.MAX_IMAGE_PIXELS, None
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of odd EXIF, which is read with care
            yield
    finally:
        Image.MAX_IMAGE_PIXELS = before


def decode_photo(data: bytes, check_size: Any = None) -> Photo:
    """Decode a photograph.

    Args:
        data: the bytes of the file.
        check_size: called with (width, height) of the stored grid before the pixels are decoded;
            raises UnusableImage if it doesn't like them.

    Raises:
        UnusableImage: it is damaged, not an image, or larger than 300 megapixels.
    """
    image = _open(data)
    try:
        with image:
            orientation, (width, height) = _geometry(image)
            if width * height > MAX_PIXELS:
                raise UnusableImage(
                    f"has {width} x {height} pixels, more than the {MAX_PIXELS // 1_000_000} "
                    "megapixels that can be read"
                )
            if check_size is not None:
                check_size(width, height)
            focal = focal_in_pixels(_details(image), width, height)
            profile = image.info.get("icc_profile")
            sixteen_bit = _is_sixteen_bit(image, data)
            with _one_large if width * height > LARGE else nullcontext():
                image.load()
                pixels, valid = _sixteen_bit(data) if sixteen_bit else (image, None)
                rgb, valid = _to_srgb(pixels, valid, profile)
            if image.format == "TIFF":  # Pillow and OpenCV have turned it upright
                rgb = make_stored(rgb, orientation)
                valid = None if valid is None else make_stored(valid, orientation)
    except DAMAGED as error:
        raise UnusableImage(_describe_damage(error)) from error
    return Photo(rgb, valid, orientation, focal)


def decode_mask(data: bytes) -> npt.NDArray[np.bool_]:
    """Decode a mask: [H, W] bool, True where bright (and opaque). Upright.

    Values 0 and 1 count as dark and bright.

    Raises:
        UnusableImage: it is damaged or not an image.
    """
    image = _open(data)
    try:
        with image:
            orientation, (width, height) = _geometry(image)
            if width * height > MAX_PIXELS:
                raise UnusableImage(f"has {width} x {height} pixels, too many to read")
            image.load()
            alpha = None
            if image.mode in ("LA", "PA", "RGBA"):
                alpha = np.asarray(image.getchannel("A")) >= 128
            if image.mode in ("1", "P", "RGB", "RGBA", "LA", "PA", "CMYK", "YCbCr"):
                gray = np.asarray(image.convert("RGB").convert("L"))
            else:
                gray = np.asarray(image)
                gray = (gray > gray.max() / 2) * np.uint8(255) if gray.max() > 255 else gray
            if image.format == "TIFF":
                gray = make_stored(gray, orientation)
                alpha = None if alpha is None else make_stored(alpha, orientation)
    except DAMAGED as error:
        raise UnusableImage(_describe_damage(error)) from error
    bright = gray > (0 if gray.max(initial=0) <= 1 else 127)
    return make_upright(bright if alpha is None else bright & alpha, orientation)


def _open(data: bytes) -> Image.Image:
    if not data:
        raise UnusableImage("is empty (0 bytes)")
    try:
        return Image.open(io.BytesIO(data))
    except UnidentifiedImageError as error:
        raise UnusableImage(_describe_content(data)) from error
    except DAMAGED as error:
        raise UnusableImage(_describe_damage(error)) from error


def _describe_content(data: bytes) -> str:
    head = data[:2000]
    printable = sum(byte in b"\t\n\r\f" or byte >= 32 for byte in head)
    if printable == len(head) and b"\0" not in head:
        return "is a text file, not an image"
    return f"is not a readable {KNOWN} image (another format, or damaged at its start)"


def _describe_damage(error: BaseException) -> str:
    text = str(error) or type(error).__name__
    if "truncated" in text.lower() or isinstance(error, EOFError):
        return "is truncated: the end of the file is missing"
    return f"is damaged and can't be decoded ({text})"


def _geometry(image: Image.Image) -> tuple[int, tuple[int, int]]:
    """EXIF orientation, and (width, height) of the stored grid, before the pixels are loaded."""
    orientation = read_orientation(image.getexif())
    if image.format == "TIFF":
        tags: Any = image
        return orientation, (int(tags.tag_v2[256]), int(tags.tag_v2[257]))
    return orientation, image.size


def _details(image: Image.Image) -> dict[int, Any]:
    try:
        return dict(image.getexif().get_ifd(EXIF_IFD))
    except DAMAGED:  # a damaged EXIF block does not spoil the picture
        return {}


def _is_sixteen_bit(image: Image.Image, data: bytes) -> bool:
    if image.format == "PNG":
        return data[24] == 16  # bit depth in the header chunk
    if image.format == "TIFF":
        tags: Any = image
        return 16 in tuple(tags.tag_v2.get(258, ()))
    return False


def _sixteen_bit(data: bytes) -> tuple[Image.Image, npt.NDArray[np.bool_] | None]:
    """Decode a 16-bit file (Pillow would drop to 8 bits by other rules) and scale it linearly."""
    deep = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    if deep is None or deep.dtype != np.uint16:
        raise ValueError("unknown sort of 16-bit image")
    eight = np.asarray((deep.astype(np.uint32) * 255 + 32767) // 65535, np.uint8)
    if eight.ndim == 2:
        return Image.fromarray(eight), None
    valid = eight[..., 3] >= 128 if eight.shape[2] == 4 else None
    return Image.fromarray(np.ascontiguousarray(eight[..., 2::-1])), valid


def _to_srgb(
    image: Image.Image, valid: npt.NDArray[np.bool_] | None, profile: bytes | None
) -> tuple[Bytes, npt.NDArray[np.bool_] | None]:
    """Convert any mode to sRGB; an alpha channel or a transparent colour becomes a mask."""
    if image.mode in ("I", "F") or image.mode.startswith("I;16"):
        raise UnusableImage(
            f"holds numbers of a kind that photographs don't ({image.mode}: 16-bit in an unusual "
            "layout, 32-bit or floating point). Save it as 8-bit or 16-bit PNG"
        )
    if image.mode == "P":
        image = image.convert("RGBA" if "transparency" in image.info else "RGB")
    elif image.mode in ("L", "RGB") and "transparency" in image.info:
        image = image.convert("RGBA")
    elif image.mode in ("1", "La", "RGBa", "RGBX", "YCbCr", "HSV"):
        image = image.convert({"La": "LA", "RGBa": "RGBA", "1": "L"}.get(image.mode, "RGB"))
    if image.mode in ("LA", "PA", "RGBA"):
        valid = np.asarray(image.getchannel("A")) >= 128
        image = image.convert("L" if image.mode == "LA" else "RGB")
    converted = _apply_profile(image, profile) if profile else None
    result = converted or (image if image.mode == "RGB" else image.convert("RGB"))
    return np.asarray(result, np.uint8), valid


def _apply_profile(image: Image.Image, profile: bytes) -> Image.Image | None:
    """Convert by an embedded ICC profile; None where it is sRGB already or doesn't fit."""
    try:
        source = ImageCms.ImageCmsProfile(io.BytesIO(profile))
        space = source.profile.xcolor_space.strip()
        fits = {"RGB": "RGB", "GRAY": "L", "CMYK": "CMYK"}.get(space) == image.mode
        name = ImageCms.getProfileDescription(source)
        if not fits or (image.mode == "RGB" and "srgb" in name.lower()):
            return None
        target = ImageCms.createProfile("sRGB")
        return ImageCms.profileToProfile(image, source, target, outputMode="RGB")
    except DAMAGED:  # a damaged profile does not spoil the picture
        return None
