"""All teeth's motions from one visit to the other: match, solve, see who stood still, again."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from itertools import chain

import numpy as np
import numpy.typing as npt

from pipeline.kernels.threads import in_threads
from pipeline.measure import usable_cores
from pipeline.studies.register import solving
from pipeline.studies.register.geometry import Laid, laid_crowns
from pipeline.studies.register.movement import tooth_axes
from pipeline.studies.register.pictures.marks import mark_spots, marks_of
from pipeline.studies.register.pictures.matching import (
    Prepared,
    Spots,
    outlines_between,
    pairs_of,
    prepare,
    spots_between,
)
from pipeline.studies.register.pictures.photometric import (
    FITS,
    PRIOR,
    facings,
    judged,
    searched,
)
from pipeline.studies.register.solving import Block, Pull, State
from pipeline.studies.register.visit import Visit, in_frame

Array = npt.NDArray[np.float64]

#: Rounds of matching while it is open who moved, and after.
OPEN_ROUNDS, CLOSED_ROUNDS = 4, 3
#: Gauss-Newton steps after each matching.
STEPS = 2
#: Partners of each photograph, and degrees between their directions at most.
PARTNERS, WIDEST = 2, 14.0
#: While it is open: how firmly a tooth is held (mm), and from how far on it is let go (mm).
HELD, LET_GO = 0.03, 0.15
#: A tooth stood still if it went by less than this (mm), or this many times what most do.
STILL, TIMES = 0.1, 2.5
#: How firmly a tooth that stood still is held, mm.
FIRM = 0.01
#: How far teeth move, mm, and from how far on a start by shape alone is taken.
EXPECTED, CLEAR = 0.5, 0.3
#: A tooth is measured if it has so many spots in all.
LEAST_SPOTS = 120
#: Rounds of laying marks onto each other, by their blur (see `marks.BLURS`), steps of
#: each, and points of a crown in a pair of photographs and pairs at most.
MARK_ROUNDS, MARK_STEPS, MARK_POINTS, MARK_PAIRS = (0, 1, 1, 1), 3, 1000, 24
#: Marks tell what a tooth did if they correlate by this at the end. Of a generated mouth they do by
#: .46 and more at the motions found, and .6 mm off by .47 at most.
LEAST_AGREEMENT = 0.5


@dataclass(frozen=True)
class Estimate:
    """What came out of matching a visit with another.

    Attributes:
        state: motions of the first visit's teeth, and the second's cameras in its frame.
        still: numbers of the teeth that stood still.
        blocks: normal equations at the end, of the marks of crowns or else of `spots`.
        spots: what optical flow found at the end.
        laid: what the crowns' shapes say of their motions.
        centres: FDI number -> [3] centre of the crown at the first visit, mm.
        likeness: median correlation of the crowns' surroundings, at the end.
        residual: median distance of crowns from crowns, laid onto each other, mm.
        first_from_second: [4, 4] similarity of the two visits' frames.
        seen: FDI number -> [4, 4] motion of a tooth that moved, by which its few pictures fit
            better than by what flow says (see `photometric.judged`), where marks tell nothing.
        fits: FDI number -> correlation of the tooth's pictures by its motion, -1..1.
        told: numbers of the teeth whose marks tell what they did.
    """

    state: State
    still: tuple[int, ...]
    blocks: tuple[Block, ...]
    spots: tuple[Spots, ...]
    laid: dict[int, Laid]
    centres: dict[int, Array]
    likeness: float
    residual: float
    first_from_second: Array
    seen: dict[int, Array] = field(default_factory=dict)
    fits: dict[int, float] = field(default_factory=dict)
    told: frozenset[int] = frozenset()


@dataclass(frozen=True)
class Started:
    """Visits matched as long as it was open which teeth moved.

    Attributes:
        first, second: photographs of both visits.
        state: motions of the first visit's teeth so far, and the second's cameras in its frame.
        spots: the last that were found.
        laid, centres, first_from_second: as in `Estimate`.
    """

    first: tuple[Prepared, ...]
    second: tuple[Prepared, ...]
    state: State
    spots: tuple[Spots, ...]
    laid: dict[int, Laid]
    centres: dict[int, Array]
    first_from_second: Array


def started(
    first: Visit, second: Visit, first_from_second: Array, agreeing: Sequence[int]
) -> Started:
    """Find about what the first visit's teeth did.

    Args:
        first, second: visits.
        first_from_second: [4, 4] similarity to begin with.
        agreeing: teeth that seem to have stood still, by that similarity.
    """
    a = tuple(prepare(look) for look in first.looks)
    b = tuple(prepare(look) for look in second.looks)
    centres = first.centres
    laid = calibrated(laid_crowns(first, second, first_from_second, agreeing), agreeing)
    state = State(
        {n: _start(laid.get(n), centres[n]) for n in centres},
        tuple(in_frame(look.camera, first_from_second) for look in second.looks),
    )
    spots = match(a, b, state, outlines_between)
    for _ in range(2 * STEPS):
        state = _step(spots, state, centres, (), laid)
    for _ in range(OPEN_ROUNDS):
        spots = match(a, b, state)
        for _ in range(STEPS):
            state = _step(spots, state, centres, None, laid)
    # Flow is lost where it starts too far off: such teeth get another start.
    still = stood_still(state, centres, spots)
    better = searched(a, b, state, still, centres, tooth_axes(centres), compared_pairs(a, state))
    moved = {n: fit.motion for n, fit in better.items() if n not in still or fit.score >= FITS}
    state = replace(state, motions={**state.motions, **moved})
    return Started(a, b, state, tuple(spots), laid, centres, first_from_second)


def finished(found: Started) -> Estimate:
    """Fix the teeth that stood still and measure the others against them."""
    a, b, state, centres, laid = found.first, found.second, found.state, found.centres, found.laid
    spots = list(found.spots)
    factor = 1.0
    for _ in range(CLOSED_ROUNDS):
        still = stood_still(state, centres, spots)
        spots = [replace(s, information=s.information * factor) for s in match(a, b, state)]
        for _ in range(STEPS):
            state = _step(spots, state, centres, still, laid)
        factor /= noise(spots, state, centres, still)
    seen, fits = judged(a, b, state, still, centres, compared_pairs(a, state))
    state = replace(state, motions={**state.motions, **seen})
    state, marks, told = by_marks(found, state, still, spots)
    seen = {n: motion for n, motion in seen.items() if n not in told}
    blocks = solving.blocks_of(marks, state, centres)
    likeness = weighted_median([s.likeness for s in spots], [s.seen for s in spots])
    residual = float(np.median([crown.residual for crown in laid.values()])) if laid else np.inf
    return Estimate(
        state, still, tuple(blocks), tuple(spots), laid, centres, likeness, residual,
        found.first_from_second, seen, fits, frozenset(told),
    )  # fmt: skip


def by_marks(
    found: Started, state: State, still: Sequence[int], spots: Sequence[Spots]
) -> tuple[State, list[Spots], set[int]]:
    """Lay the marks of the crowns onto each other.

    Optical flow needs a window that takes shading in, which stays with the light when a tooth
    turns. Once it has found the place to a pixel, the finest contrast alone tells the rest. Crowns
    whose marks do not agree keep what flow says.

    Args:
        found: the photographs, and what else is known of the teeth.
        state: the motions and cameras that flow leads to; those of crowns may be a pixel off.
        still: numbers of the teeth that stood still.
        spots: that flow found.

    Returns:
        The state by the marks; the spots that it rests on, those of flow where marks do not tell;
        the numbers of the teeth of which they do.
    """
    a, b = (marks_of([p.look for p in visit]) for visit in (found.first, found.second))
    pairs = compared_pairs(found.first, state)
    teeth = sorted({s.tooth for s in spots if len(s.points)})
    views = [v for n in teeth for v in facings(n, a, b, state, pairs, MARK_POINTS, MARK_PAIRS)]
    laid, factor, made = state, 1.0, list(spots)
    for level in MARK_ROUNDS:
        for _ in range(MARK_STEPS):
            made = [
                replace(s, information=s.information * factor)
                for s in mark_spots(views, level, laid)
            ]
            laid = _step(made, laid, found.centres, still, found.laid)
        factor /= noise(made, laid, found.centres, still)
    told = {n for n in teeth if told_by([s for s in made if s.tooth == n])}
    motions = {n: (laid if n in told else state).motions[n] for n in state.motions}
    said = [
        *(s for s in made if s.tooth in told), *(s for s in spots if s.tooth not in told)
    ]  # fmt: skip
    return replace(laid, motions=motions), said, told


def told_by(spots: Sequence[Spots]) -> bool:
    """Do its marks tell what a tooth did?

    Of one photograph they don't: how far it went along the line of sight hangs on its depth, which
    is off by more than marks are.
    """
    seen = sum(s.seen for s in spots)
    likeness = sum(s.likeness * s.seen for s in spots)
    return len({s.second for s in spots}) > 1 and likeness >= LEAST_AGREEMENT * seen


def calibrated(laid: dict[int, Laid], agreeing: Sequence[int]) -> dict[int, Laid]:
    """Shapes are as sure as those of teeth that (mostly) stood still turn out to be."""
    sizes = [
        laid[n].displacement @ laid[n].information @ laid[n].displacement / 6
        for n in agreeing
        if n in laid
    ]
    factor = max(float(np.quantile(sizes, 0.9)), 1.0) if sizes else 1.0
    return {n: replace(crown, information=crown.information / factor) for n, crown in laid.items()}


def _start(laid: Laid | None, centre: Array) -> Array:
    """[4, 4] a tooth's motion by its shape alone, where that says clearly that it moved."""
    if laid is None:
        return np.eye(4)
    prior = np.diag([1.0] * 3 + [solving.LEVER**2] * 3) / EXPECTED**2
    goal = laid.information @ laid.displacement
    likely = np.asarray(np.linalg.solve(laid.information + prior, goal), np.float64)
    if solving.travel(likely) < CLEAR:
        return np.eye(4)
    return solving.moved_tooth(np.eye(4), likely, centre)


