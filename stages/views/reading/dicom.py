"""Read one photograph from a DICOM file: pixels, colours, focal length and time, nothing of its
patient.

Call this in a child only (`dicom_child`). pydicom is an extra.

Source: DICOM PS3.3 A.8 (Secondary Capture), A.32 (Visible Light), C.7.6.3 (Image Pixel), PS3.10.
"""

from __future__ import annotations

import io
from contextlib import suppress
from typing import Any

import numpy as np
import numpy.typing as npt
import pydicom
from PIL import Image
from pydicom.encaps import get_frame
from pydicom.pixels.decoders.base import get_decoder
from pydicom.pixels.processing import apply_color_lut, convert_color_space
from pydicom.uid import UID, JPEGLossless, JPEGLosslessSV1

from pipeline.untrusted.files import UnusableFile
from pipeline.untrusted.pictures import check_size
from stages.views.reading.decode import Photo, shown
from stages.views.reading.exif import FOCAL_LENGTH_35MM, focal_in_pixels, taken_at

#: SOP classes of photographs.
CLASSES = {
    "1.2.840.10008.5.1.4.1.1.77.1.4": "VL Photographic",
    "1.2.840.10008.5.1.4.1.1.77.1.1": "VL Endoscopic",
    "1.2.840.10008.5.1.4.1.1.7": "Secondary Capture",
    "1.2.840.10008.5.1.4.1.1.7.4": "Multi-frame True Color Secondary Capture",
}
_COLOURS = (
    "RGB", "YBR_FULL", "YBR_FULL_422", "YBR_ICT", "YBR_RCT", "MONOCHROME1", "MONOCHROME2",
    "PALETTE COLOR",
)  # fmt: skip
#: Where the height and the width of a pixel may stand, what counts first.
_SIDES = ("PixelAspectRatio", "PixelSpacing", "ImagerPixelSpacing", "NominalScannedPixelSpacing")
_TABLES = [f"{colour}PaletteColorLookupTable" for colour in ("Red", "Green", "Blue")]
#: All that is read: no other element is parsed or kept.
_TAGS: list[Any] = [
    "SOPClassUID", "Rows", "Columns", "SamplesPerPixel", "PhotometricInterpretation",
    "PlanarConfiguration", "BitsAllocated", "BitsStored", "HighBit", "PixelRepresentation",
    "NumberOfFrames", "PixelData", "ExtendedOffsetTable", "ExtendedOffsetTableLengths",
    "ICCProfile", "FocalLengthIn35mmFilm", "AcquisitionDateTime", *_SIDES,
    *(f"{table}{part}" for table in _TABLES for part in ("Data", "Descriptor")),
]  # fmt: skip
#: Bytes a pixel that decoding takes at most: colours are converted in floating point.
MEMORY = 40.0
_LOSSLESS = (JPEGLossless, JPEGLosslessSV1)
#: Pixels are this much higher than wide, or wider than high, at most; more is damage. Below the
#: least they count as square: spacings are rounded.
WIDEST_PIXEL, LEAST_ODD = 4.0, 1.005


def decode_dicom(data: bytes) -> Photo:
    """Decode a photograph in a DICOM file.

    Args:
        data: the bytes of the file, with the preamble.

    Raises:
        UnusableFile: it is damaged, holds no photograph, several, or one that is compressed in a
            way that is not decoded here.
    """
    try:
        return _decode(data)
    except (UnusableFile, MemoryError):
        raise
    except Exception as error:  # what damaged files raise in pydicom is anybody's guess
        # Its text may quote the file: it is not told.
        raise UnusableFile("is a DICOM file that is damaged, and can't be decoded") from error


