"""`pipeline dicom`: what the files hold, whom they name, and what is refused."""

from __future__ import annotations

import json
import shutil
import struct
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pipeline.artifacts.space.scale import NO_SCALE, Scale
from pipeline.artifacts.views import write_png
from pipeline.errors import RequestError
from pipeline.pages.case import Case, StageRecord
from pipeline.store import Result, Store
from pipeline.store.failures import Failures
from pipeline.studies.dicom import write_dicom
from pipeline.studies.dicom.exports import exports_of
from pipeline.workspace import Request
from tests.personal_data import PERSONAL
from tests.studies import report_case

pydicom = pytest.importorskip("pydicom")
writing: Any = pytest.importorskip("pipeline.studies.dicom.writing")

PREVIEW = np.arange(40 * 61 * 3, dtype=np.uint32).astype(np.uint8).reshape(40, 61, 3)
IN_MM = Scale("mm", "tooth_widths", 4.0)


def stl(triangles: int = 3) -> bytes:
    return b"dentalsplat".ljust(80, b"\0") + struct.pack("<I", triangles) + bytes(50 * triangles)


def workspace(folder: Path, scale: Scale = IN_MM) -> Path:
    """A finished run, as far as this study looks at one without views of the scene."""
    results = folder / "results"
    results.mkdir(parents=True)
    Request(folder, (), None, (), None).save()
    write_png(results / "preview.png", PREVIEW)
    name = "mesh.stl" if scale.unit == "mm" else "mesh_without_scale.stl"
    (results / name).write_bytes(stl())
    scene = {"scale": scale.as_dict(), "frame": {"axes": "x left, y up, z front"}}
    (results / "scene.json").write_text(json.dumps(scene))
    return folder


def read(folder: Path, name: str) -> Any:
    return pydicom.dcmread(folder / name)


def test_a_picture_and_a_mesh(tmp_path: Path) -> None:
    written = write_dicom(workspace(tmp_path / "w"), views=0)
    assert sorted(written.files) == ["mesh.dcm", "preview.dcm"] and written.problems == ()
    assert written.folder == tmp_path / "w" / "dicom"
    picture = read(written.folder, "preview.dcm")
    assert picture.SOPClassUID.name == "Secondary Capture Image Storage"
    np.testing.assert_array_equal(picture.pixel_array, PREVIEW)
    assert (picture.BurnedInAnnotation, picture.ConversionType) == ("NO", "WSD")
    mesh = read(written.folder, "mesh.dcm")
    assert mesh.SOPClassUID.name == "Encapsulated STL Storage"
    assert mesh.EncapsulatedDocument[: mesh.EncapsulatedDocumentLength] == stl()
    assert mesh.MeasurementUnitsCodeSequence[0].CodeValue == "mm"
    assert "4%" in mesh.ContentDescription and "tooth_widths" in mesh.DocumentTitle
    assert picture.StudyInstanceUID == mesh.StudyInstanceUID
    assert picture.SeriesInstanceUID != mesh.SeriesInstanceUID
    assert picture.SOPInstanceUID != mesh.SOPInstanceUID


