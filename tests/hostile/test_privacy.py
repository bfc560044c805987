"""What leaves the workspace says of nobody whose teeth it shows, when, and on what computer."""

from __future__ import annotations

import base64
import binascii
import contextlib
import getpass
import json
import re
import socket
import time
import zlib
from collections.abc import Iterator
from pathlib import Path

import av
import numpy as np
import pytest
from PIL import Image

import pipeline
from pipeline.running.outcomes import RunSummary
from pipeline.store.failures import Failures
from pipeline.studies.dicom import write_dicom
from pipeline.studies.report import run_report
from tests.personal_data import DATE, PERSONAL
from tests.studies import report_case

#: Runs of base64 that are long enough to hold a picture or a name.
BASE64 = re.compile(rb"[A-Za-z0-9+/]{40,}={0,2}")


def layers(data: bytes, depth: int = 3) -> Iterator[bytes]:
    """Bytes, and what is packed inside them: base64, deflate, at any of a few depths."""
    yield data
    if depth == 0:
        return
    for found in BASE64.findall(data):
        try:
            yield from layers(base64.b64decode(found + b"=" * (-len(found) % 4)), depth - 1)
        except binascii.Error:
            continue
    for start, window in ((b"\x1f\x8b\x08", 31), (b"\x78\x9c", 15), (b"\x78\xda", 15)):
        at = data.find(start)
        while at >= 0:
            with contextlib.suppress(zlib.error):
                yield from layers(zlib.decompressobj(window).decompress(data[at:]), depth - 1)
            at = data.find(start, at + 1)


def spellings(text: str) -> set[bytes]:
    """A text as files may hold it."""
    return {form.encode(code) for form in (text, text.lower()) for code in ("utf-8", "utf-16-le")}


def told(path: Path, secrets: tuple[str, ...]) -> list[str]:
    """Those of the secrets that a file holds, whatever they are packed in."""
    wanted = {secret: spellings(secret) for secret in secrets}
    found = set()
    for layer in layers(path.read_bytes()):
        found |= {secret for secret, forms in wanted.items() if any(f in layer for f in forms)}
    return sorted(found)


def of_this_computer(run: RunSummary) -> tuple[str, ...]:
    """Names of host, user, folders and today that nobody else has to know."""
    today = (time.strftime("%Y-%m-%d"), time.strftime("%Y:%m:%d"), time.strftime("%Y%m%d"))
    parts = [socket.gethostname(), str(run.workspace), str(Path.home()), *today]
    if len(getpass.getuser()) > 4:  # a short one is a word of something else
        parts.append(getpass.getuser())
    return tuple(part for part in parts if len(part) > 4)


def test_the_search_finds_what_is_packed(tmp_path: Path) -> None:
    inner = zlib.compress(b"of one called Prognath, so it is")
    page = b"<img src='data:x;base64," + base64.b64encode(b"\0" * 40 + inner) + b"'>"
    (tmp_path / "page").write_bytes(page)
    assert told(tmp_path / "page", PERSONAL) == ["Prognath"]


def test_results_tell_of_nobody(sample_run: RunSummary) -> None:
    assert sample_run.results is not None
    secrets = (*PERSONAL, *of_this_computer(sample_run))
    files = [path for path in sample_run.results.rglob("*") if path.is_file()]
    assert len(files) > 8
    assert {str(path): told(path, secrets) for path in files if told(path, secrets)} == {}
    with av.open(str(sample_run.results / "orbit.mp4")) as film:
        assert "creation_time" not in {**film.metadata, **film.streams.video[0].metadata}
    for picture in sample_run.results.rglob("*.png"):
        with Image.open(picture) as opened:
            assert not opened.getexif()
            assert not {"date", "comment", "author"} & {str(key).lower() for key in opened.info}


