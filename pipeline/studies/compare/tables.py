"""The tables of a comparison, for the terminal, for Markdown and for the page."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

DASH = "–"


@dataclass(frozen=True)
class Table:
    """A table.

    Attributes:
        title: what is compared.
        explanation: what the columns mean.
        head: names of the columns.
        rows: cells as text.
        notes: (row, what is to be said of it).
    """

    title: str
    explanation: str
    head: Sequence[str]
    rows: Sequence[Sequence[str]]
    notes: Sequence[tuple[str, str]] = ()

    def described(self) -> dict[str, Any]:
        """The table for JSON."""
        return {
            "title": self.title, "explanation": self.explanation, "head": list(self.head),
            "rows": [list(row) for row in self.rows], "notes": [list(note) for note in self.notes],
        }  # fmt: skip


def tables_of(figures: Mapping[str, Any]) -> list[Table]:
    """All tables of a comparison's figures."""
    tables = [_cameras(figures), _points(figures)]
    if "fits" in figures:
        tables.append(_fits(figures))
    return [table for table in tables if table.rows]


def _cameras(figures: Mapping[str, Any]) -> Table:
    truth = figures["reference"] == "ground truth"
    unit = figures["units"] if figures["units"] == "mm" else "units"
    head = [
        "cameras", "registered", "models", "focal / side", "rotation °", "between views °",
        "position %", f"ATE, {unit}", "focal %", "s",
    ]  # fmt: skip
    rows, notes = [], []
    for row in figures["cameras"]:
        errors = row.get("errors") or {}
        sizes = row.get("model_sizes", [])
        models = str(row.get("models", "")) + (f" ({', '.join(map(str, sizes))})" if sizes else "")
        rows.append([
            row["name"], f"{row['registered']}/{row['views']}", models,
            _number(row.get("focal_per_side"), 3), _pair(errors.get("rotation_deg")),
            _pair(errors.get("relative_rotation_deg")), _pair(errors.get("translation_percent")),
            _number(errors.get("ate_rmse"), 3),
            _number(errors.get("focal_percent"), 1, sign=True),
            _number(row.get("seconds"), 1),
        ])  # fmt: skip
        notes += [(row["name"], row[key]) for key in ("failure", "why_not_all") if row.get(key)]
    against = (
        "Errors against the true cameras"
        if truth
        else f"Differences from {figures['reference']}: agreement, not errors"
        if figures["reference"]
        else "Nothing to measure against"
    )
    known, views = figures["reference_views"], len(figures["views"])
    if 0 < known < views:
        against += f" (of the {known} of {views} views that have a camera there)"
    return Table(
        "Cameras",
        f"{against}, after a similarity of the cameras' centres and orientations; median / largest "
        "over the views; the rotations between views need no alignment. Position in % of the "
        "largest distance between cameras. Seconds of ours include the stages before.",
        head, rows, notes,
    )  # fmt: skip


def _points(figures: Mapping[str, Any]) -> Table:
    rows = figures["points"]
    notes = [(row["name"], row["failure"]) for row in rows if row.get("failure")]
    notes += [
        (row["name"], f"of its models the points are those of number {row['model']}, the largest")
        for row in rows if row.get("model")
    ]  # fmt: skip
    if any("mesh" in row for row in rows):
        unit = figures["units"] if figures["units"] == "mm" else "units"
        near = next(
            (r["mesh"]["covered_within"] for r in rows if r.get("mesh", {}).get("accuracy")), 0
        )
        head = [
            "points", "count", "on the mesh", f"accuracy, {unit}", f"completeness, {unit}",
            f"covered %, within {near:.2g}",
        ]  # fmt: skip
        cells = [
            [
                row["name"], f"{row['points']:,}",
                _number(row.get("mesh", {}).get("points_on_mesh"), 0),
                _pair(row.get("mesh", {}).get("accuracy"), "p90"),
                _pair(row.get("mesh", {}).get("completeness"), "p90"),
                _number(row.get("mesh", {}).get("covered_percent"), 1),
            ]
            for row in rows
        ]  # fmt: skip
        text = (
            "Distances between the points and the mesh, median / 90 %. Only points that lie over "
            "the mesh in the true views count; completeness is over what two true views see. "
            "Aligned by the cameras, then by ICP with scale."
        )
        return Table("Points", text, head, cells, notes)
    if not any("cloud" in row for row in rows):
        text = (
            "How many there are: without a true surface (--mesh) or a model of COLMAP's, no more."
        )
        counts = [[row["name"], f"{row['points']:,}"] for row in rows]
        return Table("Points", text, ["points", "count"], counts, notes)
    head = ["points", "count", "to COLMAP's, %", "from COLMAP's, %"]
    cells = [
        [
            row["name"], f"{row['points']:,}",
            _pair(row.get("cloud", {}).get("to_other_percent"), "p90"),
            _pair(row.get("cloud", {}).get("from_other_percent"), "p90"),
        ]
        for row in rows
    ]  # fmt: skip
    text = (
        "Distance of our points to COLMAP's nearest, and back, in % of the extent of COLMAP's "
        f"points ({figures['points_to']}); median / 90 %. COLMAP's are sparse: the way back tells "
        "more. Aligned by the cameras."
    )
    return Table("Points", text, head, cells, notes)


