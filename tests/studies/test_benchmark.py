"""Benchmarks on toy stages: what runs, what is shared, what is not run again."""

from __future__ import annotations

import csv
import json
import os
import re
import shutil
import signal
import subprocess
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
import yaml

import pipeline
from pipeline.artifacts import KINDS
from pipeline.errors import RequestError
from pipeline.stage import get_stage
from pipeline.studies.benchmark import running, worker
from tests.studies import toy_bench
from tests.studies.small_batch import wait_for

SUITE: dict[str, Any] = {
    "title": "Toys",
    "scenes": [{"name": "a", "images": "a/*.txt", "ground_truth": "a/truth.json"}],
    "methods": [
        {"name": "good", "preset": "toy.yaml", "overrides": {"fit": {"quality": 3}}},
        {"name": "poor", "preset": "toy.yaml", "overrides": {"fit.quality": 1}},
    ],
    "tables": [{"name": "one", "form": "views", "protocol": "test_every", "views": [2, 4]}],
}


in_its_own = running._Processes._status


@contextmanager
def toy_benchmark(
    folder: Path, charts: bool = False, here: bool = False
) -> Iterator[Callable[..., Any]]:
    """What writes a suite with some changes, runs it, and returns its results.

    Args:
        folder: that everything is in.
        charts: whether the report is written.
        here: cells are run in this process: one of their own takes a second to start.
    """

    def call(change: Callable[[dict[str, Any]], None] | None = None, **options: Any) -> Any:
        write_suite(folder, change)
        (folder / "log.txt").write_text("")
        return pipeline.benchmark(folder / "suite.yaml", out=folder / "out", **options)

    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(KINDS, "numbers", "toy:Numbers")
        patch.setattr("pipeline.stage._entry_points", lambda: toy_bench.STAGES)
        patch.setattr("pipeline.studies.benchmark.running.WORKER", (*toy_bench.COMMAND, "worker"))
        patch.setenv("TOY_LOG", str(folder / "log.txt"))
        if here:
            patch.setattr(running._Processes, "_status", in_this_process)
        if not charts:
            patch.setattr(
                "pipeline.studies.benchmark.running.benchmark_report", toy_bench.no_report
            )
        get_stage.cache_clear()
        yield call
    get_stage.cache_clear()


def in_this_process(processes: Any, job: dict[str, Any]) -> int | None:
    """In place of `_Processes._status`, but for who is to be killed."""
    if job["cell"]["method"] == "killed":
        return in_its_own(processes, job)
    with processes.lock:  # one at a time: a run has the whole process
        worker.run_job(job)
    return 0


@pytest.fixture
def bench(tmp_path: Path) -> Iterator[Callable[..., Any]]:
    make_case(tmp_path)
    with toy_benchmark(tmp_path, here=True) as call:
        yield call


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Any]]:
    """The folder of a benchmark that has run, not to be changed, and its results."""
    folder = tmp_path_factory.mktemp("finished")
    make_case(folder)
    with toy_benchmark(folder, charts=True) as call:
        return folder, call()


@pytest.fixture
def again(finished: tuple[Path, Any], tmp_path: Path) -> Iterator[Callable[..., Any]]:
    """As `bench`, in a copy of the finished one: it goes on from there."""
    shutil.copytree(finished[0], tmp_path, dirs_exist_ok=True)
    with toy_benchmark(tmp_path, here=True) as call:
        yield call


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


def test_methods_share_what_comes_before_them(finished: tuple[Path, dict[str, Any]]) -> None:
    folder, results = finished
    assert computed(folder) == {"views": 2, "init": 2, "fit": 4, "evaluate": 4}
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


def test_what_is_written(finished: tuple[Path, dict[str, Any]]) -> None:
    folder, results = finished
    out = folder / "out"
    assert json.loads((out / "results.json").read_text()) == results
    assert "<html" in (out / "report.html").read_text()
    text = (out / "tables.md").read_text()
    assert "Measured on a." in text and "The data differ" not in text  # no method of the paper's
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


def test_finished_cells_are_not_run_again(
    again: Any, finished: tuple[Path, dict[str, Any]], tmp_path: Path
) -> None:
    lines: list[str] = []
    assert again(say=lines.append) == finished[1]
    assert computed(tmp_path) == {}
    assert lines == ["4 of 4 cells are finished already"]


