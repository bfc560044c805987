"""Which tooth is which and where the cameras are, from the crowns in a few wide photographs.

The teeth are the landmarks, a textbook arch is the prior: labellings are compared by evidence
(`labellings`), near ones by how the pictures match on the unrolled arch (`rivals`,
`matching`), the best one is refined with these matches, and what speaks against it is said
(`confidence`).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from pipeline.artifacts.dental.fdi import JAWS, permanent_of, teeth_of
from pipeline.artifacts.teeth import Dentition
from pipeline.errors import RequestError
from stages.dentition.changing_teeth import refuse_two_in_one_place
from stages.dentition.tooth_rows import NO_TOOTH, Labels
from stages.init.dental.cameras.held import held_cameras, roll_matrix
from stages.init.dental.landmarks import Landmark
from stages.init.dental.numbering.arch_options import ArchOptions
from stages.init.dental.numbering.colours import colour_distances
from stages.init.dental.numbering.confidence import (
    Evidence,
    case_confidence,
    fit_doubts,
    kind_doubts,
    landmark_errors,
    plain_role,
    role_doubts,
)
from stages.init.dental.numbering.labellings.edits import (
    MIN_GAIN,
    Fixed,
    common_mouth,
    improve,
    settle_ends,
    solve_shifted,
)
from stages.init.dental.numbering.labellings.scorer import (
    MAIN_ROLES,
    Scored,
    Scorer,
)
from stages.init.dental.numbering.labellings.search import (
    roles_of_view,
    search,
    view_candidates,
)
from stages.init.dental.numbering.matching import Matching
from stages.init.dental.numbering.mirrored import MIRRORED, mirror_evidence
from stages.init.dental.numbering.primary import ALL_PRIMARY, perhaps_primary, primary_teeth
from stages.init.dental.numbering.rivals import judged_by_pictures, label_doubts, margins
from stages.init.dental.numbering.sightings import as_a_childs, seen_rows
from stages.init.dental.solution import ArchFit, PlacedView
from stages.init.dental.template import landmark_names, position_of, textbook_arch, tooth_at

__all__ = ["ArchOptions", "fit_arch"]

Array = npt.NDArray[np.float64]
Image = npt.NDArray[np.float32]
Mask = npt.NDArray[np.bool_]
Progress = Callable[[str, int, int], None]

#: A photograph needs this many crowns in all to be placed.
MIN_CROWNS = 4
#: Labellings from the search that edits start from, where they are this near the best.
EDITED, EDIT_WINDOW = 3, 40.0
#: Then labellings shifted by a tooth that are no more than this worse are edited too, so often.
SHIFTS, EDIT_GAP = 3, 30.0
#: How far away known cameras are, they say themselves: hardly any prior (relative deviation).
HELD_DISTANCE_DEVIATION = 0.5


def fit_arch(
    dentitions: list[Dentition | None],
    images: list[Image],
    valid: list[Mask],
    focals: list[float | None],
    options: ArchOptions,
    threads: int,
    progress: Progress,
    names: list[str] | None = None,
    cameras: list[Array] | None = None,
) -> ArchFit:
    """Name the teeth and place the cameras of a few photographs of one patient's closed bite.

    Args:
        dentitions: the crowns of each photograph, None: it takes no part. A crown whose doubt is 0
            keeps its number.
        images: [H, W, 3] float32 RGB, 0 to 1, of each.
        valid: [H, W] bool of each; outside, nothing is matched.
        focals: known focal lengths in pixels of the working image, or None. They are held.
        options: settings.
        threads: threads to use; the result does not depend on them.
        progress: told (step, done, total).
        names: how the user knows the photographs; None: "photo 0", "photo 1", ...
        cameras: [4, 4] known cam_from_world of each, in any unit, if they are known (their focals
            too): they are held, and the arch is fitted in front of them.

    Returns:
        The fit, in the arch frame (see `PlacedView`). A photograph that can't be placed is None
        there and named among the doubts; with fewer than two left all are.

    Raises:
        RequestError: `options.order` doesn't fit the photographs, or numbers contradict.
        ValueError: the lists are not of one length.
    """
    _check(dentitions, images, valid, focals, options)
    if cameras is not None:
        options = replace(options, distance_deviation=HELD_DISTANCE_DEVIATION)
    names = names or [f"photo {index}" for index in range(len(dentitions))]
    doubts: list[str] = []
    placeable = []
    for index, dentition in enumerate(dentitions):
        if dentition is None:
            continue
        if len(dentition.upper) + len(dentition.lower) < MIN_CROWNS:
            doubts.append(f"{names[index]} could not be placed: it shows too few crowns")
        else:
            placeable.append(index)
    if len(placeable) < 2:
        doubts.append("fewer than two photographs show teeth well enough")
        return ArchFit((None,) * len(dentitions), {}, {}, 0.0, tuple(doubts))
    read = [dentition for dentition in (dentitions[i] for i in placeable) if dentition is not None]
    perhaps_a_child = perhaps_primary(read)
    if perhaps_a_child:
        options = options.of_a_child()
    inner = replace(
        options,
        order=None if options.order is None else tuple(options.order[i] for i in placeable),
    )
    shown = [names[i] for i in placeable]
    refuse_two_in_one_place(read, shown)
    fixed = _fixed_labels(read)
    focal, deviation = _focal_priors([focals[i] for i in placeable], read, options)
    rows = [seen_rows(dentition) for dentition in read]

    rolls = [dentition.roll for dentition in read]
    held = None if cameras is None else held_cameras([cameras[i] for i in placeable], rolls)
    scorer = Scorer(rows, focal, deviation, replace(inner, order=None), threads, held)
    best, others = _label(scorer, fixed, shown, progress)
    if inner.order is not None:
        best, others, scorer, contradiction = _keep_order(
            Scorer(rows, focal, deviation, inner, threads, held), fixed, scorer, best,
            others, shown, progress,
        )  # fmt: skip
        doubts += contradiction
    elif len(placeable) == 3 or (len(placeable) == 2 and held is None):
        doubts += role_doubts(best)
    cost, primary = primary_teeth(scorer, best, read)
    if perhaps_a_child:
        # A child's arch may tell another numbering than an adult's.
        childs = [(as_a_childs(upper), as_a_childs(lower)) for upper, lower in rows]
        child = Scorer(childs, focal, deviation, scorer.options, threads, held, ALL_PRIMARY)
        rival, rivals = _label(child, fixed, shown, progress)
        rival_cost, rival_primary = primary_teeth(child, rival, read)
        if rival_cost < cost:
            scorer, best, others, primary = child, rival, rivals, rival_primary
    best, ends = settle_ends(scorer, best, fixed)
    others += ends
    matching = Matching(
        scorer, read, [images[i] for i in placeable], [valid[i] for i in placeable], options
    )
    if options.dense_rounds:
        numbered = best.labelling
        best, others = judged_by_pictures(best, others, matching.shares)
        if best.labelling != numbered:
            best, ends = settle_ends(scorer, best, fixed)
            others += ends
            _, primary = primary_teeth(scorer, best, read)
    gaps = margins(best, others)
    shares = label_doubts(best, others, options.min_margin)
    if primary != best.labelling.primary:
        start = (best.adjusted.unknowns, best.adjusted.offsets)
        best = scorer.solve(replace(best.labelling, primary=primary), start)
    common = common_mouth(scorer, best)
    mirrored = mirror_evidence(scorer, best, read)

    best, pairs = matching.refined(best, progress)
    bands = [dentition.band_height for dentition in read]
    colours = colour_distances([images[i] for i in placeable], read)
    evidence = Evidence(gaps, common, mirrored, colours, bands, pairs)
    more, figures = fit_doubts(shown, scorer, best, evidence, options)
    doubts += more + kind_doubts(best, read, shown)
    found = _outcome(
        scorer, best, read, placeable, len(dentitions), gaps.cameras, doubts, figures, shares
    )
    turned = {placeable[view] for view, factor in mirrored.items() if factor > MIRRORED}
    return replace(found, mirrored=tuple(sorted(turned)))


def _check(
    dentitions: list[Dentition | None],
    images: list[Image],
    valid: list[Mask],
    focals: list[float | None],
    options: ArchOptions,
) -> None:
    """Refuse what doesn't fit together."""
    count = len(dentitions)
    if not count == len(images) == len(valid) == len(focals):
        raise ValueError(
            f"{count} dentitions, {len(images)} images, {len(valid)} masks and {len(focals)} focal "
            f"lengths were given; there must be one of each per photograph."
        )
    if options.order is not None:
        known = (*MAIN_ROLES, "between")
        if len(options.order) != count or any(role not in known for role in options.order):
            raise RequestError(
                f"The order {','.join(options.order)} does not fit {count} photographs: give one "
                f"of {', '.join(known)} for each photograph, in file order."
            )


