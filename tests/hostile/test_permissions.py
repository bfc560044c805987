"""Photographs of patients are their owner's alone: nobody else may read what is written."""

from __future__ import annotations

import os
import stat
import subprocess
import sys
import threading
from pathlib import Path
from typing import Any

import pytest
import toy

import pipeline
from pipeline.kernels import folder as kernels
from pipeline.process import privacy

TOY = Path(toy.__file__)
RAN = {"read": "ran", "scale": "ran", "count": "ran", "publish": "ran"}
CACHED = dict.fromkeys(RAN, "cached")

pytestmark = pytest.mark.skipif(os.name != "posix", reason="modes are POSIX's")


def modes(workspace: Path) -> dict[str, set[str]]:
    """The modes of the folders and of the files of a workspace, itself included."""
    found: dict[str, set[str]] = {"folders": set(), "files": set()}
    for path in (workspace, *workspace.rglob("*")):
        mode = path.lstat().st_mode
        if not stat.S_ISLNK(mode):
            kind = "folders" if stat.S_ISDIR(mode) else "files"
            found[kind].add(f"{stat.S_IMODE(mode):o}")
    return found


PRIVATE = {"folders": {"700"}, "files": {"600"}}
GROUP = {"folders": {"750"}, "files": {"640"}}


@pytest.fixture(autouse=True)
def common_mask() -> Any:
    before = os.umask(0o022)
    yield
    assert os.umask(before) == 0o022, "a function of ours changed the mask for good"


def call(folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, str(TOY), *arguments], cwd=folder, capture_output=True, text=True,
        timeout=60, umask=0o022,
    )  # fmt: skip


def test_the_command_line_writes_for_the_owner_alone(toys: Path) -> None:
    done = call(toys, "run", "images", "-w", "runs/w", "-c", "toy.yaml")
    assert done.returncode == 0, done.stderr
    assert modes(toys / "runs") == PRIVATE
    again = ("run", "-w", "runs/w", "-c", "toy.yaml")
    assert call(toys, *again, "--set", "count.fail=data").returncode == 3
    assert call(toys, "status", "-w", "runs/w").returncode == 0
    assert modes(toys / "runs") == PRIVATE


def test_so_do_the_functions(run: Any, toys: Path) -> None:
    run()
    assert modes(toys / "w") == PRIVATE
    with pytest.raises(pipeline.ReconstructionError):
        run("count.fail=data")
    with pytest.raises(KeyboardInterrupt):
        run("count.fail=interrupt")
    pipeline.run_report(toys / "w")
    assert modes(toys / "w") == PRIVATE


def test_the_group_may_read_if_it_is_said(run: Any, toys: Path) -> None:
    run(share="group")
    assert modes(toys / "w") == GROUP
    assert run() == CACHED  # said once, it stays so
    run("count.steps=3")
    pipeline.run_report(toys / "w")
    assert modes(toys / "w") == GROUP
    assert run(share="nobody") == {**CACHED}
    assert modes(toys / "w") == PRIVATE
    assert run(share="group") == CACHED
    assert modes(toys / "w") == GROUP


def test_the_command_line_asks_for_one_of_both(toys: Path) -> None:
    arguments = ("run", "images", "-w", "w", "-c", "toy.yaml", "--share")
    wrong = call(toys, *arguments, "goup")
    assert wrong.returncode == 2 and "nobody or group. Did you mean 'group'?" in wrong.stderr
    assert call(toys, *arguments, "group").returncode == 0
    assert modes(toys / "w") == GROUP


def test_a_workspace_that_others_could_read_is_closed(run: Any, toys: Path) -> None:
    run()
    open_up(toys / "w")
    assert run() == CACHED
    assert modes(toys / "w") == PRIVATE
    (toys / "w" / "teeth.yaml").write_text("photographs: {}\n")
    assert modes(toys / "w") != PRIVATE
    run()
    assert modes(toys / "w") == PRIVATE


def open_up(workspace: Path) -> None:
    for path in (workspace, *workspace.rglob("*")):
        if not path.is_symlink():
            path.chmod(0o755 if path.is_dir() else 0o644)


