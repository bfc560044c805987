"""The report of a comparison: one self-contained page."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.artifacts.cameras import Camera
from pipeline.report.figures import Chart, camera_plot, match_matrix
from pipeline.report.geometry import Similarity
from pipeline.report.page import write_page
from pipeline.report.tables import Cell
from pipeline.report.tables import Table as PageTable
from stages.comparison.poses import Motion
from stages.comparison.tables import Table, tables_of


def write_report(
    out: Path,
    figures: Mapping[str, Any],
    cameras: Sequence[tuple[str, Sequence[Camera], Motion | None]],
) -> None:
    """Write the page.

    Args:
        figures: of the comparison.
        cameras: title, cameras and what brings them into the world of the last ones.
    """
    write_page(
        "compare.html", out,
        title=Path(figures["workspace"]).resolve().name,
        figures=figures,
        tables=[(table, _for_page(table)) for table in tables_of(figures)],
        charts=_charts(figures, cameras),
    )  # fmt: skip


def _for_page(table: Table) -> PageTable:
    rows = [
        [Cell(text, None if k == 0 else _value(text)) for k, text in enumerate(row)]
        for row in table.rows
    ]
    return PageTable(table.head, rows)


def _value(text: str) -> float | None:
    try:
        return float(text.split(" / ")[0].replace(",", ""))
    except ValueError:
        return None


def _charts(
    figures: Mapping[str, Any], cameras: Sequence[tuple[str, Sequence[Camera], Motion | None]]
) -> list[Chart]:
    """Cameras seen from above, and what COLMAP matched."""
    charts = []
    if cameras:
        series = [
            (title, found, Similarity(*motion) if motion else None)
            for title, found, motion in cameras
        ]
        charts.append(camera_plot(series, np.zeros((0, 3)), np.zeros((0, 3)), "top"))
    for title, pairs in figures["pairs"].items():
        names = sorted({image for entry in pairs for image in entry["images"]})
        number = {image: k for k, image in enumerate(names)}
        if names:
            table = {
                (number[a], number[b]): entry["inliers"]
                for entry in pairs
                for a, b in [entry["images"]]
            }
            chart = match_matrix([Path(image).stem for image in names], table)
            charts.append(Chart(chart.svg, chart.alt, f"{title}: {chart.caption}"))
    return charts
