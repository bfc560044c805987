"""Labellings near a given one: other rows, missing teeth, shifts."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations, product

import numpy as np
import numpy.typing as npt

from pipeline.artifacts.dental.fdi import JAWS, teeth_of
from stages.dentition.row_edits import bounded, row_edits, shifted
from stages.dentition.tooth_rows import POSITIONS, Labels
from stages.init.dental.cameras.bundle import Adjusted, adjust, view_angles
from stages.init.dental.cameras.kernels import PER_ARCH, PER_VIEW
from stages.init.dental.numbering.labellings.ends import end_labels, ends_cost
from stages.init.dental.numbering.labellings.scorer import (
    FINAL_STEPS,
    SEARCH_STEPS,
    Labelling,
    Scored,
    Scorer,
    ViewLabels,
)
from stages.init.dental.template import position_of, tooth_at

Array = npt.NDArray[np.float64]
Fixed = dict[tuple[int, int, int], int]

#: When one row's labels are tried against the arch of the other views, its landmarks may still be
#: this far off (mm).
TRIED_DEVIATION = 0.8
#: Edits of a row that look best against that arch and are solved jointly.
JOINT_TRIALS = 12
#: Edits of a photograph that look likeliest and are tried against the other views' arch.
ROW_TRIALS = 24
#: Missing teeth that look likeliest and are solved jointly. Of those of twelve patients that were
#: taken, or came within 15 of the best, the crowns' looks put none behind the 28th.
MISSING_TRIALS = 32
#: Steps of the solver for such a trial.
TRIAL_STEPS = 6
#: An edit must gain this much to be taken.
MIN_GAIN = 1.0
#: Edits taken one after another at most.
MAX_EDITS = 6
#: Up to so many photographs, shifts of two at once are tried.
FEW_VIEWS = 4
#: Labellings next to the best that are solved to the end, to know the margin.
NEAREST = 5
#: Labellings that look less likely than the present one by more than this (evidence) are not tried.
LOOKS_WINDOW = 60.0
#: Up to so many teeth may be hidden before the last crown of a row.
HIDDEN_TEETH = 2


def _allowed(view: int, jaw: int, labels: Labels, fixed: Fixed) -> bool:
    return all(
        labels[crown] == position
        for (v, j, crown), position in fixed.items()
        if (v, j) == (view, jaw)
    )


def _is_allowed(labelling: Labelling, fixed: Fixed) -> bool:
    """The same of a whole labelling."""
    return all(
        _allowed(view, jaw, labelling.labels[number][jaw], fixed)
        for number, view in enumerate(labelling.views)
        for jaw in (0, 1)
    )


def with_row(labelling: Labelling, number: int, jaw: int, labels: Labels) -> Labelling:
    """A labelling with one row replaced, and no tooth missing that this row shows.

    Args:
        number: counts the labelling's views.
    """
    rows: ViewLabels = (
        (labels, labelling.labels[number][1]) if jaw == 0 else (labelling.labels[number][0], labels)
    )
    changed = (*labelling.labels[:number], rows, *labelling.labels[number + 1 :])
    there = {t for t in labelling.absent if t in teeth_of(JAWS[jaw]) and position_of(t) in labels}
    return replace(
        labelling, labels=changed, absent=labelling.absent - there, closed=labelling.closed - there
    )


def missing_tooth_edits(labelling: Labelling, adjusted: Adjusted) -> list[Labelling]:
    """A tooth missing in the patient, its space open or closed; or one called missing that is not.

    The numbers beyond it move outward in every photograph, all of them or as far as the next gap of
    the row; or, in the photograph taken most from its side, the numbers before it move inward.
    """
    edits: list[Labelling] = []
    for jaw, name in enumerate(JAWS):
        rows = [both[jaw] for both in labelling.labels]
        for position in range(POSITIONS):
            tooth = tooth_at(name, position)
            inside = [number for number, row in enumerate(rows) if position in row]
            if tooth in labelling.absent or not inside:
                continue
            outward = -1 if position < POSITIONS // 2 else 1
            everywhere = [_renamed(row, position, outward) for row in rows]
            # The photograph taken most from this tooth's side: there the back teeth may have held.
            yaws = view_angles(adjusted)[:, 0] * outward
            sideways = max(inside, key=lambda number: (float(yaws[number]), number))
            held = list(everywhere)
            held[sideways] = _renamed(rows[sideways], position, -outward)
            to_gaps = [_renamed(row, position, outward, to_gap=True) for row in rows]
            for renamed in (everywhere, held, *[to_gaps] * (to_gaps != everywhere)):
                changed = labelling
                for number, row in enumerate(renamed):
                    changed = with_row(changed, number, jaw, row)
                changed = replace(changed, absent=changed.absent | {tooth})
                edits += [changed, replace(changed, closed=changed.closed | {tooth})]
    return edits


def _renamed(row: Labels, position: int, by: int, to_gap: bool = False) -> Labels:
    """A row whose labels from a position on, in the direction of `by`, are moved by it.

    Args:
        to_gap: no further than the row's next gap, which closes.
    """
    end = position
    while to_gap and end in row:
        end += by
    chosen = [
        (label - position) * by >= 0 and (not to_gap or (end - label) * by > 0) for label in row
    ]
    return bounded(shifted(row, chosen, by))


def without_view(scorer: Scorer, scored: Scored, number: int) -> Scored:
    """The same labelling without one of its views, solved."""
    labelling = scored.labelling
    rest = [k for k in range(len(labelling.views)) if k != number]
    fewer = replace(
        labelling,
        views=tuple(labelling.views[k] for k in rest),
        roles=tuple(labelling.roles[k] for k in rest),
        labels=tuple(labelling.labels[k] for k in rest),
    )
    cameras = scored.adjusted.unknowns[:-PER_ARCH].reshape(-1, PER_VIEW)[rest]
    unknowns = np.concatenate([cameras.ravel(), scored.adjusted.unknowns[-PER_ARCH:]])
    return scorer.solve(fewer, (unknowns, scored.adjusted.offsets), SEARCH_STEPS)


def plausible(
    scorer: Scorer, now: Labelling, edits: list[Labelling], most: int | None = None
) -> list[Labelling]:
    """Those of some labellings that the crowns' looks don't rule out beside the present one.

    Args:
        most: so many that look likeliest, in their order, and all that look like the last of them
            (without looks, all); None: all.
    """
    limit = scorer.looks(now) + LOOKS_WINDOW
    looks = [scorer.looks(edit) for edit in edits]
    worst = sorted(looks)[most - 1] if most is not None and len(looks) > most else limit
    return [edit for edit, cost in zip(edits, looks, strict=True) if cost < limit and cost <= worst]


def common_mouth(scorer: Scorer, scored: Scored) -> list[float]:
    """Twice the log Bayes factor, view by view, that it shows the same mouth as the others.

    The rival hypothesis is a mouth of its own: arch and landmarks are fitted to the view alone.
    """
    joint = scored.adjusted.evidence
    result = []
    for number, (view, role) in enumerate(
        zip(scored.labelling.views, scored.labelling.roles, strict=True)
    ):
        rest = without_view(scorer, scored, number)
        alone = replace(
            scored.labelling, views=(view,), roles=(role,),
            labels=(scored.labelling.labels[number],),
        )  # fmt: skip
        camera = scored.adjusted.unknowns[PER_VIEW * number : PER_VIEW * (number + 1)]
        start = np.concatenate([camera, scored.adjusted.unknowns[-PER_ARCH:]])
        own = scorer.solve(alone, (start, scored.adjusted.offsets), SEARCH_STEPS)
        result.append(rest.adjusted.evidence + own.adjusted.evidence - joint)
    return result


def row_trial(
    scorer: Scorer, scored: Scored, points: Array, number: int, labels: ViewLabels
) -> float:
    """Score of one view's labels against an arch [L, 3] (only to compare with others)."""
    labelling = scored.labelling
    view, role = labelling.views[number], labelling.roles[number]
    start = np.concatenate(
        [
            scored.adjusted.unknowns[PER_VIEW * number : PER_VIEW * (number + 1)],
            np.zeros(PER_ARCH),
        ]
    )
    adjusted = adjust(
        scorer.sightings(Labelling((view,), (role,), (labels,))),
        points,
        scorer.priors((view,), (role,)),
        TRIED_DEVIATION,
        start=(start, np.zeros_like(scored.adjusted.offsets)),
        max_steps=TRIAL_STEPS,
        tolerance=0.05,
    )
    total = adjusted.evidence + scorer.row_costs(view, labels, labelling.absent)
    total += ends_cost(scorer.rows, (view,), (labels,), adjusted)
    one = replace(labelling, views=(view,), roles=(role,), labels=(labels,))
    return total + scorer.looks(one)


