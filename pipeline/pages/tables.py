"""Tables for a page, and those of the artifact `metrics`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar

from pipeline.artifacts.metrics import Scores
from pipeline.pages.page import number


@dataclass(frozen=True)
class Cell:
    """A cell: what is shown, and the number to sort by, if it is one."""

    text: str
    value: float | None = None
    best: bool = False


@dataclass(frozen=True)
class Table:
    """A table.

    Attributes:
        head: the columns' names.
        rows: cells by row.
        sums: rows at the end that sum up the others.
        caption: what it shows.
        sortable: a click on a column sorts by it.
        stacked: on a narrow screen each row is a block of its own, each figure with its column's
            name; a wide screen shows all columns without scrolling.
    """

    macro: ClassVar[str] = "table"
    head: Sequence[str]
    rows: Sequence[Sequence[Cell]]
    sums: Sequence[Sequence[Cell]] = ()
    caption: str = ""
    sortable: bool = False
    stacked: bool = False

    @property
    def numeric(self) -> list[bool]:
        """For each column: does it hold numbers?"""
        rows = [*self.rows, *self.sums]
        return [
            any(row[k].value is not None for row in rows) and k > 0 for k in range(len(self.head))
        ]


def cell(value: Any, digits: int = 2) -> Cell:
    """A cell of a text or a number."""
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    return Cell(number(value, digits), float(value) if is_number else None)


@dataclass(frozen=True)
class Figure:
    """How a figure of a view is shown: its name, factor and digits."""

    title: str
    digits: int
    factor: float = 1.0


FIGURES = {
    "psnr": Figure("PSNR dB", 2),
    "ssim": Figure("SSIM", 3),
    "lpips": Figure("LPIPS", 3),
    "flip": Figure("FLIP", 3),
    "detail": Figure("fine detail %", 0, 100),
    "psnr_mask": Figure("PSNR in masks dB", 2),
    "ssim_mask": Figure("SSIM in masks", 3),
    "coverage": Figure("covered %", 1, 100),
    "unsupported": Figure("never photographed %", 1, 100),
    "pixels": Figure("pixels scored %", 1, 100),
}


def figure_cell(name: str, value: Any) -> Cell:
    """A figure of `FIGURES` (or any other) as a cell."""
    shown = FIGURES.get(name, Figure(name, 3))
    if not isinstance(value, int | float) or isinstance(value, bool):
        return cell(value)
    return Cell(number(float(value) * shown.factor, shown.digits), float(value))


def views_table(scores: Scores, labels: Mapping[str, str]) -> Table:
    """The figures of each view, with their mean.

    Args:
        scores: the figures of each view, and their mean.
        labels: view name -> how it is shown.
    """
    views = scores.views
    found = {name for figures in views.values() for name in figures}
    names = [name for name in FIGURES if name in found]
    names += sorted(
        name for name in found - set(FIGURES)
        if all(isinstance(f.get(name), int | float | None) for f in views.values())
    )  # fmt: skip
    names = [name for name in names if any(f.get(name) is not None for f in views.values())]
    rows = [
        [Cell(labels.get(view, view)), *(figure_cell(name, figures.get(name)) for name in names)]
        for view, figures in sorted(views.items())
    ]
    mean = scores.mean
    sums = [[Cell("mean"), *(figure_cell(name, mean.get(name)) for name in names)]] if mean else []
    head = ["view", *(FIGURES.get(name, Figure(name, 3)).title for name in names)]
    return Table(head, rows, sums, sortable=True)


#: Readable names of pose figures; others are shown as they are.
POSES = {
    "rotation_deg": "rotation error, degrees",
    "translation_percent": "position error, % of the largest distance between cameras",
    "ate_rmse": "absolute trajectory error (root mean square)",
    "rpe_rotation_deg": "relative pose error, degrees",
    "rpe_translation": "relative pose error, translation",
    "auc_5": "AUC of relative poses at 5 degrees",
    "auc_10": "AUC of relative poses at 10 degrees",
    "auc_30": "AUC of relative poses at 30 degrees",
    "focal_error_percent": "focal length error, %",
    "views": "views with a known camera",
    "placed": "of these placed",
    "alignment": "aligned by",
}


def block_table(block: Mapping[str, Any], titles: Mapping[str, str]) -> Table:
    """Nested figures ({"rotation_deg": {"median": 0.1}}) as a table of two columns."""
    rows: list[list[Cell]] = []
    for name in [*(n for n in titles if n in block), *sorted(set(block) - set(titles))]:
        value = block[name]
        title = titles.get(name, name.replace("_", " "))
        if isinstance(value, Mapping):
            rows += [
                [Cell(f"{title}, {part}"), cell(inner, 3)] for part, inner in value.items()
                if isinstance(inner, int | float | str)
            ]  # fmt: skip
        elif isinstance(value, int | float | str):
            rows.append([Cell(title), cell(value, 3)])
    return Table(("figure", "value"), rows)


@dataclass(frozen=True)
class Cost:
    """What a stage cost, with the lengths of its bars in percent."""

    name: str
    wall: float
    cpu: float
    memory: float
    wall_bar: float = 0.0
    cpu_bar: float = 0.0
    memory_bar: float = 0.0


@dataclass(frozen=True)
class Costs:
    """Costs of all stages, and their sum."""

    stages: Sequence[Cost] = field(default_factory=tuple)
    wall: float = 0.0
    cpu: float = 0.0
    memory: float = 0.0


def costs(manifests: Mapping[str, Mapping[str, Any]]) -> Costs:
    """Stage name -> manifest, as costs."""
    raw = [
        Cost(name, float(m["wall_seconds"]), float(m["cpu_seconds"]), float(m["peak_memory_mb"]))
        for name, m in manifests.items() if m
    ]  # fmt: skip
    longest = max((max(c.wall, c.cpu) for c in raw), default=0.0) or 1.0
    most = max((c.memory for c in raw), default=0.0) or 1.0
    return Costs(
        [
            Cost(
                c.name, c.wall, c.cpu, c.memory, 100 * c.wall / longest, 100 * c.cpu / longest,
                100 * c.memory / most,
            )
            for c in raw
        ],
        sum(c.wall for c in raw), sum(c.cpu for c in raw),
        max((c.memory for c in raw), default=0.0),
    )  # fmt: skip
