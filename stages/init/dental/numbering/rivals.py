"""By how much a labelling beats its rivals, and which numbers these leave in doubt.

Landmarks of neighbouring teeth lie alike, so that rows shifted by a tooth explain them nearly as
well; but what is then laid over each other are pictures of different teeth. The nearest rivals are
therefore judged by how much of the photographs matches on the arch as well.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from stages.dentition.tooth_rows import NO_TOOTH
from stages.init.dental.numbering.labellings.scorer import (
    Labelling,
    Scored,
    ViewLabels,
)

Doubts = tuple[float, ...]

#: No number is surer than this: a doubt of 0 means that a person has said it.
LEAST_DOUBT = 1e-4
#: Least doubt of a crown that another labelling, nearly as good, names otherwise: it is marked.
NEAR_DOUBT = 0.12
#: Evidence (log, twice) of the logarithm of the share of a pair that matches over that by a rival
#: (first added to both: a share as good as none). By logistic regression over rivals whose rows are
#: shifted against each other, of fourteen patients, each counting the same; without any one of
#: them it is 4.4 to 5.4.
PICTURE_WEIGHT, NO_SHARE = 4.7, 0.002
#: It says at most 12 against nine rivals in ten: those that are worse than the best by more than
#: that and the least margin are not asked, and not more than the nearest ones.
PICTURED_WINDOW, PICTURED = 18.0, 3
#: Labellings count as different ones when they name more crowns differently than this that tie the
#: photographs to each other.
SAME_BUT_FOR = 2


@dataclass(frozen=True)
class Margins:
    """By how much a labelling beats others (log evidence, twice); infinite where there are none.

    Attributes:
        cameras: over those that match the photographs to each other in another way.
        numbers: over those that rename several crowns, but nearly all of them shown by no other
            photograph: numbers would change, the scene would hardly.
        local: over those that rename a crown or two.
    """

    cameras: float = math.inf
    numbers: float = math.inf
    local: float = math.inf


def margins(best: Scored, others: list[Scored]) -> Margins:
    """By how much the best labelling beats others of each sort."""
    sorts: list[list[float]] = [[], [], []]
    for other in others:
        count, shared = differences(best.labelling, other.labelling)
        if count:
            sort = 0 if shared > SAME_BUT_FOR else 1 if count > SAME_BUT_FOR else 2
            sorts[sort].append(other.score - best.score)
    return Margins(*(min(gaps, default=math.inf) for gaps in sorts))


def judged_by_pictures(
    best: Scored, others: list[Scored], shares: Callable[[Scored], Mapping[tuple[int, int], float]]
) -> tuple[Scored, list[Scored]]:
    """The best labelling when the pictures are asked, too, and all others with what they say.

    Args:
        best, others: by the landmarks.
        shares: of a labelling, pair of views -> the share of what both see that matches.
    """
    rivals: list[Scored] = []
    for other in sorted(others, key=lambda s: (s.score, s.labelling.labels)):
        if other.score > best.score + PICTURED_WINDOW or len(rivals) == PICTURED:
            break
        if not any(_alike(known, other) for known in (best, *rivals)):
            rivals.append(other)
    if not rivals:
        return best, others
    mine = shares(best)
    costs = [_picture_cost(best, mine, rival, shares(rival)) for rival in rivals]

    def judged(other: Scored) -> Scored:
        # what differs from a rival in a crown or two has its pictures
        if not _alike(best, other):
            for rival, cost in zip(rivals, costs, strict=True):
                if _alike(rival, other):
                    return replace(other, score=other.score + cost)
        return other

    after = [judged(other) for other in others]
    # others may be a trace better than the best, and were not worth a change
    asked = [new for old, new in zip(others, after, strict=True) if new is not old]
    winner = min(asked, key=lambda s: (s.score, s.labelling.labels))
    if winner.score >= best.score:
        return best, after
    return winner, [best, *(other for other in after if other is not winner)]


def _alike(a: Scored, b: Scored) -> bool:
    """Do two labellings match the photographs to each other in the same way?"""
    return differences(a.labelling, b.labelling)[1] <= SAME_BUT_FOR


def _picture_cost(
    best: Scored, mine: Mapping[tuple[int, int], float],
    rival: Scored, theirs: Mapping[tuple[int, int], float],
) -> float:  # fmt: skip
    """What the pictures speak against a rival, of pairs that it lays over each other otherwise."""
    cost = 0.0
    for pair in sorted(mine.keys() & theirs.keys()):
        one, other = (_ties(scored.labelling, *pair) for scored in (best, rival))
        if 2 * len(one & other) < len(one | other):
            cost += math.log((mine[pair] + NO_SHARE) / (theirs[pair] + NO_SHARE))
    return PICTURE_WEIGHT * cost


def _ties(labelling: Labelling, first: int, second: int) -> set[tuple[int, int, int]]:
    """Jaw and places in the rows of the crowns that are one tooth in two views."""
    return {
        (jaw, k, row.index(label))
        for jaw in (0, 1)
        for row in (labelling.labels[second][jaw],)
        for k, label in enumerate(labelling.labels[first][jaw])
        if label != NO_TOOTH and label in row
    }


def differences(a: Labelling, b: Labelling) -> tuple[int, int]:
    """How many crowns two labellings name differently, the ends of the rows apart.

    Returns:
        All of them, and those that by either labelling another photograph shows as well. These
        alone tie the photographs to each other: the others can be renamed, and no camera turns.
    """
    shown = [_shown(a), _shown(b)]
    count = shared = 0
    for view, (mine, theirs) in enumerate(zip(a.labels, b.labels, strict=True)):
        for jaw in (0, 1):
            inner = slice(1, -1)
            for both in zip(mine[jaw][inner], theirs[jaw][inner], strict=True):
                if both[0] == both[1] or NO_TOOTH in both:
                    continue
                count += 1
                shared += any(
                    by[jaw, label] - {view} for by, label in zip(shown, both, strict=True)
                )
    return count, shared


def _shown(labelling: Labelling) -> dict[tuple[int, int], set[int]]:
    """(Jaw, position) -> the photographs that show this tooth."""
    found: dict[tuple[int, int], set[int]] = defaultdict(set)
    for view, both in enumerate(labelling.labels):
        for jaw, row in enumerate(both):
            for label in row:
                found[jaw, label].add(view)
    return found


def label_doubts(
    best: Scored, others: list[Scored], least_margin: float
) -> list[tuple[Doubts, Doubts]]:
    """Probability, view by view and row by row, that each crown's label is another one.

    Every labelling that was solved counts by its evidence; of equal ones the best counts. Where one
    within the least margin renames several crowns, these have `NEAR_DOUBT` at least.

    Args:
        best: the labelling chosen.
        others: all others that were solved.
        least_margin: below this another labelling is nearly as good.
    """
    found: dict[tuple[ViewLabels, ...], Scored] = {}
    for scored in (best, *others):
        labels = scored.labelling.labels
        known = found.get(labels)
        if len(labels) == len(best.labelling.labels) and (
            known is None or scored.score < known.score
        ):
            found[labels] = scored
    least = min(scored.score for scored in found.values())
    weights = {labels: np.exp(-(s.score - least) / 2) for labels, s in found.items()}
    total = sum(weights.values())
    near = [
        labels
        for labels, scored in found.items()
        if scored.score < best.score + least_margin
        and differences(best.labelling, scored.labelling)[0] > SAME_BUT_FOR
    ]

    def doubt(number: int, jaw: int, k: int) -> float:
        label = best.labelling.labels[number][jaw][k]
        share = sum(w for other, w in weights.items() if other[number][jaw][k] != label) / total
        rivalled = any(other[number][jaw][k] != label for other in near)
        return float(np.clip(share, NEAR_DOUBT if rivalled else LEAST_DOUBT, 1.0))

    result = []
    for number, chosen in enumerate(best.labelling.labels):
        upper, lower = (
            tuple(doubt(number, jaw, k) for k in range(len(row))) for jaw, row in enumerate(chosen)
        )
        result.append((upper, lower))
    return result
