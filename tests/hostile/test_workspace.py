"""Anything may lie where a workspace keeps its own: it is repaired, or refused with the remedy."""

from __future__ import annotations

import errno
import json
import os
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from filelock import FileLock
from toy import Numbers, artifact_bytes

import pipeline
from pipeline.cli import app
from pipeline.errors import PipelineError
from pipeline.files import write_atomic
from pipeline.store import Store, file_in_the_way

RAN = {"read": "ran", "scale": "ran", "count": "ran", "publish": "ran"}
CACHED = dict.fromkeys(RAN, "cached")
QUIET = "report=false"


def folder_of(toys: Path, stage: str) -> Path:
    result = Store(toys / "w").current(stage)
    assert result is not None
    return result.folder


def no_leftovers(workspace: Path) -> None:
    assert not [p for p in workspace.rglob("*") if p.name.endswith((".tmp", ".partial"))]


def test_a_copy_with_links_turned_into_folders(run: Any, toys: Path) -> None:
    run()
    (toys / "w").rename(toys / "first")
    subprocess.run(["cp", "-rL", str(toys / "first"), str(toys / "w")], check=True)
    assert not (toys / "w" / "results").is_symlink()
    assert run() == CACHED
    assert (toys / "w" / "results").is_symlink()
    assert (toys / "w" / "results" / "viewer.html").is_file()
    assert not list((toys / "w").glob("results.*"))
    assert not list((toys / "w").glob("*/*.quarantined*"))