def compared_pairs(a: Sequence[Prepared], state: State) -> list[tuple[int, int]]:
    """Which photographs of the first visit are compared with which of the second."""
    return pairs_of([p.look.camera for p in a], list(state.cameras), PARTNERS, WIDEST)


def match(
    a: Sequence[Prepared], b: Sequence[Prepared], state: State,
    between: Callable[..., list[Spots]] = spots_between,
) -> list[Spots]:  # fmt: skip
    """The spots of all pairs of photographs, of teeth that are known in 3D."""

    def of(pair: tuple[int, int]) -> list[Spots]:
        i, j = pair
        return between(a[i], b[j], state.cameras[j], state.motions, i, j)

    every = chain(*in_threads(of, compared_pairs(a, state), usable_cores()))
    found = [spots for spots in every if spots.tooth in state.motions]
    total: dict[int, int] = {}
    for spots in found:
        total[spots.tooth] = total.get(spots.tooth, 0) + len(spots.points)
    least = 0 if between is outlines_between else LEAST_SPOTS
    return [s for s in found if total[s.tooth] >= least]


def held(travel: float, firm: float | None) -> Array:
    """[6, 6] information that holds a tooth: loosely and robustly, or by `firm` mm."""
    loose = HELD * (1 + (travel / LET_GO) ** 2)
    weight = 1 / (loose if firm is None else firm) ** 2
    lever = solving.LEVER**2
    return np.diag([weight] * 3 + [weight * lever] * 3)


