"""Cases that a CSV file lists: name, photographs, settings."""

from __future__ import annotations

import csv
import io
import re
from pathlib import Path

from pipeline.config import anchored
from pipeline.errors import PipelineError, RequestError, nearest
from pipeline.studies.batch.find import Names, as_case
from pipeline.studies.batch.records import Case
from pipeline.untrusted.files import Kind, UnusableFile, read
from pipeline.untrusted.names import printable
from pipeline.untrusted.paths import user_path

LISTING = Kind("a list of cases", 1 << 24)
COLUMNS = ("name", "photographs", "settings")
#: Between several photographs, or several settings, of a case.
SEPARATOR = ";"
#: A first line by which spreadsheets are told what stands between entries.
SAYS_DELIMITER = re.compile(r"sep=[,;\t]\s*$", re.IGNORECASE)


def read_cases(path: Path, names: Names) -> list[Case]:
    """The cases of a CSV file with a head, in its order; paths begin at its folder.

    Columns: ``name``, ``photographs`` (a folder, a film, a pattern, or several of them with ``;``
    between), and ``settings`` (``fit.iterations=500; fit.light=none``), which may be left out.

    Raises:
        RequestError: it can't be read, or its columns are others.
    """
    try:
        text = read(path, LISTING).decode("utf-8-sig")
    except UnusableFile as error:
        raise RequestError(f"The list of cases {path} {error}.") from error
    except UnicodeDecodeError as error:
        raise RequestError(
            f"The list of cases {path} is not text in UTF-8 (byte {error.start}). Save it as CSV "
            "in UTF-8."
        ) from error
    head = text.lstrip().partition("\n")[0]
    delimiter = max(",\t;", key=head.count)
    if SAYS_DELIMITER.match(head):  # the line stays, empty, and counts
        text = text.replace(head, "", 1)
    reader = csv.reader(io.StringIO(text, newline=""), delimiter=delimiter, strict=True)
    try:
        lines = [(reader.line_num, _without_empty_end(row)) for row in reader]
    except csv.Error as error:
        raise RequestError(
            f"The list of cases {path} can't be read as CSV (line {reader.line_num}: {error})."
        ) from error
    lines = [(number, row) for number, row in lines if row]
    columns = [entry.strip().lower() for entry in lines[0][1]] if lines else []
    for column in columns:
        if column not in COLUMNS:
            raise RequestError(
                f"The list of cases {path} has a column '{printable(column[:60])}'; it may have "
                f"{', '.join(COLUMNS)}.{nearest(column, COLUMNS)}"
            )
    if sorted(set(columns)) != sorted(columns) or not {"name", "photographs"} <= set(columns):
        raise RequestError(
            f"The first line of the list of cases {path} must name its columns: "
            f"{', '.join(COLUMNS)} (settings may be left out), each once."
        )
    if len(lines) == 1:
        raise RequestError(f"The list of cases {path} has no cases, only the names of its columns.")
    found, given = [], set[str]()
    for number, row in lines[1:]:
        case = _case(dict(zip(columns, row, strict=False)), len(row) - len(columns), number, path)
        if case.name in given:
            why = f"The name stands in an earlier line already (line {number} of the list)."
            case = Case("", f"{case.name} (line {number})", settled="wrong", reason=why)
        given.add(case.name)
        found.append(Case(**{**vars(case), "id": names.of(case.name)}))
    return found


def _without_empty_end(row: list[str]) -> list[str]:
    """A line without the separators that spreadsheets put where other lines have, or had, more."""
    used = [place for place, entry in enumerate(row, 1) if entry.strip()]
    return row[: max(used, default=0)]


def _case(row: dict[str, str], excess: int, number: int, path: Path) -> Case:
    called = printable(row.get("name", "").strip())
    if not called:
        return Case("", f"line {number}", settled="wrong", reason="It has no name.")
    if excess > 0:
        why = f"Line {number} has {excess} entries too many; put those with a comma in quotes."
        return Case("", called, settled="wrong", reason=why)
    parts = [part.strip() for part in row.get("photographs", "").split(SEPARATOR)]
    if not any(parts):
        return Case("", called, settled="wrong", reason="It names no photographs.")
    try:  # no shell has replaced a ~
        images = [path.parent / user_path(part, "photographs") for part in parts if part]
    except PipelineError as error:
        return Case("", called, settled="wrong", reason=str(error))
    settings = [part.strip() for part in row.get("settings", "").split(SEPARATOR)]
    overrides = tuple(anchored(part, path.parent) for part in settings if part)
    if len(images) == 1 and images[0].is_dir():
        images = _film_in(images[0]) or images
    try:
        return as_case(called, images, overrides)
    except (PipelineError, OSError, ValueError) as error:
        return Case("", called, settled="wrong", reason=str(error))


def _film_in(folder: Path) -> list[Path]:
    """The one film of a folder without photographs."""
    from stages.views.find import is_photograph, is_video

    try:
        files = [entry for entry in folder.iterdir() if entry.name[0] != "."]
    except OSError:  # told when it is read as a folder of photographs
        return []
    films = [entry for entry in files if is_video(entry)]
    return films if len(films) == 1 and not any(is_photograph(entry) for entry in files) else []
