"""From a workspace to DICOM files, and what reading them back says."""

from __future__ import annotations

import io
import os
import re
import struct
from collections.abc import Iterable
from pathlib import Path
from shlex import quote
from typing import Any

import numpy as np
import numpy.typing as npt
import pydicom
from pydicom.dataset import Dataset
from pydicom.errors import BytesLengthException, InvalidDicomError
from pydicom.filereader import read_file_meta_info

from pipeline.artifacts.dental.fdi import JAWS
from pipeline.artifacts.space.scale import Scale
from pipeline.errors import RequestError
from pipeline.files import read_json, temporary_beside
from pipeline.pages.case import Case
from pipeline.store.places import is_there
from pipeline.studies.dicom.exports import exports_of
from pipeline.studies.dicom.identity import checked, uid, valid_uid
from pipeline.studies.dicom.objects import Picture, Solid, data_sets
from pipeline.studies.dicom.written import Written
from pipeline.studies.jobs import results_in
from pipeline.studies.report.reading import read_case

#: Surfaces whose names begin so are not as the reconstruction has them: closed, with a base.
_MODIFIED = "model"
#: The axes of frames that stand, once z is up: those of a patient in DICOM, where it is a mouth's.
_Z_UP_AXES = {
    "mouth": "x left, y back, z head",
    "upright": "x right, y away, z up",
}
#: What pydicom raises at a head that is none.
UNREADABLE = (
    AttributeError, BytesLengthException, EOFError, InvalidDicomError, NotImplementedError,
    ValueError, struct.error,
)  # fmt: skip
#: What this command calls its files.
OWN_NAMES = re.compile(r"(preview|view_\d{3}|mesh\w*|model\w*)\.dcm")
#: Bytes before the triangles of a binary STL, and their layout.
_STL_HEAD = 84
_TRIANGLE = np.dtype([("vectors", "<f4", (4, 3)), ("spare", "<u2")])


def write_all(
    workspace: Path, folder: Path, patient: dict[str, str], views: int, unscaled: bool
) -> Written:
    """See `pipeline.studies.dicom.write_dicom`."""
    said = checked(patient)
    case = read_case(workspace)
    results = exports_of(case)
    scene = read_json(results / "scene.json")
    if not isinstance(scene, dict):
        raise RequestError(
            f"{workspace} has no exports to write as DICOM files. Run the pipeline to its end "
            f"first: pipeline run -w {quote(str(workspace))}"
        )
    scale = Scale.from_dict(scene.get("scale") or {})  # none in exports of before it was recorded
    _keep_apart(folder, case.request["images"])
    solids, left_out = _solids(results, scale, scene.get("frame", {}), unscaled)
    with results_in(folder):
        pictures = [*_preview(results), *_views(case, views)]
        if not pictures and not solids:
            raise RequestError(
                f"{results} holds nothing that becomes a DICOM file: no preview and no mesh with a "
                "scale. With --unscaled a mesh without one is written as well."
            )
        made = data_sets(pictures, solids, said)
        problems: list[str] = []
        try:
            before = clear(folder, made)
            for name, dataset in made.items():
                _write(folder / name, dataset)
                problems += [f"{name}: {text}" for text in read_back(folder / name, dataset)]
        except OSError as error:
            raise RequestError(
                f"The DICOM files can't be written to {folder} ({error.strerror or error}). Name "
                "another folder with -o."
            ) from error
    titles = {picture.name: picture.title for picture in pictures}
    titles |= {solid.name: solid.title for solid in solids}
    removed = tuple(name for name in before if name not in made)
    return Written(folder, titles, left_out, tuple(problems), removed)


def _keep_apart(folder: Path, images: Iterable[str]) -> None:
    """Nothing is written where the run's photographs lie: it would be one of them the next time.

    Raises:
        RequestError: they lie there.
    """
    for image in map(Path, images):
        place = image if image.is_dir() else image.parent
        if os.path.realpath(place) == os.path.realpath(folder):
            raise RequestError(
                f"{folder} holds the photographs of this run, and the next one would take DICOM "
                "files there for photographs as well. Name another folder with -o."
            )


def _solids(
    results: Path, scale: Scale, frame: dict[str, Any], unscaled: bool
) -> tuple[list[Solid], dict[str, str]]:
    """The `.stl` files of an export, all in one frame, and what is left out and why."""
    from stages.export.orientation import Z_UP

    found, left_out = [], {}
    turned = frame.get("file_from_frame", {})
    stands = frame.get("name") in _Z_UP_AXES
    for path in sorted(results.glob("*.stl")):
        measured = scale.unit == "mm" and "without_scale" not in path.name
        if not measured and not unscaled:
            why = (
                "it is in the reconstruction's own units"
                if scale.put_aside
                else "its scale is not known"
            )
            left_out[path.name] = (
                f"{why}, and a program would take its lengths for millimetres; --unscaled writes "
                "it all the same"
            )
            continue
        modified = path.stem.startswith(_MODIFIED)
        title = f"{_what(path.stem)}, {scale.short}"
        data, axes = path.read_bytes(), str(frame.get("axes", ""))
        if path.name in turned:
            upright = Z_UP if stands else np.eye(4)
            data = _turned(data, upright @ np.linalg.inv(np.array(turned[path.name], np.float64)))
            axes = _Z_UP_AXES.get(frame.get("name", ""), axes)
        found.append(
            Solid(
                f"{path.stem}.dcm", title, data, measured,
                scale.short if measured else "no scale", axes, modified,
            )
        )  # fmt: skip
    return found, left_out


