"""Two visits of one patient in one frame: what moved, how far, how sure that is."""

from __future__ import annotations

from pathlib import Path


def run_register(
    first: str | Path, second: str | Path, out: str | Path | None = None
) -> tuple[Path, str]:
    """Compare two finished runs of one patient; see docs/two_visits.md.

    Args:
        first, second: workspaces.
        out: folder for register.json, movements.csv, movements.ply and register.html; None: the
            folder `register` in the second workspace.

    Returns:
        The page, and what moved in a few lines.

    Raises:
        RequestError: a workspace holds no finished run with teeth, or the folder can't be written.
        ReconstructionError: the visits are of two patients, or share too few teeth.
    """
    from pipeline.errors import RequestError
    from pipeline.studies.register.comparing import compare_visits
    from pipeline.studies.register.movement import words
    from pipeline.studies.register.page.writing import write_register_page
    from pipeline.studies.register.visit import read_visit
    from pipeline.studies.register.writing import write_files

    visits = [read_visit(Path(folder)) for folder in (first, second)]
    found = compare_visits(visits[0], visits[1])
    folder = Path(out) if out is not None else Path(second) / "register"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        write_files(found, folder)
    except OSError as error:
        raise RequestError(f"{folder} can't be written to ({error.strerror}).") from error
    page = write_register_page(found, folder)
    lines = [
        f"{tooth.tooth}: {words(tooth.parts, tooth.half)}" for tooth in found.teeth if tooth.certain
    ]
    return page, "\n".join(lines or ["No tooth moved beyond the uncertainty."])
