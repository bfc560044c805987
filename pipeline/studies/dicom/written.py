"""What came of writing DICOM files."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class Written:
    """What came of it.

    Attributes:
        folder: that holds the files.
        files: name -> what it is.
        left_out: name of a mesh -> why it was not written.
        problems: what reading the files back found wrong; empty: nothing.
        removed: files of an earlier call that lay in the folder and were not written anew.
    """

    folder: Path
    files: Mapping[str, str]
    left_out: Mapping[str, str]
    problems: tuple[str, ...] = ()
    removed: tuple[str, ...] = ()
