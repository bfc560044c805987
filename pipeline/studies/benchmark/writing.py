"""A benchmark's results as Markdown and CSV."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pipeline.files import write_atomic

CSV_COLUMNS = (
    "table", "protocol", "known_cameras", "method", "views", "scoring", "figure", "mean", "std",
    "n", "failed",
)  # fmt: skip


def write_tables(results: Mapping[str, Any], folder: Path) -> None:
    """Write ``tables.md`` and ``tables.csv``.

    Args:
        results: what ``results.json`` holds.
    """
    write_atomic(folder / "tables.md", markdown(results))
    write_atomic(folder / "tables.csv", csv_text(results))


def markdown(results: Mapping[str, Any]) -> str:
    """All tables, the conclusions, what failed and why, and what it was measured with."""
    parts = [f"# {results['title']}", results["note"]]
    for table in results["tables"]:
        parts.append(f"## {table['title']}")
        if table["note"]:
            parts.append(table["note"])
        if table["conclusions"]:
            parts.append("\n".join(f"- {text}" for text in table["conclusions"]))
        parts += [grid_markdown(grid) for grid in table["grids"]]
    unfinished = [cell for cell in results["cells"] if cell["status"] != "done"]
    if unfinished:
        parts.append("## What failed, and why")
        parts.append("\n".join(f"- {_described(cell)}: {cell['reason']}" for cell in unfinished))
    measured = results["machine"]
    parts.append(
        f"Measured on {measured['processor']}, {measured['cores']} cores, {measured['jobs']} "
        f"cell{'s' if measured['jobs'] > 1 else ''} at a time with {measured['threads']} "
        f"thread{'s' if measured['threads'] > 1 else ''} each; dentalsplat "
        f"{results['versions']['dentalsplat']}, Python {results['versions']['python']}."
    )
    return "\n\n".join(parts) + "\n"


def grid_markdown(grid: Mapping[str, Any]) -> str:
    """One grid: its caption, a Markdown table with aligned columns, its footnotes."""
    table = [grid["columns"], *grid["rows"]]
    escaped = [[entry.replace("|", "\\|") for entry in line] for line in table]
    widths = [max(len(line[k]) for line in escaped) for k in range(len(grid["columns"]))]

    def row(entries: list[str]) -> str:
        first, *rest = zip(entries, widths, strict=True)
        padded = [first[0].ljust(first[1]), *(entry.rjust(width) for entry, width in rest)]
        return f"| {' | '.join(padded)} |"

    rule = [":" + "-" * (widths[0] - 1), *("-" * (width - 1) + ":" for width in widths[1:])]
    lines = [row(escaped[0]), row(rule), *(row(line) for line in escaped[1:])]
    notes = "".join(f"\n\n{text}" for text in dict.fromkeys(grid["footnotes"]))
    caption = grid["caption"][0].upper() + grid["caption"][1:]
    return f"**{grid['title']}.** {caption}.\n\n" + "\n".join(lines) + notes


def csv_text(results: Mapping[str, Any]) -> str:
    """A line per table, method, number of views and figure; empty where there is nothing."""
    stream = io.StringIO()
    writer = csv.DictWriter(stream, CSV_COLUMNS, lineterminator="\n")
    writer.writeheader()
    for table in results["tables"]:
        about = {"table": table["name"], **{k: table[k] for k in ("protocol", "known_cameras")}}
        for entry in table["figures"]:
            writer.writerow({**about, **entry})
    return stream.getvalue()


def _described(cell: Mapping[str, Any]) -> str:
    return f"{cell['scene']}, {cell['views']} views, {cell['method']} ({cell['status']})"