def _fits(figures: Mapping[str, Any]) -> Table:
    rows = figures["fits"]
    protocols = [
        name for name in ("registered", "refined") if any(f"held_out_{name}" in r for r in rows)
    ]
    head = ["fit started from", "views", "iterations", "Gaussians", "PSNR dB", "SSIM"]
    head += [f"held out, {name}: PSNR dB / SSIM" for name in protocols] + ["s"]
    cells, notes = [], []
    for row in rows:
        held = [row.get(f"held_out_{name}") for name in protocols]
        cells.append([
            row["start"], _number(row.get("views"), 0), _number(row.get("iterations"), 0),
            _number(row.get("gaussians"), 0), _number(row.get("psnr"), 2),
            _number(row.get("ssim"), 3),
            *(f"{h['psnr']:.2f} / {h['ssim']:.3f}" if h else DASH for h in held),
            _number(row.get("seconds"), 1),
        ])  # fmt: skip
        if row.get("failure"):
            notes.append((row["start"], row["failure"]))
    text = (
        "The same fit, with the settings of this workspace. PSNR and SSIM of the input views, "
        "which the fit has seen; seconds of all stages, without COLMAP's own."
    )
    if figures.get("fits_from"):
        text += (
            f" COLMAP's model: {figures['fits_from']}. From its points, align and sap are left out."
        )
    return Table("Fits", text, head, cells, notes)


def _number(value: float | None, digits: int, sign: bool = False) -> str:
    if value is None:
        return DASH
    return f"{value:+.{digits}f}" if sign else f"{value:,.{digits}f}"


def _pair(values: Mapping[str, float] | None, second: str = "max") -> str:
    if not values:
        return DASH
    return f"{values['median']:.3g} / {values[second]:.3g}"


def markdown(tables: Sequence[Table]) -> str:
    """The tables as Markdown."""
    parts = ["# Comparison with COLMAP\n"]
    for table in tables:
        parts.append(f"## {table.title}\n\n{table.explanation}\n")
        parts.append("| " + " | ".join(table.head) + " |\n" + "|" + "---|" * len(table.head))
        parts += ["| " + " | ".join(row) + " |" for row in table.rows]
        parts.append("")
        parts += [f"- **{name}**: {text}" for name, text in table.notes]
        if table.notes:
            parts.append("")
    return "\n".join(parts) + "\n"


def print_tables(tables: Sequence[Table]) -> None:
    """The tables on the terminal."""
    from rich.console import Console
    from rich.table import Table as RichTable

    console = Console(highlight=False)
    if not console.is_terminal:
        console = Console(highlight=False, width=200)
    for table in tables:
        shown = RichTable(box=None, pad_edge=False, header_style="bold")
        for number, name in enumerate(table.head):
            shown.add_column(name, justify="left" if number == 0 else "right")
        for row in table.rows:
            shown.add_row(*row)
        console.print(f"\n[bold]{table.title}[/]")
        console.print(table.explanation, markup=False)
        console.print(shown)
        for name, text in table.notes:
            console.print(f"[yellow]{name}[/]: ", end="")
            console.print(text, markup=False)
