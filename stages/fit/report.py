"""What the page about a run says of the fit."""

from __future__ import annotations

import csv
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from pipeline.pages.charts import Chart, line_chart
from pipeline.pages.page import number
from pipeline.pages.parts import Block, Card, Grid, Heading, Section
from pipeline.pages.pictures import Picture, from_file
from pipeline.stage import Parts

if TYPE_CHECKING:
    from pipeline.pages.case import Case

#: Previews on the page at most.
MOST_PREVIEWS = 4


def size(case: Case) -> Iterator[Card]:
    """How many Gaussians the scene has."""
    figures = case.figures()
    if "gaussians" in figures:
        yield Card(number(figures["gaussians"]), "Gaussians in the scene")


def course(case: Case) -> Iterator[Section]:
    """Loss, PSNR and number of Gaussians over the iterations, and the previews."""
    folder = case.folder("fit", "pictures")
    if folder is None:
        return
    charts, previews = _charts(folder / "curve.csv"), _previews(folder)
    if not charts and not previews:
        return
    blocks: list[Block] = [Grid(charts)]
    if previews:
        blocks += [Heading("As it went: photograph and render"), Grid(previews, "wide")]
    yield Section("Fit", blocks, "loss and previews")


def _charts(path: Path) -> list[Chart]:
    rows = _curve(path)
    x = rows.get("iteration", ())
    if len(x) < 2:
        return []
    return [
        line_chart(
            x, {name: rows[name]}, ("iteration", title),
            f"{title}: from {rows[name][0]:.6g} to {rows[name][-1]:.6g} in {x[-1]:.0f} iterations.",
            log=log,
        )
        for name, title, log in (
            ("loss", "loss (running mean)", True),
            ("psnr", "PSNR of training views, dB", False),
            ("gaussians", "Gaussians", False),
        )
        if name in rows
    ]  # fmt: skip


def _curve(path: Path) -> dict[str, list[float]]:
    if not path.is_file():
        return {}
    with path.open(newline="") as stream:
        lines = list(csv.DictReader(stream))
    return {name: [float(line[name]) for line in lines] for name in (lines[0] if lines else ())}


def _previews(folder: Path) -> list[Picture]:
    """Some of the pictures that were drawn on the way, the first and the last among them."""
    paths = sorted(folder.glob("fit_*.png"), key=lambda path: int(path.stem[4:]))
    chosen = {round(k) for k in np.linspace(0, len(paths) - 1, MOST_PREVIEWS)} if paths else ()
    return [
        from_file(paths[k], f"Photograph and render after {int(paths[k].stem[4:])} iterations.",
                  f"after {int(paths[k].stem[4:])} iterations", 900)
        for k in sorted(chosen)
    ]  # fmt: skip


PARTS: Parts = {"fit": course, "number of Gaussians": size}