def test_a_changed_method_makes_exactly_its_cells_stale(again: Any, tmp_path: Path) -> None:
    def better(suite: dict[str, Any]) -> None:
        suite["methods"][1]["overrides"] = {"fit.quality": 9}

    lines: list[str] = []
    results = again(better, say=lines.append)
    assert computed(tmp_path) == {"fit": 2, "evaluate": 2}
    assert lines[0] == "2 of 4 cells are finished already"
    assert all("poor" in line for line in lines[1:]) and len(lines) == 3
    assert results["cells"][1]["figures"]["registered"]["psnr"] == 20 + 2 + 9
    again()  # back again: the store still has it
    assert computed(tmp_path) == {}


def test_a_changed_photograph_is_noticed(again: Any, tmp_path: Path) -> None:
    (tmp_path / "a" / "2.txt").write_text("77")  # no input of the cells with 2 views
    again()
    assert computed(tmp_path)["init"] == 1


#: Method of `troubled` -> its settings, the status of its cell, and what is said of it.
TROUBLES: dict[str, tuple[dict[str, Any], str, str]] = {
    "bug": ({"fit.fail": "bug"}, "fault", "ZeroDivisionError"),
    "killed": ({"fit.fail": "killed"}, "fault", "signal 9"),
    "request": ({"fit.fail": "request"}, "refused", "can't be done"),
    "empty": ({"evaluate.broken": True}, "fault", "holds no mean figures"),
    "needy": ({"init.needs": 3}, "failed", "COLMAP could not place"),
    "nowhere": ({"views.masks": "/nowhere/masks"}, "refused", "no folder /nowhere/masks"),
}


@pytest.fixture(scope="module")
def troubled(tmp_path_factory: pytest.TempPathFactory) -> tuple[dict[str, Any], str, list[Any]]:
    """Results and tables of a suite of which one method succeeds; what a second run logs."""
    folder = tmp_path_factory.mktemp("troubled")
    make_case(folder)

    def change(suite: dict[str, Any]) -> None:
        suite["tables"][0]["views"] = [2]
        suite["methods"][:-1] = [
            {"name": name, "preset": "toy.yaml", "overrides": how}
            for name, (how, _, _) in TROUBLES.items()
        ]

    with toy_benchmark(folder, here=True) as call:
        results = call(change)
        told = (folder / "out" / "tables.md").read_text()
        call(change)
    return results, told, [json.loads(x) for x in (folder / "log.txt").read_text().splitlines()]


@pytest.mark.parametrize("name", TROUBLES)
def test_a_method_that_fails_is_a_result_and_a_fault_is_a_problem(troubled: Any, name: str) -> None:
    (_, status, text), (results, told, _) = TROUBLES[name], troubled
    cell = next(cell for cell in results["cells"] if cell["method"] == name)
    assert cell["status"] == status and text in cell["reason"]
    assert re.search(rf"\| {name} +\| +{status} \|", told)
    problems = [problem for problem in results["problems"] if f"2 views, {name}:" in problem]
    assert len(problems) == (status != "failed")
    assert all(text in problem for problem in problems)


def test_neither_stops_the_others_and_only_a_fault_is_tried_again(troubled: Any) -> None:
    results, _, second = troubled
    assert [(c["method"], c["status"]) for c in results["cells"]][-1] == ("poor", "done")
    assert len(results["problems"]) == 5
    # "empty" had its figures before; "needy" would fail again.
    again = [(stage, config.get("fail")) for stage, config in second]
    assert again == [("fit", "bug"), ("fit", "killed"), ("fit", "request")]


def test_a_method_may_fail_on_some_photographs_only(bench: Any, tmp_path: Path) -> None:
    def needy(suite: dict[str, Any]) -> None:
        suite["methods"] = [{**suite["methods"][1], "overrides": {"init.needs": 3}}]

    results = bench(needy)
    failed, done = results["cells"]
    assert (failed["status"], failed["views"], done["status"]) == ("failed", 2, "done")
    assert list(failed["keys"]) == ["views", "init"]
    assert results["problems"] == []
    text = (tmp_path / "out" / "tables.md").read_text()
    poor = next(line for line in text.splitlines() if line.startswith("| poor"))
    assert poor.count("failed") == 3
    assert "a, 2 views, poor (failed): COLMAP could not place" in text


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


def command(folder: Path, out: str, *arguments: str, charts: bool = False) -> subprocess.Popen[str]:
    environment = {**os.environ, "TOY_LOG": str(folder / "log.txt")}
    if charts:
        environment["TOY_CHARTS"] = "yes"
    return subprocess.Popen(
        [*toy_bench.COMMAND, "benchmark", "suite.yaml", "-o", out, *arguments],
        cwd=folder, env=environment, text=True, stdout=subprocess.PIPE, stderr=subprocess.PIPE,
    )  # fmt: skip