def _what(stem: str) -> str:
    """What a mesh is, in words: an archive shows no file names."""
    jaw = next((f", {jaw} jaw" for jaw in JAWS if f"_{jaw}" in stem), "")
    if stem.startswith(_MODIFIED):
        return f"Closed model{jaw}, back and base made up"
    return f"Surface from photographs{jaw}"


def _turned(stl: bytes, turn: npt.NDArray[np.float64]) -> bytes:
    """A binary STL, its normals and corners turned by a rotation [4, 4] about the origin."""
    if np.array_equal(turn, np.eye(4)):
        return stl
    rows = np.frombuffer(stl, _TRIANGLE, offset=_STL_HEAD).copy()
    rows["vectors"] = rows["vectors"] @ turn[:3, :3].T.astype(np.float32)
    return stl[:_STL_HEAD] + rows.tobytes()


def _preview(results: Path) -> list[Picture]:
    from pipeline.artifacts.views import read_png

    path = results / "preview.png"
    if not path.is_file():
        return []
    title = "Photograph, and the scene from its place and from another"
    return [Picture("preview.dcm", title, _colours(read_png(path)))]


def _views(case: Case, count: int) -> list[Picture]:
    """The scene from places of the walk around it, as the workspace holds it."""
    from pipeline.artifacts.space.frames import frame_of
    from pipeline.measure import usable_cores
    from stages.export.pictures.orbits import between
    from stages.export.scene import assemble

    views, cameras, gaussians = (case.latest(kind) for kind in ("views", "cameras", "gaussians"))
    if count < 1 or views is None or cameras is None or gaussians is None or not len(cameras):
        return []
    frame = frame_of(cameras, "auto")
    scene = assemble(
        views, cameras, gaussians, case.latest("points"), frame, usable_cores(),
        lambda *said: None,
    )  # fmt: skip
    places = between(scene.orbit, scene.cameras, count)
    return [
        Picture(
            f"view_{number:03d}.dcm", f"The scene from place {number + 1} of {len(places)}",
            scene.picture(place),
        )
        for number, place in enumerate(places)
    ]  # fmt: skip


def _colours(pixels: npt.NDArray[Any]) -> npt.NDArray[np.uint8]:
    if pixels.ndim == 2:
        pixels = np.repeat(pixels[..., None], 3, -1)
    return np.ascontiguousarray(pixels[..., :3], np.uint8)


def clear(folder: Path, names: Iterable[str]) -> list[str]:
    """Delete what an earlier call wrote into a folder: files of two patients are no study.

    What another program wrote stays.

    Args:
        names: of files that are to be written.

    Returns:
        Names of what was deleted.

    Raises:
        RequestError: another program wrote a file of such a name; nothing was deleted.
    """
    found = [path for path in sorted(folder.glob("*.dcm")) if _is_ours(path)]
    for path in (folder / name for name in names):
        if path not in found and is_there(path):
            raise RequestError(
                f"{path} was not written by this command and is not replaced. Name another folder "
                "with -o."
            )
    for path in found:
        path.unlink()
    return [path.name for path in found]


def _is_ours(path: Path) -> bool:
    if not OWN_NAMES.fullmatch(path.name) or path.is_symlink() or not path.is_file():
        return False
    try:
        mark = read_file_meta_info(path).ImplementationClassUID
    except UNREADABLE:
        return False
    return bool(mark == uid("dentalsplat"))


def _write(path: Path, dataset: Dataset) -> None:
    """Whole or not at all."""
    stream = io.BytesIO()
    pydicom.dcmwrite(stream, dataset, enforce_file_format=True)
    temporary = temporary_beside(path)
    try:
        temporary.write_bytes(stream.getvalue())
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


def read_back(path: Path, meant: Dataset) -> list[str]:
    """What is wrong with a file that was written: nothing, as a rule.

    Args:
        path: of the file.
        meant: what should be in it.
    """
    found = pydicom.dcmread(path)
    wrong = []
    for keyword in ("SOPInstanceUID", "SeriesInstanceUID", "StudyInstanceUID"):
        if not valid_uid(str(found[keyword].value)):
            wrong.append(f"{keyword} is no UID")
    if "PixelData" in meant:
        same = np.array_equal(
            found.pixel_array.tobytes(), meant.PixelData[: found.pixel_array.size]
        )
        if not same or found.pixel_array.shape != (meant.Rows, meant.Columns, 3):
            wrong.append("its pixels are not those that were written")
    else:
        length = int(found.EncapsulatedDocumentLength)
        stl = bytes(found.EncapsulatedDocument)[:length]
        triangles = int.from_bytes(stl[80:84], "little")
        if stl != meant.EncapsulatedDocument[:length] or length != 84 + 50 * triangles:
            wrong.append("its mesh is not the one that was written")
    return wrong
