"""`teeth.csv`: the teeth of `teeth.json` as a table, a row each, for spreadsheets and registers."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping
from typing import Any

from pipeline.artifacts.dental.fdi import is_left, is_primary

COLUMNS = (
    "fdi", "universal", "name", "jaw", "side", "dentition", "doubt", "x", "y", "z", "spread",
    "width", "height", "unit", "photographs",
)  # fmt: skip

_PERMANENT = (
    "central incisor", "lateral incisor", "canine", "first premolar", "second premolar",
    "first molar", "second molar", "third molar",
)  # fmt: skip
_PRIMARY = (*_PERMANENT[:3], "first molar", "second molar")


def tooth_name(fdi: int) -> str:
    """A tooth in words: ``upper right central incisor``, ``lower left primary second molar``."""
    jaw = "upper" if fdi // 10 in (1, 2, 5, 6) else "lower"
    side = "left" if is_left(fdi) else "right"
    place = fdi % 10 - 1
    return f"{jaw} {side} " + (
        f"primary {_PRIMARY[place]}" if is_primary(fdi) else _PERMANENT[place]
    )


def teeth_table(described: Mapping[str, Any]) -> str:
    """The text of `teeth.csv`: RFC 4180, but lines end as text files do here.

    An empty cell: not known. Lengths are in ``unit``, which is ``mm`` or ``arbitrary``.

    Args:
        described: the content of `teeth.json` (`describe_teeth`).
    """
    text = io.StringIO()
    table = csv.writer(text, lineterminator="\n")
    table.writerow(COLUMNS)
    for tooth in described["teeth"]:
        fdi = tooth["fdi"]
        centre = tooth["centre"] or (None, None, None)
        table.writerow(
            (
                fdi, tooth["universal"], tooth_name(fdi), tooth["jaw"],
                "left" if is_left(fdi) else "right", tooth["dentition"], tooth["doubt"], *centre,
                tooth["spread"], tooth["width"], tooth["height"], described["units"],
                len({seen["photograph"] for seen in tooth["seen_in"]}),
            )
        )  # fmt: skip
    return text.getvalue()
