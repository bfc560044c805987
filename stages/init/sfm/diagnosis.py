"""Saying what is wrong with the photographs, and what to do about it, to the one who took them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pipeline.geometry.graph import Pair
from pipeline.geometry.rigid import angle_between
from stages.init.sfm.mapping import Solution
from stages.init.sfm.matching.roll import groups
from stages.init.sfm.reconstruct import Attempt, Evidence

#: Advice that helps in nearly all cases.
HOW_TO_SHOOT = (
    "Take photographs from different sides of the teeth, neighbouring ones turned by no more than "
    "20 degrees against each other, all sharp and with the same zoom, and move the camera rather "
    "than turning it on the spot."
)


HOW_TO_BRIDGE = (
    "Add a photograph between them, turned no more than 20 degrees against either, sharp and with "
    "the same zoom (or take a short video that sweeps around)."
)
HOW_TO_GIVE_FOCAL = (
    "Keep the EXIF data of the photographs, or pass the focal length over the long side of the "
    "image, if you know it, as in --set init.focal=1.2."
)
#: Photographs of teeth that are turned by no more than this against each other, in degrees, are
#: linked; those from 40 on hardly ever (see `TwoView.evidence`).
LINKED_UP_TO = 35
#: Share of the spots that look alike which agree by chance, at most: 6 % where one photograph shows
#: a house and the other a mouth, 3 to 8 % where both show one mouth from too far apart.
BY_CHANCE = 0.1
#: Share from which on two photographs are near enough: it is spots that they lack.
NEAR_ENOUGH = 0.5
#: A photograph with less than this share of the spots that the others show is a bad one.
BLURRED = 0.4
#: Gaps and photographs that are explained one by one.
MOST_NAMED = 3


@dataclass(frozen=True)
class Limits:
    """What a reconstruction must keep to be believed.

    Attributes:
        min_views: least number of views.
        min_tri_angle: degrees, of the median point.
        min_baseline: largest distance between two cameras over the median depth.
        min_points: points that each view must observe.
        max_error: root mean square reprojection error in pixels.
        max_turn: degrees by which the cameras may contradict the pairs that link them.
        max_flat: share of a pair's matches that one homography may explain.
    """

    min_views: int
    max_error: float
    min_tri_angle: float = 1.5
    min_baseline: float = 0.02
    min_points: int = 12
    max_turn: float = 10.0
    max_flat: float = 0.9


def least_views(count: int, fraction: float) -> int:
    """How many of `count` views must be placed: all of up to 3, else the fraction, at least 2."""
    return count if count <= 3 else max(2, int(np.ceil(fraction * count)))


def failure(
    attempt: Attempt, names: list[str], limits: Limits, unsharp: Sequence[int] = (),
    blank: Sequence[int] = (), bright: Sequence[int] = (),
) -> str | None:  # fmt: skip
    """The diagnosis of an attempt as one paragraph, or None if the reconstruction is good.

    Args:
        names: how the user knows the photographs.
        unsharp: those that are shaken or out of focus; that is said first.
        blank: those that show an even surface and nothing else; that is said before.
        bright: those that lack detail too, and are white in good part.
    """
    found = _failure(attempt, names, limits, [*unsharp, *bright], blank)
    if found is None:
        return None
    said = _bad_ones(names, unsharp, blank, bright)
    if len(names) - len(blank) < limits.min_views:
        return " ".join(said)  # the others could not do it, whatever they share
    return " ".join([*said, found])


def _bad_ones(
    names: list[str], unsharp: Sequence[int], blank: Sequence[int], bright: Sequence[int]
) -> list[str]:
    """A part of a diagnosis for each way in which photographs are bad by themselves."""
    ways = ((_nothing_shown, blank), (_too_bright, bright), (_too_soft, unsharp))
    return [text([names[view] for view in views]) for text, views in ways if views]


def _nothing_shown(names: list[str]) -> str:
    one = len(names) == 1
    return (
        f"{_listed(names)} {'shows' if one else 'show'} nothing to match: an even surface without "
        "detail, as of a bare wall, a covered lens or far too much light. Leave "
        f"{'it' if one else 'them'} out, or take {'it' if one else 'them'} again of the teeth."
    )


def _too_bright(names: list[str]) -> str:
    one = len(names) == 1
    return (
        f"{_listed(names)} {'has' if one else 'have'} too little fine detail left to match, and "
        f"{'is' if one else 'are'} plain white in good part: far too bright (or, before something "
        f"white, not sharp). Take {'it' if one else 'them'} again with less light, a weaker flash "
        "or a lower exposure, so that the teeth are not white all over."
    )


def _too_soft(names: list[str]) -> str:
    one = len(names) == 1
    return (
        f"{_listed(names)} {'is' if one else 'are'} not sharp: shaken, or out of focus, so that "
        f"too little fine detail is left to match. Take {'it' if one else 'them'} again with the "
        "camera held still, in better light, and focused on the teeth."
    )


def _failure(
    attempt: Attempt, names: list[str], limits: Limits, unsharp: Sequence[int],
    blank: Sequence[int],
) -> str | None:  # fmt: skip
    if len(names) < 2:
        return (
            f"One photograph ({', '.join(names)}) can't give a 3D scene: at least two are needed, "
            f"three or more are better. {HOW_TO_SHOOT}"
        )
    bad = [*unsharp, *blank]
    evidence, solution = attempt.evidence, attempt.solution
    poor = [
        names[view] for view, count in enumerate(evidence.keypoints)
        if count < 50 and view not in blank
    ]  # fmt: skip
    if poor and (solution is None or len(solution.poses) < limits.min_views):
        return (
            f"There is too little to recognise in {_listed(poor)} (fewer than 50 distinct "
            "spots): the photograph is blurred, too dark, too bright, or its mask covers it. "
            "Leave it out or take it again."
        )
    if evidence.is_still():
        return (
            "The camera did not move between the photographs: they are the same, or nearly, "
            f"so that there is no depth to see. {HOW_TO_SHOOT}"
        )
    if flat := _flat(evidence, limits):
        return f"{flat} {HOW_TO_SHOOT}"
    if solution is None:
        return (
            "No two photographs could be placed against each other. "
            f"{_gaps(evidence, names, bad)} {_advice(attempt, names, bad)}"
        ).rstrip()
    doubt = doubtful(solution, evidence, limits)
    if doubt:
        return f"{doubt} {HOW_TO_SHOOT}"
    if len(solution.poses) < limits.min_views:
        unplaced = [view for view in range(len(names)) if view not in solution.poses]
        reasons = " ".join(
            _why_unplaced(evidence, names, view, set(solution.poses), bad)
            for view in [view for view in unplaced if view not in blank][:MOST_NAMED]
        )
        return (
            f"Only {len(solution.poses)} of {len(names)} photographs could be placed; at least "
            f"{limits.min_views} are needed. Not placed: "
            f"{_listed([names[view] for view in unplaced])}. {reasons} "
            f"{_advice(attempt, names, bad)}"
        ).rstrip()
    return None


def doubtful(solution: Solution, evidence: Evidence, limits: Limits) -> str | None:
    """Why a reconstruction can't be believed, or None. Small residuals alone prove nothing."""
    if flat := _flat(evidence, limits):
        return flat
    angle = float(np.median(solution.triangulation_angles())) if len(solution.points) else 0.0
    centres = solution.centres()
    baseline = np.linalg.norm(centres[:, None] - centres[None], axis=-1).max()
    depth = _median_depth(solution)
    if angle < limits.min_tri_angle or depth <= 0 or baseline < limits.min_baseline * depth:
        return (
            "The photographs were taken from nearly the same spot (the rays to the same points "
            f"differ by {angle:.1f} degrees), which gives no depth."
        )
    if solution.error > limits.max_error:
        return (
            f"The photographs contradict each other: points miss their place by "
            f"{solution.error:.1f} pixels. Something moved between them, or the zoom changed."
        )
    bare = [view for view in solution.poses if len(solution.points_of(view)) < limits.min_points]
    linked = [evidence.edges[pair] for pair in solution.edges if pair in evidence.edges]
    turned = [
        _turn(solution, pair, evidence)
        for pair in solution.edges
        if pair in evidence.edges and {*pair} <= set(solution.poses)
    ]
    if bare or not linked or (turned and np.median(turned) > limits.max_turn):
        return "The photographs could be placed only by coincidence: too few points agree on it."
    return None


