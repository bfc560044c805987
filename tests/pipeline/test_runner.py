"""Reuse, early cut-off, chains of stages, failures and resuming, on toy stages."""

from __future__ import annotations

import errno
import json
import os
import re
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from toy import STAGES, ToyEntryPoint, artifact_bytes

import pipeline
from pipeline.artifacts.views import read_png
from pipeline.running.failing import explained
from pipeline.running.reporter import Reporter
from pipeline.stage import Stage, StageConfig, StageContext
from pipeline.store import Store

ALL_RAN = {"read": "ran", "scale": "ran", "count": "ran", "publish": "ran"}
ALL_CACHED = dict.fromkeys(ALL_RAN, "cached")


def test_second_run_computes_nothing(run: Any) -> None:
    assert run() == ALL_RAN
    assert run() == ALL_CACHED


def test_going_back_is_a_hit(run: Any) -> None:
    run()
    changed = run("scale.factor=3")
    assert changed == {"read": "cached", "scale": "ran", "count": "ran", "publish": "ran"}
    assert run() == ALL_CACHED
    assert run("scale.factor=3") == ALL_CACHED


def test_runtime_fields_and_threads_are_not_in_the_key(run: Any) -> None:
    run()
    assert run("scale.log_every=7", "threads=1") == ALL_CACHED


def test_a_profile_changes_no_key_and_is_whole(run: Any, toys: Path) -> None:
    pytest.importorskip("pyinstrument")
    run(stages=["read"])
    assert run(profile=True) == {**ALL_RAN, "read": "cached"}
    assert run() == ALL_CACHED
    pages = sorted((toys / "w" / "profile").iterdir())
    assert [page.name for page in pages] == ["count.html", "publish.html", "scale.html"]
    text = pages[0].read_text(encoding="utf-8")
    assert "toy.py" in text
    assert "https://" not in text, "nothing is loaded from the network"


