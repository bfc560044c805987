"""The likeliest labellings: of each photograph alone, then of all together, by a beam."""

from __future__ import annotations

from dataclasses import replace
from itertools import product

import numpy as np
import numpy.typing as npt

from stages.dentition.tooth_rows import NO_TOOTH, Labels, best_rows
from stages.init.dental.cameras.kernels import PER_ARCH, PER_VIEW
from stages.init.dental.numbering.arch_options import ArchOptions
from stages.init.dental.numbering.labellings.scorer import (
    FINAL_STEPS,
    MAIN_ROLES,
    REPEATED_ROLE_COST,
    SEARCH_STEPS,
    VIEW_STEPS,
    Labelling,
    Scored,
    Scorer,
    ViewLabels,
)
from stages.init.dental.numbering.sightings import SeenRow

Array = npt.NDArray[np.float64]

#: `between` lies on one side or the other; the name tells which while searching.
BETWEEN_ROLES = ("between right", "between left")
#: Labellings of a view further behind its best one than this are not looked at (evidence).
VIEW_WINDOW = 60.0
#: Pairs of partial labelling and view's candidate solved in each step of the search.
PAIRS_A_STEP = 120
#: Upper and lower positions above each other differ by no more than this.
MAX_JAW_SHIFT = 2.2


def roles_of_view(view: int, views: int, options: ArchOptions) -> tuple[str, ...]:
    """Roles that a photograph may have."""
    if options.order is not None:
        role = options.order[view]
        return BETWEEN_ROLES if role == "between" else (role,)
    return MAIN_ROLES if views <= 3 else MAIN_ROLES + BETWEEN_ROLES


def row_pairs(rows: tuple[SeenRow, SeenRow], count: int) -> list[ViewLabels]:
    """The labels of both rows of a view that look likeliest and that anatomy allows.

    Where it allows none, the looks of one row are wrong: the likeliest, for the others to correct.
    """
    upper, lower = rows
    best = [best_rows(row.looks, count, row.said_wholes) for row in rows]
    likeliest = sorted((cost + other, (a, b)) for (cost, a), (other, b) in product(*best))
    pairs = []
    for _, (a, b) in likeliest:
        shift = _jaw_shift(upper, lower, a, b)
        if shift is None or abs(shift) <= MAX_JAW_SHIFT:
            pairs.append((a, b))
            if len(pairs) == count:
                break
    return pairs or [pair for _, pair in likeliest[:count]]


def _jaw_shift(upper: SeenRow, lower: SeenRow, a: Labels, b: Labels) -> float | None:
    """By how many positions the upper row is ahead of the lower one where both are seen."""
    known = [np.array([label != NO_TOOTH for label in labels], bool) for labels in (a, b)]
    if min(k.sum() for k in known) < 2:
        return None
    x = [row.middles[k, 0] for row, k in zip((upper, lower), known, strict=True)]
    at = [np.array(labels)[k] for labels, k in zip((a, b), known, strict=True)]
    left, right = max(x[0][0], x[1][0]), min(x[0][-1], x[1][-1])
    across = np.linspace(left, right, 9) if right > left else np.array([(left + right) / 2])
    return float((np.interp(across, x[0], at[0]) - np.interp(across, x[1], at[1])).mean())


def view_candidates(
    scorer: Scorer, view: int, roles: tuple[str, ...], fixed: dict[tuple[int, int, int], int]
) -> list[Scored]:
    """The labellings of one photograph alone that are worth a look, best first.

    Args:
        scorer: of all photographs.
        view: which.
        roles: that it may have.
        fixed: (view, jaw, crown) -> position, where a person has said it.
    """
    pairs = [
        labels
        for labels in row_pairs(scorer.rows[view], scorer.options.rows_tried)
        if all(
            labels[jaw][crown] == position
            for (v, jaw, crown), position in fixed.items()
            if v == view
        )
    ]
    kept: list[Scored] = []
    for role in roles:
        jobs = [
            (Labelling((view,), (role,), (labels,), primary=scorer.primary), None)
            for labels in pairs
        ]
        solved = sorted(scorer.solve_all(list(jobs), VIEW_STEPS), key=_order)
        kept += solved[: scorer.options.candidates_per_view]
    kept.sort(key=_order)
    return [scored for scored in kept if scored.score < kept[0].score + VIEW_WINDOW]


def _order(scored: Scored) -> tuple[float, tuple[ViewLabels, ...], tuple[str, ...]]:
    """Sort key that never ties by chance."""
    return (scored.score, scored.labelling.labels, scored.labelling.roles)


def join(state: Scored, candidate: Scored) -> tuple[Labelling, tuple[Array, Array]]:
    """A partial labelling and a candidate of one more view: the joint one, and where to start."""
    a, b = state.labelling, candidate.labelling
    labelling = replace(
        a, views=a.views + b.views, roles=a.roles + b.roles, labels=a.labels + b.labels
    )
    unknowns = np.concatenate(
        [
            state.adjusted.unknowns[:-PER_ARCH],
            candidate.adjusted.unknowns[:PER_VIEW],
            state.adjusted.unknowns[-PER_ARCH:],
        ]
    )
    return labelling, (unknowns, state.adjusted.offsets)


def sort_views(scored: Scored) -> tuple[Labelling, tuple[Array, Array]]:
    """The same labelling with its views in file order, and where to start."""
    labelling = scored.labelling
    order = sorted(range(len(labelling.views)), key=lambda k: labelling.views[k])
    cameras = scored.adjusted.unknowns[:-PER_ARCH].reshape(-1, PER_VIEW)[order]
    return (
        replace(
            labelling,
            views=tuple(labelling.views[k] for k in order),
            roles=tuple(labelling.roles[k] for k in order),
            labels=tuple(labelling.labels[k] for k in order),
        ),
        (
            np.concatenate([cameras.ravel(), scored.adjusted.unknowns[-PER_ARCH:]]),
            scored.adjusted.offsets,
        ),
    )


def search(scorer: Scorer, candidates: dict[int, list[Scored]]) -> list[Scored]:
    """Joint labellings of all views, best first, by a beam over views.

    Args:
        scorer: of all photographs.
        candidates: of each view that takes part, from `view_candidates`.

    Returns:
        At most `options.beam`, their views in file order.
    """
    beam = scorer.options.beam

    def clarity(view: int) -> tuple[float, int]:
        mine = candidates[view]
        others = [s.score for s in mine if s.labelling.labels != mine[0].labelling.labels]
        return (-(min(others) - mine[0].score) if others else -np.inf, view)

    order = sorted(candidates, key=clarity)
    states = candidates[order[0]]
    for view in order[1:]:
        mine = candidates[view]
        repeated = len(scorer.rows) <= 3 and scorer.options.order is None
        pairs = sorted(
            (
                state.score
                + candidate.score
                + REPEATED_ROLE_COST
                * (repeated and candidate.labelling.roles[0] in state.labelling.roles),
                i,
                j,
            )
            for i, state in enumerate(states)
            for j, candidate in enumerate(mine)
        )[:PAIRS_A_STEP]
        jobs = [join(states[i], mine[j]) for _, i, j in pairs]
        solved = sorted(scorer.solve_all(list(jobs), SEARCH_STEPS), key=_order)
        states = solved[: 2 * beam]
    finished = [sort_views(state) for state in states[:beam]]
    return sorted(scorer.solve_all(list(finished), FINAL_STEPS), key=_order)
