"""The order of the teeth along a row, as a hidden Markov chain.

Crowns come from left to right. A crown's looks are the evidence; from one crown to the next the
position grows by one, more where a tooth is missing or was not found; a crown may be none at all.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping

import numpy as np
import numpy.typing as npt

from pipeline.artifacts.dental.fdi import Jaw, permanent_of, teeth_of
from pipeline.artifacts.teeth import Crown

Array = npt.NDArray[np.float64]
Labels = tuple[int, ...]

#: Positions along a row, patient's right to left, the midline between 6 and 7; and the label of a
#: crown that is no tooth.
POSITIONS = 14
NO_TOOTH = -1
#: Log probability of a position where a person has said another.
SAID_OTHERWISE = -60.0
#: Least probability of any position by looks.
LEAST_BY_LOOKS = 2e-3
#: Costs are negative log probabilities: of each position passed over between two crowns, next to
#: each other or apart; of a crown that is no tooth of the row; of one that is the rest of the one
#: before, where it may be: of 80 neighbours that look like one tooth ten are.
SKIPPED_COST, NO_TOOTH_COST, PART_COST = 3.0, 4.5, 2.1


def position_evidence(numbers: Mapping[int, float], jaw: Jaw) -> Array:
    """[14] log probability of each position along the row by a crown's looks."""
    order = teeth_of(jaw)
    share = np.zeros(POSITIONS)
    for tooth, probability in numbers.items():
        if permanent_of(tooth) in order:
            share[order.index(permanent_of(tooth))] += probability
    if share.sum() <= 0:
        share[:] = 1.0
    spread = 1 - LEAST_BY_LOOKS * POSITIONS
    return np.asarray(np.log(spread * share / share.sum() + LEAST_BY_LOOKS))


def number_is_said(crown: Crown) -> bool:
    """Whether a person has said the crown's number."""
    return crown.doubt == 0 and crown.number != 0


def believed(crown: Crown) -> Mapping[int, float]:
    """FDI number -> probability: by its looks, or what a person has said."""
    return {crown.number: 1.0} if number_is_said(crown) else crown.numbers


def crown_evidence(crown: Crown, jaw: Jaw) -> Array:
    """[14] log probability of each position; a person's word leaves no other, and none at all to
    a wisdom tooth, which stands behind the row."""
    if number_is_said(crown):
        said = np.array(teeth_of(jaw)) == permanent_of(crown.number)
        return np.where(said, 0.0, SAID_OTHERWISE)
    return position_evidence(crown.numbers, jaw)


def row_probabilities(
    evidence: Array, weights: Array | None = None, spacing: Array | None = None
) -> Array:
    """Probabilities of each crown's position in its row.

    Args:
        evidence: [n, 14] log probability of each position by looks, crowns from left to right.
        weights: [n] as how many crowns each counts in being no tooth; None: as one.
        spacing: [n, 14, 14] log likelihood of the position before and that of each crown, by how
            far they are apart.

    Returns:
        [n, 15] probabilities of the positions and (last) of being no tooth of this row.
    """
    count = len(evidence)
    if count == 0:
        return np.zeros((0, POSITIONS + 1))
    # A state is the last position taken, 0: none yet; p + 1: position p.
    states = POSITIONS + 1
    step = np.full((states, states), -np.inf)
    for a in range(states):
        for b in range(a + 1, states):
            step[a, b] = 0.0 if a == 0 else -SKIPPED_COST * (b - a - 1)
    steps = np.repeat(step[None], count, axis=0)
    if spacing is not None:
        steps[:, 1:, 1:] += spacing
    stay = -(NO_TOOTH_COST + np.log(POSITIONS)) * (np.ones(count) if weights is None else weights)
    forward = np.full((count + 1, states), -np.inf)
    forward[0, 0] = 0.0
    for k in range(count):
        moved = np.logaddexp.reduce(forward[k][:, None] + steps[k], axis=0)
        moved[1:] += evidence[k]
        forward[k + 1] = np.logaddexp(moved, forward[k] + stay[k])
    backward = np.zeros((count + 1, states))
    for k in range(count - 1, -1, -1):
        ahead = backward[k + 1].copy()
        ahead[1:] += evidence[k]
        taken = np.logaddexp.reduce(steps[k] + ahead[None], axis=1)
        backward[k] = np.logaddexp(taken, backward[k + 1] + stay[k])
    total = float(backward[0, 0])
    result = np.zeros((count, POSITIONS + 1))
    for k in range(count):
        arrive = np.logaddexp.reduce(forward[k][:, None] + steps[k], axis=0)[1:]
        result[k, :POSITIONS] = np.exp(arrive + evidence[k] + backward[k + 1][1:] - total)
        result[k, POSITIONS] = np.exp(
            np.logaddexp.reduce(forward[k] + stay[k] + backward[k + 1]) - total
        )
    return result


def best_rows(
    evidence: Array, count: int, wholes: Collection[int] = ()
) -> list[tuple[float, Labels]]:
    """The most probable labellings of a row, best first.

    Args:
        evidence: [n, 14] as for `row_probabilities`.
        count: how many at most.
        wholes: the first of each two neighbours that may be parts of one crown.

    Returns:
        (cost, labels): cost is the negative log probability; a label is a position or `NO_TOOTH`.
        Parts of one crown have the same.
    """
    none = NO_TOOTH_COST + float(np.log(POSITIONS))
    partial: dict[int, list[tuple[float, Labels]]] = {-1: [(0.0, ())]}
    for k, crown in enumerate(evidence):
        following: dict[int, list[tuple[float, Labels]]] = {}
        for last, rows in partial.items():
            for cost, labels in rows:
                following.setdefault(last, []).append((cost + none, (*labels, NO_TOOTH)))
                if k - 1 in wholes and labels[-1] == last and labels[-2:-1] != (last,):
                    more = cost + PART_COST - float(crown[last])
                    following[last].append((more, (*labels, last)))
                for position in range(last + 1, POSITIONS):
                    skipped = 0 if last < 0 else position - last - 1
                    more = cost + SKIPPED_COST * skipped - float(crown[position])
                    following.setdefault(position, []).append((more, (*labels, position)))
        partial = {last: sorted(rows)[:count] for last, rows in following.items()}
    return sorted(row for rows in partial.values() for row in rows)[:count]