def test_a_missing_profiler_is_said_first(
    run: Any, toys: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("pipeline.installed.is_installed", lambda *_: False)
    with pytest.raises(pipeline.RequestError, match=r"--profile needs pyinstrument.*\[profile\]"):
        run(profile=True)
    assert not (toys / "w").exists()


def test_early_cut_off_when_the_bytes_stay_the_same(run: Any) -> None:
    run()
    after = run("scale.round=true")  # 2.0 rounds to 2: other config, same numbers
    assert after["scale"] == "ran"
    assert after["count"] == after["publish"] == "cached"


def test_changed_input_file_reruns_what_depends_on_it(run: Any, toys: Path) -> None:
    run()
    (toys / "images" / "1.txt").write_text("2.0")  # other bytes, the same number
    after = run()
    assert after == {**ALL_CACHED, "read": "ran"}
    (toys / "images" / "1.txt").write_text("5")
    assert run() == ALL_RAN


def test_named_stages_take_the_rest_from_the_workspace(run: Any) -> None:
    run()
    assert run("count.steps=5", stages=["count"], images=()) == {"count": "ran"}
    assert run("count.steps=5", stages=["read", "count"]) == {"read": "cached", "count": "ran"}


def test_stage_without_its_input_is_refused(run: Any, toys: Path) -> None:
    with pytest.raises(pipeline.RequestError, match=r"'publish' needs metrics.*count would make"):
        run(stages=["read", "publish"])
    assert not (toys / "w").exists()


def test_stages_in_another_order_than_they_need(run: Any) -> None:
    run()
    with pytest.raises(pipeline.RequestError, match="order given: name count before publish"):
        run(stages=["publish", "count"])


def test_from_begins_in_the_middle(run: Any) -> None:
    run()
    assert run("count.steps=3", from_stage="count") == {
        "read": "cached", "count": "ran", "publish": "ran"
    }  # fmt: skip


def test_photographs_named_again_do_not_supersede_what_was_made_of_them(run: Any) -> None:
    """`scale` makes its own numbers of those that `read` makes: a later stage wants those."""
    whole = {"read": "cached", "count": "cached"}
    run()
    assert run(stages=["count"]) == whole
    assert run(stages=["count"], dry_run=True) == whole
    assert run(from_stage="count") == {**whole, "publish": "cached"}


class PeekStage(Stage):
    """Quick, and run unasked where a stage that was named can use what it says."""

    name, version, summary = "peek", 1, "notes the largest number"
    requires = ("numbers",)
    provides = ("metrics",)
    prepares = True
    Config = StageConfig

    def run(self, context: StageContext) -> None:
        largest = max(context.load("numbers").values)
        (context.output("metrics") / "metrics.json").write_text(f'{{"total": {largest}}}')


def test_a_stage_that_runs_unasked_sees_what_it_saw_before(
    run: Any, toys: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It stands before `scale`, whose numbers are not for it."""
    monkeypatch.setitem(STAGES, "peek", [ToyEntryPoint(PeekStage)])
    (toys / "toy.yaml").write_text("stages: [read, peek, scale, publish]\n")
    assert run() == {"read": "ran", "peek": "ran", "scale": "ran", "publish": "ran"}
    cached = {"read": "cached", "peek": "cached", "publish": "cached"}
    assert run(stages=["publish"]) == cached


class Ears(Reporter):
    def __init__(self) -> None:
        self.heard: list[str] = []

    def message(self, text: str) -> None:
        self.heard.append(text)


def test_from_warns_of_results_that_do_not_fit_together(run: Any) -> None:
    ears = Ears()
    run()
    run("read.keep=2", stages=["read"])
    run(from_stage="publish", images=(), reporter=ears)
    assert any("'scale' in use was computed from other numbers" in text for text in ears.heard)


def test_other_photographs_than_those_of_the_results_in_use_are_said(run: Any, toys: Path) -> None:
    ears = Ears()
    run(reporter=ears)
    run(stages=["count"], reporter=ears)
    assert not any("computed from other" in text for text in ears.heard)
    (toys / "images" / "1.txt").write_text("5")
    run(stages=["count"], reporter=ears)
    assert any("'scale' in use was computed from other numbers" in text for text in ears.heard)


def test_unknown_and_repeated_stages_are_refused(run: Any) -> None:
    with pytest.raises(pipeline.RequestError, match=r"Unknown stage 'scal'.*'scale'"):
        run(stages=["read", "scal"])
    with pytest.raises(pipeline.RequestError, match="named twice"):
        run(stages=["read", "scale", "read"])
    with pytest.raises(pipeline.RequestError, match="--from nowhere"):
        run(from_stage="nowhere")


def test_force_computes_anew_and_once(run: Any) -> None:
    run()
    assert run(force=True) == ALL_RAN
    assert run(force=True, stages=["scale"], images=()) == {"scale": "ran"}


def test_dry_run_tells_and_does_nothing(run: Any, toys: Path) -> None:
    assert run(dry_run=True) == {
        "read": "would run", "scale": "would run", "count": "would run", "publish": "would run"
    }  # fmt: skip
    assert not (toys / "w").exists()
    run()
    before = artifact_bytes(toys / "w")
    assert run("scale.factor=3", dry_run=True) == {
        "read": "cached", "scale": "would run", "count": "unknown", "publish": "unknown"
    }  # fmt: skip
    assert artifact_bytes(toys / "w") == before


@pytest.mark.parametrize(
    ("number", "said"),
    [
        (errno.ENOSPC, r"is full \(\d+\.\d MB left\)"),
        (errno.EDQUOT, r"takes no more from you \(Disk quota exceeded\)"),
        (errno.EFBIG, r"takes no more from you \(File too large\)"),
    ],
)
def test_a_quota_is_not_called_a_full_disk(tmp_path: Path, number: int, said: str) -> None:
    told = explained(OSError(number, os.strerror(number)), "fit", tmp_path)
    assert isinstance(told, pipeline.RequestError)
    assert re.search(f"{said}; the stage 'fit' could not .* make room", str(told))


@pytest.mark.parametrize(
    ("how", "error", "text"),
    [
        ("data", "ReconstructionError", "share too little"),
        ("bug", "StageError", r"a fault of ours: ZeroDivisionError: oops \(toy.py, line \d+\)"),
        ("exit", "StageError", "a fault of ours: SystemExit: 7"),
        ("disk", "RequestError", "is full .* Nothing computed before is lost"),
    ],
)
def test_failure_keeps_what_was_computed(
    run: Any, toys: Path, how: str, error: str, text: str
) -> None:
    with pytest.raises(getattr(pipeline, error), match=text):
        run(f"count.fail={how}")
    states = {s.name: s.state for s in pipeline.status(workspace=toys / "w")}
    assert states == {"read": "cached", "scale": "cached", "count": "failed", "publish": "missing"}
    failed = pipeline.status(workspace=toys / "w")[2]
    assert failed.failure
    assert run() == {"read": "cached", "scale": "cached", "count": "ran", "publish": "ran"}
    assert all(s.failure is None for s in pipeline.status(workspace=toys / "w"))


def test_pictures_of_a_failure_are_kept_until_a_run_succeeds(run: Any, toys: Path) -> None:
    folder = toys / "w" / "count" / "failure"
    with pytest.raises(pipeline.ReconstructionError, match=re.escape(str(folder))):
        run("count.fail=data")
    picture = read_png(folder / "pair.png")
    assert picture.shape == (4, 6, 3) and (picture == 77).all()
    pipeline.clean(toys / "w")  # which leaves the message that names them as well
    assert (folder / "pair.png").exists()
    run()
    assert not folder.exists()


def test_pictures_that_find_no_room_do_not_hide_the_failure(
    run: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(pictures: Any, folder: Path) -> None:
        raise OSError(errno.ENOSPC, "No space left on device", str(folder))

    monkeypatch.setattr("pipeline.artifacts.pictures.Pictures.save", full)
    with pytest.raises(pipeline.ReconstructionError, match=r"add one between them\.$"):
        run("count.fail=data")


def test_figures_may_be_numpy_s(run: Any, toys: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def count(self: Any, context: Any) -> None:
        context.save(context.load("numbers"))
        context.summarize(total=np.int64(7), mean=np.float32(0.5), all=np.bool_(True))

    monkeypatch.setattr("toy.ScaleStage.run", count)
    run(stages=["read", "scale"])
    found = pipeline.status(workspace=toys / "w")
    assert found[1].summary == {"total": 7, "mean": 0.5, "all": True}


def test_a_stage_may_provide_a_kind_for_some_input_only(run: Any, toys: Path) -> None:
    run()
    without = pipeline.status(workspace=toys / "w")
    assert {s.state for s in without} == {"cached"}
    states = run("scale.note=true")  # the same numbers come out in the end
    assert states == {"read": "cached", "scale": "ran", "count": "ran", "publish": "cached"}
    assert {s.state for s in pipeline.status(workspace=toys / "w")} == {"cached"}
    folder = next(s for s in pipeline.status(workspace=toys / "w") if s.name == "scale").folder
    assert folder and (Path(folder) / "metrics" / "metrics.json").exists()
    assert run()["count"] == "cached"


def test_interrupted_stage_resumes_to_the_same_bytes(run: Any, toys: Path) -> None:
    run("count.steps=31")
    whole = artifact_bytes(toys / "w")
    (toys / "w").rename(toys / "w1")
    with pytest.raises(KeyboardInterrupt):
        run("count.steps=31", "count.fail=interrupt")
    # The failing config has another key, so its checkpoint is not touched by the other.
    assert run("count.steps=31")["count"] == "ran"
    with pytest.raises(KeyboardInterrupt):
        run("count.steps=33", "count.fail=interrupt")
    assert pipeline.status(workspace=toys / "w")[2].resumable
    assert run("count.steps=33", "count.fail=interrupt")["count"] == "resumed"
    run("count.steps=31")
    now = artifact_bytes(toys / "w")
    assert {name: now[name] for name in whole} == whole


def test_damaged_result_is_set_aside_and_made_anew(
    run: Any, toys: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run()
    workspace = toys / "w"
    whole = artifact_bytes(workspace)
    victim = next(name for name in whole if name.startswith("scale/"))
    (workspace / victim).write_text(whole[victim].decode().replace("8", "9"))  # same size
    after = run("count.steps=7")  # loads it: the checksum tells
    assert after["scale"] == "ran"
    assert "damaged" in capsys.readouterr().err
    assert (workspace / victim).read_bytes() == whole[victim]
    (workspace / victim).write_text("short")  # the size tells, without loading
    assert run("count.steps=7")["scale"] == "ran"
    assert (workspace / victim).read_bytes() == whole[victim]


def test_result_without_manifest_never_existed(run: Any, toys: Path) -> None:
    run()
    folder = Store(toys / "w").current("count").folder  # type: ignore[union-attr]
    (folder / "manifest.json").unlink()
    assert run() == {**ALL_CACHED, "count": "ran"}


def test_two_processes_share_one_computation(run: Any, toys: Path) -> None:
    outcomes: list[dict[str, str]] = []
    threads = [
        threading.Thread(target=lambda: outcomes.append(run("count.step_seconds=0.02")))
        for _ in range(2)
    ]
    for thread in threads:
        thread.start()
        time.sleep(0.1)
    for thread in threads:
        thread.join()
    assert sorted(outcome["count"] for outcome in outcomes) == ["cached", "ran"]


def test_results_link_follows_the_setting(run: Any, toys: Path) -> None:
    run("publish.title=first")
    run("publish.title=second")
    assert (toys / "w" / "results" / "viewer.html").read_text().startswith("second")
    run("publish.title=first")
    assert (toys / "w" / "results" / "viewer.html").read_text().startswith("first")


def test_manifest_tells_everything(run: Any, toys: Path) -> None:
    started = time.perf_counter()
    run()
    elapsed = time.perf_counter() - started
    result = Store(toys / "w").current("count")
    assert result is not None
    manifest = json.loads((result.folder / "manifest.json").read_text())
    assert manifest["stage"] == "count"
    assert manifest["key"].startswith(result.folder.name)
    assert manifest["config"]["steps"] == 30
    assert manifest["inputs"]["numbers"]["stage"] == "scale"
    assert manifest["warnings"] == ["this is only a toy"]
    assert set(manifest["outputs"]["metrics"]["files"]) == {
        "metrics.json", *(f"step_{k}.txt" for k in range(5))
    }  # fmt: skip
    assert manifest["wall_seconds"] <= elapsed
    assert manifest["peak_memory_mb"] > 1


def test_workspace_remembers_its_photographs(run: Any) -> None:
    run()
    assert run("scale.factor=5", images=()) == {"scale": "ran", "count": "ran", "publish": "ran"}
    assert run("read.keep=1", images=(), stages=["read", "scale"])["read"] == "ran"


def test_a_mistyped_workspace_remembers_nothing(run: Any, toys: Path) -> None:
    with pytest.raises(pipeline.RequestError, match="w remembers none: no run was started there"):
        run(images=())
    assert not (toys / "w").exists()


def test_photographs_that_are_away_for_a_while_are_not_forgotten(run: Any, toys: Path) -> None:
    run()
    (toys / "images").rename(toys / "elsewhere")
    assert run("scale.factor=5", images=())["scale"] == "ran"
    found = pipeline.status(workspace=toys / "w")
    assert [stage.state for stage in found] == ["cached"] * 3, "all but what reads them"
    for ask in (lambda: run("read.keep=1", images=()), lambda: status_of(toys, "read")):
        with pytest.raises(pipeline.RequestError, match="images can't be read"):
            ask()
    (toys / "elsewhere").rename(toys / "images")
    assert run("read.keep=1", images=())["read"] == "ran"


def status_of(toys: Path, *stages: str) -> Any:
    return pipeline.status(workspace=toys / "w", stages=stages)


def test_photographs_are_read_again_with_other_settings(run: Any) -> None:
    run()
    assert "read" not in run(images=())
    assert run("read.keep=1", images=())["read"] == "ran"
    assert "read" not in run("read.keep=1", images=()), "what is there is what is asked for"
    assert run("scale.factor=5", images=())["read"] == "cached"  # the preset's setting again


def test_settings_that_change_nothing_are_said(run: Any) -> None:
    ears = Ears()
    run()
    assert run("read.keep=1", images=(), stages=["publish"], reporter=ears) == {"publish": "cached"}
    assert any("given for 'read' change nothing in this run" in text for text in ears.heard)


def test_what_prepares_runs_after_what_reads_and_before_the_rest(
    run: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("toy.ScaleStage.prepares", True)
    assert next(iter(run(stages=["read"]))) == "read"
    assert list(run(stages=["count"])) == ["read", "scale", "count"]
    assert list(run(stages=["read", "count"])) == ["read", "scale", "count"]
    assert list(run(stages=["publish"], images=())) == ["publish"]
