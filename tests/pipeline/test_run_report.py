"""A run writes its report, says so, and never fails because of it."""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

import pipeline
from pipeline.cli import app
from pipeline.config import load_config
from pipeline.front.pages import DrawnBeside
from pipeline.running.outcomes import RunSummary
from pipeline.running.reporter import Reporter


class Listener(Reporter):
    def __init__(self) -> None:
        self.heard: list[str] = []

    def message(self, text: str) -> None:
        self.heard.append(text)


def start(toys: Path, *overrides: str, **options: Any) -> RunSummary:
    return pipeline.run(
        toys / "images", workspace=toys / "w", preset=toys / "toy.yaml", overrides=overrides,
        **options,
    )  # fmt: skip


def test_a_run_ends_with_its_report(toys: Path) -> None:
    summary = start(toys, "scale.factor=3")
    assert summary.report == toys / "w" / "report.html"
    assert summary.to_dict()["report"] == str(summary.report)
    page = summary.report.read_text()
    assert "this is only a toy" in page
    assert "scale.factor=3" in page
    keys = [stage.key[:12] for stage in summary.stages if stage.key]
    assert len(keys) == 4 and all(key in page for key in keys)
    assert "up to date" in page and "Not up to date" not in page


@pytest.mark.parametrize("switch", ["report=false", "run.report=false"])
def test_the_report_can_be_left_out(toys: Path, switch: str) -> None:
    assert start(toys, switch).report is None
    assert not (toys / "w" / "report.html").exists()
    assert load_config(toys / "toy.yaml", ["run.threads=3"]).threads == 3


def test_a_failed_stage_is_diagnosed_and_later_results_are_not_shown(toys: Path) -> None:
    start(toys)
    before = pipeline.status(workspace=toys / "w")
    listener = Listener()
    with pytest.raises(pipeline.ReconstructionError):
        start(toys, "count.fail=data", reporter=listener)
    assert any("report.html" in text for text in listener.heard)
    page = (toys / "w" / "report.html").read_text()
    assert "count failed" in page
    assert "Photos &#39;a&#39; and &#39;b&#39; share too little" in page
    assert len(re.findall(r'<img src="data:image/jpeg', page)) == 1
    keys = {stage.name: stage.key or "" for stage in before}
    assert keys["scale"][:12] in page
    assert keys["publish"][:12] not in page


def test_what_shows_an_earlier_run_is_renewed_where_a_stage_refuses(toys: Path) -> None:
    listener = Listener()
    with pytest.raises(pipeline.RequestError, match="is full"):
        start(toys, "count.fail=disk", reporter=listener)
    assert not (toys / "w" / "report.html").exists(), "there is nothing to show yet"
    start(toys)
    with pytest.raises(pipeline.RequestError, match="is full"):
        start(toys, "count.fail=disk", "count.steps=7")
    page = (toys / "w" / "report.html").read_text()
    assert "count failed" in page and "is full" in page
    with pytest.raises(pipeline.RequestError, match=r"count\.stepz"):
        start(toys, "count.stepz=7")
    assert (toys / "w" / "report.html").read_text() == page


def test_what_is_stale_is_said(toys: Path) -> None:
    start(toys)
    (toys / "images" / "1.txt").write_text("9")
    page = pipeline.run_report(toys / "w").read_text()
    assert "Not up to date" in page
    assert "input file changed: 1.txt" in page


def test_what_follows_from_a_lost_result_may_be_stale(toys: Path) -> None:
    start(toys)
    shutil.rmtree(toys / "w" / "count")
    page = pipeline.run_report(toys / "w").read_text()
    (note,) = re.findall(r'<b class="from">Not up to date</b>(.*?)</p>', page)
    assert note.startswith("Perhaps what follows from a stage that has yet to run: publish.")


def test_photographs_that_are_gone_are_no_obstacle(toys: Path) -> None:
    start(toys)
    for path in (toys / "images").iterdir():
        path.unlink()
    page = pipeline.run_report(toys / "w").read_text()
    assert "this is only a toy" in page


def test_a_fault_of_the_report_is_a_message(toys: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(workspace: Path) -> Path:
        raise ZeroDivisionError("oops")

    monkeypatch.setattr("pipeline.studies.report.run_report", broken)
    listener = Listener()
    summary = start(toys, reporter=listener)
    assert summary.report is None
    assert [stage.action for stage in summary.stages] == ["ran"] * 4
    assert listener.heard[-1] == "The report could not be written: oops"
    with pytest.raises(pipeline.ReconstructionError, match="share too little"):
        start(toys, "count.fail=data", reporter=listener)


def test_the_command(toys: Path, capsys: pytest.CaptureFixture[str]) -> None:
    start(toys, "report=false")
    app(["report", "-w", str(toys / "w")], standalone_mode=False)
    assert capsys.readouterr().out.strip() == str(toys / "w" / "report.html")
    assert json.loads((toys / "w" / "request.json").read_text())["overrides"] == ["report=false"]


class TestBesideTheRun:
    """With several threads the pages are drawn in a process of their own."""

    @pytest.fixture
    def ran(self, named_samples: Path, tmp_path: Path) -> Callable[..., RunSummary]:
        def call(**options: Any) -> RunSummary:
            return pipeline.run(
                named_samples, workspace=tmp_path / "w", stages=["views"],
                overrides={"run.threads": 2, "views.long_side": 128}, **options,
            )  # fmt: skip

        return call

    def test_it_writes_them(self, ran: Any, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr("pipeline.studies.report.run_report", None)  # not by this process
        page = ran().report.read_text()
        assert len(re.findall(r'<img src="data:image/jpeg', page)) == 3
        assert "could not be drawn" not in page

    def test_the_same_as_this_process_would(self, ran: Any) -> None:
        beside = re.sub(r"\d\d:\d\d", "", ran().report.read_text())
        here = re.sub(r"\d\d:\d\d", "", pipeline.run_report(ran().workspace).read_text())
        assert beside == here

    def test_what_it_can_not_write_is_said(self, ran: Any, tmp_path: Path) -> None:
        (tmp_path / "w" / "report.html" / "mine").mkdir(parents=True)
        listener = Listener()
        assert ran(reporter=listener).report is None
        assert any("The report could not be written" in text for text in listener.heard)

    def test_when_it_is_killed_this_process_writes_them(
        self, ran: Any, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        write = DrawnBeside.write

        def killed(drawing: DrawnBeside) -> None:
            assert drawing._process is not None
            drawing._process.kill()
            write(drawing)

        monkeypatch.setattr(DrawnBeside, "write", killed)
        assert "views" in ran().report.read_text()