def _flat(evidence: Evidence, limits: Limits) -> str | None:
    if evidence.flat <= limits.max_flat:
        return None
    return (
        "The photographs show no depth: "
        f"{100 * evidence.flat:.0f} % of what they share moves as if painted on a flat board. "
        "The camera was turned on the spot, or what it saw is flat."
    )


def _turn(solution: Solution, pair: Pair, evidence: Evidence) -> float:
    i, j = pair
    turn = solution.poses[j][:3, :3] @ solution.poses[i][:3, :3].T
    return angle_between(turn, evidence.edges[pair].rotation)


def _median_depth(solution: Solution) -> float:
    depths = [solution.points @ pose[2, :3] + pose[2, 3] for pose in solution.poses.values()]
    return float(np.median(np.concatenate(depths))) if depths else 0.0


def warnings_of(
    attempt: Attempt, names: list[str], unsharp: Sequence[int] = (), blank: Sequence[int] = (),
    bright: Sequence[int] = (),
) -> list[str]:  # fmt: skip
    """What the user should know of a reconstruction that stands: views left out, and a guess.

    Args:
        names: how the user knows the photographs.
        unsharp: those that are shaken or out of focus.
        blank: those that show an even surface and nothing else.
        bright: those that lack detail too, and are white in good part.
    """
    solution = attempt.solution
    if solution is None:
        return []
    ways = (unsharp, blank, bright)
    bad = [view for views in ways for view in views]
    unplaced = [view for view in range(len(names)) if view not in solution.poses]
    result = []
    if unplaced:
        placed = set(solution.poses)
        shown = [view for view in unplaced if view not in blank]
        said = [
            f"{len(unplaced)} of {len(names)} photographs could not be placed and are left out: "
            f"{_listed([names[view] for view in unplaced])}.",
            *_bad_ones(names, *([v for v in unplaced if v in way] for way in ways)),
            *(
                _why_unplaced(attempt.evidence, names, view, placed, bad)
                for view in shown[:MOST_NAMED]
            ),
        ]
        result.append(" ".join([*said, HOW_TO_BRIDGE] if shown else said))
    if not attempt.focal_determined:
        few = " Two photographs fit nearly any." if len(solution.poses) < 3 else ""
        result.append(f"The focal length is undetermined: it is a guess.{few} {HOW_TO_GIVE_FOCAL}")
    return result


