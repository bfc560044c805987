"""The last crown of a row.

Where it ends may be hidden, and so may a tooth before it, so that neither its landmarks nor its
place in the row tell which tooth it is. But what is seen of it lies within its tooth: a crown as
wide as a molar is no premolar, and one that begins where a premolar does is no molar behind it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import lru_cache

from pipeline.artifacts.dental.fdi import Jaw
from stages.dentition.tooth_rows import NO_TOOTH, POSITIONS, Labels
from stages.init.dental.cameras.bundle import Adjusted
from stages.init.dental.numbering.sightings import SeenRow
from stages.init.dental.template import PAPILLA, landmark_index

#: How far a crown reaches beyond its tooth's papillae, towards the row and outward, and standard
#: deviations of that, as shares of the band of teeth. Of rows of twelve patients whose last crown
#: was numbered right: -.05 +- .06 beyond the inner papilla, -.03 +- .13 beyond the outer one.
INNER_SLACK, INNER_DEVIATION = 0.05, 0.08
OUTER_SLACK, OUTER_DEVIATION = 0.05, 0.12
#: An end costs no more than this (evidence): its outline may be wrong altogether.
MOST_COST = 16.0


def ends_cost(
    rows: Sequence[tuple[SeenRow, SeenRow]], views: Sequence[int],
    labels: Sequence[tuple[Labels, Labels]], adjusted: Adjusted,
) -> float:  # fmt: skip
    """Twice the negative log likelihood of how far the last crowns of all rows reach.

    Args:
        rows: of all photographs.
        views, labels: of a labelling.
        adjusted: its solution.
    """
    total = 0.0
    for number, (view, both) in enumerate(zip(views, labels, strict=True)):
        ends = [
            (row, end, label, outward)
            for row, own in zip(rows[view], both, strict=True)
            if len(own) > 1
            for end, outward in ((0, -1), (len(own) - 1, 1))
            if (label := own[end]) != NO_TOOTH
        ]
        if not ends:
            continue
        papillae = [
            landmark
            for row, _, label, outward in ends
            for landmark in _papilla_landmarks(row.jaw, label, outward)
        ]
        x = adjusted.project(number, adjusted.points[papillae])[:, 0].tolist()
        for k, (row, end, label, outward) in enumerate(ends):
            # Nothing bounds the last tooth: a wisdom tooth may stand behind it.
            bounded = 0 <= label + outward < POSITIONS
            outer = x[2 * k + 1] if bounded else outward * math.inf
            total += _end_cost(row, end, outward, x[2 * k], outer)
    return total


@lru_cache(maxsize=256)
def _papilla_landmarks(jaw: Jaw, label: int, outward: int) -> tuple[int, int]:
    """The landmarks of a tooth's papillae, towards the row's middle and outward (any where there is
    none)."""
    inner, outer = min(label, label - outward), min(label, label + outward)
    within = inner, min(max(outer, 0), POSITIONS - 2)
    first, second = (landmark_index(jaw, PAPILLA, papilla) for papilla in within)
    return first, second


def _end_cost(row: SeenRow, end: int, outward: int, inner: float, outer: float) -> float:
    """Cost of what a crown shows beyond the place of its tooth."""
    seen = (float(row.lefts[end]), float(row.rights[end]))
    seen_inner, seen_outer = seen if outward > 0 else seen[::-1]
    before = outward * (inner - seen_inner) / row.band - INNER_SLACK
    beyond = outward * (seen_outer - outer) / row.band - OUTER_SLACK
    cost = max(before / INNER_DEVIATION, 0.0) ** 2 + max(beyond / OUTER_DEVIATION, 0.0) ** 2
    return float(min(cost, MOST_COST))


def end_labels(labels: Labels, most_hidden: int) -> list[Labels]:
    """A row with other labels for its first or last crown: teeth before it hidden, or not."""
    result = []
    for end, beside, outward in ((0, 1, -1), (len(labels) - 1, len(labels) - 2, 1)):
        if len(labels) < 3 or labels[beside] == NO_TOOTH:
            continue
        for hidden in range(most_hidden + 1):
            label = labels[beside] + outward * (1 + hidden)
            if 0 <= label < POSITIONS and label != labels[end]:
                result.append((*labels[:end], label, *labels[end + 1 :]))
    return result


def hidden_at_ends(labels: Labels, absent: frozenset[int]) -> int:
    """How many teeth are hidden before the first or last crown of a row.

    Args:
        labels: positions of the row's crowns.
        absent: positions of this jaw that are missing in the patient.
    """
    count = 0
    for one, two in {(labels[0], labels[1]), (labels[-2], labels[-1])} if len(labels) > 2 else ():
        if NO_TOOTH not in (one, two):
            count += sum(p not in absent for p in range(one + 1, two))
    return count