def improve(scorer: Scorer, scored: Scored, fixed: Fixed) -> tuple[Scored, list[Scored]]:
    """Take edits as long as they gain.

    Args:
        scorer: of all photographs.
        scored: where to begin.
        fixed: (view, jaw, crown) -> position, where a person has said it.

    Returns:
        The best labelling found, and all others that were solved jointly on the way.
    """
    others: list[Scored] = []
    for _ in range(MAX_EDITS):
        labelling = scored.labelling
        trials: list[tuple[float, Labelling]] = []
        for number, labels in enumerate(labelling.labels):
            # The arch as the other views have it: this view's errors must not be built in.
            points = without_view(scorer, scored, number).adjusted.points
            now = row_trial(scorer, scored, points, number, labels)
            rows = scorer.rows[labelling.views[number]]
            edits = [
                with_row(labelling, number, jaw, edit)
                for jaw in (0, 1)
                for edit in row_edits(labels[jaw], rows[jaw].wholes)
                if _allowed(labelling.views[number], jaw, edit, fixed)
            ]
            for changed in plausible(scorer, labelling, edits, ROW_TRIALS):
                score = row_trial(scorer, scored, points, number, changed.labels[number])
                trials.append((score - now, changed))
        trials.sort(key=lambda trial: (trial[0], trial[1].labels))
        jobs = [changed for _, changed in trials[:JOINT_TRIALS]]
        missing = missing_tooth_edits(labelling, scored.adjusted)
        jobs += [
            edit
            for edit in plausible(scorer, labelling, missing, MISSING_TRIALS)
            if _is_allowed(edit, fixed)
        ]
        finished, rest = _solved(scorer, scored, jobs, 3)
        finished.sort(key=lambda s: (s.score, s.labelling.labels))
        others += finished + rest
        if not finished or finished[0].score > scored.score - MIN_GAIN:
            break
        others.append(scored)
        scored = finished[0]
    return scored, others


