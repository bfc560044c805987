"""Who a DICOM file is of, and the numbers that tell it from all others.

Source: DICOM PS3.3 C.7.1.1 (Patient), C.7.2.1 (Study), C.12.1 (SOP Common); PS3.5 B.2 (UUIDs).
"""

from __future__ import annotations

import re
import uuid
from collections.abc import Callable, Mapping
from datetime import date, datetime
from typing import Any

from pydicom.dataset import Dataset
from pydicom.uid import UID
from pydicom.valuerep import validate_value

from pipeline.errors import RequestError, nearest

#: What may be said of a patient and a study -> option of the command line.
GIVEN = {
    "PatientID": "--patient-id",
    "PatientName": "--patient-name",
    "PatientBirthDate": "--birth-date",
    "PatientSex": "--sex",
    "AccessionNumber": "--accession",
    "StudyInstanceUID": "--study-uid",
}
_KINDS = {
    "PatientID": "LO", "PatientName": "PN", "PatientBirthDate": "DA", "PatientSex": "CS",
    "AccessionNumber": "SH", "StudyInstanceUID": "UI",
}  # fmt: skip
#: No letters of our own are in it: two runs of the same content have the same numbers.
_NAMESPACE = uuid.UUID("d5b1b5a6-3a0c-5a6e-9a57-7d3c1f0f6a11")
METHOD = "Made from pixels alone, no patient data taken over"


def checked(patient: Mapping[str, str]) -> dict[str, str]:
    """What was said of the patient, if DICOM allows it.

    Raises:
        RequestError: it does not.
    """
    found = {}
    for keyword, value in patient.items():
        if keyword not in GIVEN:
            raise RequestError(
                f"{keyword} can't be given. What can: {', '.join(GIVEN)}.{nearest(keyword, GIVEN)}"
            )
        kind = _KINDS[keyword]
        try:
            validate_value(kind, value, 2)
            ok = _MEANT[kind](value) and "\\" not in value and value.isprintable()
        except ValueError:
            ok = False
        if not ok:
            raise RequestError(
                f"{GIVEN[keyword]} {value!r} is not what DICOM allows there: {_ALLOWED[kind]}."
            )
        found[keyword] = value
    return found


def _says_something(value: str) -> bool:
    return any(character.isalnum() for character in value)


def _is_name(value: str) -> bool:
    return _says_something(value) and all(group.count("^") < 5 for group in value.split("="))


def _is_past_day(value: str) -> bool:
    return len(value) == 8 and datetime.strptime(value, "%Y%m%d").date() <= date.today()


def valid_uid(text: str) -> bool:
    """Is it a UID?"""
    return len(text) <= 64 and bool(re.fullmatch(r"(0|[1-9][0-9]*)(\.(0|[1-9][0-9]*))+", text))


#: Kind of value -> is it one? pydicom allows blanks alone, days that no month has, ranges of days.
_MEANT: dict[str, Callable[[str], bool]] = {
    "LO": _says_something, "SH": _says_something, "PN": _is_name, "DA": _is_past_day,
    "CS": ("M", "F", "O").__contains__, "UI": valid_uid,
}  # fmt: skip
_ALLOWED = {
    "LO": "letters or digits, at most 64, no backslash",
    "SH": "letters or digits, at most 16, no backslash",
    "PN": "a name as Family^Given, at most 64 letters",
    "DA": "a day that has been, as YYYYMMDD",
    "CS": "M, F or O",
    "UI": "numbers with points between them, at most 64 letters",
}


def uid(*parts: str) -> UID:
    """A UID that these texts alone decide (a name-based UUID under 2.25)."""
    return UID(f"2.25.{uuid.uuid5(_NAMESPACE, '|'.join(parts)).int}")


def describe_patient(dataset: Dataset, patient: Mapping[str, str], study: str) -> None:
    """The modules Patient and Study; what is not known is empty, as DICOM wants it.

    Args:
        patient: as `checked` gave it.
        study: UID of the study, where none was given.
    """
    dataset.PatientName = patient.get("PatientName", "")
    dataset.PatientID = patient.get("PatientID", "")
    dataset.PatientBirthDate = patient.get("PatientBirthDate", "")
    dataset.PatientSex = patient.get("PatientSex", "")
    named: dict[str, Any] = {**patient}
    named.pop("StudyInstanceUID", None)
    dataset.PatientIdentityRemoved = "NO" if named else "YES"
    if not named:
        dataset.DeidentificationMethod = METHOD
    dataset.StudyInstanceUID = patient.get("StudyInstanceUID", study)
    dataset.StudyDate = dataset.StudyTime = ""
    dataset.ReferringPhysicianName = dataset.StudyID = ""
    dataset.AccessionNumber = patient.get("AccessionNumber", "")
    if any(not value.isascii() for value in patient.values()):
        dataset.SpecificCharacterSet = "ISO_IR 192"
