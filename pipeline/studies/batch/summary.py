"""``summary.csv`` and ``summary.html`` of a batch: a line for each case, at every moment."""

from __future__ import annotations

import csv
import io
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any
from urllib.parse import quote

from pipeline.files import write_atomic
from pipeline.pages.page import seconds, write_page
from pipeline.studies.batch.records import STATES

#: Measurements of `teeth.json`; in the table each has a value and an uncertainty, millimetres.
MEASURED = (
    "overjet", "overbite", "midline_shift", "intercanine_upper", "intercanine_lower",
    "intermolar_upper", "intermolar_lower",
)  # fmt: skip
COLUMNS = (
    "name", "state", "reason", "like", "photographs", "placed", "teeth", "psnr", "ssim", "seconds",
    "peak_memory_mb", "bytes", "warnings", "attempts", "host", "folder", "viewer", "report",
    "check", *(f"{name}{ending}" for name in MEASURED for ending in ("_mm", "_uncertainty_mm")),
    "overbite_is_estimated",
)  # fmt: skip
#: What a spreadsheet would take for a formula.
_FORMULA = ("=", "+", "-", "@", "\t", "\r")
#: Colours of the states that need a look, and of the good one.
TONES = {"done": "good", "refused": "bad", "wrong": "bad", "fault": "bad", "killed": "bad",
         "duplicate": "warn", "stopped": "warn"}  # fmt: skip


def write_summary(
    out: Path, records: Sequence[Mapping[str, Any]], title: str, note: str = ""
) -> None:
    """Write both files in the batch's folder.

    Args:
        records: all cases, in their order.
        note: how far it is.
    """
    # without the mark spreadsheets take umlauts for two letters each
    write_atomic(out / "summary.csv", f"\ufeff{csv_text(records)}")
    known = {record["id"]: record for record in records}
    counts = Counter(record["state"] for record in records)
    write_page(
        "pipeline.studies.batch", "summary.html", out / "summary.html", title=title, note=note,
        rows=[_row(out, record, known) for record in records],
        states=[(state, meaning, counts[state]) for state, meaning in STATES.items()
                if counts[state]],
    )  # fmt: skip


def csv_text(records: Sequence[Mapping[str, Any]]) -> str:
    """A line per case; empty where nothing is known. Paths begin at the batch's folder."""
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(COLUMNS)
    for record in records:
        place = f"cases/{record['id']}"
        links = {name: f"{place}/{path}" for name, path in record["links"].items()}
        told = {
            **record, "warnings": len(record["warnings"]), "folder": place if links else "",
            "reason": " ".join(record["reason"].split()), 
            **dict.fromkeys(("viewer", "report", "check"), ""), **links,
            **_measurements(record["measured"]),
        }  # fmt: skip
        writer.writerow([_plain(told[name]) for name in COLUMNS])
    return stream.getvalue()


def _measurements(measured: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    """The columns of what was measured on a case's teeth."""
    columns: dict[str, Any] = {}
    for name in MEASURED:
        entry = measured.get(name, {})
        columns[f"{name}_mm"] = entry.get("value")
        columns[f"{name}_uncertainty_mm"] = entry.get("uncertainty")
    estimated = measured.get("overbite", {}).get("estimated")
    columns["overbite_is_estimated"] = None if estimated is None else ("yes" if estimated else "no")
    return columns


def _plain(value: Any) -> Any:
    """A value that a spreadsheet takes for what it is."""
    if isinstance(value, str) and value.startswith(_FORMULA):
        return f"'{value}"
    return "" if value is None else value


def _row(
    out: Path, record: Mapping[str, Any], known: Mapping[str, Mapping[str, Any]]
) -> dict[str, Any]:
    """What the page shows of a case; a duplicate shows what came of the one that it is like."""
    shown = known.get(record["like"], record)
    place = f"cases/{shown['id']}"
    picture = f"thumbnails/{shown['id']}.jpg"
    # that of a case which waits is of an earlier run
    is_shown = shown["state"] != "waiting" and (out / picture).is_file()
    placed = None
    if record["placed"] is not None:
        placed = f"{record['placed']} of {record['photographs']}"
    return {
        **record,
        "tone": TONES.get(record["state"], ""),
        "placed": placed,
        "placed_number": record["placed"],
        "time": seconds(record["seconds"]),
        "overjet": record["measured"].get("overjet"),
        "picture": quote(picture) if is_shown else "",
        "links": [
            (quote(f"{place}/{path}{'/' if name == 'results' else ''}"), name)
            for name, path in shown["links"].items()
        ],
        "log": quote(f"logs/{record['id']}.txt") if record["state"] in ("fault", "killed") else "",
    }
