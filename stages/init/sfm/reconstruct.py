"""Cameras and sparse points from photographs alone: features, pairs, focal length, mapping."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt
from threadpoolctl import threadpool_limits

from pipeline.geometry.graph import Pair
from pipeline.kernels.threads import in_threads
from stages.init.sfm.mapping import MappingInput, Solution
from stages.init.sfm.matching.features import (
    Features,
    copies_of,
    describe,
    detect_features,
    joined,
    reduced,
)
from stages.init.sfm.matching.match import (
    candidate_pairs,
    match_features,
    overlap_counts,
    select_pairs,
)
from stages.init.sfm.matching.roll import find_rolls, groups
from stages.init.sfm.matching.two_view import (
    Correspondences,
    Lens,
    TwoView,
    coherent_matches,
    homography_share,
    unrolled,
)
from stages.init.sfm.options import (
    COHERENCE_RADIUS,
    COPIES_SIDE,
    REFERENCE_SIDE,
    VIEWS_PER_FREE_LENS,
    ClassicalOptions,
    RefinementOptions,
)
from stages.init.sfm.refine import refine_solution, with_zoomed
from stages.init.sfm.solver import Progress, Solver, known_focal, unknown_focal

#: Defaults of the last adjustment.
REFINEMENT = RefinementOptions()
#: Features of each view that tell how much two overlap; from so many matches among them on plain
#: features do, without squeezed copies.
OVERLAP_FEATURES, OVERLAP_MATCHES = 800, 80
#: Pairs that are matched fully, for each view.
PAIRS_PER_VIEW = 6
#: How many pairs are asked whether there is any parallax.
PAIRS_CHECKED_FOR_DEPTH = 4
#: Pixels below which nothing moved between two photographs, and evidence that makes it certain.
STILL, CERTAIN = 1.5, 25
#: Focal lengths that differ by less than this (relative) are of one lens at one zoom.
SAME_LENS = 0.005
#: `Evidence.flat` from which on no cameras are looked for.
FLAT = 0.98


@dataclass(frozen=True)
class Evidence:
    """What the photographs say of each other, for the diagnosis.

    Attributes:
        keypoints: [N] keypoints of each view.
        matches: pair -> number of matches.
        displacement: pair -> median length in pixels by which its coherent matches move.
        edges: pair -> two-view geometry at the focal length used last.
        linked: the pairs that can be believed.
        flat: least share of the inliers of a pair that one homography explains, of the pairs used
            that move most; 1: there is no depth to see.
        correspondences: the matches themselves, that `edges` tell the inliers of.
    """

    keypoints: list[int]
    matches: dict[Pair, int]
    displacement: dict[Pair, float]
    edges: dict[Pair, TwoView] = field(default_factory=dict)
    linked: tuple[Pair, ...] = ()
    flat: float = 0.0
    correspondences: Mapping[Pair, Correspondences] = field(default_factory=dict)

    def certain(self) -> list[Pair]:
        """The pairs that are beyond doubt; none where these leave views out."""
        found = [pair for pair, edge in self.edges.items() if edge.evidence >= CERTAIN]
        linked = {view for pair in found for view in pair}
        return found if len(linked) == len(self.keypoints) else []

    def is_still(self, pairs: Iterable[Pair] | None = None) -> bool:
        """Does none of these pairs, all that are certain by default, show any movement?"""
        certain = self.certain()
        asked = certain if pairs is None else pairs
        return bool(certain) and all(self.displacement[pair] < STILL for pair in asked)


@dataclass(frozen=True)
class Attempt:
    """The outcome of `reconstruct`.

    Attributes:
        solution: the best reconstruction, or None.
        evidence: for the diagnosis of what is missing.
        focal_known: the focal length was given or is in EXIF.
        focal_determined: the photographs determine it.
    """

    solution: Solution | None
    evidence: Evidence
    focal_known: bool
    focal_determined: bool


def reconstruct(
    grays: list[npt.NDArray[np.uint8]],
    valid: list[npt.NDArray[np.bool_]],
    focals: list[float | None],
    focal_given: bool,
    ordered: bool,
    options: ClassicalOptions,
    *,
    seed: int,
    threads: int,
    scratch: Path,
    progress: Progress,
    refinement: RefinementOptions = REFINEMENT,
    plain_features: list[Features] | None = None,
) -> Attempt:
    """Find cameras and sparse points.

    Args:
        grays: N images [H, W] uint8.
        valid: N masks [H, W]; outside there are no features.
        focals: N focal lengths in pixels, or None where unknown.
        focal_given: they are known for sure, and not to be refined.
        ordered: the views are a sequence.
        threads: how many to use; doesn't change the result.
        scratch: folder for the mapper's files.
        progress: called with (step, done, total).
        refinement: settings of the last adjustment.
        plain_features: what `find_features` finds without squeezed copies, if that has been done.
    """
    side = max(max(gray.shape) for gray in grays)
    pixel = side / REFERENCE_SIDE
    shapes = [gray.shape for gray in grays]
    lenses, lens_of_view = group_lenses(shapes, focals)

    def matched(
        rolls: list[float],
    ) -> tuple[list[Features], dict[Pair, Correspondences], Solver]:
        def solver_of(correspondences: dict[Pair, Correspondences]) -> Solver:
            given = MappingInput.of(lenses, lens_of_view, features, correspondences, shapes)
            return Solver(given, options, pixel, seed, threads, scratch)

        plain = tuple(squeeze for squeeze in options.squeezes if squeeze == 1) or options.squeezes
        first = replace(options, squeezes=plain)
        features = list(plain_features or ()) if plain == (1.0,) and not any(rolls) else []
        features = features or find_features(grays, valid, first, threads, progress, rolls, scratch)
        counts = overlaps(features, ordered, options)
        near = [pair for pair, count in counts.items() if count >= OVERLAP_MATCHES]
        found = match_pairs(features, near, options, pixel, threads, progress)
        solver = solver_of(found)
        lacking = weakly_linked(solver.links(), len(grays))
        far = [pair for pair in counts if pair not in found and lacking & {*pair}]
        if not far:
            return features, found, solver
        copies = tuple(squeeze for squeeze in options.squeezes if squeeze not in plain)
        turned = sorted({view for pair in far for view in pair}) if copies else []
        small = [reduced(grays[view], valid[view], COPIES_SIDE) for view in turned]
        more = find_features(
            [gray for gray, _ in small], [inside for _, inside in small],
            replace(options, squeezes=copies), threads, progress, [rolls[view] for view in turned],
            scratch,
        )  # fmt: skip
        for view, (gray, _), others in zip(turned, small, more, strict=True):
            height, width = grays[view].shape
            others = others.enlarged((width / gray.shape[1], height / gray.shape[0]))
            features[view] = joined(features[view], others)
        found |= match_pairs(features, far, options, pixel, threads, progress)
        return features, dict(sorted(found.items())), solver_of(found)

    features, correspondences, solver = matched([0.0] * len(grays))
    linked = solver.links()
    if refinement.unroll and len(set(groups(linked, len(grays)))) > 1:
        small = [reduced(*pair, COPIES_SIDE) for pair in zip(grays, valid, strict=True)]
        rolls = find_rolls(
            [gray for gray, _ in small], [inside for _, inside in small], linked,
            options.peak_threshold, max(max(gray.shape) for gray, _ in small) / REFERENCE_SIDE,
            threads, progress,
        )  # fmt: skip
        if any(rolls):
            features, correspondences, solver = matched(rolls)
    evidence = Evidence(
        keypoints=[len(np.unique(feature.points)) for feature in features],
        matches={pair: len(found) for pair, found in correspondences.items()},
        displacement={pair: _displacement(found) for pair, found in correspondences.items()},
        correspondences=correspondences,
    )
    unmoved = replace(evidence, edges=solver.first_edges(), linked=tuple(solver.links()))

    def flatness(pairs: Iterable[Pair], edges: Mapping[Pair, TwoView]) -> float:
        moving = sorted(pairs, key=lambda pair: (-evidence.displacement[pair], pair))
        shares = [
            homography_share(
                correspondences[pair], edges[pair].inliers, options.max_error * pixel, seed
            )
            for pair in moving[:PAIRS_CHECKED_FOR_DEPTH]
        ]
        return min(shares, default=0.0)

    unmoved = replace(unmoved, flat=flatness(unmoved.certain(), unmoved.edges))
    if unmoved.is_still(correspondences) or unmoved.flat > FLAT:  # at whatever focal length
        return Attempt(None, unmoved, all(lens.focal for lens in lenses), focal_determined=False)
    free = options.refine_focal == "always" or (
        options.refine_focal == "auto"
        and not focal_given
        and len(grays) >= VIEWS_PER_FREE_LENS * len(lenses)
    )
    known = all(lens.focal for lens in lenses)
    if known:
        best, determined = known_focal(solver, free, progress), True
    else:
        best, determined = unknown_focal(solver, free, progress)
    if best is not None:
        best = solver.with_other_mapper(best, free)
        best = refine_solution(solver, best, free, refinement)
        solver, best = with_zoomed(solver, best, free, refinement)
    progress("reconstruct", 1, 1)
    edges = solver.edges_used(best)
    used = [pair for pair in best.edges if pair in edges] if best else []
    return Attempt(
        solution=best,
        evidence=replace(
            evidence,
            edges=edges,
            linked=tuple(solver.believed(edges)),
            flat=flatness(used, edges),
        ),
        focal_known=known,
        focal_determined=determined,
    )


def group_lenses(
    shapes: Iterable[tuple[int, ...]], focals: list[float | None]
) -> tuple[list[Lens], list[int]]:
    """Share one lens among views of one size and one known focal length.

    Photographs upright and on their sides are of one size, and so is what scaling has rounded: of
    6000 x 4000 and 1024 x 683 pixels come 341 and 342 rows at 512 columns. The lens is as wide and
    as high as all of its views, which lie in its middle. A view without a known focal length, where
    other views have one, is taken to have their median over the long side.
    """
    sizes = [(shape[1], shape[0]) for shape in shapes]
    known = [focal / max(size) for focal, size in zip(focals, sizes, strict=True) if focal]
    usual = float(np.median(known)) if known else None
    lenses: list[Lens] = []
    firsts: list[Lens] = []  # of each lens, as its first view has it
    lens_of_view = []
    for (width, height), focal in zip(sizes, focals, strict=True):
        if not focal and usual:
            focal = usual * max(width, height)
        lens = Lens(width, height, round(focal, 1) if focal else None)
        number = next((k for k, first in enumerate(firsts) if _is_one(lens, first)), len(lenses))
        if number == len(lenses):
            lenses.append(lens)
            firsts.append(lens)
        other = lenses[number]
        lenses[number] = replace(
            other, width=max(width, other.width), height=max(height, other.height)
        )
        lens_of_view.append(number)
    return lenses, lens_of_view


def _is_one(lens: Lens, other: Lens) -> bool:
    """Are two lenses, both with a focal length or both without, one but for how they are held?"""
    sides = sorted((lens.width, lens.height)), sorted((other.width, other.height))
    apart = max(abs(a - b) for a, b in zip(*sides, strict=True))
    return apart <= 1 and abs((lens.focal or 1.0) / (other.focal or 1.0) - 1) < SAME_LENS


def find_features(
    grays: list[npt.NDArray[np.uint8]],
    valid: list[npt.NDArray[np.bool_]],
    options: ClassicalOptions,
    threads: int,
    progress: Progress,
    rolls: list[float] | None = None,
    scratch: Path | None = None,
) -> list[Features]:
    """The features of all views; `rolls` are their rolls in degrees, if any is known."""
    rolls = rolls or [0.0] * len(grays)
    count = len(options.squeezes)
    features: list[Features] = []
    # A few views at a time, so that one sees how it goes on.
    for start in range(0, len(grays), 2 * threads):
        views = range(start, min(start + 2 * threads, len(grays)))
        copies = [
            copy for view in views for copy in copies_of(grays[view], options.squeezes, rolls[view])
        ]
        found = describe(
            copies, options.upright, options.peak_threshold, options.max_features, threads, scratch
        )
        for number, view in enumerate(views):
            features.append(
                detect_features(
                    grays[view], valid[view],
                    squeezes=options.squeezes, roll=rolls[view],
                    described=found[number * count : (number + 1) * count],
                )
            )  # fmt: skip
        progress("features", len(features), len(grays))
    return features


def match_views(
    features: list[Features],
    ordered: bool,
    options: ClassicalOptions,
    pixel: float,
    threads: int,
    progress: Progress,
) -> dict[Pair, Correspondences]:
    """The matches of all pairs of views that may overlap.

    Views near each other match without the squeezed copies, at a fifth of the cost.
    """
    counts = overlaps(features, ordered, options)
    near = [pair for pair, count in counts.items() if count >= OVERLAP_MATCHES]
    plain = [feature.plain() for feature in features]
    found = match_pairs(plain, near, options, pixel, threads, progress)
    far = [pair for pair in counts if pair not in found]
    found |= match_pairs(features, far, options, pixel, threads, progress)
    return dict(sorted(found.items()))


def overlaps(features: list[Features], ordered: bool, options: ClassicalOptions) -> dict[Pair, int]:
    """The pairs of views worth matching, with the count that says how much they overlap."""
    pairs = candidate_pairs(len(features), ordered, options.window)
    with threadpool_limits(1, "blas"):
        counts = overlap_counts(features, pairs, OVERLAP_FEATURES)
    chosen = select_pairs(counts, len(features), PAIRS_PER_VIEW)
    return {pair: counts[pair] for pair in chosen}


def weakly_linked(links: list[Pair], count: int) -> set[int]:
    """The views outside the largest group of linked ones, or linked to less than two others."""
    group = groups(links, count)
    largest = max(set(group), key=lambda number: (group.count(number), -number))
    degrees = np.bincount(np.array(links, np.int64).ravel(), minlength=count)
    return {
        view for view in range(count) if group[view] != largest or degrees[view] < min(2, count - 1)
    }


def match_pairs(
    features: list[Features],
    pairs: list[Pair],
    options: ClassicalOptions,
    pixel: float,
    threads: int,
    progress: Progress,
) -> dict[Pair, Correspondences]:
    """The matches of these pairs of views."""

    def match(pair: Pair) -> Correspondences:
        i, j = pair
        found = match_features(features[i], features[j], ratio=options.match_ratio)
        positions_i = features[i].positions[found[:, 0]]
        positions_j = features[j].positions[found[:, 1]]
        rolls = features[i].roll, features[j].roll
        coherent = coherent_matches(
            unrolled(positions_i, rolls[0]), unrolled(positions_j, rolls[1]),
            COHERENCE_RADIUS * pixel,
        )  # fmt: skip
        return Correspondences(found, positions_i, positions_j, coherent, *rolls)

    # OpenBLAS's own threads wait by spinning: under ours they took 2.6 times the CPU time.
    with threadpool_limits(1, "blas"):
        found = in_threads(
            match, pairs, threads, lambda done: progress("matching", done, len(pairs))
        )
    return dict(zip(pairs, found, strict=True))


def _displacement(found: Correspondences) -> float:
    moved = (found.positions_j - found.positions_i)[found.coherent]
    return float(np.median(np.linalg.norm(moved, axis=1))) if len(moved) else float("inf")