def _decode(data: bytes) -> Photo:
    found = pydicom.dcmread(io.BytesIO(data), specific_tags=_TAGS)
    sort = str(found.get("SOPClassUID", ""))
    if sort not in CLASSES:
        raise UnusableFile(
            f"is a DICOM file of another kind ({_name(sort)}): photographs are "
            "VL Photographic, VL Endoscopic or Secondary Capture"
        )
    if "PixelData" not in found:
        raise UnusableFile("is a DICOM file without pixels")
    frames = int(found.get("NumberOfFrames") or 1)
    if frames != 1:
        raise UnusableFile(
            f"is a DICOM file of {frames} pictures, and only files of one are read: save each "
            "as a file of its own, or name the film that they come from"
        )
    width, height = int(found.Columns), int(found.Rows)
    check_size(width, height, MEMORY)
    colours = str(found.PhotometricInterpretation)
    depth, stored = int(found.BitsAllocated), int(found.BitsStored)
    if (
        colours not in _COLOURS
        or depth not in (8, 16)
        or not 1 <= stored <= depth
        or int(found.get("PixelRepresentation", 0)) != 0
    ):
        raise UnusableFile(
            f"is a DICOM file whose pixels are not those of a photograph ({colours[:16]}, {stored} "
            f"of {depth} bits); RGB, YBR_FULL, YBR_FULL_422, MONOCHROME and PALETTE COLOR of 8 or "
            "16 bits are read"
        )
    pixels, stored = _pixels(found, colours, stored)
    if stored > 8 or (stored < 8 and pixels.max(initial=0) < 1 << stored):
        pixels = (pixels.astype(np.uint32) * 255 // ((1 << stored) - 1)).clip(0, 255)
    eight = np.ascontiguousarray(pixels, np.uint8)
    if eight.shape[:2] != (height, width) or eight.shape[2:] not in ((), (3,)):
        raise UnusableFile("is a DICOM file that is damaged: its pixels don't fit its header")
    if colours == "MONOCHROME1":
        eight = 255 - eight
    profile = found.get("ICCProfile")
    rgb, _ = shown(Image.fromarray(eight), bytes(profile) if profile else None)
    higher = _height_by_width(found)
    if higher != 1:  # none of the pixels are lost
        width, height = round(width / min(higher, 1)), round(height * max(higher, 1))
        check_size(width, height, MEMORY)
        rgb = np.asarray(Image.fromarray(rgb).resize((width, height), Image.Resampling.BICUBIC))
    focal = focal_in_pixels(
        {FOCAL_LENGTH_35MM: found.get("FocalLengthIn35mmFilm")}, width, height
    )  # fmt: skip
    return Photo(rgb, None, 1, focal, _taken_at(str(found.get("AcquisitionDateTime") or "")))


def _height_by_width(found: Any) -> float:
    """Of a pixel, by the first element that says it; 1 where it is square or nonsense is said."""
    for name in _SIDES:
        with suppress(TypeError, ValueError, ZeroDivisionError):
            height, width = map(float, found[name].value if name in found else ())
            higher = height / width
            odd = max(higher, 1 / higher)
            return higher if LEAST_ODD < odd <= WIDEST_PIXEL else 1.0
    return 1.0


def _taken_at(text: str) -> float | None:
    """Of DICOM's "20261127140559.123+0100"; the zone is left out, as EXIF has none."""
    parts = text[:4], text[4:6], text[6:8], text[8:10], text[10:12], text[12:14]
    return taken_at("{}:{}:{} {}:{}:{}".format(*parts))


def _pixels(found: Any, colours: str, stored: int) -> tuple[npt.NDArray[Any], int]:
    """[H, W] or [H, W, 3] numbers, in RGB where they are colours, and how many bits they have."""
    syntax = UID(found.file_meta.TransferSyntaxUID)
    if syntax in _LOSSLESS:
        pixels = _lossless_jpeg(found)
        if colours.startswith("YBR"):
            pixels = convert_color_space(pixels, colours, "RGB")
        stored = min(stored, 8)
    else:
        try:
            decoder = get_decoder(syntax)
        except NotImplementedError:
            decoder = None
        # an uncompressed file needs no decoder's plugin
        if decoder is None or (syntax.is_compressed and not decoder.is_available):
            raise UnusableFile(
                f"is a DICOM file compressed in a way that is not decoded here ({_name(syntax)}): "
                "JPEG, JPEG lossless, JPEG 2000 and RLE of 8 bits are. Let the archive send it "
                "uncompressed, or save it as JPEG"
            )
        pixels, _ = decoder.as_array(found, index=0)
    if colours == "PALETTE COLOR":
        # some write 8 bits into the words of a table and call them 16
        tables = [np.frombuffer(found[f"{name}Data"].value, np.uint8) for name in _TABLES]
        pixels = apply_color_lut(pixels, found)
        wide = pixels.dtype.itemsize == 2 and any(table[1::2].any() for table in tables)
        stored = 16 if wide else 8
    return pixels, stored


def _lossless_jpeg(found: Any) -> npt.NDArray[Any]:
    """By libjpeg-turbo 3, which Pillow has; its colours are those of the file, as they stand."""
    frame = get_frame(found.PixelData, 0, number_of_frames=1)
    with Image.open(io.BytesIO(frame), formats=["JPEG"]) as image:
        if image.mode not in ("L", "RGB"):
            raise ValueError("unknown sort of lossless JPEG")
        check_size(*image.size, MEMORY)
        return np.asarray(image)


def _name(uid: str) -> str:
    """What DICOM calls a UID; a private one is not told."""
    name = UID(uid).name  # the number itself where it has none
    return "unknown" if name == uid else name