def pulls(
    drift: dict[int, Array], still: Sequence[int] | None, laid: dict[int, Laid]
) -> list[Pull]:
    """What holds the teeth: those that stood still firmly, the others by their shape."""
    zero = np.zeros(6)
    found = []
    for n, d in drift.items():
        if still is not None and n in still:
            found.append(Pull(n, held(0.0, FIRM), zero))
            continue
        found.append(Pull(n, PRIOR, zero))
        if still is None:
            found.append(Pull(n, held(solving.travel(d), None), zero))
        if n in laid:
            found.append(Pull(n, laid[n].information, laid[n].displacement))
    return found


def _step(
    spots: Sequence[Spots], state: State, centres: dict[int, Array],
    still: Sequence[int] | None, laid: dict[int, Laid],
) -> State:  # fmt: skip
    """One Gauss-Newton step of everything. `still`: None while it is open who stood still."""
    used = [s for s in spots if len(s.points)]
    blocks = solving.blocks_of(used, state, centres)
    teeth = sorted({s.tooth for s in used})
    drift = {n: solving.displacement(state.motions[n], centres[n]) for n in teeth}
    system = solving.system_of(blocks, len(state.cameras))
    change, _ = solving.solved(
        system, system.matrices.sum(0), system.vectors.sum(0), pulls(drift, still, laid), drift
    )
    cameras = change[solving.TOOTH * len(teeth) :].reshape(-1, solving.CAMERA)
    motions = dict(state.motions)
    for n in teeth:
        motions[n] = solving.moved_tooth(motions[n], change[system.place(n)], centres[n])
    return State(
        motions,
        tuple(solving.moved_view(c, v) for c, v in zip(state.cameras, cameras, strict=True)),
    )


def noise(
    spots: Sequence[Spots], state: State, centres: dict[int, Array], still: Sequence[int]
) -> float:
    """By what factor spots are less sure than they say, by the teeth that stood still.

    Each is let go by itself: what it would do then is noise.
    """
    sizes = []
    for n in still:
        mine = solving.blocks_of((s for s in spots if s.tooth == n), state, centres)
        matrix = sum((b.matrix[:6, :6] for b in mine), 1e-9 * np.eye(6))
        change = np.linalg.solve(matrix, sum((b.vector[:6] for b in mine), np.zeros(6)))
        sizes.append(float(change @ matrix @ change) / 6)
    return max(float(np.median(sizes)), 1e-3) if sizes else 1.0


def stood_still(state: State, centres: dict[int, Array], spots: Sequence[Spots]) -> tuple[int, ...]:
    """The teeth whose motion is no more than what most teeth's is, by noise alone."""
    measured = sorted({s.tooth for s in spots if len(s.points)})
    travel = {
        n: solving.travel(solving.displacement(state.motions[n], centres[n])) for n in measured
    }
    if not travel:
        return ()
    values = np.sort(list(travel.values()))
    lower = values[: max(3, len(values) // 2)]
    limit = max(STILL, TIMES * float(np.median(lower)))
    return tuple(n for n in measured if travel[n] <= limit)


def weighted_median(values: Sequence[float], weights: Sequence[float]) -> float:
    """The value at which half of the weight is reached; -1 for no values."""
    if not len(values):
        return -1.0
    order = np.argsort(values)
    total = np.cumsum(np.asarray(weights, np.float64)[order])
    return float(np.asarray(values)[order][np.searchsorted(total, total[-1] / 2)])
