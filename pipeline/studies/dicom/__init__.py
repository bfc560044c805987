"""What a run made as DICOM files, for an archive (PACS): pictures and meshes. pydicom is an extra.

Not a part of the stage `export`: whom the files are of is said when they are written, and belongs
neither to the settings of a stage nor into the key of a result.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from pipeline.studies.dicom.written import Written


def write_dicom(
    workspace: str | Path,
    out: str | Path | None = None,
    *,
    patient: Mapping[str, str] | None = None,
    views: int = 5,
    unscaled: bool = False,
) -> Written:
    """Write the preview, views of the scene and the meshes of a run as DICOM files.

    Args:
        workspace: with a finished run up to `export`.
        out: folder for them; default ``WORKSPACE/dicom``. What an earlier call wrote there goes.
        patient: DICOM keyword -> value, of `identity.GIVEN` (``PatientID``, ...). Without any, the
            files say of nobody whose teeth they show, and that identity was removed.
        views: how many places of the walk around the scene to show.
        unscaled: also write a mesh on which nothing can be measured.

    Raises:
        RequestError: the extra is missing, the run has no exports or they are not what it was last
            asked for, a value is not what DICOM allows, or the folder can't be written or holds
            another program's file of such a name.
    """
    from pipeline.installed import require
    from pipeline.process.privacy import kept_for, share_for

    require("Writing DICOM files", "dicom", "pydicom")
    from pipeline.studies.dicom.writing import write_all

    with kept_for(share_for(Path(workspace))):
        folder = Path(out) if out is not None else Path(workspace) / "dicom"
        return write_all(Path(workspace), folder, dict(patient or {}), views, unscaled)