@pytest.mark.parametrize("frame", ["mouth", "input"])
def test_all_meshes_are_in_the_same_axes(frame: str, tmp_path: Path) -> None:
    """Those of a patient: in the frame of a mouth y is up; files have z up, and one of them lies on
    its base. In the frame of given cameras, which has its own axes, that one alone is turned."""
    corners = np.array([[1, 2, 3], [5, 2, 3], [1, 9, 3]], np.float32)  # in the frame of the mouth
    turns = {
        "mesh.stl": [[1, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]],
        "model_upper.stl": [[-1, 0, 0, 0], [0, 0, -1, 0], [0, -1, 0, 0], [0, 0, 0, 1]],
    }
    if frame == "input":
        turns["mesh.stl"] = np.eye(4).tolist()
    folder = workspace(tmp_path / "w")
    for name, turn in turns.items():
        moved = corners @ np.array(turn, np.float32)[:3, :3].T
        triangle = np.zeros(1, [("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("spare", "<u2")])
        triangle["corners"] = moved
        data = stl(1)[:84] + triangle.tobytes()
        (folder / "results" / name).write_bytes(data)
    told = {name: turn for name, turn in turns.items() if turn != np.eye(4).tolist()}
    axes = {"name": frame, "axes": "those of the cameras", "file_from_frame": told}
    scene = {"scale": IN_MM.as_dict(), "frame": axes}
    (folder / "results" / "scene.json").write_text(json.dumps(scene))
    write_dicom(folder, tmp_path / "out", views=0)
    for name in turns:
        found = read(tmp_path / "out", f"{Path(name).stem}.dcm")
        held = np.frombuffer(found.EncapsulatedDocument, "<f4", 9, 84 + 12).reshape(3, 3)
        if frame == "mouth":
            turned = np.stack([corners[:, 0], -corners[:, 2], corners[:, 1]], 1)
            np.testing.assert_array_equal(held, turned)
            assert found.ContentDescription.endswith("x left, y back, z head")
        else:
            np.testing.assert_array_equal(held, corners)
            assert found.ContentDescription.endswith("those of the cameras")
        modified = name.startswith("model")
        assert found.ModelModification == ("YES" if modified else "NO")
        title = "Closed model, upper jaw, back and base made up" if modified else "Surface from"
        assert found.DocumentTitle.startswith(title), "an archive shows no file names"


def test_nobody_is_named_unless_asked(tmp_path: Path) -> None:
    folder = workspace(tmp_path / "Prognath_Anna")
    for name in write_dicom(folder, tmp_path / "none", views=0).files:
        found = read(tmp_path / "none", name)
        assert (found.PatientName, found.PatientID, found.StudyDate) == ("", "", "")
        assert found.PatientIdentityRemoved == "YES" and found.DeidentificationMethod
        data = (tmp_path / "none" / name).read_bytes()
        assert not any(word.encode() in data for word in PERSONAL)
    patient = {"PatientID": "MRN-0815", "PatientName": "Prögnath^Anna", "PatientSex": "F"}
    write_dicom(folder, tmp_path / "anna", patient=patient, views=0)
    found = read(tmp_path / "anna", "mesh.dcm")
    assert (found.PatientID, str(found.PatientName)) == ("MRN-0815", "Prögnath^Anna")
    assert found.PatientIdentityRemoved == "NO" and "DeidentificationMethod" not in found


def test_the_same_content_gives_the_same_bytes(tmp_path: Path) -> None:
    folder = workspace(tmp_path / "w")
    for name in ("a", "b"):
        write_dicom(folder, tmp_path / name, views=0)
    write_dicom(folder, tmp_path / "c", patient={"PatientID": "1"}, views=0)
    for name in ("preview.dcm", "mesh.dcm"):
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes()
        first, other = read(tmp_path / "a", name), read(tmp_path / "c", name)
        assert first.SOPInstanceUID != other.SOPInstanceUID, "another patient's are others"


def test_every_file_is_an_object_of_its_own(tmp_path: Path) -> None:
    """An archive takes two files of one number for one object, and one object is in one series."""
    one = writing.Picture("view_000.dcm", "a", PREVIEW)
    same = replace(one, name="view_001.dcm", title="b")
    other = replace(one, name="preview.dcm", rgb=PREVIEW[::-1])
    joined = {"StudyInstanceUID": "1.2.840.99.5"}
    first = writing.data_sets([one, same], [], joined)
    again = writing.data_sets([one, same, other], [], joined)
    assert len({made.SOPInstanceUID for made in (*first.values(), *again.values())}) == 5
    assert first["view_000.dcm"].SeriesInstanceUID != again["view_000.dcm"].SeriesInstanceUID
    repeated = writing.data_sets([one, same], [], joined)
    assert [made.SOPInstanceUID for made in repeated.values()] == [
        made.SOPInstanceUID for made in first.values()
    ]


def test_a_study_to_join(tmp_path: Path) -> None:
    written = write_dicom(
        workspace(tmp_path / "w"), patient={"StudyInstanceUID": "1.2.840.99.5"}, views=0
    )
    found = read(written.folder, "preview.dcm")
    assert found.StudyInstanceUID == "1.2.840.99.5" and found.PatientIdentityRemoved == "YES"


def test_a_mesh_without_scale_is_not_written_unless_asked(tmp_path: Path) -> None:
    folder = workspace(tmp_path / "w", NO_SCALE)
    written = write_dicom(folder, tmp_path / "a", views=0)
    assert sorted(written.files) == ["preview.dcm"]
    assert "scale is not known" in written.left_out["mesh_without_scale.stl"]
    written = write_dicom(folder, tmp_path / "b", views=0, unscaled=True)
    found = read(tmp_path / "b", "mesh_without_scale.dcm")
    assert found.MeasurementUnitsCodeSequence[0].CodeMeaning == "no units"
    assert "no scale" in found.DocumentTitle


@pytest.mark.parametrize(
    ("patient", "said"),
    [
        ({"PatientBirthDate": "4.7.2019"}, "--birth-date '4.7.2019' is not what DICOM allows"),
        ({"PatientBirthDate": "20230231"}, "--birth-date '20230231'"),
        ({"PatientBirthDate": "20200101-20210101"}, "a day that has been"),
        ({"PatientBirthDate": "29991231"}, "a day that has been"),
        ({"PatientName": "^"}, "--patient-name '^'"),
        ({"PatientName": "A^B^C^D^E^F"}, "a name as Family^Given"),
        ({"PatientID": " "}, "--patient-id ' '"),
        ({"StudyInstanceUID": "1"}, "--study-uid '1'"),
        ({"PatientSex": "female"}, "M, F or O"),
        ({"PatientID": "a\\b"}, "no backslash"),
        ({"PatientID": ""}, "--patient-id"),
        ({"StudyInstanceUID": "1.2.x"}, "--study-uid"),
        ({"AccessionNumber": "1" * 17}, "at most 16"),
        ({"PatientNam": "A"}, "Did you mean 'PatientName'?"),
    ],
)
def test_what_dicom_does_not_allow_is_refused(
    tmp_path: Path, patient: dict[str, str], said: str
) -> None:
    folder = workspace(tmp_path / "w")
    with pytest.raises(RequestError) as refused:
        write_dicom(folder, patient=patient, views=0)
    assert said in str(refused.value)
    assert not (folder / "dicom").exists()


def test_no_run_no_files(tmp_path: Path) -> None:
    with pytest.raises(RequestError, match="is not a workspace"):
        write_dicom(tmp_path)
    kept = workspace(tmp_path / "k")
    (kept / "request.json").unlink()
    with pytest.raises(RequestError, match="results alone, as 'pipeline batch --keep results'"):
        write_dicom(kept)
    folder = workspace(tmp_path / "w")
    (folder / "results" / "scene.json").unlink()
    with pytest.raises(RequestError, match="no exports"):
        write_dicom(folder)
    other = workspace(tmp_path / "v")
    (other / "dicom").write_text("in the way")
    with pytest.raises(RequestError, match="can't be written to"):
        write_dicom(other, views=0)


def test_a_folder_holds_one_study(tmp_path: Path) -> None:
    """What an earlier call left goes, under whatever options; nobody else's files do."""
    folder, out = workspace(tmp_path / "w"), tmp_path / "out"
    write_dicom(folder, out, patient={"PatientID": "A"}, views=0)
    (out / "notes.txt").write_text("kept")
    (out / "model_of_stone.dcm").write_bytes(b"no DICOM file")
    other = read(out, "preview.dcm")
    other.file_meta.ImplementationClassUID = "1.2.3"
    other.save_as(out / "view_003.dcm")
    (folder / "results" / "mesh.stl").unlink()
    written = write_dicom(folder, out, patient={"PatientID": "B"}, views=0)
    assert written.removed == ("mesh.dcm",) and read(out, "preview.dcm").PatientID == "B"
    left = {path.name for path in out.iterdir()}
    assert left == {"notes.txt", "model_of_stone.dcm", "view_003.dcm", "preview.dcm"}
    other.save_as(out / "preview.dcm")
    with pytest.raises(RequestError, match="not written by this command"):
        write_dicom(folder, out, views=0)
    assert read(out, "preview.dcm").PatientID == "A"


@pytest.mark.parametrize("named", ["", "*.jpg", "1.jpg"])
def test_no_file_is_put_among_the_photographs(
    named: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The next run would take it for one."""
    monkeypatch.setattr(writing, "exports_of", lambda case: case.workspace / "results")
    folder, photographs = workspace(tmp_path / "w"), tmp_path / "photographs"
    photographs.mkdir()
    (photographs / "1.jpg").write_bytes(b"a photograph")
    Request(folder, (str(photographs / named),), None, (), None).save()
    with pytest.raises(RequestError, match="holds the photographs of this run"):
        write_dicom(folder, photographs, views=0)
    assert len(list(photographs.iterdir())) == 1
    assert write_dicom(folder, photographs / "dicom", views=0).files


def test_a_run_that_failed_before_its_exports_is_refused(tmp_path: Path) -> None:
    folder = workspace(tmp_path / "w")
    Failures(folder).record("evaluate", "key", "after the exports")
    assert write_dicom(folder, views=0).files
    Failures(folder).record("fit", "key", "too dark")
    with pytest.raises(RequestError, match="the last run ended in fit"):
        write_dicom(folder, tmp_path / "out", views=0)
    assert not (tmp_path / "out").exists()


def scene(folder: Path) -> list[StageRecord]:
    """A run of two stages, as its workspace has it."""
    report_case.write_result(folder, "fit", [report_case.points(5)])
    source = {"points": {"stage": "fit", "content": result_of(folder, "fit").contents["points"]}}
    report_case.write_result(folder, "export", [], {"exports/scene.json": b"{}"}, inputs=source)
    return [
        StageRecord(name, "cached", (), None, result_of(folder, name)) for name in ("fit", "export")
    ]


def result_of(folder: Path, stage: str) -> Result:
    found = Store(folder).current(stage)
    assert found is not None
    return found


def test_exports_are_those_that_the_last_request_leads_to(tmp_path: Path) -> None:
    tmp_path /= "a b"
    fit, export = scene(tmp_path)
    place = export.result and export.result.folder / "exports"

    def found(*records: StageRecord) -> Path:
        return exports_of(Case(tmp_path, {}, records))

    assert found(fit, export) == place
    stopped = replace(fit, state="stale", reasons=("fit.iterations 5 → 9",))
    waiting = replace(export, state="pending")
    with pytest.raises(
        RequestError, match=r"'fit' has yet to run \(fit.iterations 5 → 9\)"
    ) as said:
        found(stopped, waiting)
    assert str(said.value).endswith(f"pipeline run -w '{tmp_path}'"), "as a shell takes it"
    newer = ("library numba 1 → 2", "fit version 3 → 4", "fit.speed (absent) → 1")
    assert found(replace(fit, state="stale", reasons=newer), waiting) == place
    assert found(fit) == place, "a request that ends before the exports, of the fit that they show"
    shutil.rmtree(tmp_path / "fit")
    report_case.write_result(tmp_path, "fit", [report_case.points(6)])
    with pytest.raises(RequestError, match="'fit' has another result by now"):
        found(fit)


def test_reading_back_finds_what_is_wrong(tmp_path: Path) -> None:
    written = write_dicom(workspace(tmp_path / "w"), views=0)
    for name, change in (("preview.dcm", {"Rows": 20}), ("mesh.dcm", {})):
        meant, path = read(written.folder, name), written.folder / name
        other = read(written.folder, name)
        for keyword, value in change.items():
            setattr(other, keyword, value)
        if "EncapsulatedDocument" in other:
            other.EncapsulatedDocument = stl(2) + bytes(50)
        other.save_as(path)
        assert writing.read_back(path, meant) != []