def test_the_workspace_keeps_names_of_files_and_nothing_else_of_them(
    sample_run: RunSummary,
) -> None:
    secrets = tuple(secret for secret in PERSONAL if secret != "Prognath")
    files = [path for path in sample_run.workspace.rglob("*") if path.is_file()]
    assert {str(path): told(path, secrets) for path in files if told(path, secrets)} == {}


def test_a_report_without_names(sample_run: RunSummary) -> None:
    open_page = sample_run.report
    assert open_page is not None
    assert told(open_page, ("Prognath",)), "the usual report names the photographs"
    page = run_report(sample_run.workspace, anonymous=True)
    assert page.name == "report_anonymous.html"
    assert told(page, (*PERSONAL, *of_this_computer(sample_run), "sample_run")) == []
    text = page.read_text()
    assert not re.search(r'<a href="(?!#)', text), "what it leads to is not passed on"
    assert "their file names" in open_page.read_text() and "their file names" not in text
    assert "photographs placed in space" in text and "Time and memory" in text


@pytest.mark.parametrize(
    ("said", "shown"),
    [
        ("The photograph Prognath_Anna_left.jpg is blurred.", "The photograph 002 is blurred."),
        ("<Prognath> is the same picture as 001.", "<[name]> is the same picture as 001."),
        ("Pictures: /srv/patients/Anna/w/init/failure.", "Pictures: [path]"),
        ("on the right and 3/4 of it, see a/b", "on the right and 3/4 of it, see a/b"),
        ({"given": ["C:\\cases\\Prognath\\x.json", 3]}, {"given": ["[path]", 3]}),
    ],
)
def test_texts_without_names(said: object, shown: object) -> None:
    from pipeline.pages.anonymous import Secrets

    places = {"Prognath_Anna_left.jpg": "002", "Prognath_Anna_left": "002", "Prognath": "[name]"}
    assert Secrets(places).hide(said) == shown


def test_paths_with_spaces_and_the_folders_on_the_way(tmp_path: Path) -> None:
    """What no sentence tells the end of: the request and the settings do."""
    from pipeline.pages.anonymous import secrets_of
    from pipeline.pages.case import Case

    workspace = tmp_path / "Otto Meier" / "visit 2"
    masks = "/data/Anna Müller/visit1/masks"
    request = {
        "images": ["/data/Jo O'Hara/June 3/IMG 1.jpg"], "preset": None,
        "overrides": [f"evaluate.masks={masks}", "init.pointmap.files=../Eva Kern/maps"],
    }  # fmt: skip
    hide = secrets_of(Case(workspace, request, ())).hide
    for said, shown in {
        f"--set views.masks={masks}": "--set views.masks=[path]",
        f"{masks}/left side.png is no mask": "[path] side.png is no mask",
        "/data/Anna Müller/visit1/teeth.json is damaged": "[path] is damaged",
        'mesh="/data/Anna M\\xFCller/visit1"': 'mesh="[path]"',
        "files: '/data/Jo O''Hara/June 3'": "files: '[path]'",
        "the folder June 3 of Anna Müller": "the folder [name] of [name]",
        f"Pictures: {workspace}/init/failure.": "Pictures: [path]",
        "No such file: '/srv/Max Roth/b c.png'": "No such file: '[path]'",
        "../Eva Kern/maps": "[path]",
        "the data of a mouth, 3 of 4, 1/2": "the data of a mouth, 3 of 4, 1/2",
    }.items():
        assert hide(said) == shown


def test_photographs_that_no_stage_could_use_are_not_named(tmp_path: Path) -> None:
    from pipeline.pages.anonymous import secrets_of
    from pipeline.pages.case import Case

    (tmp_path / "given").mkdir()
    (tmp_path / "given" / "Anna_left.jpg").write_bytes(b"")
    for images in (str(tmp_path / "given"), str(tmp_path / "given" / "*.jpg")):
        request = {"images": [images], "preset": "paper", "overrides": []}
        hide = secrets_of(Case(tmp_path / "w", request, ())).hide
        assert hide("Anna_left.jpg is too small. -c paper") == "[name] is too small. -c paper"


