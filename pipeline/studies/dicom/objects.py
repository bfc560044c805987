"""DICOM data sets of pictures (Secondary Capture) and meshes (Encapsulated STL).

A rendered view is no photograph: it is a Secondary Capture of a workstation, derived.
Sources: DICOM PS3.3 A.8.1 (Secondary Capture Image), A.85.1 (Encapsulated STL), C.24.2
(Encapsulated Document), C.35.1 (Manufacturing 3D Model).
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from pydicom.dataset import Dataset, FileMetaDataset
from pydicom.sequence import Sequence
from pydicom.uid import UID, ExplicitVRLittleEndian

from pipeline.installed import library_version
from pipeline.studies.dicom.identity import describe_patient, uid

SECONDARY_CAPTURE = "1.2.840.10008.5.1.4.1.1.7"
ENCAPSULATED_STL = "1.2.840.10008.5.1.4.1.1.104.3"


@dataclass(frozen=True)
class Picture:
    """A picture to be written: name of the file, what it shows, [H, W, 3] uint8 sRGB."""

    name: str
    title: str
    rgb: npt.NDArray[np.uint8]


@dataclass(frozen=True)
class Solid:
    """A mesh to be written: name of the file, what it is, a binary STL, unit (UCUM code) and frame.

    Attributes:
        frame: what its axes are, in words.
        modified: it is not as the reconstruction has it: closed, or given a base.
    """

    name: str
    title: str
    stl: bytes
    in_mm: bool
    scale: str
    frame: str
    modified: bool


def data_sets(
    pictures: list[Picture], solids: list[Solid], patient: Mapping[str, str]
) -> dict[str, Dataset]:
    """Name of a file -> its data set. The same content gives the same bytes.

    Args:
        patient: as `identity.checked` gave it.
    """
    said = "|".join(f"{key}={value}" for key, value in sorted(patient.items()))
    marks = {p.name: _digest(p.rgb.tobytes()) for p in pictures}
    marks |= {s.name: _digest(s.stl) for s in solids}
    study = uid("study", said, *(f"{name}:{mark}" for name, mark in sorted(marks.items())))
    found: dict[str, Dataset] = {}
    for number, picture in enumerate(pictures, 1):
        made = _common(SECONDARY_CAPTURE, "OT", study, patient, picture.name)
        made.SeriesDescription, made.SeriesNumber = "Rendered views", 1
        _add_picture(made, picture, number)
        found[picture.name] = made
    for number, solid in enumerate(solids, 1):
        made = _common(ENCAPSULATED_STL, "M3D", study, patient, solid.name)
        made.SeriesDescription, made.SeriesNumber = "Surfaces", 2
        _add_solid(made, solid, number, study)
        found[solid.name] = made
    return found


def _digest(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()


def _common(sort: str, modality: str, study: str, patient: Mapping[str, str], name: str) -> Dataset:
    """Patient, Study, Series, Equipment and SOP Common.

    Args:
        study: UID that the content of all files, their names and the patient decide.
        name: of the file. Two files are two objects, also where they show the same, and where one
            has been sent before with others beside it.
    """
    made = Dataset()
    made.file_meta = FileMetaDataset()
    made.file_meta.TransferSyntaxUID = ExplicitVRLittleEndian
    made.file_meta.ImplementationClassUID = uid("dentalsplat")
    made.file_meta.ImplementationVersionName = "DENTALSPLAT"
    describe_patient(made, patient, study)
    made.SOPClassUID = made.file_meta.MediaStorageSOPClassUID = UID(sort)
    made.SOPInstanceUID = uid("instance", made.StudyInstanceUID, study, name)
    made.file_meta.MediaStorageSOPInstanceUID = made.SOPInstanceUID
    made.Modality = modality
    made.SeriesInstanceUID = uid("series", made.StudyInstanceUID, study, modality)
    made.Manufacturer, made.ManufacturerModelName = "dentalsplat", "dentalsplat"
    made.DeviceSerialNumber = "none"
    made.SoftwareVersions = library_version("dentalsplat")
    made.BurnedInAnnotation = "NO"
    return made


def _add_picture(made: Dataset, picture: Picture, number: int) -> None:
    height, width = picture.rgb.shape[:2]
    made.Laterality = ""  # the mouth is no paired part
    made.ConversionType = "WSD"
    made.ImageType = ["DERIVED", "SECONDARY"]
    made.InstanceNumber = number
    made.PatientOrientation = ""
    made.ImageComments = made.DerivationDescription = picture.title
    made.SamplesPerPixel, made.PhotometricInterpretation = 3, "RGB"
    made.PlanarConfiguration = 0
    made.Rows, made.Columns = height, width
    made.BitsAllocated = made.BitsStored = 8
    made.HighBit, made.PixelRepresentation = 7, 0
    made.LossyImageCompression = "00"
    data = np.ascontiguousarray(picture.rgb).tobytes()
    made.PixelData = data + b"\0" * (len(data) % 2)


def _add_solid(made: Dataset, solid: Solid, number: int, study: str) -> None:
    made.InstanceNumber = number
    made.ContentDate = made.ContentTime = made.AcquisitionDateTime = ""
    made.DocumentTitle = solid.title
    made.ConceptNameCodeSequence = Sequence([_code("85040-4", "LN", "3D Model")])
    made.MIMETypeOfEncapsulatedDocument = "model/stl"
    made.EncapsulatedDocument = solid.stl + b"\0" * (len(solid.stl) % 2)
    made.EncapsulatedDocumentLength = len(solid.stl)
    made.FrameOfReferenceUID = uid("frame", made.StudyInstanceUID, study)
    made.PositionReferenceIndicator = ""
    unit = _code("mm", "UCUM", "mm") if solid.in_mm else _code("1", "UCUM", "no units")
    made.MeasurementUnitsCodeSequence = Sequence([unit])
    made.ModelModification = "YES" if solid.modified else "NO"
    made.ModelMirroring = "NO"
    made.ContentDescription = _short(f"{solid.scale}; {solid.frame}", 64)


def _code(value: str, scheme: str, meaning: str) -> Dataset:
    made = Dataset()
    made.CodeValue, made.CodingSchemeDesignator, made.CodeMeaning = value, scheme, meaning
    return made


def _short(text: str, most: int) -> str:
    return text if len(text) <= most else text[: most - 3] + "..."
