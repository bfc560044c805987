"""What the user sees: plain lines where there is no terminal, a live display where there is one."""

from __future__ import annotations

import io
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import typer
from rich.console import Console
from typer.testing import CliRunner

from pipeline.cli import app
from pipeline.front import progress
from pipeline.front.options import answer
from pipeline.front.progress import LineReporter, LiveReporter, Pace, describe


def test_time_left() -> None:
    pace = Pace()
    assert pace.time_left("fit", "steps", 10, 100, now=50.0) == ""  # nothing known yet
    assert pace.time_left("fit", "steps", 20, 100, now=50.5) == ""  # too early to tell
    assert pace.time_left("fit", "steps", 55, 100, now=60.0) == "10 s left"
    assert pace.time_left("fit", "steps", 55, 100, now=650.0) == "10 min left"
    assert pace.time_left("fit", "steps", 100, 100, now=700.0) == ""
    assert pace.time_left("fit", "others", 55, 100, now=800.0) == ""  # another step


def test_time_left_does_not_go_by_the_first_piece_which_waits_for_kernels() -> None:
    pace = Pace()
    said = [pace.time_left("export", "video", n, 200, now=5.0 * (n > 0) + n / 4) for n in range(9)]
    assert said[:5] == [""] * 5
    assert said[5:] == ["49 s left", "48 s left", "48 s left", "48 s left"]


def test_describe() -> None:
    assert describe({"loss": 0.03125, "gaussians": 20000}) == "loss 0.03125, gaussians 20000"


def test_lines_are_few_and_say_what_matters() -> None:
    stream = io.StringIO()
    reporter = LineReporter(stream, interval=0.0)
    reporter.stage_started("fit", ["fit.iterations 5 → 9"], resumed=False)
    reporter.progress("fit", "optimise", 3, 9, loss=0.25)
    figures = {"wall_seconds": 2.0, "summary": {"gaussians": 7}}
    reporter.stage_finished("fit", False, figures)
    reporter.stage_finished("export", True, figures)
    lines = stream.getvalue().splitlines()
    assert lines[0] == "fit: starts (fit.iterations 5 → 9)"
    assert lines[1].startswith("fit: optimise 3/9, loss 0.25")
    assert lines[2] == "fit: done in 2.0 s (gaussians 7)"
    assert lines[3] == "export: cached"
    quiet = io.StringIO()
    rare = LineReporter(quiet, interval=1e9)
    rare.stage_started("fit", [], resumed=True)
    for step in range(100):
        rare.progress("fit", "optimise", step, 100)
    assert quiet.getvalue() == "fit: goes on from its checkpoint\n"


def test_live_display_shows_stage_step_and_loss(monkeypatch) -> None:  # type: ignore[no-untyped-def]
    stream = io.StringIO()
    monkeypatch.setattr(
        "rich.console.Console",
        lambda **_: Console(file=stream, force_terminal=True, width=120, highlight=False),
    )
    reporter = LiveReporter()
    reporter.start(["fit"])
    reporter.stage_started("fit", [], resumed=False)
    reporter.progress("fit", "optimise", 3, 9, loss=0.25)
    reporter._display.refresh()
    reporter.message("fit: careful [now]")
    reporter.stage_finished("fit", False, {"wall_seconds": 2.0, "summary": {"gaussians": 7}})
    reporter.stop()
    shown = stream.getvalue()
    for text in ("fit", "optimise", "loss 0.25", "33 %", "careful [now]", "gaussians 7"):
        assert text in shown
    assert type(progress.make_reporter(quiet=True)) is progress.Reporter, "which says nothing"


#: The commands that say how far they are.
SPEAKING = ("run", "compare", "benchmark", "batch", "register")


def test_quiet_and_verbose_are_the_same_everywhere() -> None:
    """In the help, and so in what the shell completes."""
    commands: dict[str, Any] = typer.main.get_command(app).commands  # type: ignore[attr-defined]
    told = {}
    for name, command in commands.items():
        found = [p for p in command.params if {"-q", "-v"} & set(p.opts)]
        told[name] = [(parameter.opts, parameter.help) for parameter in found]
    assert {name for name, options in told.items() if options} == set(SPEAKING)
    assert all(told[name] == told["run"] for name in SPEAKING)
    assert [options for options, _ in told["run"]] == [["-q", "--quiet"], ["-v", "--verbose"]]


def test_json_is_printed_however_quiet(capsys: pytest.CaptureFixture[str]) -> None:
    def told(**how: bool) -> str:
        answer(lambda: {"teeth": 3}, lambda: print("three teeth"), **how)
        return capsys.readouterr().out

    assert told(as_json=False, quiet=False) == "three teeth\n"
    assert told(as_json=False, quiet=True) == ""
    as_json = told(as_json=True, quiet=False)
    assert as_json == told(as_json=True, quiet=True) == '{\n "teeth": 3\n}\n'


@pytest.mark.parametrize(
    ("terminal", "quiet", "verbose", "what"),
    [
        (True, False, False, "live"), (False, False, False, "lines"), (True, False, True, "more"),
        (False, False, True, "more"), (True, True, False, "silent"), (False, True, True, "silent"),
    ],
)  # fmt: skip
def test_what_fits(
    monkeypatch: pytest.MonkeyPatch, terminal: bool, quiet: bool, verbose: bool, what: str
) -> None:
    monkeypatch.setattr("sys.stderr", SimpleNamespace(isatty=lambda: terminal))
    made = progress.fitting(
        lambda: "silent", lambda more: "more" if more else "lines", lambda: "live",
        quiet=quiet, verbose=verbose,
    )  # fmt: skip
    assert made == what


def test_compare_speaks_as_it_is_told(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """What it computes is another test's; here, who hears of it, and what is printed."""
    heard = []

    def found(*_: Any, reporter: Any, **__: Any) -> SimpleNamespace:
        heard.append(reporter)
        reporter.message("COLMAP runs")
        return SimpleNamespace(figures={"cameras": []}, folder=tmp_path)

    monkeypatch.setattr("pipeline.studies.compare.compare.compare", found)
    monkeypatch.setattr("pipeline.studies.compare.tables.tables_of", lambda _: [])
    shell, base = CliRunner(), ["compare", "-w", str(tmp_path)]
    usual, quiet, more = (shell.invoke(app, [*base, *how]) for how in ([], ["-q"], ["-v"]))
    assert "COLMAP runs" in usual.stderr and "Results: " in usual.stdout
    assert quiet.exit_code == 0 and quiet.output == ""
    assert "COLMAP runs" in more.stderr and heard[2]._verbose and not heard[0]._verbose
    as_json = [shell.invoke(app, [*base, "--json", *how]).stdout for how in ([], ["-q"], ["-v"])]
    assert as_json == ['{\n "cameras": []\n}\n'] * 3
