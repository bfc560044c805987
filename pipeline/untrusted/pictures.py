"""Which pictures are decoded, and how large they may be: told from their first bytes.

Only the formats that the documentation names; what a file is called says nothing.
"""

from __future__ import annotations

import importlib
import io
import struct
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from pipeline.untrusted.files import UnusableFile

if TYPE_CHECKING:
    from PIL import Image

KNOWN = "JPEG, PNG, TIFF, WebP, HEIC, BMP or DICOM"
#: How the names of pictures end; of DICOM files apart, which may hold none.
SUFFIXES = (".jpg", ".jpeg", ".jfif", ".png", ".tif", ".tiff", ".webp", ".heic", ".heif", ".bmp")
MAX_PIXELS = 300_000_000
#: The longest side that a JPEG can have.
MAX_SIDE = 65_535
#: Bytes that decoding one picture may take: ten for each of the most pixels.
MOST_MEMORY = 10 * MAX_PIXELS
#: Kinds whose decoders are run in a process of their own.
APART = ("HEIF", "TIFF", "DICOM")
#: Where a DICOM file says that it is one, and how (PS3.10, 7.1).
DICOM_MARK = (128, b"DICM")

_HEIC = (b"heic", b"heix", b"heim", b"heis", b"hevc", b"hevx", b"hevm", b"hevs", b"mif1", b"msf1")
_OTHERS = (
    (0, b"%!PS", "a PostScript file"),
    (0, b"\xc5\xd0\xd3\xc6", "a PostScript file"),
    (0, b"%PDF", "a PDF"),
    (0, b"GIF8", "a GIF"),
    (0, b"8BPS", "a Photoshop file"),
    (0, b"PK\3\4", "an archive"),
    (0, b"\x1f\x8b", "an archive"),
    (0, b"Rar!", "an archive"),
    (0, b"7z\xbc\xaf", "an archive"),
    (0, b"\0\0\0\x0cjP  ", "a JPEG 2000"),
    (0, b"\xff\x4f\xff\x51", "a JPEG 2000"),
    (0, b"\xff\x0a", "a JPEG XL"),
    (0, b"\0\0\0\x0cJXL ", "a JPEG XL"),
    (4, b"ftypavi", "an AVIF"),
    (4, b"ftypcrx", "a raw file of a camera"),
    (4, b"ftyp", "a film"),
    (4, b"moov", "a film"),
    (0, b"\x1aE\xdf\xa3", "a film"),
    (*DICOM_MARK, "a DICOM file"),
)


@dataclass(frozen=True)
class Header:
    """What the first bytes of a picture say.

    Attributes:
        kind: JPEG, PNG, TIFF, WEBP, HEIF, BMP or DICOM.
        width, height: of the stored grid; 0 where only the decoder of the kind can tell (HEIF,
            DICOM).
        bits: of a channel.
        memory: bytes a pixel that decoding it takes at most, measured; `benchmarks/pictures.py`.
    """

    kind: str
    width: int = 0
    height: int = 0
    bits: int = 8
    memory: float = 10.0


def look(data: bytes) -> Header:
    """Read the header of a picture; nothing is allocated.

    Raises:
        UnusableFile: it is no picture of a known format, is cut off, or says that it is too large.
    """
    if not data:
        raise UnusableFile("is empty (0 bytes)")
    kind = _kind(data)
    if kind is None:
        raise UnusableFile(describe(data))
    try:
        header = _READERS[kind](data)
    except (struct.error, IndexError) as error:
        raise UnusableFile("is truncated: the end of the file is missing") from error
    if kind not in ("HEIF", "DICOM"):
        check_size(header.width, header.height, header.memory)
    return header


def check_size(width: int, height: int, memory: float = 10.0) -> None:
    """Refuse a picture of so many pixels, or with so much memory a pixel to decode it.

    Raises:
        UnusableFile: it is too large, or has no pixels.
    """
    if width < 1 or height < 1:
        raise UnusableFile(f"is damaged: by its header it has {width} x {height} pixels")
    if max(width, height) > MAX_SIDE:
        raise UnusableFile(
            f"has {width} x {height} pixels by its header, and a side of more than {MAX_SIDE:,} "
            "can't be read"
        )
    most = min(MAX_PIXELS, int(MOST_MEMORY / memory))
    if width * height > most:
        raise UnusableFile(
            f"has {width} x {height} pixels by its header, more than the {most / 1e6:.3g} "
            "megapixels that can be read of such a file"
        )


@contextmanager
def large_pictures() -> Iterator[None]:
    """Lift Pillow's own limit on sizes, as `look` has one, and hush its warnings.

    It changes settings of the whole process: enter it once, around all threads that decode.
    """
    from PIL import Image

    before, Image.MAX_IMAGE_PIXELS = Image.MAX_IMAGE_PIXELS, None
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of odd EXIF, which is read with care
            yield
    finally:
        Image.MAX_IMAGE_PIXELS = before


