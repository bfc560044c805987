"""Read one photograph of any common format as 8-bit sRGB, on its stored pixel grid."""

from __future__ import annotations

import io
import struct
import threading
import zlib
from collections.abc import Callable, Iterator
from contextlib import nullcontext, suppress
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from PIL import Image, ImageCms

from pipeline.untrusted.files import UnusableFile
from pipeline.untrusted.pictures import Header, bare_png, look, opened
from stages.views.orientation import make_stored, make_upright
from stages.views.reading.exif import (
    DATE_TAKEN,
    EXIF_IFD,
    focal_in_pixels,
    read_orientation,
    taken_at,
)

Bytes = npt.NDArray[np.uint8]
Valid = npt.NDArray[np.bool_]

#: Above this, one at a time whatever the number of threads.
LARGE = 60_000_000
#: Pixels that are brought to sRGB at a time: what that takes is small beside the picture.
STRIP = 1 << 20
#: Of a TIFF file: the tag that says what a page is, its bits, and pages that are looked for.
NEW_SUBFILE_TYPE, SMALLER, TRANSPARENCY, MOST_PAGES = 254, 1, 4, 1000
#: What Pillow and its plugins raise on damaged files.
DAMAGED = (
    OSError, SyntaxError, ValueError, RuntimeError, EOFError, LookupError, TypeError,
    AttributeError, ArithmeticError, struct.error, zlib.error, ImageCms.PyCMSError,
)  # fmt: skip

_one_large = threading.Lock()


@dataclass(frozen=True)
class Photo:
    """A decoded photograph on the stored pixel grid, before the EXIF orientation is applied.

    Attributes:
        rgb: [H, W, 3] uint8 sRGB.
        valid: [H, W] bool from the alpha channel, or None where there is none.
        orientation: EXIF orientation 1..8, still to be applied.
        focal_px: focal length in stored pixels, or None.
        taken_at: by the camera's clock, seconds; or None.
        pages: pictures in the file (pages, or those of an animation), of which this is the first;
            smaller copies do not count.
    """

    rgb: Bytes
    valid: npt.NDArray[np.bool_] | None
    orientation: int
    focal_px: float | None
    taken_at: float | None = None
    pages: int = 1

    def facts(self) -> dict[str, Any]:
        """All but the pixels, by name."""
        return {
            "orientation": self.orientation, "focal_px": self.focal_px, "taken_at": self.taken_at,
            "pages": self.pages,
        }  # fmt: skip


def decode_photo(data: bytes, check_size: Callable[[int, int], None] | None = None) -> Photo:
    """Decode a photograph.

    Args:
        data: the bytes of the file.
        check_size: called with (width, height) of the stored grid before the pixels are decoded;
            raises UnusableFile if it doesn't like them.

    Raises:
        UnusableFile: it is damaged, not an image, or larger than can be read (`look`).
    """
    header = look(data)
    try:
        with opened(data, header) as image:
            orientation, (width, height) = _geometry(image, header)
            if check_size is not None:
                check_size(width, height)
            details = _details(image)
            focal = focal_in_pixels(details, width, height)
            profile = image.info.get("icc_profile")
            with _one_large if width * height > LARGE else nullcontext():
                image.load()
                deep = header.bits == 16 and header.kind in ("PNG", "TIFF")
                rgb, valid = _deep(data, header, image, profile) if deep else shown(image, profile)
            # what follows in a JPEG is a map of its brightness
            several = header.kind in ("PNG", "WEBP", "HEIF") and image.tell() == 0
            pages = getattr(image, "n_frames", 1) if several else 1
            if header.kind == "TIFF":  # Pillow and OpenCV have turned it upright
                pages = _pages(image)
                rgb = make_stored(rgb, orientation)
                valid = None if valid is None else make_stored(valid, orientation)
    except DAMAGED as error:
        raise UnusableFile(_describe_damage(error)) from error
    return Photo(rgb, valid, orientation, focal, taken_at(details.get(DATE_TAKEN)), pages)


def _pages(image: Any) -> int:
    """Pictures in a TIFF file, its first page and those others that are no smaller copy or mask."""
    found = 1
    with suppress(*DAMAGED):  # of pages that are not used; and where they end
        for page in range(1, MOST_PAGES):
            image.seek(page)
            found += not image.tag_v2.get(NEW_SUBFILE_TYPE, 0) & (SMALLER | TRANSPARENCY)
    return found


def decode_mask(data: bytes) -> npt.NDArray[np.bool_]:
    """Decode a mask: [H, W] bool, True where bright (and opaque). Upright.

    Values 0 and 1 count as dark and bright.

    Raises:
        UnusableFile: it is damaged, not an image, or larger than can be read (`look`).
    """
    header = look(data)
    try:
        with opened(data, header) as image:
            orientation, _ = _geometry(image, header)
            image.load()
            gray, alpha = _brightness(image)
            if header.kind == "TIFF":
                gray = make_stored(gray, orientation)
                alpha = None if alpha is None else make_stored(alpha, orientation)
    except DAMAGED as error:
        raise UnusableFile(_describe_damage(error)) from error
    bright = gray > (0 if gray.max(initial=0) <= 1 else 127)
    return make_upright(bright if alpha is None else bright & alpha, orientation)