def test_a_disk_that_knows_no_links(
    run: Any, toys: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def refuse(*_: Any) -> None:
        raise PermissionError(errno.EPERM, "Operation not permitted")

    monkeypatch.setattr(Path, "symlink_to", refuse)
    assert run() == RAN
    assert "The disk knows no links" in capsys.readouterr().err
    assert not (toys / "w" / "results").exists()


@pytest.mark.parametrize("kind", ["folder", "file", "link", "loop"])
def test_results_is_something_else(run: Any, toys: Path, kind: str) -> None:
    run(QUIET)
    good = (toys / "w" / "results" / "viewer.html").read_bytes()
    place(toys / "w" / "results", kind)
    assert run(QUIET) == CACHED
    assert (toys / "w" / "results" / "viewer.html").read_bytes() == good
    aside = list((toys / "w").glob("results.*"))
    assert len(aside) == (kind in ("folder", "file"))  # what may be the user's is kept
    pipeline.clean(toys / "w")
    assert list((toys / "w").glob("results.*")) == aside


def place(path: Path, kind: str) -> None:
    """Put something else under a name."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)
    if kind == "folder":
        path.mkdir()
        (path / "something").write_text("of the user's")
    elif kind == "file":
        path.write_text("5")
    elif kind == "link":
        path.symlink_to("nowhere/at/all")
    elif kind == "loop":
        path.symlink_to(path.name)
    elif kind == "pipe":
        os.mkfifo(path)


OWN = (
    "count/.lock", "count/.owner.json", "count/current.json", "count/failure.json",
    "count/failure", "request.json", "report.html", "pages.json",
)  # fmt: skip


@pytest.mark.parametrize("kind", ["folder", "file", "link", "loop", "pipe"])
def test_other_things_in_the_places_of_the_workspace_s_own(run: Any, toys: Path, kind: str) -> None:
    run()
    whole = artifact_bytes(toys / "w")
    for name in OWN:
        place(toys / "w" / name, kind)
    assert run() == CACHED
    assert run("count.steps=7")["count"] == "ran"
    with pytest.raises(pipeline.ReconstructionError):
        run("count.fail=data", "count.steps=7")
    assert run() == CACHED
    assert {s.state for s in pipeline.status(workspace=toys / "w")} == {"cached"}
    pipeline.clean(toys / "w")
    assert run() == CACHED
    assert {n: b for n, b in artifact_bytes(toys / "w").items() if n in whole} == whole
    no_leftovers(toys / "w")


@pytest.mark.parametrize("kind", ["folder", "file", "link", "loop", "pipe"])
def test_other_things_in_the_places_of_results(
    run: Any, toys: Path, kind: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("pipeline.store.checks.SETTLED_NS", 0)
    run(QUIET)
    whole = artifact_bytes(toys / "w")
    folder = folder_of(toys, "count")
    for path in (
        folder, folder / "manifest.json", folder / "metrics", folder / "metrics" / "step_1.txt",
        folder / "checked.json", folder.with_name(f"{folder.name}.partial"),
        folder.with_name(f"{folder.name}.replaced"),
    ):  # fmt: skip
        place(path, kind)
        done = run(QUIET)
        assert done in (CACHED, {**CACHED, "count": "ran"})
        pipeline.clean(toys / "w")
        assert run(QUIET) == CACHED
        assert artifact_bytes(toys / "w") == whole


@pytest.mark.parametrize("kind", ["file", "folder"])
def test_scratch_is_something_else(run: Any, toys: Path, kind: str) -> None:
    run(QUIET, stages=["read", "scale"])
    with pytest.raises(KeyboardInterrupt):
        run(QUIET, "count.fail=interrupt")
    (partial,) = (toys / "w").glob("count/*.partial")
    place(partial / "scratch", kind)
    with pytest.raises(KeyboardInterrupt):
        run(QUIET, "count.fail=interrupt")


@pytest.mark.parametrize("kind", ["file", "link", "loop", "pipe"])
def test_the_name_of_a_stage_is_taken(run: Any, toys: Path, kind: str) -> None:
    """What has it may be the user's: it is not touched."""
    run(QUIET)
    shutil.rmtree(toys / "w" / "count")
    place(toys / "w" / "count", kind)
    with pytest.raises(pipeline.RequestError, match=r"w/count is .* Move it away"):
        run(QUIET, "read.keep=2")
    assert pipeline.status(workspace=toys / "w")[2].state == "missing"
    pipeline.clean(toys / "w")
    (toys / "w" / "count").unlink()
    assert run(QUIET) == {**CACHED, "count": "ran"}


def test_the_folder_of_a_stage_may_be_a_link_to_another_disk(run: Any, toys: Path) -> None:
    run(QUIET)
    (toys / "w" / "count").rename(toys / "elsewhere")
    (toys / "w" / "count").symlink_to(toys / "elsewhere")
    assert run(QUIET) == CACHED
    assert run(QUIET, "count.steps=3")["count"] == "ran"


GOOD = {"images": [], "preset": None, "overrides": [], "stages": None, "from": None}
VALUES: tuple[Any, ...] = (5, 1.5, True, None, "text", [], [5], [None], [["a"]], {}, {"a": 1})
REQUESTS: list[Any] = [
    *VALUES,
    *({**GOOD, name: value} for name in GOOD for value in VALUES if GOOD[name] != value),
    *({k: v for k, v in GOOD.items() if k != name} for name in GOOD),
    {**GOOD, "more": 1},
    {**GOOD, "images": ["\0", "a" * 5000, "\ud800"]},
]


def test_a_request_of_any_shape(run: Any, toys: Path) -> None:
    run(QUIET)
    file = toys / "w" / "request.json"
    good = file.read_bytes()
    asks: tuple[Callable[[], Any], ...] = (
        lambda: pipeline.status(workspace=toys / "w"),
        lambda: pipeline.run(workspace=toys / "w", dry_run=True),
        lambda: pipeline.clean(toys / "w"),
        lambda: pipeline.run_report(toys / "w"),
        lambda: pipeline.compare(toys / "w", run_colmap=True),
    )
    texts = [json.dumps(value) for value in REQUESTS]
    for text in (*texts, "", "{", "[" * 100_000, '"\xff', "1" * 5000, "NaN"):
        file.write_bytes(text.encode("latin-1", errors="replace"))
        for ask in asks:
            try:
                ask()
            except PipelineError as error:
                assert error.exit_status == 2, (text, error)
    assert run(QUIET) == CACHED
    assert file.read_bytes() == good


def test_a_manifest_of_any_shape(run: Any, toys: Path) -> None:
    run(QUIET)
    whole = artifact_bytes(toys / "w")
    file = folder_of(toys, "scale") / "manifest.json"
    good = json.loads(file.read_text())
    del good["checksum"]
    good["format"] = 1
    changed = [good | {name: value} for name in good for value in (5, None, {"a": 5})]
    for value in (*VALUES, *changed, {k: v for k, v in good.items() if k != "outputs"}):
        file.write_text(json.dumps(value))
        pipeline.status(workspace=toys / "w")
        # what no reader looks at may be wrong
        assert run(QUIET) in (CACHED, {**CACHED, "scale": "ran"})
        assert artifact_bytes(toys / "w").items() >= whole.items()
        pipeline.clean(toys / "w")


@pytest.mark.parametrize("name", ["current.json", "failure.json", ".owner.json"])
def test_a_small_record_of_any_shape(run: Any, toys: Path, name: str) -> None:
    run(QUIET)
    for value in (*VALUES, {"key": 5}, {"key": "a", "reasons": 5}, {"key": "../../x"}):
        (toys / "w" / "count" / name).write_text(json.dumps(value))
        pipeline.status(workspace=toys / "w")
        assert run(QUIET) == CACHED


def test_whoever_waits_for_a_lock_is_not_harmed_by_its_owner_s_record(tmp_path: Path) -> None:
    import threading

    store = Store(tmp_path)
    heard: list[str] = []
    with store.lock("fit", print):
        (tmp_path / "fit" / ".owner.json").write_text("[1]")

        def wait() -> None:
            with Store(tmp_path).lock("fit", heard.append):
                pass

        waiting = threading.Thread(target=wait)
        waiting.start()
        while not heard:
            pass
    waiting.join()
    assert heard == ["waiting for another process, which has been working on 'fit'"]


@pytest.fixture
def closed(run: Any, toys: Path) -> Any:
    """The workspace of a finished run on a disk that can't be written to."""
    disk = toys / "disk"
    disk.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=8m", "tmpfs", str(disk)]
    if subprocess.run(mount, capture_output=True).returncode != 0:
        pytest.skip("mounting a file system needs root")
    try:
        (toys / "w").symlink_to(disk / "w")
        (disk / "w").mkdir()
        run("scale.factor=3")
        run()
        subprocess.run(["mount", "-o", "remount,ro", str(disk)], check=True)
        yield toys / "w"
    finally:
        subprocess.run(["umount", "-l", str(disk)], check=True)


def test_a_workspace_that_can_t_be_written_to(closed: Path, run: Any) -> None:
    assert {s.state for s in pipeline.status(workspace=closed)} == {"cached"}
    assert {s.state for s in pipeline.status(workspace=closed, verify=True)} == {"cached"}
    with pytest.raises(pipeline.RequestError, match=r"can't be cleaned .*Read-only"):
        pipeline.clean(closed)
    with pytest.raises(pipeline.RequestError, match=r"can't be written to \(Read-only"):
        run()
    with pytest.raises(pipeline.RequestError, match=r"report.*can't be written \(Read-only"):
        pipeline.run_report(closed)


@pytest.mark.parametrize("what", ["folder", "file"])
def test_the_workspace_of_somebody_else(
    run: Any, toys: Path, monkeypatch: pytest.MonkeyPatch, what: str
) -> None:
    run(QUIET)
    before, access = Path.lstat, os.access

    def lstat(path: Path) -> os.stat_result:
        if what == "folder" and path.parent == toys / "w":
            raise PermissionError(13, "Permission denied", str(path))
        return before(path)

    monkeypatch.setattr(Path, "lstat", lstat)
    monkeypatch.setattr(
        os, "access",
        lambda path, mode: (Path(path).name != "request.json" or mode != os.R_OK)
        and access(path, mode),
    )  # fmt: skip
    workspace = toys / "w"
    for ask in (
        run,
        lambda: run(images=()),
        lambda: pipeline.status(workspace=workspace),
        lambda: pipeline.clean(workspace),
        lambda: pipeline.run_report(workspace),
    ):
        with pytest.raises(pipeline.RequestError, match=r"can't be read: permission denied"):
            ask()


def test_files_that_may_not_be_read(run: Any, toys: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """By other means than permissions, which don't hold for root."""
    run(QUIET)
    whole = artifact_bytes(toys / "w")
    closed = (folder_of(toys, "scale") / "manifest.json").stat().st_ino
    before = os.open

    def refuse(path: Any, *rest: Any, **more: Any) -> int:
        if Path(path).exists() and Path(path).stat().st_ino == closed:
            raise PermissionError(13, "Permission denied", str(path))
        return before(path, *rest, **more)

    monkeypatch.setattr(os, "open", refuse)
    assert run(QUIET) == {**CACHED, "scale": "ran"}
    assert artifact_bytes(toys / "w").items() >= whole.items()


def test_a_folder_that_vanishes_or_closes_ends_with_the_remedy(
    run: Any, toys: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def closed(path: Path, *rest: Any, **more: Any) -> None:
        raise PermissionError(13, "Permission denied", str(path))

    run(QUIET, stages=["read"])
    with monkeypatch.context() as patch:
        patch.setattr("toy.Numbers.save", lambda numbers, folder: closed(folder / "numbers.json"))
        with pytest.raises(pipeline.RequestError, match=r"can't be used \(Permission denied\)"):
            run(QUIET)
    assert run(QUIET) == RAN | {"read": "cached"}


def test_a_workspace_that_is_moved_while_it_is_worked_in(
    run: Any, toys: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    save = Numbers.save

    def moved(numbers: Numbers, folder: Path) -> None:
        (toys / "w").rename(toys / "moved")
        save(numbers, folder)

    run(QUIET, stages=["read"])
    with monkeypatch.context() as patch:
        patch.setattr("toy.Numbers.save", moved)
        with pytest.raises(pipeline.RequestError, match=r"numbers.json has gone while"):
            run(QUIET)
    assert not (toys / "w").exists(), "nothing is left in its old place"
    (toys / "moved").rename(toys / "w")
    assert run(QUIET) == RAN | {"read": "cached"}


def test_what_is_in_the_way_is_named_and_no_temporary_file(tmp_path: Path) -> None:
    (tmp_path / "current.json").mkdir()
    (tmp_path / "scale").touch()
    for path, named in (("current.json", "current.json"), ("scale/.owner.json", "scale")):
        with pytest.raises(OSError) as refused:
            write_atomic(tmp_path / path, "")
        assert str(file_in_the_way(refused.value)).startswith(f"{tmp_path / named} can't be used")


# -- clean -----------------------------------------------------------------------------------------


def stopped(run: Any, *overrides: str) -> None:
    with pytest.raises(KeyboardInterrupt):
        run(QUIET, "count.fail=interrupt", *overrides)


def test_clean_keeps_what_a_run_goes_on_from(
    run: Any, toys: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    stopped(run, "count.steps=33")
    stopped(run)  # of another key: this is what was asked for last
    kept = pipeline.status(workspace=toys / "w")[2]
    assert kept.key and kept.resumable
    app(["clean", "-w", str(toys / "w")], standalone_mode=False)
    told = capsys.readouterr().out
    assert f"kept count/{kept.key[:12]}.partial, 0.0 MB" in told and "1 results deleted" in told
    assert run(QUIET, "count.fail=interrupt")["count"] == "resumed"
    stopped(run, "count.steps=20")
    with FileLock(toys / "w" / "count" / ".lock"):
        capsys.readouterr()
        app(["clean", "-w", str(toys / "w"), "--all"], standalone_mode=False)
        assert "(another process is working there)" in capsys.readouterr().out
    pipeline.clean(toys / "w", everything=True)
    assert not pipeline.status(workspace=toys / "w")[2].resumable
    no_leftovers(toys / "w")


def test_clean_keeps_checkpoints_where_it_can_t_tell(run: Any, toys: Path) -> None:
    stopped(run)
    shutil.rmtree(toys / "images")
    assert not [n for n in pipeline.clean(toys / "w")[0] if n.endswith(".partial")]
    (toys / "w" / "request.json").write_text("5")
    assert not [n for n in pipeline.clean(toys / "w")[0] if n.endswith(".partial")]
    assert len(list((toys / "w").glob("count/*.partial"))) == 1


def test_clean_deletes_the_checkpoint_of_what_is_finished(run: Any, toys: Path) -> None:
    stopped(run)
    run(QUIET)
    removed, _ = pipeline.clean(toys / "w")
    assert len(removed) == 1 and removed[0].endswith(".partial")
    assert run(QUIET) == CACHED
