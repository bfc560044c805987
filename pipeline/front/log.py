"""A log file for each run, in ``WORKSPACE/logs``: what was asked, what ran, what was said, faults.

It says no more of the photographs than the report does: their file names, where a stage names one.
A log that can't be written is no reason for a run to fail.
"""

from __future__ import annotations

import contextlib
import os
import platform
import time
import traceback
from pathlib import Path
from typing import Any, TextIO

from pipeline.errors import PipelineError
from pipeline.front.progress import LineReporter, describe
from pipeline.installed import library_version
from pipeline.running.outcomes import StageOutcome
from pipeline.running.reporter import Figure, Reporter
from pipeline.workspace import Request

FOLDER = "logs"
#: So many logs are kept, the newest.
KEPT = 20
#: Bytes of one log; what comes after is not written, but for the end of the run.
MOST_BYTES = 2_000_000


class Log(Reporter):
    """Writes what it hears to a file, and hands it on.

    Args:
        request: what the run was asked for.
        inner: hears everything as well.
    """

    def __init__(self, request: Request, inner: Reporter) -> None:
        self._request, self._inner = request, inner
        self._stream: TextIO | None = None
        self._written = 0
        self._lines = LineReporter(self)  # type: ignore[arg-type]  # it only writes
        #: The file, once there is one.
        self.path: Path | None = None

    # What the lines are written to.

    def write(self, text: str, *, last: bool = False) -> int:
        """A line or a part of one; each line gets the time of day."""
        if self._stream is None or (self._written > MOST_BYTES and not last):
            return len(text)
        stamp = time.strftime("%H:%M:%S ")
        lines = "".join(f"{stamp}{line}\n" for line in text.splitlines() if line)
        try:
            self._stream.write(lines)
            self._stream.flush()
            self._written += len(lines)
            if self._written > MOST_BYTES and not last:
                self._stream.write(f"{stamp}The log is cut here: it is {MOST_BYTES} bytes long.\n")
        except (OSError, ValueError):  # a full disk: the run itself says so where it matters
            self._close()
        return len(text)

    def flush(self) -> None:
        """Each line is flushed as it is written."""

    def _open(self) -> None:
        folder = self._request.workspace / FOLDER
        name = time.strftime("run_%Y-%m-%d_%H%M%S") + f"_{os.getpid()}.log"
        try:
            folder.mkdir(exist_ok=True)
            self._stream = (folder / name).open(
                "a", encoding="utf-8", errors="backslashreplace"
            )  # fmt: skip
            self.path = folder / name
            others = [path for path in sorted(folder.glob("run_*.log")) if path != self.path]
            for old in others[: len(others) + 1 - KEPT]:  # a clock set back would name this one
                old.unlink(missing_ok=True)
        except OSError as error:
            if self._stream is None:
                self._inner.message(f"No log is written: {folder} ({error.strerror or error}).")

    def _close(self) -> None:
        if self._stream is not None:
            with contextlib.suppress(OSError, ValueError):
                self._stream.close()
        self._stream = None

    # What a run tells.

    def start(self, stages: list[str]) -> None:
        self._open()
        asked = self._request
        self.write(
            f"dentalsplat {library_version('dentalsplat')}, Python {platform.python_version()}, "
            f"{platform.system()} {platform.machine()}, {time.strftime('%Y-%m-%d %H:%M:%S %z')}"
        )
        self.write(f"preset: {asked.preset or 'default'}; settings: {list(asked.overrides)}")
        self.write(f"stages: {', '.join(stages)}")
        self._inner.start(stages)

    def foreseen(self, stages: list[StageOutcome]) -> None:
        self._lines.foreseen(stages)
        self._inner.foreseen(stages)

    def stage_started(self, stage: str, reasons: list[str], resumed: bool) -> None:
        self._lines.stage_started(stage, reasons, resumed)
        self._inner.stage_started(stage, reasons, resumed)

    def progress(self, stage: str, step: str, done: int, total: int, **figures: Figure) -> None:
        self._lines.progress(stage, step, done, total, **figures)
        self._inner.progress(stage, step, done, total, **figures)

    def stage_finished(self, stage: str, cached: bool, figures: dict[str, Any]) -> None:
        self._lines.stage_finished(stage, cached, figures)
        if not cached:
            costs = {key: figures.get(key) for key in ("cpu_seconds", "peak_memory_mb")}
            self.write(f"{stage}: {describe(costs)}")
        self._inner.stage_finished(stage, cached, figures)

    def message(self, text: str) -> None:
        self.write(f"note: {text}")
        self._inner.message(text)

    def stop(self) -> None:
        self._inner.stop()

    # How it ends.

    def failed(self, error: BaseException) -> None:
        """The run ended in an error; one that is a fault of ours comes with its trace."""
        if isinstance(error, PipelineError):
            self.write(f"failed, exit status {error.exit_status}: {error}", last=True)
        else:
            self.write(f"ended: {type(error).__name__}: {error}", last=True)
        fault = not isinstance(error, PipelineError) or error.exit_status == 1
        if fault and not isinstance(error, KeyboardInterrupt | SystemExit):
            self.write("".join(traceback.format_exception(error)), last=True)
        self._close()

    def done(self) -> None:
        """The run ended well."""
        self.write("done", last=True)
        self._close()
