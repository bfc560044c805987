"""What `pipeline compare` left in a workspace, as tables of a page."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from pipeline.files import read_json
from pipeline.pages.case import Case
from pipeline.pages.tables import Cell, Table

#: Where `pipeline compare` writes, below the workspace.
FOLDER, FILE = "compare", "comparison.json"


@dataclass(frozen=True)
class Compared:
    """A table of a comparison.

    Attributes:
        title, explanation: what is compared, and what the columns mean.
        table: its cells.
        notes: (row, what is to be said of it).
    """

    title: str
    explanation: str
    table: Table
    notes: tuple[tuple[str, str], ...]


def compared_table(described: Mapping[str, Any]) -> Compared:
    """A table as the comparison describes it: title, explanation, head, rows of texts, notes."""
    rows = [
        [Cell(text, None if column == 0 else _value(text)) for column, text in enumerate(row)]
        for row in described["rows"]
    ]
    notes = tuple((str(row), str(text)) for row, text in described["notes"])
    return Compared(
        described["title"], described["explanation"], Table(described["head"], rows), notes
    )


def comparison(case: Case) -> dict[str, Any] | None:
    """The tables of the last comparison, and the stages that were computed anew since then."""
    figures = case.hide(read_json(case.workspace / FOLDER / FILE))
    if not isinstance(figures, dict) or not figures.get("tables"):
        return None
    in_use = {record.name: record.result.key for record in case.stages if record.result}
    then = figures["results"]
    return {
        "tables": [compared_table(described) for described in figures["tables"]],
        "reference": figures["reference"],
        "renewed": [name for name, key in then.items() if in_use.get(name, key) != key],
    }


def _value(text: str) -> float | None:
    try:
        return float(text.split(" / ")[0].replace(",", ""))
    except ValueError:
        return None