def end_of(process: subprocess.Popen[str]) -> tuple[int, str, str]:
    """Exit status, standard output and standard error."""
    out, told = process.communicate(timeout=60)
    return process.returncode, out, told


def only_two_views(suite: dict[str, Any]) -> None:
    suite["tables"][0]["views"] = [2]


def one_cell(suite: dict[str, Any]) -> None:
    only_two_views(suite)
    del suite["methods"][1]


def test_exit_status_and_what_is_said(tmp_path: Path) -> None:
    """Quiet nothing, verbose each step; the tables or JSON come on standard output alone."""
    make_case(tmp_path)
    write_suite(tmp_path, one_cell)

    def call(out: str, *how: str, status: int = 0) -> tuple[str, str]:
        ended, said, told = end_of(command(tmp_path, out, *how, charts=out == "usual" and not how))
        assert ended == status, told
        assert (tmp_path / out / "report.html").exists() == (out == "usual")
        return said, told

    assert call("quiet", "-q") == ("", "")
    out, err = call("usual")
    assert "| good" in out and "fit done in" in err
    assert "[1/1] a, 2 views, good: 26.00 dB on unseen views" in err
    assert "fit: starts" not in err and "key" not in err
    verbose, err = call("verbose", "-v", "--json")
    assert len(json.loads(verbose)["cells"]) == 1
    assert err.count(": fit: starts") == 1
    assert err.count(": fit: would run, key ") == 1 and "peak memory mb" in err
    quiet = call("verbose", "--json", "-q")
    assert quiet == (verbose, "")
    out, err = call("usual", "--set", "fit.fail=bug", status=1)
    assert "fault" in out and "ZeroDivisionError" in err.rpartition("[1/1]")[2]
    call("usual", "--data", "nowhere", status=2)


def test_killed_half_way_it_goes_on(tmp_path: Path) -> None:
    make_case(tmp_path)
    write_suite(tmp_path, only_two_views)
    (tmp_path / "log.txt").write_text("")
    slow = ("--set", "fit.step_seconds=0.5")
    killed = command(tmp_path, "out", *slow)
    cells = tmp_path / "out" / "cells"
    wait_for(lambda: len(list(cells.glob("*.json"))) == 1)
    wait_for(lambda: computed(tmp_path)["fit"] == 2)  # the second is in the middle of its fit
    killed.kill()
    killed.wait()
    done = next(cells.glob("*.json"))
    before = done.stat().st_mtime_ns
    wait_for(lambda: not workers(tmp_path))
    assert not (tmp_path / "out" / "results.json").exists()
    status, _, told = end_of(command(tmp_path, "out", *slow))
    assert status == 0, told
    assert "1 of 2 cells are finished already" in told
    assert done.stat().st_mtime_ns == before
    # Only the fit that was killed ran twice.
    assert computed(tmp_path) == {"views": 1, "init": 1, "fit": 3, "evaluate": 2}
    results = json.loads((tmp_path / "out" / "results.json").read_text())
    seconds = [stage for cell in results["cells"] for stage in cell["stages"]]
    assert all(s["wall_seconds"] >= 0.5 for s in seconds if s["name"] == "fit")


def test_interrupt_ends_it_and_its_cells(tmp_path: Path) -> None:
    make_case(tmp_path)
    write_suite(tmp_path)
    (tmp_path / "log.txt").write_text("")
    # Started in the background, a test run ignores interrupts, and so would its children.
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    process = command(tmp_path, "out", "--set", "fit.step_seconds=30")
    signal.signal(signal.SIGINT, before)
    wait_for(lambda: computed(tmp_path)["fit"] == 1)
    process.send_signal(signal.SIGINT)
    _, told = process.communicate(timeout=30)
    assert process.returncode == 130, told
    assert "Run the same command again" in told
    assert not workers(tmp_path)


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
    again: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(results: dict[str, Any], out: Path) -> Path:
        raise ZeroDivisionError("oops")

    monkeypatch.setattr("pipeline.studies.benchmark.running.benchmark_report", broken)
    out = tmp_path / "out"
    for name in ("results.json", "tables.md", "report.html"):
        (out / name).unlink()
    lines: list[str] = []
    results = again(say=lines.append)
    assert lines[-1] == "The report could not be written: oops"
    assert results["problems"] == []
    assert json.loads((out / "results.json").read_text()) == results
    assert (out / "tables.md").exists() and not (out / "report.html").exists()
