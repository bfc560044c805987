"""Benchmarks on toy stages: what runs, what is shared, what is not run again."""

from __future__ import annotations

import csv
import json
import os
import re
import signal
import subprocess
import time
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml

import pipeline
from pipeline.artifacts import KINDS
from pipeline.errors import RequestError
from pipeline.stage import get_stage
from tests.studies import toy_bench

SUITE: dict[str, Any] = {
    "title": "Toys",
    "scenes": [{"name": "a", "images": "a/*.txt", "ground_truth": "a/truth.json"}],
    "methods": [
        {"name": "good", "preset": "toy.yaml", "overrides": {"fit": {"quality": 3}}},
        {"name": "poor", "preset": "toy.yaml", "overrides": {"fit.quality": 1}},
    ],
    "tables": [{"name": "one", "form": "views", "protocol": "test_every", "views": [2, 4]}],
}


@pytest.fixture
def bench(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[Callable[..., Any]]:
    """Write a suite with some changes, run it, and return its results."""
    monkeypatch.setitem(KINDS, "numbers", "toy:Numbers")
    monkeypatch.setattr("pipeline.stage._entry_points", lambda: toy_bench.STAGES)
    monkeypatch.setattr("pipeline.studies.benchmark.running.WORKER", (*toy_bench.COMMAND, "worker"))
    monkeypatch.setenv("TOY_LOG", str(tmp_path / "log.txt"))
    get_stage.cache_clear()
    make_case(tmp_path)

    def call(change: Callable[[dict[str, Any]], None] | None = None, **options: Any) -> Any:
        write_suite(tmp_path, change)
        (tmp_path / "log.txt").write_text("")
        return pipeline.benchmark(tmp_path / "suite.yaml", out=tmp_path / "out", **options)

    yield call
    get_stage.cache_clear()


def make_case(folder: Path) -> None:
    (folder / "toy.yaml").write_text(f"stages: {toy_bench.ORDER}\n")
    (folder / "a").mkdir()
    (folder / "a" / "truth.json").write_text("{}")
    for index in range(7):
        (folder / "a" / f"{index}.txt").write_text(str(index))


def write_suite(folder: Path, change: Callable[[dict[str, Any]], None] | None = None) -> None:
    suite = json.loads(json.dumps(SUITE))
    if change:
        change(suite)
    (folder / "suite.yaml").write_text(yaml.safe_dump(suite))


def computed(folder: Path) -> Counter[str]:
    """How often each stage computed since the last start of a benchmark."""
    lines = (folder / "log.txt").read_text().splitlines()
    return Counter(json.loads(line)[0] for line in lines)


def test_methods_share_what_comes_before_them(bench: Any, tmp_path: Path) -> None:
    results = bench()
    assert computed(tmp_path) == {"views": 2, "init": 2, "fit": 4, "evaluate": 4}
    cells = {(cell["method"], cell["views"]): cell for cell in results["cells"]}
    assert {cell["status"] for cell in cells.values()} == {"done"}
    assert cells["good", 2]["figures"]["refined"]["psnr"] == 20 + 2 + 3 + 1
    assert cells["poor", 4]["figures"]["registered"]["psnr"] == 20 + 4 + 1
    assert cells["poor", 4]["photographs"] == ["0.txt", "2.txt", "4.txt", "6.txt"]
    assert cells["poor", 2]["held_out"] == ["1.txt", "3.txt", "5.txt"]
    # The second method took `init` from the store, and is told its seconds all the same.
    actions = {stage["name"]: stage["action"] for stage in cells["poor", 2]["stages"]}
    assert actions == {"views": "cached", "init": "cached", "fit": "ran", "evaluate": "ran"}
    for cell in cells.values():
        counted = [s["wall_seconds"] for s in cell["stages"] if s["name"] != "evaluate"]
        assert cell["seconds"] == pytest.approx(sum(counted), abs=1e-3)
        assert len(counted) == 3 and cell["peak_memory_mb"] > 0


def test_what_is_written(bench: Any, tmp_path: Path) -> None:
    results = bench()
    out = tmp_path / "out"
    assert json.loads((out / "results.json").read_text()) == results
    text = (out / "tables.md").read_text()
    assert "The data differ" in text
    assert "test poses registered and then refined" in text
    assert re.search(r"\| good +\| +26\.00 \|", text)
    with (out / "tables.csv").open() as stream:
        lines = list(csv.DictReader(stream))
    chosen = [
        line["mean"]
        for line in lines
        if (line["method"], line["views"], line["scoring"], line["figure"])
        == ("poor", "4", "refined", "psnr")
    ]
    assert chosen == ["26.0"]
    assert (out / "a" / "4_views" / "request.json").exists()


def test_finished_cells_are_not_run_again(bench: Any, tmp_path: Path) -> None:
    first = bench()
    lines: list[str] = []
    again = bench(say=lines.append)
    assert computed(tmp_path) == {}
    assert again == first
    assert lines == ["4 of 4 cells are finished already"]


def only_two_views(suite: dict[str, Any]) -> None:
    suite["tables"][0]["views"] = [2]


def test_quiet_it_says_nothing_and_verbose_each_step(tmp_path: Path) -> None:
    make_case(tmp_path)
    write_suite(tmp_path, only_two_views)

    def call(out: str, *how: str) -> tuple[str, str]:
        done = subprocess.run(
            [*toy_bench.COMMAND, "benchmark", "suite.yaml", "-o", out, *how], cwd=tmp_path,
            env={**os.environ, "TOY_LOG": str(tmp_path / "log.txt")}, capture_output=True,
            text=True, check=False, timeout=120,
        )  # fmt: skip
        assert done.returncode == 0, done.stderr
        return done.stdout, done.stderr

    assert call("quiet", "-q") == ("", "")
    out, err = call("usual")
    assert "| good" in out and "fit done in" in err and "[2/2]" in err
    assert "fit: starts" not in err and "key" not in err
    out, err = call("verbose", "-v")
    assert "| good" in out and err.count(": fit: starts") == 2
    assert err.count(": fit: would run, key ") == 2 and "peak memory mb" in err
    usual, quiet = call("usual", "--json"), call("usual", "--json", "-q")
    assert usual[0] == quiet[0] and json.loads(quiet[0])["cells"] and quiet[1] == ""


def test_a_changed_method_makes_exactly_its_cells_stale(bench: Any, tmp_path: Path) -> None:
    def better(suite: dict[str, Any]) -> None:
        suite["methods"][1]["overrides"] = {"fit.quality": 9}

    bench()
    lines: list[str] = []
    results = bench(better, say=lines.append)
    assert computed(tmp_path) == {"fit": 2, "evaluate": 2}
    assert lines[0] == "2 of 4 cells are finished already"
    assert all("poor" in line for line in lines[1:]) and len(lines) == 3
    assert results["cells"][1]["figures"]["registered"]["psnr"] == 20 + 2 + 9
    bench()  # back again: the store still has it
    assert computed(tmp_path) == {}


def test_a_changed_photograph_is_noticed(bench: Any, tmp_path: Path) -> None:
    bench()
    (tmp_path / "a" / "2.txt").write_text("77")  # no input of the cells with 2 views
    bench()
    assert computed(tmp_path)["init"] == 1


def test_a_method_that_fails_is_a_result(bench: Any, tmp_path: Path) -> None:
    def needy(suite: dict[str, Any]) -> None:
        suite["methods"][1]["overrides"] = {"init.needs": 3}

    results = bench(needy)
    failed = [cell for cell in results["cells"] if cell["status"] == "failed"]
    assert [(cell["method"], cell["views"]) for cell in failed] == [("poor", 2)]
    assert "COLMAP could not place" in failed[0]["reason"]
    assert list(failed[0]["keys"]) == ["views", "init"]
    assert results["problems"] == []
    text = (tmp_path / "out" / "tables.md").read_text()
    poor = next(line for line in text.splitlines() if line.startswith("| poor"))
    assert poor.count("failed") == 3
    assert "a, 2 views, poor (failed): COLMAP could not place" in text
    bench(needy)
    assert computed(tmp_path) == {}  # it would fail again


@pytest.mark.parametrize(
    ("how", "status", "text"),
    [
        ({"fit.fail": "bug"}, "fault", "ZeroDivisionError"),
        ({"fit.fail": "killed"}, "fault", "signal 9"),
        ({"fit.fail": "request"}, "refused", "can't be done"),
        ({"evaluate.broken": True}, "fault", "holds no mean figures"),
    ],
)
def test_a_fault_does_not_stop_the_others(
    bench: Any, tmp_path: Path, how: dict[str, Any], status: str, text: str
) -> None:
    def broken(suite: dict[str, Any]) -> None:
        suite["methods"][0]["overrides"] = how
        suite["tables"][0]["views"] = [2]

    results = bench(broken)
    assert [cell["status"] for cell in results["cells"]] == [status, "done"]
    assert len(results["problems"]) == 1 and text in results["problems"][0]
    told = (tmp_path / "out" / "tables.md").read_text()
    assert re.search(rf"\| good +\| +{status} \|", told)
    bench(broken)
    assert computed(tmp_path) == ({"fit": 1} if "fit.fail" in how else {})  # tried again


def test_seeds_spread_and_known_cameras(bench: Any, tmp_path: Path) -> None:
    def more(suite: dict[str, Any]) -> None:
        suite["seeds"] = [0, 2]
        suite["tables"][0] |= {"views": [2], "methods": ["good"]}
        exact = {"name": "exact", "known_cameras": True, "views": [2], "methods": ["good"]}
        suite["tables"].append({**suite["tables"][0], **exact})

    results = bench(more, jobs=2)
    assert len(results["cells"]) == 4
    assert {cell["workspace"] for cell in results["cells"]} == {"a/2_views", "a/2_views_2"}
    first, exact = results["tables"]
    psnr = next(f for f in first["figures"] if (f["scoring"], f["figure"]) == ("input", "psnr"))
    assert (psnr["mean"], psnr["n"]) == (36.0, 2)
    assert psnr["std"] == pytest.approx(2**0.5)
    assert "36.00 ± 1.41 (n=2)" in (tmp_path / "out" / "tables.md").read_text()
    assert exact["known_cameras"]
    lines = [json.loads(line) for line in (tmp_path / "log.txt").read_text().splitlines()]
    placed = [config for stage, config in lines if stage == "init" and config["cameras"]]
    assert [config["method"] for config in placed] == ["known", "known"]
    assert [c["optimize_poses"] for s, c in lines if s == "fit"].count(False) == 2


def test_wrong_presets_and_settings_are_refused_before_anything_runs(
    bench: Any, tmp_path: Path
) -> None:
    def preset(suite: dict[str, Any]) -> None:
        suite["methods"][1]["preset"] = "dentalsplit"

    def setting(suite: dict[str, Any]) -> None:
        suite["methods"][1]["overrides"] = {"fit.qualty": 1}

    for change, text in ((preset, "Did you mean 'dentalsplat'"), (setting, "fit.quality")):
        with pytest.raises(RequestError, match="The method 'poor' of the suite") as error:
            bench(change)
        assert text in str(error.value)
    with pytest.raises(RequestError, match=r"fit\.qualty"):
        bench(overrides=["fit.qualty=1"])
    assert not (tmp_path / "out").exists()


def test_another_benchmark_in_the_folder_is_refused(bench: Any, tmp_path: Path) -> None:
    from filelock import FileLock

    (tmp_path / "out").mkdir()
    with FileLock(tmp_path / "out" / ".lock"), pytest.raises(RequestError, match="Another"):
        bench()


# -- the command line ------------------------------------------------------------------------------


def command(folder: Path, *arguments: str, **options: Any) -> subprocess.Popen[str]:
    environment = {**os.environ, "TOY_LOG": str(folder / "log.txt")}
    return subprocess.Popen(
        [*toy_bench.COMMAND, "benchmark", "suite.yaml", "-o", "out", *arguments],
        cwd=folder, env=environment, text=True, stdout=subprocess.PIPE, stderr=subprocess.PIPE,
        **options,
    )  # fmt: skip


def test_killed_half_way_it_goes_on(tmp_path: Path) -> None:
    make_case(tmp_path)
    write_suite(tmp_path)
    (tmp_path / "log.txt").write_text("")
    slow = ("--set", "fit.step_seconds=0.5")
    killed = command(tmp_path, *slow)
    cells = tmp_path / "out" / "cells"
    wait_for(lambda: len(list(cells.glob("*.json"))) == 1)
    wait_for(lambda: computed(tmp_path)["fit"] == 2)  # the second is in the middle of its fit
    killed.kill()
    killed.wait()
    done = next(cells.glob("*.json"))
    before = done.stat().st_mtime_ns
    wait_for(lambda: not workers(tmp_path))
    assert not (tmp_path / "out" / "results.json").exists()
    again = command(tmp_path, *slow)
    _, told = again.communicate(timeout=60)
    assert again.returncode == 0, told
    assert "1 of 4 cells are finished already" in told
    assert done.stat().st_mtime_ns == before
    # Only the fit that was killed ran twice.
    assert computed(tmp_path) == {"views": 2, "init": 2, "fit": 5, "evaluate": 4}
    results = json.loads((tmp_path / "out" / "results.json").read_text())
    seconds = [stage for cell in results["cells"] for stage in cell["stages"]]
    assert all(s["wall_seconds"] >= 0.5 for s in seconds if s["name"] == "fit")


def test_interrupt_ends_it_and_its_cells(tmp_path: Path) -> None:
    make_case(tmp_path)
    write_suite(tmp_path)
    (tmp_path / "log.txt").write_text("")
    # Started in the background, a test run ignores interrupts, and so would its children.
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    process = command(tmp_path, "--set", "fit.step_seconds=30")
    signal.signal(signal.SIGINT, before)
    wait_for(lambda: computed(tmp_path)["fit"] == 1)
    process.send_signal(signal.SIGINT)
    _, told = process.communicate(timeout=30)
    assert process.returncode == 130, told
    assert "Run the same command again" in told
    assert not workers(tmp_path)


def test_exit_status_and_json(tmp_path: Path) -> None:
    make_case(tmp_path)
    write_suite(tmp_path, only_two_views)
    (tmp_path / "log.txt").write_text("")
    good = command(tmp_path, "--json")
    out, told = good.communicate(timeout=60)
    assert good.returncode == 0 and len(json.loads(out)["cells"]) == 2
    assert "[2/2] a, 2 views, poor: 24.00 dB on unseen views" in told
    bad = command(tmp_path, "--set", "fit.fail=bug")
    out, told = bad.communicate(timeout=60)
    assert bad.returncode == 1
    assert "fault" in out and "ZeroDivisionError" in told.rpartition("[2/2]")[2]
    assert command(tmp_path, "--data", "nowhere").wait() == 2


def wait_for(condition: Callable[[], bool]) -> None:
    for _ in range(1500):
        if condition():
            return
        time.sleep(0.02)
    raise AssertionError("this never came to pass")


def workers(folder: Path) -> list[str]:
    """Processes of cells that work in a folder."""
    found = []
    for process in Path("/proc").glob("[0-9]*"):
        try:
            text = (process / "cmdline").read_text()
            here = (process / "cwd").readlink() == folder
        except OSError:
            continue
        if "toy_bench.py" in text and "worker" in text and here:
            found.append(text)
    return found


def test_a_fault_of_the_report_is_a_message(
    bench: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(results: dict[str, Any], out: Path) -> Path:
        raise ZeroDivisionError("oops")

    monkeypatch.setattr("pipeline.studies.benchmark.running.benchmark_report", broken)
    lines: list[str] = []
    results = bench(say=lines.append)
    assert lines[-1] == "The report could not be written: oops"
    assert results["problems"] == []
    out = tmp_path / "out"
    assert json.loads((out / "results.json").read_text()) == results
    assert (out / "tables.md").exists() and not (out / "report.html").exists()
