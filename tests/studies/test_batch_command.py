"""The command `batch` on toy cases: what it says, and what an interrupt and a kill leave."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
from pathlib import Path

import pytest

from tests.studies import toy_batch
from tests.studies.small_batch import wait_for
from tests.studies.toy_batch_case import PRESET, add_case, computed

pytest.importorskip("distributed")


def command(folder: Path, *arguments: str) -> subprocess.Popen[str]:
    (folder / "toy.yaml").write_text(PRESET)
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        return subprocess.Popen(
            [*toy_batch.COMMAND, "batch", "cases", "-o", "out", "-c", "toy.yaml", *arguments],
            cwd=folder, env={**os.environ, "TOY_LOG": str(folder / "log.txt")}, text=True,
            stdout=subprocess.PIPE, stderr=subprocess.PIPE,
        )  # fmt: skip
    finally:
        signal.signal(signal.SIGINT, before)


def fitting(folder: Path) -> list[int]:
    """Processes in which a fit has begun."""
    lines = (folder / "log.txt").read_text().splitlines() if (folder / "log.txt").exists() else []
    return [entry[2] for entry in map(json.loads, lines) if entry[0] == "fit"]


def alive(process: int) -> bool:
    try:
        return "child" in Path(f"/proc/{process}/cmdline").read_text()
    except OSError:
        return False


def test_quiet_it_says_nothing_and_verbose_each_step(tmp_path: Path) -> None:
    add_case(tmp_path, "anna", 1, 2)
    add_case(tmp_path, "berta", 1, 3)

    def call(*how: str) -> tuple[str, str]:
        process = command(tmp_path, *how)
        said = process.communicate(timeout=120)
        assert process.returncode == 0, said
        return said

    out, err = call("-v")
    assert "2 done" in out and "Summary: " in out
    for name in ("anna", "berta"):
        for text in (
            "views: would run, key ",
            "fit: starts",
            "export: done in",
            "key .*, peak memory mb",
        ):
            assert re.search(rf"^  {name}: {text}", err, re.MULTILINE), (name, text, err)
        assert len(re.findall(rf"\] {name}: done", err)) == 1
        assert err.count(f"{name}: fit: starts") == 1, "each line once"
    assert call("-q", "--retry", "anna") == ("", "")
    usual, quiet = call("--json"), call("--json", "-q")
    told = [json.loads(text) | {"seconds": 0} for text, _ in (usual, quiet)]
    assert told[0] == told[1] and "2 of 2 cases are done" in usual[1] and quiet[1] == ""


def test_interrupted_or_killed_it_leaves_no_orphan_and_goes_on(tmp_path: Path) -> None:
    for name in ("a", "b", "c"):
        add_case(tmp_path, name, *(ord(name) + k for k in range(2)))
    for how, status in ((signal.SIGINT, 130), (signal.SIGKILL, -9)):
        slow = command(tmp_path, "--set", "fit.wait=60", "--jobs", "2")
        wait_for(lambda: len(fitting(tmp_path)) == 2)
        children = fitting(tmp_path)
        assert all(map(alive, children))
        slow.send_signal(how)
        _, told = slow.communicate(timeout=30)
        assert slow.returncode == status, told
        assert computed(tmp_path)["views"] == (2 if how == signal.SIGINT else 0)
        wait_for(lambda those=children: not any(map(alive, those)))
        (tmp_path / "log.txt").write_text("")
    again = command(tmp_path, "--json")
    out, told = again.communicate(timeout=60)
    assert again.returncode == 0, told
    assert json.loads(out)["counts"] == {"done": 3}
    assert computed(tmp_path) == {"views": 1, "fit": 3, "export": 3}


def test_what_is_in_the_way_in_the_folder_of_a_batch_is_no_fault_of_ours(tmp_path: Path) -> None:
    for number, name in enumerate("abc"):
        add_case(tmp_path, name, number, 10 + number)
    (tmp_path / "out" / "cases").mkdir(parents=True)
    (tmp_path / "out" / "cases" / "a").write_text("a file where the workspace is to be")
    (tmp_path / "out" / "logs" / "b.txt").mkdir(parents=True)
    process = command(tmp_path, "--json")
    out, told = process.communicate(timeout=120)
    assert process.returncode == 3, told
    states = {record["name"]: record["state"] for record in json.loads(out)["cases"]}
    assert states == {"a": "wrong", "b": "wrong", "c": "done"}
    for place, why in (("cases/a", "there is something else"), ("logs/b.txt", "Is a directory")):
        assert f"{tmp_path}/out/{place} can't be used ({why}" in told
    assert told.count("add --retry failed") == 2
    (tmp_path / "out" / "cases" / "a").unlink()
    (tmp_path / "out" / "logs" / "b.txt").rmdir()
    out, told = (again := command(tmp_path, "--json", "--retry", "failed")).communicate(timeout=120)
    assert again.returncode == 0 and json.loads(out)["counts"] == {"done": 3}


def test_a_case_that_was_renamed_keeps_what_it_has(tmp_path: Path) -> None:
    for number, name in enumerate(("anna", "ben", "carl")):
        add_case(tmp_path, name, number, 10 + number)

    def states() -> dict[str, tuple[str, str]]:
        (tmp_path / "log.txt").write_text("")
        process = command(tmp_path, "--json")
        out, told = process.communicate(timeout=120)
        assert process.returncode == 0, told
        return {each["name"]: (each["id"], each["state"]) for each in json.loads(out)["cases"]}

    states()
    said = tmp_path / "out" / "cases" / "anna" / "teeth.yaml"
    said.write_text("what was put right")
    states()
    (tmp_path / "cases" / "north").mkdir()
    (tmp_path / "cases" / "anna").rename(tmp_path / "cases" / "north" / "Anna 2026")
    (tmp_path / "cases" / "ben").rename(tmp_path / "cases" / "dora")
    (tmp_path / "cases" / "dora" / "1.jpg").write_text("8")  # another photograph: another case
    expected = {
        "north/Anna 2026": ("anna", "done"), "dora": ("dora", "done"), "carl": ("carl", "done"),
    }  # fmt: skip
    assert states() == expected
    assert computed(tmp_path) == {"views": 1, "fit": 1, "export": 1}, "dora alone"
    assert said.exists()
    assert states() == expected and computed(tmp_path) == {}
    assert not (tmp_path / "out" / "cases" / "north__Anna_2026").exists()