def _why_unplaced(
    evidence: Evidence, names: list[str], view: int, placed: set[int], unsharp: Sequence[int]
) -> str:
    """One sentence: why a photograph could not be placed beside those that are."""
    usual = float(np.median(evidence.keypoints))
    if evidence.keypoints[view] < BLURRED * usual:
        return (
            f"'{names[view]}' shows only {evidence.keypoints[view]} distinct spots where the "
            f"others show {usual:.0f}: it is blurred, too dark, too bright or mostly masked."
        )
    pair = _best_pair(evidence, [pair for pair in evidence.matches
                                 if view in pair and ({*pair} - {view}) & placed])  # fmt: skip
    if pair is None:
        return f"'{names[view]}' resembles none of the placed ones."
    if pair in evidence.linked:
        other = names[pair[0] if pair[1] == view else pair[1]]
        agreeing = len(evidence.edges[pair].inliers)
        return (
            f"'{names[view]}' matches '{other}' ({agreeing} spots agree), but contradicts the "
            "other photographs: something moved, or the zoom changed."
        )
    return _link(evidence, names, pair, unsharp)


def _gaps(evidence: Evidence, names: list[str], unsharp: Sequence[int]) -> str:
    """A sentence on each gap that keeps photographs apart: the best of the pairs across it."""
    group = groups(list(evidence.linked), len(names))
    sentences: list[str] = []
    while len(set(group)) > 1 and len(sentences) < MOST_NAMED:
        across = [pair for pair in evidence.matches if group[pair[0]] != group[pair[1]]]
        pair = _best_pair(evidence, across)
        if pair is None:
            lone = [names[view] for view in range(len(names)) if group[view] != group[0]]
            sentences.append(f"{_listed(lone)} resemble none of the others.")
            break
        sentences.append(_link(evidence, names, pair, unsharp))
        old, new = group[pair[1]], group[pair[0]]
        group = [new if number == old else number for number in group]
    if sentences:
        return " ".join(sentences)
    return (
        "All photographs are linked by matches, but these contradict each other: something moved "
        "between them, or the zoom changed."
    )


def _best_pair(evidence: Evidence, pairs: list[Pair]) -> Pair | None:
    """The pair that comes nearest to a link."""

    def strength(pair: Pair) -> tuple[float, int]:
        edge = evidence.edges.get(pair)
        return (edge.evidence if edge else 0.0, evidence.matches[pair])

    return min(
        pairs, key=lambda pair: (tuple(-value for value in strength(pair)), pair), default=None
    )  # fmt: skip


def _link(evidence: Evidence, names: list[str], pair: Pair, unsharp: Sequence[int]) -> str:
    """What a pair that does not link has, and what that means where both are sharp."""
    matches = evidence.matches[pair]
    edge = evidence.edges.get(pair)
    agreeing = len(edge.inliers) if edge else 0
    share = agreeing / max(matches, 1)
    if share >= NEAR_ENOUGH:
        why = " So few spots are in photographs that are small, or hardly show any detail."
    else:
        why = f" They are probably more than {LINKED_UP_TO} degrees apart"
        why += ", or one shows something else and is to be left out." if share < BY_CHANCE else "."
    return (
        f"'{names[pair[0]]}' and '{names[pair[1]]}' share too little: {matches} spots look alike, "
        f"of which {agreeing} ({100 * share:.0f} %) agree on where the camera stood."
        f"{'' if {*pair} & {*unsharp} else why}"
    )


def _advice(attempt: Attempt, names: list[str], unsharp: Sequence[int]) -> str:
    if len(unsharp) == len(names):
        return ""  # sharp ones come first
    return HOW_TO_BRIDGE if attempt.focal_known else f"{HOW_TO_BRIDGE} {HOW_TO_GIVE_FOCAL}"


def _listed(names: list[str]) -> str:
    shown = ", ".join(f"'{name}'" for name in names[:6])
    return shown if len(names) <= 6 else f"{shown} and {len(names) - 6} more"
