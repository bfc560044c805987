"""The command line on toy stages, in processes of its own: exit statuses, messages, kills."""

from __future__ import annotations

import json
import os
import random
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from toy import artifact_bytes

TOY = Path(__file__).parent / "toy.py"


def command(*arguments: str) -> list[str]:
    """The command line of a toy pipeline, for the folder that its preset and images are in."""
    return [sys.executable, str(TOY), *arguments]


def call(folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        command(*arguments), cwd=folder, capture_output=True, text=True, timeout=60
    )


RUN = ("run", "images", "-w", "w", "-c", "toy.yaml")


def test_no_arguments_teaches_by_example(toys: Path) -> None:
    done = call(toys)
    assert done.returncode == 0
    assert "pipeline run photos/" in done.stdout
    assert "--stages init,sap,fit" in done.stdout


def test_help_says_which_workspace_is_meant_where_none_is_named(toys: Path) -> None:
    assert "[default: ./runs/" in " ".join(call(toys, "run", "--help").stdout.split())
    for command_that_makes_none in ("status", "report", "clean", "compare", "dicom"):
        said = " ".join(call(toys, command_that_makes_none, "--help").stdout.split())
        assert "[default: this folder, or the only one in ./runs]" in said


def test_run_ends_with_a_summary(toys: Path) -> None:
    done = call(toys, *RUN)
    assert done.returncode == 0, done.stderr
    for text in ("count", "seconds", "MB", "views 3", "this is only a toy", "w/results"):
        assert text in done.stdout
    assert "count: starts\n" in done.stderr
    again = call(toys, *RUN)
    assert again.stderr.count("cached") == 4


def test_photographs_that_would_share_a_folder_are_said_to(toys: Path) -> None:
    for clinic in ("north", "south"):
        shutil.copytree(toys / "images", toys / clinic / "anna")
    first, again, other = (
        call(toys, "run", f"{clinic}/anna", "-c", "toy.yaml")
        for clinic in ("north", "north", "south")
    )
    assert first.returncode == other.returncode == 0, other.stderr
    assert "-w" not in first.stderr + again.stderr
    said = " ".join(other.stderr.split())
    assert "runs/anna is also where other photographs go that are called so, those in /" in said
    assert (
        f"{toys}/north/anna; it shows what was run last. To keep both, give each a folder: -w."
        in said
    )
    for given in (["south/anna/*"], ["south/anna", "-w", "runs/anna"]):
        assert "give each a folder" not in call(toys, "run", *given, "-c", "toy.yaml").stderr
    shutil.move(toys / "south", toys / "moved")
    assert "give each" not in call(toys, "run", "moved/anna", "-c", "toy.yaml").stderr


def test_json_is_json(toys: Path) -> None:
    summary = json.loads(call(toys, *RUN, "--json").stdout)
    assert [stage["action"] for stage in summary["stages"]] == ["ran"] * 4
    states = json.loads(call(toys, "status", "-w", "w", "--json").stdout)
    assert [stage["state"] for stage in states] == ["cached"] * 4
    assert json.loads(call(toys, "clean", "-w", "w", "--json").stdout)["removed"] == []
    wrong = call(toys, *RUN, "--json", "--set", "count.step=1")
    assert json.loads(wrong.stdout)["exit_status"] == 2


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="there is no /dev/full here")
@pytest.mark.parametrize("more", [(), ("--json",)])
def test_an_answer_that_finds_no_room_is_said_in_words(toys: Path, more: tuple[str, ...]) -> None:
    with Path("/dev/full").open("w") as full:
        done = subprocess.run(
            command(*RUN, "--dry-run", *more),
            cwd=toys,
            stdout=full,
            stderr=subprocess.PIPE,
            text=True,
        )
    assert done.returncode == 2 and "Traceback" not in done.stderr


def test_status_tells_why(toys: Path) -> None:
    call(toys, *RUN)
    done = call(toys, "status", "-w", "w", "--set", "scale.factor=3")
    assert "scale.factor 2.0 → 3.0" in done.stdout
    assert "depends on scale" in done.stdout


def test_a_link_in_a_circle_is_no_workspace(toys: Path) -> None:
    (toys / "loop").symlink_to("loop")
    done = call(toys, "run", "images", "-w", "loop", "-c", "toy.yaml")
    assert done.returncode == 2 and "loop can't be written to" in done.stderr
    assert call(toys, "batch", "images", "-o", "loop").returncode == 2


def test_status_tells_of_a_checkpoint(toys: Path) -> None:
    call(toys, *RUN, "--set", "count.fail=interrupt")
    (line,) = (e for e in call(toys, "status", "-w", "w").stdout.splitlines() if "count " in e[:6])
    assert line.split(maxsplit=2)[2].strip() == "goes on from its checkpoint"
    foreseen = call(toys, *RUN, "--dry-run", "--set", "count.fail=interrupt").stdout.splitlines()
    (line,) = (entry for entry in foreseen if entry.startswith("count "))
    assert "would run" in line and line.endswith("goes on from its checkpoint")


