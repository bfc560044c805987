"""The pages of a run, written when a run ends unless nothing that they show has changed."""

from __future__ import annotations

import hashlib
import json
import os
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Self

from pipeline.config import Config
from pipeline.errors import PipelineError
from pipeline.files import sha256_file
from pipeline.installed import ROOT, module_command
from pipeline.pages.page import CHECK, REPORT
from pipeline.process.native import ONE_THREAD
from pipeline.running.reporter import Reporter
from pipeline.store import MANIFEST, Store, read_own, write_sealed

#: What the pages were last made from, and their checksums.
PAGES = "pages.json"
#: Files of a workspace that the pages show something of, besides the results in use.
_SHOWN = ("request.json", "teeth.yaml", "compare/comparison.json", "*/failure.json")
#: What draws them.
_DRAWING = (".py", ".html", ".css", ".js")


class DrawnBeside:
    """Draws the pages in a process of its own (`pipeline.studies.report.beside`).

    It begins beside the last two stages, which leave a core idle now and then; once they are done,
    little is left to draw. Use as a context manager: the process ends with it.

    Args:
        stages: of the run, in order.
    """

    def __init__(self, workspace: Path, config: Config, stages: Sequence[str]) -> None:
        self._workspace = Path(os.path.realpath(workspace))
        self._last = stages[-2:] if config.run.report and config.threads > 1 else ()
        self._process: subprocess.Popen[str] | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        if self._process is not None:
            self._process.kill()
            self._process.communicate()

    def stage_started(self, stage: str) -> None:
        """A stage begins to compute."""
        if stage not in self._last:
            return
        if self._process is None:
            command = [*module_command("pipeline.studies.report.beside"), str(self._workspace)]
            environment = {
                **os.environ, **ONE_THREAD,
                # what this process found its plug-ins by
                "PYTHONPATH": os.pathsep.join(filter(None, sys.path)),
            }  # fmt: skip
            with suppress(OSError):
                self._process = subprocess.Popen(
                    command, env=environment, stdin=subprocess.PIPE, stdout=subprocess.PIPE,
                    stderr=subprocess.DEVNULL, text=True, encoding="utf-8",
                )  # fmt: skip
        with suppress(OSError):  # it died; the pages are written here then
            self._tell("draw")

    def _tell(self, what: str) -> None:
        if self._process is not None and self._process.stdin is not None:
            self._process.stdin.write(f"{what}\n")
            self._process.stdin.flush()

    def write(self) -> None:
        """Write the pages; here, where the process is not there or does not answer.

        Raises:
            PipelineError: they can't be written.
        """
        from pipeline.studies.report import run_report

        answer = None
        with suppress(OSError, ValueError):
            self._tell("write")
            if self._process is not None and self._process.stdout is not None:
                answer = json.loads(self._process.stdout.readline())
        if answer is None:
            run_report(self._workspace)
        elif answer["error"] is not None:
            raise PipelineError(answer["error"])


def write_pages(
    workspace: Path, config: Config, reporter: Reporter, drawing: DrawnBeside
) -> tuple[Path | None, Path | None]:
    """Write the report, and the page to put the teeth right where there are any.

    Whatever goes wrong with it is said, and harms nothing else.
    """
    if not config.run.report:
        return None, None
    check = workspace / CHECK
    try:
        state = _state(workspace, config)
        if read_own(workspace / PAGES) != {"made_from": state, **_written(workspace)}:
            drawing.write()
            write_sealed(workspace / PAGES, {"made_from": state, **_written(workspace)})
    except Exception as error:
        reporter.message(f"The report could not be written: {error}")
        return None, None
    return workspace / REPORT, check if check.is_file() else None


def _written(workspace: Path) -> dict[str, str]:
    pages = (workspace / REPORT, workspace / CHECK)
    return {page.name: sha256_file(page) for page in pages if page.is_file()}


def _state(workspace: Path, config: Config) -> str:
    """Hash of all that the pages are made from."""
    digest = hashlib.sha256()
    sections = {name: section.model_dump(mode="json") for name, section in config.sections.items()}
    for told in (workspace.resolve().name, config.run.model_dump(mode="json"), sections):
        digest.update(repr(told).encode(errors="surrogateescape"))
    for path in _shown(workspace):
        digest.update(repr(path).encode(errors="surrogateescape"))
        with suppress(OSError):
            digest.update(path.read_bytes())
    for home in (ROOT / "pipeline", ROOT / "stages"):
        for path in sorted(home.rglob("*")):
            if path.suffix in _DRAWING:
                found = path.stat()
                digest.update(repr((path.name, found.st_size, found.st_mtime_ns)).encode())
    return digest.hexdigest()


def _shown(workspace: Path) -> Iterator[Path]:
    for pattern in _SHOWN:
        yield from sorted(workspace.glob(pattern))
    store = Store(workspace)
    for pointer in sorted(workspace.glob("*/current.json")):
        yield pointer
        used = store.pointer(pointer.parent.name)
        if used is not None:
            yield store.folder(pointer.parent.name, used["key"]) / MANIFEST
