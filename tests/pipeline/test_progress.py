"""What the user sees: plain lines where there is no terminal, a live display where there is one."""

from __future__ import annotations

import io

from rich.console import Console

from pipeline.front import progress
from pipeline.front.progress import LineReporter, LiveReporter, Pace, describe


def test_time_left() -> None:
    pace = Pace()
    assert pace.time_left("fit", "steps", 10, 100, now=50.0) == ""  # nothing known yet
    assert pace.time_left("fit", "steps", 20, 100, now=50.5) == ""  # too early to tell
    assert pace.time_left("fit", "steps", 55, 100, now=60.0) == "10 s left"
    assert pace.time_left("fit", "steps", 55, 100, now=650.0) == "10 min left"
    assert pace.time_left("fit", "steps", 100, 100, now=700.0) == ""
    assert pace.time_left("fit", "others", 55, 100, now=800.0) == ""  # another step


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
