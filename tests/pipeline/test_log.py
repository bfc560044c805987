"""The log of a run, what a second run is said to cost, and going on with the last settings."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

import pipeline
from pipeline.errors import PipelineError, RequestError
from pipeline.front import log
from pipeline.front.progress import cost, make_reporter
from pipeline.running.outcomes import StageOutcome
from pipeline.running.reporter import Reporter
from pipeline.workspace import read_request


class Heard(Reporter):
    """Keeps what it is told."""

    def __init__(self) -> None:
        self.messages: list[str] = []
        self.foretold: list[StageOutcome] = []

    def message(self, text: str) -> None:
        self.messages.append(text)

    def foreseen(self, stages: list[StageOutcome]) -> None:
        self.foretold = stages


def logs(folder: Path) -> list[str]:
    return [path.read_text() for path in sorted((folder / "w" / "logs").iterdir())]


def test_each_run_leaves_a_log(run: Any, toys: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run("scale.factor=3")
    [text] = logs(toys)
    assert "scale.factor=3" in text
    assert "scale: starts" in text and "peak memory mb" in text
    assert text.rstrip().endswith("done")
    monkeypatch.setattr(log, "KEPT", 1)
    run()
    assert len(logs(toys)) == 1, "the newest stay"
    [last] = (toys / "w" / "logs").iterdir()
    last.rename(last.with_name("run_2999-01-01_000000_1.log"))  # since then the clock was set back
    run("scale.factor=4")
    [text] = logs(toys)
    assert "scale.factor=4" in text


def test_a_fault_comes_with_its_trace(
    run: Any, toys: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(self: Any, context: Any) -> None:
        raise ZeroDivisionError("in the middle")

    monkeypatch.setattr("toy.ScaleStage.run", broken)
    with pytest.raises(PipelineError):
        run()
    [text] = logs(toys)
    assert "exit status 1" in text
    assert "Traceback" in text and "ZeroDivisionError: in the middle" in text


def test_a_log_that_cannot_be_written_harms_nothing(run: Any, toys: Path) -> None:
    (toys / "w").mkdir()
    (toys / "w" / "logs").write_text("in the way")
    heard = Heard()
    assert run(reporter=heard)["scale"] == "ran"
    assert any(text.startswith("No log is written") for text in heard.messages)


def test_a_full_disk_ends_the_log_and_not_the_run(
    run: Any, toys: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    full = Path("/dev/full")
    if not full.exists():
        pytest.skip("there is no /dev/full here")
    monkeypatch.setattr(
        log.Log, "_open", lambda self: setattr(self, "_stream", full.open("a"))
    )  # fmt: skip
    assert run()["scale"] == "ran"


def test_a_log_has_a_length(run: Any, toys: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(log, "MOST_BYTES", 200)
    run()
    [text] = logs(toys)
    assert "The log is cut here" in text and text.rstrip().endswith("done")
    assert len(text) < 700


def test_what_a_second_run_costs(run: Any) -> None:
    heard = Heard()
    run(reporter=heard)
    assert cost(heard.foretold) == "", "nothing is known of a first one"
    run(reporter=heard)
    assert cost(heard.foretold) == "Cached: everything. Nothing is computed."
    run("scale.factor=3", reporter=heard)
    told = cost(heard.foretold)
    assert told.startswith("Cached: read; To be computed: scale (")
    assert "unless" in told and "count" in told


def test_a_run_without_photographs_goes_on_with_the_last_settings(run: Any, toys: Path) -> None:
    run("scale.factor=3")
    heard = Heard()
    again = pipeline.run(workspace=toys / "w", from_stage="scale", reporter=heard)
    assert {stage.action for stage in again.stages} == {"cached"}
    assert any("--set scale.factor=3" in text for text in heard.messages)
    other = pipeline.run(workspace=toys / "w", overrides=["scale.factor=5"])
    assert {stage.name: stage.action for stage in other.stages}["scale"] == "ran"
    assert read_request(toys / "w")["overrides"] == ["scale.factor=5"]
    fresh = pipeline.run(
        workspace=toys / "w", preset=toys / "toy.yaml", reporter=(quiet := Heard())
    )
    assert fresh.stages and not any("As in the" in text for text in quiet.messages)


def test_what_is_lacking_and_where_to_begin(run: Any, toys: Path) -> None:
    run(stages=["read"])
    with pytest.raises(RequestError) as refused:
        pipeline.run(workspace=toys / "w", from_stage="publish")
    text = str(refused.value)
    assert "which no earlier stage" in text and "It holds" in text and "--from " in text


def test_quiet_and_verbose(run: Any, capsys: pytest.CaptureFixture[str]) -> None:
    run(reporter=make_reporter(quiet=True))
    assert capsys.readouterr().err == ""
    run("scale.factor=3", reporter=make_reporter(verbose=True))
    told = capsys.readouterr().err
    assert "key " in told and "wall seconds" in told
