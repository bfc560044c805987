"""The pages of a run, written when a run ends unless nothing that they show has changed."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

from pipeline.config import Config
from pipeline.files import sha256_file
from pipeline.installed import ROOT
from pipeline.pages.page import CHECK, REPORT
from pipeline.running.reporter import Reporter
from pipeline.store import MANIFEST, Store, read_own, write_sealed

#: What the pages were last made from, and their checksums.
PAGES = "pages.json"
#: Files of a workspace that the pages show something of, besides the results in use.
_SHOWN = ("request.json", "teeth.yaml", "compare/comparison.json", "*/failure.json")
#: What draws them.
_DRAWING = (".py", ".html", ".css", ".js")


def write_pages(
    workspace: Path, config: Config, reporter: Reporter
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
            from pipeline.studies.report import run_report

            run_report(workspace)
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