def _fixed_labels(dentitions: list[Dentition]) -> Fixed:
    """Crowns whose number a person has said (doubt 0) -> position."""
    return {
        (view, jaw, crown): position_of(permanent_of(found.number))
        for view, dentition in enumerate(dentitions)
        for jaw, name in enumerate(JAWS)
        for crown, found in enumerate(dentition.crowns(name))
        if not found.doubt and permanent_of(found.number) in teeth_of(name)
    }


def _focal_priors(
    focals: list[float | None], dentitions: list[Dentition], options: ArchOptions
) -> tuple[Array, Array]:
    """Focal lengths in pixels and their relative standard deviations (0 where known)."""
    values, deviations = [], []
    for focal, dentition in zip(focals, dentitions, strict=True):
        # Of the long side: turning the camera upright does not change its lens.
        values.append(focal or options.focal_per_side * max(dentition.size))
        deviations.append(0.0 if focal else options.focal_deviation)
    return np.array(values, np.float64), np.array(deviations, np.float64)


def _label(
    scorer: Scorer, fixed: Fixed, photos: list[str], progress: Progress
) -> tuple[Scored, list[Scored]]:
    """The best labelling of all views and others that were solved."""
    count = len(scorer.rows)
    candidates = {}
    for view in range(count):
        progress("teeth of each photo", view, count)
        roles = roles_of_view(view, count, scorer.options)
        candidates[view] = view_candidates(scorer, view, roles, fixed)
        if not candidates[view]:
            raise RequestError(
                f"The tooth numbers given for {photos[view]} contradict each other, or the teeth "
                "beside and opposite them: from left to right each crown is the next tooth of its "
                "row, and the same teeth of both jaws stand above each other; only two crowns that "
                "touch may have one number, as parts of one."
            )
    progress("numbering the teeth", 0, 1)
    found = search(scorer, candidates)
    starts: list[Scored] = []
    for scored in found:
        near = scored.score < found[0].score + EDIT_WINDOW
        # The same numbers in other roles would be edited to the same end.
        new = all(scored.labelling.labels != start.labelling.labels for start in starts)
        if near and new and len(starts) < EDITED:
            starts.append(scored)
    improved: list[Scored] = []
    others = list(found)
    for start in starts:
        better, tried = improve(scorer, start, fixed)
        improved.append(better)
        others += tried
    best = min(improved, key=lambda s: (s.score, s.labelling.labels))
    others += [s for s in improved if s is not best]
    for _ in range(SHIFTS):
        # Edits move a row at a time; what is off by a tooth in all views needs this.
        shifted = solve_shifted(scorer, best, fixed)
        others += shifted
        rival = min(shifted, key=lambda s: (s.score, s.labelling.labels), default=best)
        if rival.score > best.score + EDIT_GAP:
            break
        better, tried = improve(scorer, rival, fixed)
        others += [*tried, better]
        if better.score > best.score - MIN_GAIN:
            break
        others.append(best)
        best = better
    progress("numbering the teeth", 1, 1)
    return best, others


