"""The report of a comparison: one self-contained page."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.artifacts.cameras import Camera
from pipeline.pages.charts import Chart, camera_plot, match_matrix
from pipeline.pages.directions import Similarity
from pipeline.pages.page import write_page
from pipeline.studies.compare.poses import Motion
from pipeline.studies.report.compared import compared_table


def write_report(
    out: Path,
    figures: Mapping[str, Any],
    cameras: Sequence[tuple[str, Sequence[Camera], Motion | None]],
    photos: Mapping[str, str],
) -> None:
    """Write the page.

    Args:
        figures: what comparison.json says.
        cameras: title, cameras and what brings them into the world of the last ones.
        photos: as `colmap_run.photo_names` has them.
    """
    named = [
        (title, [_named(camera, photos) for camera in found], motion)
        for title, found, motion in cameras
    ]
    write_page(
        "pipeline.studies.compare", "compare.html", out,
        title=Path(figures["workspace"]).resolve().name,
        figures=figures,
        tables=[compared_table(described) for described in figures["tables"]],
        charts=_charts(figures, named),
    )  # fmt: skip


def _named(camera: Camera, photos: Mapping[str, str]) -> Camera:
    """A camera that is called like its photograph, where that is known."""
    return replace(camera, name=Path(photos.get(f"{camera.name}.png", camera.name)).stem)


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