def opened(data: bytes, header: Header) -> Image.Image:
    """The picture, opened by the decoder of its kind only; its pixels are not decoded yet.

    Args:
        data: the bytes of the file.
        header: what `look` found.

    Raises:
        UnusableFile: it is not what its first bytes say, too large, or a DICOM file, which Pillow
            does not read.
        Others: what Pillow raises of damaged files.
    """
    from PIL import Image, UnidentifiedImageError

    if header.kind == "DICOM":
        raise UnusableFile("is a DICOM file, which only a photograph may be")
    _import_decoder(header.kind)
    try:
        image: Image.Image = Image.open(io.BytesIO(data), formats=[header.kind])
    except UnidentifiedImageError as error:
        raise UnusableFile(describe(b"")) from error
    check_size(*image.size, header.memory)  # Pillow may have believed another part of the file
    return image


def _import_decoder(kind: str) -> None:
    """Only the one that is needed: Pillow would import all of its decoders."""
    if kind == "HEIF":
        import pillow_heif

        pillow_heif.register_heif_opener()
    else:
        name = {"JPEG": "Jpeg", "PNG": "Png", "TIFF": "Tiff", "WEBP": "WebP", "BMP": "Bmp"}[kind]
        importlib.import_module(f"PIL.{name}ImagePlugin")


def gray(data: bytes) -> npt.NDArray[np.uint8]:
    """Decode a picture as [H, W] grey, upright, by OpenCV's rules.

    Raises:
        UnusableFile: it can't be read.
    """
    import cv2

    header = look(data)
    if header.kind == "DICOM":
        raise UnusableFile("is a DICOM file, which only a photograph may be")
    if header.kind == "PNG":
        data = bare_png(data)
    try:
        found = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_GRAYSCALE)
    except cv2.error as error:
        raise UnusableFile("is damaged and can't be decoded") from error
    if found is None:
        raise UnusableFile("is damaged and can't be decoded")
    return np.asarray(found, np.uint8)


def same_shape(a: tuple[int, ...], b: tuple[int, ...]) -> bool:
    """Are two sizes equal up to scale, within their rounding to whole pixels?"""
    return abs(a[0] * b[1] - a[1] * b[0]) <= max(*a, *b)


def bare_png(data: bytes) -> bytes:
    """A PNG with nothing but what its first picture is made of: no texts, profiles, animation."""
    kept, place = [data[:8]], 8
    while place + 12 <= len(data):
        (length,) = struct.unpack_from(">I", data, place)
        name = data[place + 4 : place + 8]
        if name in (b"IHDR", b"PLTE", b"tRNS", b"IDAT", b"IEND", b"eXIf"):
            kept.append(data[place : place + 12 + length])
        if name == b"IEND":
            break
        place += 12 + length
    return b"".join(kept)


def describe(data: bytes) -> str:
    """What a file is that is no picture to be read, as the end of a sentence."""
    for place, magic, name in _OTHERS:
        if data[place : place + len(magic)] == magic:
            return f"is {name} by its content, not a {KNOWN} image"
    head = data[:2000]
    printable = sum(byte in b"\t\n\r\f" or byte >= 32 for byte in head)
    if head and printable == len(head):
        return "is a text file, not an image"
    return f"is not a readable {KNOWN} image (another format, or damaged at its start)"


