"""Photographs in DICOM files, with a patient in every element that may name one."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pydicom
from PIL import Image
from pydicom.dataset import Dataset, FileMetaDataset
from pydicom.encaps import encapsulate
from pydicom.sequence import Sequence
from pydicom.uid import ExplicitVRLittleEndian, JPEG2000Lossless, JPEGBaseline8Bit

from tests.personal_data import DATE, MAKER, PHONE, PLACE

VL_PHOTOGRAPH = "1.2.840.10008.5.1.4.1.1.77.1.4"


def dicom_photograph(rgb: npt.NDArray[np.uint8], **changes: Any) -> Dataset:
    """A VL Photographic Image of these pixels [H, W, 3] (or [H, W]).

    Args:
        changes: elements by keyword, other than usual.
    """
    found = Dataset()
    found.file_meta = FileMetaDataset()
    found.file_meta.TransferSyntaxUID = ExplicitVRLittleEndian
    found.file_meta.MediaStorageSOPClassUID = found.SOPClassUID = VL_PHOTOGRAPH
    found.file_meta.MediaStorageSOPInstanceUID = found.SOPInstanceUID = "2.25.7"
    found.PatientName, found.PatientID = "Prognath^Anna", "MRN-0815"
    found.PatientBirthDate = found.StudyDate = DATE.replace(":", "")
    found.PatientTelephoneNumbers, found.InstitutionAddress = PHONE, PLACE
    found.Manufacturer, found.ReferringPhysicianName = MAKER, "Dr. Braces"
    found.ImageComments = "Prognath, Anna; MRN-0815"
    code = Dataset()
    code.CodeValue, code.CodeMeaning = "1", "Prognath from the right"
    found.ViewCodeSequence = Sequence([code])
    found.private_block(0x0011, MAKER, create=True).add_new(0x01, "LO", "MRN-0815")
    found.Rows, found.Columns = rgb.shape[:2]
    found.SamplesPerPixel = 1 if rgb.ndim == 2 else 3
    found.PhotometricInterpretation = "MONOCHROME2" if rgb.ndim == 2 else "RGB"
    if rgb.ndim == 3:
        found.PlanarConfiguration = 0
    found.BitsAllocated = found.BitsStored = 8 * rgb.dtype.itemsize
    found.HighBit = found.BitsStored - 1
    found.PixelRepresentation = 0
    data = rgb.tobytes()
    found.PixelData = data + b"\0" * (len(data) % 2)
    for keyword, value in changes.items():
        setattr(found, keyword, value)
    return found


def compressed(rgb: npt.NDArray[np.uint8], kind: str, **changes: Any) -> Dataset:
    """The same, as `JPEG` or `JPEG2000` of Pillow's."""
    stream = io.BytesIO()
    if kind == "JPEG":
        Image.fromarray(rgb).save(stream, "JPEG", quality=95, subsampling=2)
        colours, syntax = "YBR_FULL_422", JPEGBaseline8Bit
    else:
        Image.fromarray(rgb).save(stream, "JPEG2000", irreversible=False, no_jp2=True, mct=1)
        colours, syntax = "YBR_RCT", JPEG2000Lossless
    found = dicom_photograph(rgb, PhotometricInterpretation=colours, **changes)
    found.file_meta.TransferSyntaxUID = syntax
    found.PixelData = encapsulate([stream.getvalue()])
    found["PixelData"].VR = "OB"
    return found


def as_bytes(dataset: Dataset) -> bytes:
    """The file of a data set."""
    stream = io.BytesIO()
    pydicom.dcmwrite(stream, dataset, enforce_file_format=True)
    return stream.getvalue()


def write_all(folder: Path, photographs: dict[str, npt.NDArray[np.uint8]]) -> Path:
    """Photographs as files of these names; returns the folder."""
    folder.mkdir(exist_ok=True)
    for name, rgb in photographs.items():
        (folder / name).write_bytes(as_bytes(compressed(rgb, "JPEG")))
    return folder
