"""Two visits of one patient in one frame: what moved, how far, how sure that is."""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pipeline.running.reporter import Reporter
    from pipeline.studies.register.comparing import Comparison

#: How the command is called where it says how far it is.
NAME = "register"


def run_register(
    first: str | Path, second: str | Path, out: str | Path | None = None, *,
    live: bool = True, reporter: Reporter | None = None,
) -> tuple[Path, str]:  # fmt: skip
    """Compare two finished runs of one patient; see docs/two_visits.md.

    Args:
        first, second: workspaces.
        out: folder for register.json, movements.csv, movements.ply and register.html; None: the
            folder `register` in the second workspace.
        live: whether the page holds both scenes, which are nearly all of its size.
        reporter: hears of the progress.

    Returns:
        The page, and what moved in a few lines.

    Raises:
        RequestError: a workspace holds no finished run with teeth, or the folder can't be written.
        ReconstructionError: the visits are of two patients, or share too few teeth.
    """
    from pipeline.measure import peak_mb_with_children
    from pipeline.running.reporter import Reporter
    from pipeline.studies.register.movement import words
    from pipeline.studies.register.writing import warning

    hears = reporter or Reporter()
    started = time.perf_counter()
    hears.start([NAME])
    try:
        hears.stage_started(NAME, [], False)
        found, page = _registered([Path(first), Path(second)], out, live, hears)
        moved = [tooth for tooth in found.teeth if tooth.certain]
        summary = {
            "teeth": len(found.teeth), "moved": len(moved),
            "page_mb": round(page.stat().st_size / 1e6, 2),
        }  # fmt: skip
        hears.stage_finished(
            NAME, False, {
                "wall_seconds": time.perf_counter() - started,
                "peak_memory_mb": peak_mb_with_children(), "summary": summary,
            },
        )  # fmt: skip
    finally:
        hears.stop()
    lines = [f"{tooth.tooth}: {words(tooth.parts, tooth.half)}" for tooth in moved]
    lines = lines or ["No tooth moved beyond the uncertainty."]
    told = warning(found)
    return page, "\n".join([told, *lines] if told else lines)


def _registered(
    workspaces: list[Path], out: str | Path | None, live: bool, hears: Reporter
) -> tuple[Comparison, Path]:
    """Compare, and write what came of it."""
    from pipeline.errors import RequestError
    from pipeline.process.privacy import kept_for, share_for
    from pipeline.studies.jobs import results_in
    from pipeline.studies.register.comparing import compare_visits
    from pipeline.studies.register.page.writing import write_register_page
    from pipeline.studies.register.visit import names_of, read_visit
    from pipeline.studies.register.writing import write_files
    from pipeline.workspace import read_request

    for workspace in workspaces:
        read_request(workspace)  # no folder is made in what is none
    steps = len(workspaces) + 2
    folder = Path(out) if out is not None else workspaces[1] / "register"
    with kept_for(share_for(workspaces[1])), results_in(folder):
        visits = []
        for number, (workspace, name) in enumerate(
            zip(workspaces, names_of(workspaces), strict=True)
        ):
            hears.progress(NAME, f"read {workspace}", number, steps)
            visits.append(replace(read_visit(workspace), name=name))
        hears.progress(NAME, "compare the teeth", len(visits), steps)
        found = compare_visits(visits[0], visits[1])
        hears.progress(NAME, "write", len(visits) + 1, steps)
        try:
            write_files(found, folder)
        except OSError as error:
            raise RequestError(f"{folder} can't be written to ({error.strerror}).") from error
        return found, write_register_page(found, folder, live)