def _kind(data: bytes) -> str | None:
    if data[:3] == b"\xff\xd8\xff":
        return "JPEG"
    if data[:8] == b"\x89PNG\r\n\x1a\n":
        return "PNG"
    if data[:4] in (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+"):
        return "TIFF"
    if data[:4] == b"RIFF" and data[8:12] == b"WEBP":
        return "WEBP"
    if data[4:8] == b"ftyp" and data[8:12] in _HEIC:
        return "HEIF"
    if data[:2] == b"BM":
        return "BMP"
    place, mark = DICOM_MARK
    return "DICOM" if data[place : place + len(mark)] == mark else None


def _jpeg(data: bytes) -> Header:
    place = 2
    while True:
        if data[place] != 0xFF:  # as decoders do: on to the next marker
            place = data.find(b"\xff", place)
            if place < 0:
                raise IndexError
        marker = data[place + 1]
        if marker in (0xFF, 0x00):
            place += 1
        elif 0xD0 <= marker <= 0xD8 or marker == 0x01:
            place += 2
        elif marker in (0xD9, 0xDA):
            raise UnusableFile("is damaged: it has no header before its pixels")
        elif 0xC0 <= marker <= 0xCF and marker not in (0xC4, 0xC8, 0xCC):
            bits, height, width, channels = struct.unpack_from(">BHHB", data, place + 4)
            # Progressive ones are collected whole, two bytes a coefficient, before the pixels are.
            held = sum(
                (data[place + 11 + 3 * n] >> 4) * (data[place + 11 + 3 * n] & 15)
                for n in range(channels)
            )
            most = max(
                ((data[place + 11 + 3 * n] >> 4) * (data[place + 11 + 3 * n] & 15)
                 for n in range(channels)), default=1,
            )  # fmt: skip
            coefficients = 0.0 if marker in (0xC0, 0xC1) else 2.0 * held / max(most, 1)
            return Header("JPEG", width, height, bits, max(9.0, 4.5 + coefficients))
        else:
            place += 2 + int.from_bytes(data[place + 2 : place + 4])
            if place + 2 > len(data):
                raise IndexError


def _png(data: bytes) -> Header:
    if data[12:16] != b"IHDR":
        raise UnusableFile("is damaged: it has no header before its pixels")
    width, height, bits, colour = struct.unpack_from(">IIBB", data, 16)
    channels = {0: 1, 2: 3, 3: 1, 4: 2, 6: 4}.get(colour, 4)
    # OpenCV decodes 16 bits into one buffer and copies it to another.
    return Header("PNG", width, height, bits, max(7.0, 1.0 + 4 * channels) if bits == 16 else 9.0)


def _bmp(data: bytes) -> Header:
    (size,) = struct.unpack_from("<I", data, 14)
    width, height = struct.unpack_from("<hh" if size == 12 else "<ii", data, 18)
    return Header("BMP", width, abs(height))


def _webp(data: bytes) -> Header:
    chunk = data[12:16]
    if chunk == b"VP8X":
        width = 1 + int.from_bytes(data[24:27], "little")
        height = 1 + int.from_bytes(data[27:30], "little")
    elif chunk == b"VP8L":
        (packed,) = struct.unpack_from("<I", data, 21)
        width, height = (packed & 0x3FFF) + 1, (packed >> 14 & 0x3FFF) + 1
    elif chunk == b"VP8 ":
        width, height = (side & 0x3FFF for side in struct.unpack_from("<HH", data, 26))
    else:
        raise UnusableFile(describe(b""))
    return Header("WEBP", width, height, memory=18.0)  # its library holds two canvases


def _tiff(data: bytes) -> Header:
    """The first directory, read strictly: decoders differ in what they make of a doubled tag."""
    order = "<" if data[:2] == b"II" else ">"
    big = 43 in data[2:4]
    place = struct.unpack_from(order + ("Q" if big else "I"), data, 8 if big else 4)[0]
    count = struct.unpack_from(order + ("Q" if big else "H"), data, place)[0]
    place, step = place + (8 if big else 2), 20 if big else 12
    if count > 4096:
        raise UnusableFile(f"is damaged: its header names {count:,} tags")
    found: dict[int, int] = {}
    for entry in range(place, place + count * step, step):
        tag, kind = struct.unpack_from(order + "HH", data, entry)
        amount = struct.unpack_from(order + ("Q" if big else "I"), data, entry + 4)[0]
        inline = {1: "B", 3: "H", 4: "I", 16: "Q"}.get(kind)
        if tag in (256, 257, 258, 259, 262, 277, 284):
            if tag in found:
                raise UnusableFile(f"is damaged: its header names tag {tag} twice")
            if inline is None or amount < 1 or (inline == "Q" and not big):
                raise UnusableFile(f"is damaged: tag {tag} of its header holds no number")
            at = entry + (12 if big else 8)
            if struct.calcsize(inline) * amount > (8 if big else 4):
                at = struct.unpack_from(order + ("Q" if big else "I"), data, at)[0]
            found[tag] = struct.unpack_from(order + inline, data, at)[0]
        elif inline != "B" and amount > 1 << 22:
            raise UnusableFile(f"is damaged: tag {tag} of its header holds {amount:,} numbers")
    bits, samples = found.get(258, 1), found.get(277, 1)
    if not 1 <= samples <= 8 or bits > 64:
        raise UnusableFile(f"has {samples} channels of {bits} bits, as no photograph has")
    planar = samples > 1 and found.get(284, 1) == 2
    if bits == 16 and (planar or found.get(262) == 0):
        how = "one channel after the other" if planar else "as a negative"
        raise UnusableFile(
            f"holds 16 bits a channel {how}, which is not read right. Save it as PNG, or as TIFF "
            "with interleaved channels"
        )
    # A file of one strip is held three times: as it is, decoded, and as a picture.
    memory = 14.0 if bits <= 8 else 4.0 + 3 * samples * bits / 8
    return Header("TIFF", found.get(256, 0), found.get(257, 0), bits, memory)


def _heif(data: bytes) -> Header:
    return Header("HEIF", memory=12.0)


def _dicom(data: bytes) -> Header:
    return Header("DICOM")


_READERS: dict[str, Callable[[bytes], Header]] = {
    "JPEG": _jpeg, "PNG": _png, "TIFF": _tiff, "WEBP": _webp, "HEIF": _heif, "BMP": _bmp,
    "DICOM": _dicom,
}  # fmt: skip