def shifted_labellings(labelling: Labelling) -> list[Labelling]:
    """Labellings a tooth off: one view or all, or two of a few each its own way; one jaw or both.

    Where both sides are off, each half way back is worse than none: the two are tried at once.
    """
    count = len(labelling.labels)
    moves = [{view: by} for view in range(count) for by in (-1, 1)]
    moves += [dict.fromkeys(range(count), by) for by in (-1, 1)]
    if count <= FEW_VIEWS:
        for pair in combinations(range(count), 2):
            both = product((-1, 1), repeat=2)
            moves += [dict(zip(pair, steps, strict=True)) for steps in both]
    result = {
        _moved(labelling, move, jaws): None for move in moves for jaws in ((0, 1), (0,), (1,))
    }
    return list(result)


def _moved(labelling: Labelling, steps: dict[int, int], jaws: tuple[int, ...]) -> Labelling:
    """The labelling with the rows of some views so many teeth further along."""
    for number, by in steps.items():
        for jaw in jaws:
            row = labelling.labels[number][jaw]
            new = bounded(shifted(row, [True] * len(row), by))
            labelling = with_row(labelling, number, jaw, new)
    return labelling


def solve_shifted(scorer: Scorer, best: Scored, fixed: Fixed) -> list[Scored]:
    """Labellings a tooth off the best one, solved; those against what a person has said left out.

    Args:
        scorer: of all photographs.
        best: the labelling to compare with.
        fixed: (view, jaw, crown) -> position, where a person has said it.
    """
    shifted = [
        labelling
        for labelling in plausible(scorer, best.labelling, shifted_labellings(best.labelling))
        if _is_allowed(labelling, fixed)
    ]
    finished, rest = _solved(scorer, best, shifted, NEAREST)
    return finished + rest


def _solved(
    scorer: Scorer, near: Scored, labellings: list[Labelling], best: int
) -> tuple[list[Scored], list[Scored]]:
    """Labellings solved from one that is near: so many of the best to the end, and the others."""
    start = (near.adjusted.unknowns, near.adjusted.offsets)
    solved = scorer.solve_all([(labelling, start) for labelling in labellings], SEARCH_STEPS)
    solved.sort(key=lambda s: (s.score, s.labelling.labels))
    again = [(s.labelling, (s.adjusted.unknowns, s.adjusted.offsets)) for s in solved[:best]]
    return scorer.solve_all(list(again), FINAL_STEPS), solved[best:]


def settle_ends(scorer: Scorer, best: Scored, fixed: Fixed) -> tuple[Scored, list[Scored]]:
    """Try every label that the last crown of each row may have.

    Args:
        scorer: of all photographs.
        best: the labelling so far.
        fixed: (view, jaw, crown) -> position, where a person has said it.

    Returns:
        The best labelling, and all others that were solved.
    """
    others: list[Scored] = []
    for _ in range(MAX_EDITS):
        labelling = best.labelling
        jobs = [
            with_row(labelling, number, jaw, row)
            for number, both in enumerate(labelling.labels)
            for jaw in (0, 1)
            for row in end_labels(both[jaw], HIDDEN_TEETH)
            if _allowed(labelling.views[number], jaw, row, fixed)
        ]
        start = (best.adjusted.unknowns, best.adjusted.offsets)
        solved = scorer.solve_all([(job, start) for job in jobs], SEARCH_STEPS)
        others += solved
        nearest = min(solved, key=lambda s: (s.score, s.labelling.labels), default=best)
        if nearest.score > best.score - MIN_GAIN:
            break
        others.append(best)
        again = (nearest.adjusted.unknowns, nearest.adjusted.offsets)
        best = scorer.solve(nearest.labelling, again)
    return best, others
