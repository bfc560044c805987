"""Mean and spread of the cells' figures over scenes and seeds, and who wins."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

#: Which way is better; figures that are not here are not compared.
HIGHER_IS_BETTER = {"psnr": True, "ssim": True, "lpips": False}

Record = Mapping[str, Any]


@dataclass(frozen=True)
class Summary:
    """One figure over scenes and seeds.

    Attributes:
        mean: over the cells that have the figure; None where none has.
        std: sample standard deviation; None for fewer than two.
        n: how many cells it is the mean of.
        failed: how many cells failed.
    """

    mean: float | None
    std: float | None
    n: int
    failed: int


def summarise(records: Sequence[Record], scoring: str, figure: str) -> Summary:
    """Mean and spread of one figure over cells (each counts the same)."""
    values = [
        v for v in (figure_of(record, scoring, figure) for record in records) if v is not None
    ]
    failed = sum(record["status"] != "done" for record in records)
    if not values:
        return Summary(None, None, 0, failed)
    mean = math.fsum(values) / len(values)
    std = None
    if len(values) > 1:
        std = math.sqrt(math.fsum((v - mean) ** 2 for v in values) / (len(values) - 1))
    return Summary(mean, std, len(values), failed)


def figure_of(record: Record, scoring: str, figure: str) -> float | None:
    """One figure of a cell: None where the cell failed or the figure was not measured.

    Args:
        scoring: ``input``, ``registered`` or ``refined``; ``cost`` for the seconds and the like;
            ``poses`` and ``geometry``, where a figure is a path: ``rotation_deg/median``.
    """
    if record["status"] != "done":
        return None
    if scoring == "cost":
        found = record.get(figure)
    elif scoring in ("poses", "geometry"):
        found = record.get(scoring)
        for part in figure.split("/"):
            found = found.get(part) if isinstance(found, Mapping) else None
    else:
        found = record["figures"].get(scoring, {}).get(figure)
    return float(found) if isinstance(found, int | float) else None


def figures_of(records: Iterable[Record], scoring: str) -> list[str]:
    """Names of the figures that any of the cells has, in the order of the first that has them."""
    names: dict[str, None] = {}
    for record in records:
        if record["status"] == "done":
            if scoring in ("poses", "geometry"):
                names |= dict.fromkeys(_leaves(record.get(scoring, {})))
            else:
                names |= dict.fromkeys(record["figures"].get(scoring, {}))
    return list(names)


def _leaves(tree: Mapping[str, Any], prefix: str = "") -> Iterable[str]:
    for name, value in tree.items():
        if isinstance(value, Mapping):
            yield from _leaves(value, f"{prefix}{name}/")
        elif isinstance(value, int | float) and not isinstance(value, bool):
            yield f"{prefix}{name}"


@dataclass(frozen=True)
class Comparison:
    """Our figure and a rival's, over the cells (scenes, seeds) that both could do."""

    rival: str
    figure: str
    ours: float
    theirs: float

    @property
    def won(self) -> bool:
        """Ours is strictly better."""
        better = self.ours > self.theirs
        return better if HIGHER_IS_BETTER[self.figure] else self.ours < self.theirs


def compare(
    ours: Sequence[Record], rivals: Mapping[str, Sequence[Record]], scoring: str
) -> list[Comparison]:
    """Set our figures beside each rival's.

    Args:
        ours: cells of one number of views.
        rivals: name -> cells of the same number of views.
    """
    found = []
    for name, records in rivals.items():
        for figure in HIGHER_IS_BETTER:
            theirs = _by_place(records, scoring, figure)
            mine = _by_place(ours, scoring, figure)
            common = sorted(mine.keys() & theirs.keys())
            if common:
                a, b = (math.fsum(side[k] for k in common) / len(common) for side in (mine, theirs))
                found.append(Comparison(name, figure, a, b))
    return found


def _by_place(records: Sequence[Record], scoring: str, figure: str) -> dict[tuple[str, int], float]:
    found = {}
    for record in records:
        value = figure_of(record, scoring, figure)
        if value is not None:
            found[record["scene"], record["seed"]] = value
    return found