@pytest.mark.parametrize(
    ("arguments", "status", "text"),
    [
        ((*RUN, "--stages", "red"), 2, "Unknown stage 'red'"),
        ((*RUN, "--set", "scale.factor=70"), 2, "scale.factor=70 is not allowed"),
        ((*RUN, "--set", "count.fail=data"), 3, "share too little"),
        ((*RUN, "--set", "count.fail=bug"), 1, "fault of ours"),
        ((*RUN, "--set", "count.fail=disk"), 2, "is full"),
        ((*RUN, "--nonsense"), 2, "nonsense"),
        (("run",), 2, "Give the photographs"),
        (("status",), 2, "Say which workspace"),
        (("run", "images", "-w", "", "-c", "toy.yaml"), 2, "A path that was given is empty"),
        (("clean", "-w", ""), 2, "A path that was given is empty"),
        (("run", "", "-w", "w", "-c", "toy.yaml"), 2, "photograph or folder is empty"),
        ((*RUN, "--stages", ""), 2, "--stages names nothing"),
        (("run", "images", "-w", "w", "-c", ""), 2, "--config names nothing"),
        (("frobnicate",), 2, "frobnicate"),
        (("images",), 2, "To make a scene: pipeline run PHOTOGRAPHS"),
    ],
)
def test_failure_is_one_paragraph_with_its_status(
    toys: Path, arguments: tuple[str, ...], status: int, text: str
) -> None:
    done = call(toys, *arguments)
    assert done.returncode == status, done.stderr
    paragraph = done.stderr.strip().rpartition("\n")[2]
    assert text in paragraph
    assert "Traceback" not in done.stderr


def test_the_folder_it_is_called_in_has_gone(toys: Path) -> None:
    call_there = f"cd {toys / 'images'} && rm -r ../images && {sys.executable} {TOY} run 1.txt"
    done = subprocess.run(["sh", "-c", call_there], capture_output=True, text=True, timeout=60)
    assert done.returncode == 2 and "Traceback" not in done.stderr
    assert "is not there any more" in done.stderr


def test_debug_shows_the_trace(toys: Path) -> None:
    done = call(toys, *RUN, "--set", "count.fail=bug", "--debug")
    assert done.returncode == 1
    assert "ZeroDivisionError" in done.stderr and "Traceback" in done.stderr
    for words in (("--debug", "status"), ("status", "--debug")):
        done = call(toys, *words, "-w", "nosuch")
        assert "Traceback" in done.stderr and "nosuch is not a workspace" in done.stderr


def test_unwritable_workspace_is_refused(toys: Path) -> None:
    (toys / "w").write_text("a file, not a folder")
    done = call(toys, *RUN)
    assert done.returncode == 2
    assert "w can't be written to (there is something else of that name)" in done.stderr


def test_really_full_disk(toys: Path) -> None:
    """A file system of 64 KB: the paragraph comes, and the run succeeds once there is room."""
    small = toys / "small"
    small.mkdir()
    mount = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", "size=64k", "tmpfs", str(small)], capture_output=True
    )
    if mount.returncode != 0:
        pytest.skip("mounting a small file system needs root")
    try:
        done = call(toys, "run", "images", "-w", str(small / "w"), "-c", "toy.yaml")
        assert done.returncode == 2, done.stderr
        assert "is full" in done.stderr and "Nothing computed before is lost" in done.stderr
        subprocess.run(["mount", "-o", "remount,size=4m", str(small)], check=True)
        again = call(toys, "run", "images", "-w", str(small / "w"), "-c", "toy.yaml")
        assert again.returncode == 0, again.stderr
        assert "scale: cached" in again.stderr
    finally:
        subprocess.run(["umount", str(small)], check=True)


def test_kill_at_any_moment_changes_no_byte(toys: Path) -> None:
    whole = call(toys, *RUN[:3], "whole", *RUN[4:])
    assert whole.returncode == 0
    slow = (*RUN, "--set", "count.step_seconds=0.03")
    moments = random.Random(0)
    killed = 0
    while killed < 8:
        process = subprocess.Popen(
            command(*slow), cwd=toys, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        )
        try:
            process.wait(timeout=moments.uniform(0.1, 0.9))
            shutil.rmtree(toys / "w")  # it was done before the moment came: begin anew
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
            killed += 1
    final = call(toys, *slow)
    assert final.returncode == 0, final.stderr
    assert artifact_bytes(toys / "w") == artifact_bytes(toys / "whole")
    assert not [p for p in (toys / "w").rglob("*") if p.name.endswith((".partial", ".tmp"))]


def test_help_is_quick_to_import() -> None:
    """`pipeline --help` must not import numpy, let alone heavier things."""
    code = "import sys, pipeline.cli; print({'numpy', 'cv2', 'torch'} & set(sys.modules))"
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, env=os.environ, check=True
    )
    assert done.stdout.strip() == "set()"