def test_what_else_lies_in_its_folder_is_left_alone(run: Any, toys: Path) -> None:
    """The photographs may be in the workspace, and it in a folder for all."""
    (toys / "w").mkdir()
    (toys / "images").rename(toys / "w" / "photos")
    run(images=toys / "w" / "photos")
    open_up(toys / "w")
    assert run(images=toys / "w" / "photos") == CACHED
    for path in (toys / "w", toys / "w" / "photos", toys / "w" / "photos" / "0.txt"):
        assert path.stat().st_mode & 0o044
    for name in ("read", "count", "request.json", "report.html"):
        assert not (toys / "w" / name).stat().st_mode & 0o077, name


def test_it_is_remembered_beside_what_else_lies_in_its_folder(run: Any, toys: Path) -> None:
    (toys / "w").mkdir(mode=0o750)
    (toys / "images").rename(toys / "w" / "photos")
    photos = toys / "w" / "photos"
    run(images=photos, share="group")
    run(images=photos, share="nobody")
    assert run("count.steps=3", images=photos)["count"] == "ran"
    for name in ("request.json", "report.html", "count"):
        assert not (toys / "w" / name).stat().st_mode & 0o077, name


def test_what_other_commands_leave_is_its_own(run: Any, toys: Path) -> None:
    run(share="group")
    for name in ("dicom", "register", "profile"):
        (toys / "w" / name).mkdir()
        (toys / "w" / name / "of.txt").write_text("a patient's")
    (toys / "w" / "report_anonymous.html").write_text("")
    run(share="nobody")
    assert modes(toys / "w") == PRIVATE


def test_what_can_t_be_closed_is_told(
    run: Any, toys: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    run()
    open_up(toys / "w")

    def refuse(path: Path, mode: int) -> None:
        raise PermissionError(1, "Operation not permitted", str(path))

    with monkeypatch.context() as patch:
        patch.setattr(Path, "chmod", refuse)
        assert run() == CACHED
    assert "Others may be able to read" in capsys.readouterr().err


def test_links_are_not_followed(run: Any, toys: Path) -> None:
    run()
    (toys / "outside").write_text("of somebody else's")
    (toys / "w" / "count" / "link").symlink_to(toys / "outside")
    (toys / "w" / "count").chmod(0o755)
    run()
    assert stat.S_IMODE((toys / "outside").stat().st_mode) == 0o644


def test_the_mask_of_two_runs_at_once_is_the_stricter_one() -> None:
    inside, out = threading.Event(), threading.Event()

    def other() -> None:
        with privacy.kept_for("nobody"):
            inside.set()
            out.wait(10)

    def mask() -> int:
        os.umask(found := os.umask(0))
        return found

    with privacy.kept_for("group"):
        assert mask() == 0o027
        thread = threading.Thread(target=other)
        thread.start()
        inside.wait(10)
        assert mask() == 0o077
        out.set()
        thread.join()
        assert mask() == 0o027
    assert mask() == 0o022


def test_compiled_kernels_beside_the_program_are_for_all(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("NUMBA_CACHE_DIR", raising=False)
    monkeypatch.setattr(kernels, "folders", lambda: [tmp_path / "shared", tmp_path / "own"])
    with privacy.kept_for("nobody"):
        for name in ("shared", "own"):
            (tmp_path / name).mkdir()
            (tmp_path / name / "a.kernel").write_text("")
            kernels.for_all(tmp_path / name / "a.kernel")
    assert modes(tmp_path / "shared") == {"folders": {"755"}, "files": {"644"}}
    assert modes(tmp_path / "own") == PRIVATE


LOGGING = """
import sys, pipeline, pycolmap
for say in (pycolmap.logging.info, pycolmap.logging.warning, pycolmap.logging.error):
    say("of machine and user")
"""


def test_no_library_leaves_a_log(tmp_path: Path) -> None:
    """glog's files are readable by all, and named after the machine and the user."""
    done = subprocess.run(
        [sys.executable, "-c", LOGGING], env={**os.environ, "TMPDIR": str(tmp_path)},
        capture_output=True, text=True, timeout=60, cwd=Path(pipeline.__file__).parents[1],
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert list(tmp_path.iterdir()) == []