def _brightness(image: Image.Image) -> tuple[npt.NDArray[Any], Valid | None]:
    """[H, W] grey values of a mask of any mode, and where it is opaque."""
    width, height = image.size
    alpha: Valid | None = None
    if image.mode not in ("1", "L", "P", "RGB", "RGBA", "LA", "PA", "CMYK", "YCbCr"):
        gray = np.asarray(image)
        return (gray > gray.max() / 2) * np.uint8(255) if gray.max() > 255 else gray, None
    gray = np.empty((height, width), np.uint8)
    if image.mode in ("LA", "PA", "RGBA"):
        alpha = np.empty((height, width), np.bool_)
    for rows in _rows(height, width):
        strip = image.crop((0, rows.start, width, min(rows.stop, height)))
        if alpha is not None:
            alpha[rows] = np.asarray(strip.getchannel("A")) >= 128
        gray[rows] = np.asarray(strip if strip.mode == "L" else strip.convert("RGB").convert("L"))
    return gray, alpha


def _describe_damage(error: BaseException) -> str:
    text = str(error) or type(error).__name__
    if "truncated" in text.lower() or isinstance(error, EOFError):
        return "is truncated: the end of the file is missing"
    return f"is damaged and can't be decoded ({text})"


def _geometry(image: Image.Image, header: Header) -> tuple[int, tuple[int, int]]:
    """EXIF orientation, and (width, height) of the stored grid, before the pixels are loaded."""
    try:
        orientation = read_orientation(image.getexif())
    except DAMAGED:  # as for the rest of EXIF
        orientation = 1
    return orientation, (header.width, header.height) if header.kind == "TIFF" else image.size


def _details(image: Image.Image) -> dict[int, Any]:
    try:
        return dict(image.getexif().get_ifd(EXIF_IFD))
    except DAMAGED:  # a damaged EXIF block does not spoil the picture
        return {}


def _deep(
    data: bytes, header: Header, image: Image.Image, profile: bytes | None
) -> tuple[Bytes, Valid | None]:
    """Decode a 16-bit file (Pillow would drop to 8 bits by other rules) and scale it linearly."""
    import cv2

    image.close()  # it was decoded to find damage, which OpenCV does not tell
    if header.kind == "PNG":
        data = bare_png(data)
    try:
        deep = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error as error:
        raise ValueError("unknown sort of 16-bit image") from error
    if deep is None or deep.dtype != np.uint16:
        raise ValueError("unknown sort of 16-bit image")
    height, width = deep.shape[:2]

    def strips() -> Iterator[tuple[Image.Image, Valid | None]]:
        for rows in _rows(height, width):
            eight = np.asarray((deep[rows].astype(np.uint32) * 255 + 32767) // 65535, np.uint8)
            if eight.ndim == 2:
                yield Image.fromarray(eight), None
            else:
                valid = eight[..., 3] >= 128 if eight.shape[2] == 4 else None
                yield Image.fromarray(np.ascontiguousarray(eight[..., 2::-1])), valid

    return _to_srgb(strips(), height, width, profile)


def shown(image: Image.Image, profile: bytes | None) -> tuple[Bytes, Valid | None]:
    """A decoded 8-bit picture of any mode as sRGB, and where it is opaque.

    Args:
        profile: of its colours (ICC), if any.
    """
    width, height = image.size

    def strips() -> Iterator[tuple[Image.Image, Valid | None]]:
        for rows in _rows(height, width):
            yield image.crop((0, rows.start, width, min(rows.stop, height))), None

    return _to_srgb(strips(), height, width, profile)


def _rows(height: int, width: int) -> Iterator[slice]:
    step = max(1, STRIP // width)
    return (slice(top, top + step) for top in range(0, height, step))


def _to_srgb(
    strips: Iterator[tuple[Image.Image, Valid | None]], height: int, width: int,
    profile: bytes | None,
) -> tuple[Bytes, Valid | None]:  # fmt: skip
    """Convert any mode to sRGB; an alpha channel or a transparent colour becomes a mask.

    In strips of some rows: a whole picture in every step of its conversion takes several times the
    memory.
    """
    rgb = np.empty((height, width, 3), np.uint8)
    valid: Valid | None = None
    transform: _Transform | None = None
    top = 0
    for strip, known in strips:
        colours, opaque = _split(strip, known)
        if profile and transform is None:
            transform = _transform(colours.mode, profile)
        if transform is not None and transform.apply is not None:
            colours = transform.apply(colours)
        bottom = top + colours.height
        rgb[top:bottom] = np.asarray(colours if colours.mode == "RGB" else colours.convert("RGB"))
        if opaque is not None:
            valid = np.empty((height, width), np.bool_) if valid is None else valid
            valid[top:bottom] = opaque
        top = bottom
    return rgb, valid


def _split(image: Image.Image, valid: Valid | None) -> tuple[Image.Image, Valid | None]:
    """The colours of a picture of any mode, and where it is opaque."""
    if image.mode in ("I", "F") or image.mode.startswith("I;16"):
        raise UnusableFile(
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
    return image, valid


@dataclass(frozen=True)
class _Transform:
    """What brings a strip to sRGB by its picture's profile; None where nothing is to be done."""

    apply: Callable[[Image.Image], Image.Image] | None


def _transform(mode: str, profile: bytes) -> _Transform:
    """By an embedded ICC profile; nothing where that is sRGB already or doesn't fit."""
    try:
        source = ImageCms.ImageCmsProfile(io.BytesIO(profile))
        space = source.profile.xcolor_space.strip()
        fits = {"RGB": "RGB", "GRAY": "L", "CMYK": "CMYK"}.get(space) == mode
        name = ImageCms.getProfileDescription(source)
        if not fits or (mode == "RGB" and "srgb" in name.lower()):
            return _Transform(None)
        made: Any = ImageCms.buildTransform(source, ImageCms.createProfile("sRGB"), mode, "RGB")
    except DAMAGED:  # a damaged profile does not spoil the picture
        return _Transform(None)

    def apply(image: Image.Image) -> Image.Image:
        return ImageCms.applyTransform(image, made) or image

    return _Transform(apply)
