"""Names of files and folders that are no text, or act on what shows them."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

import pipeline
from pipeline.errors import RequestError
from pipeline.files import canonical_json, read_json, sha256_text, write_json
from pipeline.untrusted.names import printable, readable, storable
from pipeline.workspace import default_workspace
from stages.views.find import find_images, find_masks

ROOT = Path(__file__).resolve().parents[2]
PHOTOS = sorted((ROOT / "data_samples" / "three_photos").glob("*.jpg"))
FOLDER = b"caf\xe9 [b] \xf0\x9f\xa6\xb7"
NAMES = (b"\xff\xfem.jpg", b"line\nend.jpg", b"\x1b[31m[red].jpg")


@pytest.fixture
def odd(tmp_path: Path) -> Path:
    """Photographs under odd names, in a folder of an odd name."""
    folder = Path(os.fsdecode(os.fsencode(tmp_path) + b"/" + FOLDER))
    try:
        folder.mkdir()
    except OSError:
        pytest.skip("this file system takes no such names")
    for photo, name in zip(PHOTOS, NAMES, strict=True):
        (folder / os.fsdecode(name)).write_bytes(photo.read_bytes())
    return folder


@pytest.mark.parametrize(
    ("name", "text"),
    [
        (b"plain name.jpg", "plain name.jpg"),
        ("Zähne 🦷.jpg".encode(), "Zähne 🦷.jpg"),
        (b"caf\xe9.jpg", "caf\\xe9.jpg"),
        (b"a\nb\x1b[1m.jpg", "a\\nb\\x1b[1m.jpg"),
        ("gpj.\u202ea".encode(), "gpj.\\u202ea"),
    ],
)
def test_printable(name: bytes, text: str) -> None:
    assert printable(os.fsdecode(name)) == text
    assert printable(Path(os.fsdecode(name))) == text
    text.encode()


def test_messages_keep_their_lines() -> None:
    assert readable("one\ntwo \x1b") == "one\ntwo \\x1b"
    assert str(RequestError("caf\udce9")) == "caf\\xe9"


def test_json_gives_names_back(tmp_path: Path) -> None:
    name = os.fsdecode(b"/caf\xe9/\xf0\x9f\xa6\xb7")
    write_json(tmp_path / "a.json", {"images": [name]})
    assert read_json(tmp_path / "a.json") == {"images": [name]}
    assert json.loads(canonical_json([name])) == [name]
    sha256_text(canonical_json([name]))
    assert canonical_json(["ä🦷"]) == '["ä🦷"]'
    assert storable("ä🦷") == "ä🦷"


def test_labels_are_texts_and_their_own(tmp_path: Path) -> None:
    raw, escaped = tmp_path / os.fsdecode(b"a\xff.jpg"), tmp_path / "a\\xff.jpg"
    for path in (raw, escaped):
        path.write_bytes(b"x")
    found = find_images([tmp_path])
    assert set(found.values()) == {raw, escaped}
    assert all(label == printable(label) for label in found)
    masks = tmp_path / "masks"
    masks.mkdir()
    mask = masks / os.fsdecode(b"b\xff.png")
    mask.write_bytes(b"x")
    assert find_masks(masks, ["b\\xff.jpg", "c.jpg"]) == {"b\\xff.jpg": mask}


def test_the_default_workspace_has_a_plain_name(odd: Path) -> None:
    assert default_workspace([odd]).name == "caf\\xe9 [b] 🦷"


def test_the_default_workspace_of_a_pattern_has_no_stars(tmp_path: Path) -> None:
    """``runs/**`` is a folder that nobody wants to delete."""
    (tmp_path / "anna" / "photos").mkdir(parents=True)
    (tmp_path / "anna" / "photos" / "a [1].jpg").write_bytes(b"x")
    for pattern in ("*.jpg", "**/*.jpg", "p*/*.jpg", "p*/a.jpg", "photos/?.jpg"):
        assert default_workspace([tmp_path / "anna" / pattern]) == Path("runs", "anna")
        assert default_workspace([tmp_path / "anna" / pattern, "x"]) == Path("runs", "anna")
    one = tmp_path / "anna" / "photos" / "a [1].jpg"
    assert default_workspace([one]) == Path("runs", "a [1]")


def test_a_run_in_this_process(odd: Path) -> None:
    workspace = odd / "w"
    pipeline.run(odd, workspace=workspace, stages=["views"])
    views = json.loads(next(workspace.glob("views/*/views/views.json")).read_text())
    assert {view["source_name"] for view in views["views"]} == {
        "\\xff\\xfem.jpg", "line\\nend.jpg", "\\x1b[31m[red].jpg",
    }  # fmt: skip
    next(workspace.glob("views/*/manifest.json")).read_text(encoding="utf-8")
    states = pipeline.status(workspace=workspace)
    assert states[0].state == "cached"
    again = pipeline.run(workspace=workspace, stages=["views"])
    assert {stage.action for stage in again.stages} == {"cached"}


@pytest.mark.parametrize("locale", [{"LANG": "C"}, {"LC_ALL": "C", "PYTHONUTF8": "0"}])
def test_the_command_line_in_any_locale(odd: Path, locale: dict[str, str]) -> None:
    environment = {k: v for k, v in os.environ.items() if k[:3] not in ("LC_", "LAN")}
    environment |= {"PYTHONPATH": str(ROOT), "PYTHONCOERCECLOCALE": "0", **locale}

    def call(*arguments: str | Path) -> str:
        done = subprocess.run(
            [sys.executable, "-m", "pipeline.cli", *arguments], env=environment, cwd=odd,
            capture_output=True, timeout=120,
        )  # fmt: skip
        assert done.returncode == 0, done.stderr
        text = done.stdout + done.stderr
        assert b"\x1b" not in text
        return text.decode()  # whatever the locale, it is text

    call("run", odd, "-w", odd / "w", "--stages", "views", "--set", "report=false")
    assert "cached" in call("status", "-w", odd / "w")
    assert "report.html" in call("report", "-w", odd / "w")
    page = (odd / "w" / "report.html").read_bytes().decode("utf-8")
    assert "\\xff\\xfem.jpg" in page
    assert json.loads(call("status", "-w", odd / "w", "--json"))[0]["state"] == "cached"


def test_an_error_is_told(odd: Path) -> None:
    (odd / os.fsdecode(b"bad\xff.jpg")).write_bytes(b"not a picture")
    with pytest.raises(RequestError, match=r"bad\\xff\.jpg is a text file"):
        pipeline.run(odd, workspace=odd / "w", stages=["views"])