def test_dates_and_uids_that_photographs_are_called_by_are_not_told(tmp_path: Path) -> None:
    from pipeline.pages.anonymous import secrets_of
    from pipeline.pages.case import Case

    uid, date, place = "1.2.840.113619.2.5", "20240512_101533", "0003"
    for name in (uid, f"{date}.jpg", f"{place}.jpg"):
        (tmp_path / name).write_bytes(b"")
    request = {"images": [str(tmp_path)], "preset": None, "overrides": []}
    hide = secrets_of(Case(tmp_path / "w", request, ())).hide
    assert hide(f"{uid} is the same picture.") == "[name] is the same picture."
    assert hide(f"no mask {date}.png, of 0003 points") == "no mask [name].png, of 0003 points"


def test_settings_of_a_report_without_names(tmp_path: Path) -> None:
    """Also where the page folds a long path into two lines."""
    workspace = report_case.write_case(tmp_path / "Otto Meier", ("views", "init", "fit"))
    path = workspace / "request.json"
    request = json.loads(path.read_text())
    masks = "/data/Anna Müller/and so on and on and on and on and on and on and on/Max Roth/masks"
    request["overrides"] += [f"evaluate.masks={masks}", "evaluate.mesh=/data/Eva Kern/mesh.ply"]
    request["stages"] = [*request["stages"], "evaluate"]
    path.write_text(json.dumps(request))
    Failures(workspace).record("evaluate", "key", f"{masks} has no mask of left.jpg.")
    page = run_report(workspace, anonymous=True).read_text()
    assert "[path] has no mask of 001." in page
    assert "--set evaluate.masks=[path]" in page
    assert "mesh: &#39;[path]&#39;" in page
    words = set(re.split(r"\W+", page))
    assert not words & {"Otto", "Meier", "Anna", "Müller", "Max", "Roth", "Eva", "Kern"}


PHOTOS = Path(__file__).resolve().parents[2] / "data_samples" / "three_photos"
#: A whole run in a few seconds, with all files but film and page of the scene.
HASTY = {
    "views.long_side": 256, "fit.iterations": 5, "export.mesh_resolution": 64,
    "export.mesh_faces": 2000, "export.video": False, "init.dental.complete_depth": False,
}  # fmt: skip


def test_dicom_files_tell_of_nobody_anywhere(tmp_path: Path) -> None:
    """Name, number, birth date, institution, private elements: in no byte of a workspace."""
    pytest.importorskip("pydicom")
    from tests.dicom_files import as_bytes, compressed

    given = tmp_path / "study"
    given.mkdir()
    for number, photo in enumerate(sorted(PHOTOS.glob("*.jpg"))):
        with Image.open(photo) as opened:
            data = as_bytes(compressed(np.asarray(opened.convert("RGB")), "JPEG"))
        (given / f"IM_{number:04d}").write_bytes(data)
    dates = (DATE.replace(":", ""), DATE.replace(":", "-"))
    assert set(dates[:1]) | set(PERSONAL) - {DATE} <= set(
        told(given / "IM_0000", (*PERSONAL, *dates))
    ), "else nothing would be tested"
    run = pipeline.run(given, workspace=tmp_path / "w", overrides=HASTY)
    assert run.results is not None and (run.workspace / "report.html").exists()
    written = write_dicom(run.workspace, run.workspace / "dicom", views=1)
    assert not written.problems and "mesh.dcm" in written.files
    files = [path for path in run.workspace.rglob("*") if path.is_file()]
    kinds = {path.suffix for path in files}
    assert {".log", ".html", ".glb", ".spz", ".sog", ".dcm", ".json"} <= kinds
    secrets = (*PERSONAL, *dates)
    assert {str(path): told(path, secrets) for path in files if told(path, secrets)} == {}
