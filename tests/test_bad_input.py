"""What goes wrong at a user's desk: a clear paragraph, the right exit status, an unharmed cache."""

from __future__ import annotations

import contextlib
import io
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

import pipeline
from pipeline import cli
from pipeline.running.reporter import Reporter

SAMPLES = Path(__file__).resolve().parents[1] / "data_samples" / "three_photos"
PHOTOS = sorted(SAMPLES.glob("*.jpg"))


@pytest.fixture(scope="module")
def workspace(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A workspace with a good result in it."""
    folder = tmp_path_factory.mktemp("case") / "w"
    pipeline.run(SAMPLES, workspace=folder, stages=["views"])
    return folder


def call(workspace: Path, *arguments: str, apart: bool = False) -> tuple[int, str]:
    """Run the command line; returns exit status and the last paragraph on standard error.

    Afterwards the good result must still be there.

    Args:
        workspace: with the good result.
        arguments: of `pipeline run`.
        apart: in a process of its own, as a user does; else in this one, a second faster.
    """
    words = ["run", *arguments, "-w", str(workspace)]
    if apart:
        command = [sys.executable, "-m", "pipeline.cli", *words]
        done = subprocess.run(command, capture_output=True, text=True, timeout=120)
        status, told = done.returncode, done.stderr
    else:
        stderr = io.StringIO()
        with pytest.MonkeyPatch.context() as patch, contextlib.redirect_stderr(stderr):
            patch.setattr(sys, "argv", ["pipeline", *words])
            with pytest.raises(SystemExit) as ended:
                cli.main()
        assert isinstance(ended.value.code, int)
        status, told = ended.value.code, stderr.getvalue()
    assert "Traceback" not in told
    summary = pipeline.run(SAMPLES, workspace=workspace, stages=["views"])
    assert {stage.action for stage in summary.stages} == {"cached"}
    return status, told.strip().rpartition("\n")[2]


def two_and(folder: Path, name: str, content: bytes) -> Path:
    """A folder with two good photographs and one more file."""
    folder.mkdir(exist_ok=True)
    for photo in PHOTOS[:2]:
        shutil.copy(photo, folder)
    (folder / name).write_bytes(content)
    return folder


def one_image(folder: Path) -> Path:
    shutil.copy(PHOTOS[0], folder)
    return folder


def no_images(folder: Path) -> Path:
    (folder / "notes.txt").write_text("no pictures here")
    return folder


def truncated(folder: Path) -> Path:
    return two_and(folder, "cut.jpg", PHOTOS[2].read_bytes()[:9000])


def text_as_jpg(folder: Path) -> Path:
    return two_and(folder, "letter.jpg", b"Dear colleague, please find enclosed")


def identical(folder: Path) -> Path:
    shutil.copy(PHOTOS[0], folder / "a.jpg")
    shutil.copy(PHOTOS[0], folder / "b.jpg")
    return folder


def ribbon(folder: Path) -> Path:
    stripe = np.random.default_rng(0).integers(0, 255, (10, 20000, 3), np.uint8)
    return two_and(folder, "ribbon.png", cv2.imencode(".png", stripe)[1].tobytes())


def missing(folder: Path) -> Path:
    return folder / "nowhere"


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (one_image, ["two"]),
        (no_images, ["notes.txt"]),
        (truncated, ["cut.jpg"]),
        (text_as_jpg, ["letter.jpg"]),
        (identical, ["a.jpg", "b.jpg"]),
        (ribbon, ["ribbon.png", "20000"]),
        (missing, ["nowhere"]),
    ],
)
def test_unusable_photographs(
    workspace: Path, tmp_path: Path, make: Callable[[Path], Path], words: list[str]
) -> None:
    apart = make is one_image
    status, paragraph = call(workspace, str(make(tmp_path)), "--stages", "views", apart=apart)
    assert status == 2, paragraph
    for word in words:
        assert word in paragraph
    assert len(paragraph) > 40  # what, where, and what to do


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--stages", "views,inti"), ["'inti'", "Did you mean 'init'?"]),
        (("--set", "sap.quantile=7"), ["sap.quantile=7", "less than 1"]),
        (("--set", "sap.quantil=0.9"), ["'sap.quantil'", "Did you mean sap.quantile"]),
        (("--set", "fit.iterations=none"), ["fit.iterations"]),
        (("-c", "dentalsplatt"), ["Did you mean 'dentalsplat'?"]),
        (("--frames", "-3"), ["views.frames"]),
    ],
)
def test_wrong_request(workspace: Path, arguments: tuple[str, ...], words: list[str]) -> None:
    status, paragraph = call(workspace, str(SAMPLES), *arguments, apart="--stages" in arguments)
    assert status == 2, paragraph
    for word in words:
        assert word in paragraph


def test_photographs_that_share_nothing(workspace: Path, tmp_path: Path) -> None:
    """Exit status 3, and a diagnosis that names photographs and says what to do."""
    random = np.random.default_rng(0)
    for name in ("left.png", "front.png", "right.png"):
        noise = cv2.resize(random.integers(0, 255, (48, 64, 3), np.uint8), (512, 384))
        cv2.imwrite(str(tmp_path / name), noise)
    status, paragraph = call(workspace, str(tmp_path), apart=True)
    assert status == 3, paragraph
    assert ".png" in paragraph and "photograph" in paragraph


def test_pictures_of_earlier_runs_are_left_out_and_that_is_said(
    workspace: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shutil.copytree(SAMPLES, tmp_path / "photos", ignore=shutil.ignore_patterns("depth"))
    shutil.copytree(workspace, tmp_path / "w")
    for photo in PHOTOS:  # as if a run had cached photographs of such names
        shutil.copy(photo, next((tmp_path / "w" / "views").glob("*/views")) / f"own_{photo.name}")
    heard: list[str] = []
    reporter = Reporter()
    reporter.message = heard.append  # type: ignore[method-assign]
    for times in (1, 2):
        summary = pipeline.run(
            tmp_path / "**" / "*.jpg", workspace=tmp_path / "other", stages=["views"],
            reporter=reporter,
        )  # fmt: skip
        notes = [text for text in summary.stages[0].warnings if "earlier runs have made" in text]
        assert summary.stages[0].figures["summary"]["views"] == 3
        assert len(notes) == 1 and heard.count(f"views: {notes[0]}") == times
    words = [str(tmp_path / "**" / "*.jpg"), "--dry-run", "-w", str(tmp_path / "other")]
    with pytest.MonkeyPatch.context() as patch, pytest.raises(SystemExit) as ended:
        patch.setattr(sys, "argv", ["pipeline", "run", *words])
        cli.main()
    assert ended.value.code == 0
    assert "earlier runs have made (views/ of a workspace)" in capsys.readouterr().out


def test_full_disk(tmp_path: Path) -> None:
    """A real file system that is too small, then larger: the run goes on where it stopped."""
    small = tmp_path / "small"
    small.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=1m", "tmpfs", str(small)]
    if subprocess.run(mount, capture_output=True).returncode != 0:
        pytest.skip("mounting a small file system needs root")
    command = [
        sys.executable, "-m", "pipeline.cli", "run", str(SAMPLES), "-w", str(small / "w"),
        "--stages", "views",
    ]  # fmt: skip
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=120)
        assert done.returncode == 2, done.stderr
        assert "is full" in done.stderr and "Nothing computed before is lost" in done.stderr
        subprocess.run(["mount", "-o", "remount,size=64m", str(small)], check=True)
        again = subprocess.run(command, capture_output=True, text=True, timeout=120)
        assert again.returncode == 0, again.stderr
    finally:
        subprocess.run(["umount", str(small)], check=True)