def _keep_order(
    ordered: Scorer,
    fixed: Fixed,
    free: Scorer,
    free_best: Scored,
    free_others: list[Scored],
    photos: list[str],
    progress: Progress,
) -> tuple[Scored, list[Scored], Scorer, list[str]]:
    """Hold the order given, unless the teeth clearly say otherwise: then say what is wrong."""
    best, others = _label(ordered, fixed, photos, progress)
    given = best.labelling.roles
    found = free_best.labelling.roles
    if found == given or free_best.score > best.score - ordered.options.min_margin:
        return best, others, ordered, []
    wrong = [
        f"{photo} (given as {plain_role(a)}, looks like {plain_role(b)})"
        for photo, a, b in zip(photos, given, found, strict=True)
        if plain_role(a) != plain_role(b)
    ]
    sides = {plain_role(a) for a, b in zip(given, found, strict=True) if a != b}
    hint = "the order is wrong"
    if sides == {"right", "left"}:
        hint = "left and right are swapped, or the photographs are mirrored"
    sentence = f"the order given contradicts the teeth: {hint}; see {', '.join(wrong)}"
    return free_best, free_others, free, [sentence] if wrong else []


def _outcome(
    scorer: Scorer,
    best: Scored,
    dentitions: list[Dentition],
    photos: list[int],
    count: int,
    gap: float,
    doubts: list[str],
    figures: dict[str, float],
    crown_shares: list[tuple[tuple[float, ...], tuple[float, ...]]],
) -> ArchFit:
    """The fit in the terms of the contract.

    Its size is brought to that of the textbook's teeth, all in all. The adjustment alone weighs the
    height of the crowns against their width: long crowns came out as small mouths (of 20 generated
    ones three by a sixth).
    """
    adjusted, labelling = best.adjusted, best.labelling
    sightings = scorer.sightings(labelling)
    errors = landmark_errors(adjusted, sightings)
    names = landmark_names()
    seen = np.unique(sightings.landmark)
    textbook = textbook_arch(labelling.closed, labelling.primary)
    enlarged = size_of(textbook[seen]) / size_of(adjusted.points[seen])
    views: list[PlacedView | None] = [None] * count
    for view, photo in enumerate(photos):
        turn = roll_matrix(dentitions[view].roll)
        pose = np.eye(4)
        pose[:3, :3] = turn @ adjusted.rotations[view]
        pose[:3, 3] = enlarged * turn @ adjusted.translations[view]
        mine = sightings.view == view
        views[photo] = PlacedView(
            cam_from_world=pose,
            focal=float(adjusted.focals[view]),
            role=plain_role(labelling.roles[view]),
            upper=_teeth(0, labelling.labels[view][0]),
            lower=_teeth(1, labelling.labels[view][1]),
            upper_doubts=crown_shares[view][0],
            lower_doubts=crown_shares[view][1],
            error=float(np.median(errors[mine])) if mine.any() else float("inf"),
        )
    gone = labelling.absent
    shape: dict[Landmark, Array] = {
        name: enlarged * adjusted.points[i]
        for i, name in enumerate(names)
        if name.tooth not in gone and name.neighbour not in gone
    }
    return ArchFit(
        views=tuple(views),
        landmarks={names[i]: shape[names[i]] for i in seen if names[i] in shape},
        shape=shape,
        margin=float(gap),
        doubts=tuple(doubts),
        figures=figures,
        primary=labelling.primary,
        confidence=case_confidence(figures, bool(doubts), scorer.options),
    )


def size_of(points: Array) -> float:
    """Root mean square distance of points [N, 3] from their mean."""
    return float(np.sqrt(points.var(axis=0).sum()))


def _teeth(jaw: int, labels: Labels) -> tuple[int, ...]:
    """FDI numbers of a row's labels, 0 for no tooth."""
    return tuple(0 if label == NO_TOOTH else tooth_at(JAWS[jaw], label) for label in labels)
