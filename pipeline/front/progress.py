"""What the user sees while stages run: a live display on a terminal, plain lines elsewhere."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from typing import Any, TextIO, TypeVar

from pipeline.running.outcomes import StageOutcome
from pipeline.running.reporter import Figure, Reporter

Said = TypeVar("Said")


def describe(figures: dict[str, Any]) -> str:
    """``loss 0.031, gaussians 20000``."""
    parts = []
    for name, value in figures.items():
        shown = f"{value:.4g}" if isinstance(value, float) else f"{value}"
        parts.append(f"{name.replace('_', ' ')} {shown}")
    return ", ".join(parts)


def in_words(seconds: float) -> str:
    """``12 s``, ``3 min``."""
    return f"{seconds:.0f} s" if seconds < 90 else f"{seconds / 60:.0f} min"


def cost(stages: list[StageOutcome]) -> str:
    """What a run takes from before and what it computes, with the time that this took last.

    Empty where nothing is there from before.
    """
    if not any(stage.action == "cached" or stage.figures for stage in stages):
        return ""
    parts = []
    for action, text in (
        ("cached", "Cached: {}"), ("would run", "To be computed: {}"),
        ("unknown", "then, unless what they are made from stays the same: {}"),
    ):  # fmt: skip
        found = [stage for stage in stages if stage.action == action]
        if found:
            last = [stage.figures["wall_seconds"] for stage in found if stage.figures]
            told = text.format(", ".join(stage.name for stage in found))
            some = "" if len(last) == len(found) else f"{len(last)} of them "
            if action != "cached" and last:
                told += f" ({some}{in_words(sum(last))} last time)"
            parts.append(told)
    if all(stage.action == "cached" for stage in stages):
        return "Cached: everything. Nothing is computed."
    return "; ".join(parts) + "."


class Pace:
    """Estimates the time left from how fast the step that is going on has gone so far."""

    def __init__(self) -> None:
        self._step: tuple[str, str] | None = None
        #: When the step began and when its first piece was done, with how many there were then.
        self._marks: list[tuple[float, int]] = []

    def time_left(self, stage: str, step: str, done: int, total: int, now: float) -> str:
        """E.g. ``12 s left``; empty while nothing is known.

        Args:
            now: a clock's seconds.
        """
        if self._step != (stage, step):
            self._step, self._marks = (stage, step), [(now, done)]
        if len(self._marks) == 1 and done > self._marks[0][1]:
            # kernels that are compiled or loaded make the first piece slower than any other
            self._marks.append((now, done))
        since, first = self._marks[-1]
        if len(self._marks) == 1 or done <= first or done >= total or now - since < 1.0:
            return ""
        each = min((now - start) / (done - before) for start, before in self._marks)
        return f"{in_words(each * (total - done))} left"


class LineReporter(Reporter):
    """Plain log lines for a file, a pipe or a batch system."""

    def __init__(
        self, stream: TextIO | None = None, interval: float = 5.0, *, verbose: bool = False
    ) -> None:
        """
        Args:
            stream: where the lines go; default standard error.
            interval: seconds between two lines of one stage.
            verbose: also say keys, and what each stage cost.
        """
        self._stream = stream or sys.stderr
        self._verbose = verbose
        self._interval = interval
        self._last = 0.0
        self._pace = Pace()

    def _say(self, text: str) -> None:
        print(text, file=self._stream, flush=True)

    def foreseen(self, stages: list[StageOutcome]) -> None:
        if told := cost(stages):
            self._say(told)
        if self._verbose:
            for stage in stages:
                self._say(f"  {stage.name}: {stage.action}, key {stage.key or 'not known yet'}")

    def stage_started(self, stage: str, reasons: list[str], resumed: bool) -> None:
        self._last = time.monotonic()
        why = f" ({'; '.join(reasons)})" if reasons else ""
        self._say(f"{stage}: {'goes on from its checkpoint' if resumed else 'starts'}{why}")

    def progress(self, stage: str, step: str, done: int, total: int, **figures: Figure) -> None:
        now = time.monotonic()
        left = self._pace.time_left(stage, step, done, total, now)
        if now - self._last < self._interval:
            return
        self._last = now
        more = [describe(figures), left]
        self._say(f"{stage}: {step} {done}/{total}" + "".join(f", {m}" for m in more if m))

    def stage_finished(self, stage: str, cached: bool, figures: dict[str, Any]) -> None:
        if cached:
            self._say(f"{stage}: cached")
        else:
            seconds, summary = figures["wall_seconds"], describe(figures["summary"])
            self._say(f"{stage}: done in {seconds:.1f} s{f' ({summary})' if summary else ''}")
        if self._verbose:
            costs = {key: value for key, value in figures.items() if key != "summary"}
            self._say(f"  {stage}: {describe(costs)}")

    def message(self, text: str) -> None:
        self._say(text)


class LiveReporter(Reporter):
    """A rich progress display: one line per finished stage, a bar for the running one."""

    def __init__(self) -> None:
        from rich.console import Console
        from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

        self._console = Console(stderr=True, highlight=False, emoji=False)
        self._display = Progress(
            TextColumn("[bold]{task.fields[stage]:>9}[/]"),
            BarColumn(bar_width=24),
            TextColumn("{task.percentage:>3.0f} %"),
            TimeElapsedColumn(),
            TextColumn("{task.description}"),
            console=self._console,
            transient=True,
        )
        self._task: Any = None
        self._pace = Pace()

    def start(self, stages: list[str]) -> None:
        self._display.start()

    def foreseen(self, stages: list[StageOutcome]) -> None:
        if told := cost(stages):
            self._console.print(told, style="dim", markup=False)

    def stage_started(self, stage: str, reasons: list[str], resumed: bool) -> None:
        from rich.markup import escape

        text = "goes on from its checkpoint" if resumed else "; ".join(reasons)
        self._task = self._display.add_task(escape(text), total=None, stage=stage)

    def progress(self, stage: str, step: str, done: int, total: int, **figures: Figure) -> None:
        from rich.markup import escape

        left = self._pace.time_left(stage, step, done, total, time.monotonic())
        more = [describe(figures), left]
        text = step + "".join(f" · {part}" for part in more if part)
        self._display.update(self._task, completed=done, total=total, description=escape(text))

    def stage_finished(self, stage: str, cached: bool, figures: dict[str, Any]) -> None:
        from rich.markup import escape

        if self._task is not None:
            self._display.remove_task(self._task)
            self._task = None
        if cached:
            self._console.print(f"[bold]{stage:>9}[/] [dim]cached[/]")
        else:
            text = (
                f"{figures['wall_seconds']:6.1f} s  [dim]{escape(describe(figures['summary']))}[/]"
            )
            self._console.print(f"[bold]{stage:>9}[/] {text}")

    def message(self, text: str) -> None:
        self._console.print(text, style="yellow", markup=False)

    def stop(self) -> None:
        self._display.stop()


def fitting(
    silent: Callable[[], Said], lines: Callable[[bool], Said], live: Callable[[], Said], *,
    quiet: bool, verbose: bool,
) -> Said:  # fmt: skip
    """What says as much as -q and -v ask for (of both -q counts), as suits standard error.

    Args:
        silent: makes what says nothing.
        lines: makes what writes lines that stay; told whether they are to say more.
        live: makes what a terminal shows.
    """
    if quiet:
        return silent()
    return live() if sys.stderr.isatty() and not verbose else lines(verbose)


def make_reporter(quiet: bool = False, verbose: bool = False) -> Reporter:
    """The reporter that suits standard error; where it is to be verbose, lines that stay."""
    return fitting(
        Reporter,
        lambda more: LineReporter(interval=0.5 if more else 5.0, verbose=more),
        LiveReporter,
        quiet=quiet,
        verbose=verbose,
    )
