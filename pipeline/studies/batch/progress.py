"""What the user sees while a batch runs: a bar on a terminal, plain lines elsewhere."""

from __future__ import annotations

import sys
import time
from collections import Counter
from collections.abc import Mapping
from typing import Any, TextIO

from pipeline.front.progress import Pace, describe, fitting
from pipeline.studies.batch.records import STATES


def outcome(record: Mapping[str, Any]) -> str:
    """What came of a case, in one line."""
    if record["state"] != "done":
        return f"{record['state']}: {record['reason']}"
    parts = ["done"]
    if record["teeth"]:
        parts.append(f"{record['teeth']} teeth")
    if record["placed"] is not None:
        parts.append(f"{record['placed']} of {record['photographs']} photographs placed")
    if record["psnr"] is not None:
        parts.append(f"{record['psnr']:.1f} dB")
    if record["seconds"] is not None:
        parts.append(f"{record['seconds']:.0f} s")
    return ", ".join(parts)


def by_state(counts: Mapping[str, int]) -> str:
    """``12 done, 1 refused, 3 waiting``."""
    return ", ".join(f"{counts[state]} {state}" for state in STATES if counts.get(state))


class Lines:
    """A line for each case that ends, and now and then how all stand."""

    def __init__(
        self, stream: TextIO | None = None, interval: float = 60.0, *, verbose: bool = False
    ) -> None:
        """
        Args:
            stream: where the lines go; default standard error.
            interval: seconds between two lines on how all stand.
            verbose: also say each step of the cases, keys, and memory.
        """
        #: Whether it wants to hear `step`.
        self.verbose = verbose
        self._stream = stream or sys.stderr
        self._interval = interval
        self._last = time.monotonic()
        self._pace = Pace()

    def start(self, total: int) -> None:
        """So many cases are to be brought to an end."""

    def case(self, record: Mapping[str, Any], done: int, total: int) -> None:
        """A case has ended."""
        self.message(f"[{done}/{total}] {record['name']}: {outcome(record)}")
        if self.verbose:
            known = [(name, record.get(name)) for name in ("key", "peak_memory_mb")]
            told = {name: value for name, value in known if value is not None}
            self.message(f"  {record['name']}: {describe(told)}")

    def step(self, record: Mapping[str, Any], text: str) -> None:
        """A case says this of its run."""
        self.message(f"  {record['name']}: {text}")

    def state(self, counts: Counter[str], done: int, total: int) -> None:
        """How all cases stand."""
        now = time.monotonic()
        left = self._pace.time_left("batch", "cases", done, total, now)
        if now - self._last >= self._interval:
            self._last = now
            self.message(", ".join(filter(None, [by_state(counts), left])))

    def message(self, text: str) -> None:
        """Something that the user should know."""
        print(text, file=self._stream, flush=True)

    def stop(self) -> None:
        """The batch is over, well or not."""


class Bar(Lines):
    """A bar with the time left and the cases by state; above it a line for each that went wrong."""

    def __init__(self) -> None:
        super().__init__()
        from rich.console import Console
        from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

        self._console = Console(stderr=True, highlight=False, emoji=False)
        self._display = Progress(
            TextColumn("[bold]cases[/]"), BarColumn(bar_width=24),
            TextColumn("{task.completed}/{task.total}"), TimeElapsedColumn(),
            TextColumn("{task.description}", markup=False), console=self._console, transient=True,
        )  # fmt: skip
        self._task: Any = None

    def start(self, total: int) -> None:
        self._display.start()
        self._task = self._display.add_task("", total=total)

    def case(self, record: Mapping[str, Any], done: int, total: int) -> None:
        if record["state"] != "done":
            self.message(f"{record['name']}: {outcome(record)}")

    def state(self, counts: Counter[str], done: int, total: int) -> None:
        left = self._pace.time_left("batch", "cases", done, total, time.monotonic())
        text = " · ".join(filter(None, [by_state(counts), left]))
        if self._task is not None:
            self._display.update(self._task, completed=done, total=total, description=text)

    def message(self, text: str) -> None:
        self._console.print(text, style="yellow", markup=False)

    def stop(self) -> None:
        self._display.stop()


class Silent(Lines):
    """Says nothing."""

    def message(self, text: str) -> None:
        """Nobody listens."""


def make_progress(quiet: bool = False, verbose: bool = False) -> Lines:
    """What suits standard error; where it is to be verbose, lines that stay."""
    return fitting(
        Silent,
        lambda more: Lines(interval=5.0 if more else 60.0, verbose=more),
        Bar,
        quiet=quiet,
        verbose=verbose,
    )
