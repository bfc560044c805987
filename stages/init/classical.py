"""Cameras and sparse points from photographs alone: features, pairs, focal length, mapping."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt

from stages.init.blas import one_blas_thread
from stages.init.features import Features, detect_features
from stages.init.focal import better, search_focal
from stages.init.geometry import (
    Correspondences,
    Lens,
    Pair,
    TwoView,
    coherent_matches,
    trusted_edges,
    verify_pair,
)
from stages.init.mapping import MappingInput, Solution, map_views
from stages.init.matching import candidate_pairs, match_features, overlap_counts, select_pairs

Progress = Callable[[str, int, int], None]
Result = TypeVar("Result")

#: Pixel thresholds are given for images of this long side and scale with it.
REFERENCE_SIDE = 512.0
#: Coherence looks at neighbours this near (pixels at the reference size).
COHERENCE_RADIUS = 40.0


@dataclass(frozen=True)
class ClassicalOptions:
    """Settings of `reconstruct`; the stage's config describes each for users."""

    squeezes: tuple[float, ...] = (1.0, 0.71, 0.5)
    upright: bool = True
    peak_threshold: float = 0.002
    max_features: int = 6000
    merge_radius: float = 1.2
    match_ratio: float = 0.88
    overlap_features: int = 800
    overlap_matches: int = 80
    pairs_per_view: int = 6
    window: int = 4
    max_error: float = 2.0
    min_inliers: int = 25
    min_coherence: float = 0.8
    cycle_angle: float = 8.0
    refine_focal: str = "auto"
    mapper: str = "auto"
    max_reprojection_error: float = 2.0
    min_tri_angle: float = 1.0


@dataclass(frozen=True)
class Evidence:
    """What the photographs say of each other, for the diagnosis.

    Attributes:
        keypoints: [N] keypoints of each view.
        matches: pair -> number of matches.
        displacement: pair -> median length in pixels by which its coherent matches move.
        edges: pair -> two-view geometry at the focal length used last.
    """

    keypoints: list[int]
    matches: dict[Pair, int]
    displacement: dict[Pair, float]
    edges: dict[Pair, TwoView] = field(default_factory=dict)


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
    ordered: bool,
    options: ClassicalOptions,
    *,
    seed: int,
    threads: int,
    scratch: Path,
    progress: Progress,
) -> Attempt:
    """Find cameras and sparse points.

    Args:
        grays: N images [H, W] uint8.
        valid: N masks [H, W]; outside there are no features.
        focals: N focal lengths in pixels, or None where unknown.
        ordered: the views are a sequence.
        threads: how many to use; doesn't change the result.
        scratch: folder for the mapper's files.
        progress: called with (step, done, total).
    """
    side = max(max(gray.shape) for gray in grays)
    pixel = side / REFERENCE_SIDE
    features = _features(grays, valid, options, threads, progress)
    correspondences = _correspondences(features, ordered, options, pixel, threads, progress)
    lenses, lens_of_view = group_lenses([gray.shape for gray in grays], focals)
    given = MappingInput(
        lenses=lenses,
        lens_of_view=lens_of_view,
        positions=[feature.positions for feature in features],
        points=[feature.points for feature in features],
        correspondences=correspondences,
    )
    evidence = Evidence(
        keypoints=[len(np.unique(feature.points)) for feature in features],
        matches={pair: len(found) for pair, found in correspondences.items()},
        displacement={pair: _displacement(found) for pair, found in correspondences.items()},
    )
    solver = _Solver(given, options, pixel, seed, threads, scratch)
    known = all(lens.focal for lens in lenses)
    count = len(grays)
    free = options.refine_focal == "always" or (options.refine_focal == "auto" and count >= 6)
    determined = known
    if known:
        progress("reconstruct", 0, 1)
        best = solver.solve([float(lens.focal or 0) for lens in lenses], free)
    else:
        best, determined = _unknown_focal(solver, count, free, progress)
    if best is not None:
        best = solver.with_other_mapper(best, free)
    progress("reconstruct", 1, 1)
    return Attempt(
        solution=best,
        evidence=Evidence(evidence.keypoints, evidence.matches, evidence.displacement,
                          solver.edges_used(best)),
        focal_known=known,
        focal_determined=determined,
    )  # fmt: skip


def group_lenses(
    shapes: Iterable[tuple[int, ...]], focals: list[float | None]
) -> tuple[list[Lens], list[int]]:
    """Share one lens among views of one size and one known focal length.

    A view without a known focal length, where other views have one, is taken to have their median
    over the long side.
    """
    sizes = [(shape[1], shape[0]) for shape in shapes]
    known = [focal / max(size) for focal, size in zip(focals, sizes, strict=True) if focal]
    usual = float(np.median(known)) if known else None
    lenses: list[Lens] = []
    lens_of_view = []
    for (width, height), focal in zip(sizes, focals, strict=True):
        if not focal and usual:
            focal = usual * max(width, height)
        lens = Lens(width, height, round(focal, 1) if focal else None)
        if lens not in lenses:
            lenses.append(lens)
        lens_of_view.append(lenses.index(lens))
    return lenses, lens_of_view


def _features(
    grays: list[npt.NDArray[np.uint8]],
    valid: list[npt.NDArray[np.bool_]],
    options: ClassicalOptions,
    threads: int,
    progress: Progress,
) -> list[Features]:
    def detect(view: int) -> Features:
        return detect_features(
            grays[view], valid[view],
            squeezes=options.squeezes, upright=options.upright,
            peak_threshold=options.peak_threshold, max_features=options.max_features,
            merge_radius=options.merge_radius,
        )  # fmt: skip

    return _in_threads(
        detect, range(len(grays)), threads, lambda done: progress("features", done, len(grays))
    )


def _correspondences(
    features: list[Features],
    ordered: bool,
    options: ClassicalOptions,
    pixel: float,
    threads: int,
    progress: Progress,
) -> dict[Pair, Correspondences]:
    pairs = candidate_pairs(len(features), ordered, options.window)
    with one_blas_thread():
        counts = overlap_counts(features, pairs, options.overlap_features)
    pairs = select_pairs(counts, len(features), options.pairs_per_view)
    plain = [np.flatnonzero(feature.squeezes == 1) for feature in features]

    def match(pair: Pair) -> Correspondences:
        i, j = pair
        # Views this near each other match without the squeezed copies, at a fifth of the cost.
        near = counts[pair] >= options.overlap_matches
        found = match_features(
            features[i], features[j],
            ratio=options.match_ratio,
            use_first=plain[i] if near else None,
            use_second=plain[j] if near else None,
        )  # fmt: skip
        positions_i = features[i].positions[found[:, 0]]
        positions_j = features[j].positions[found[:, 1]]
        coherent = coherent_matches(positions_i, positions_j, COHERENCE_RADIUS * pixel)
        return Correspondences(found, positions_i, positions_j, coherent)

    with one_blas_thread():
        found = _in_threads(
            match, pairs, threads, lambda done: progress("matching", done, len(pairs))
        )
    return dict(zip(pairs, found, strict=True))


def _displacement(found: Correspondences) -> float:
    moved = (found.positions_j - found.positions_i)[found.coherent]
    return float(np.median(np.linalg.norm(moved, axis=1))) if len(moved) else float("inf")


def _unknown_focal(
    solver: _Solver, count: int, free: bool, progress: Progress
) -> tuple[Solution | None, bool]:
    """Free bundle adjustment where it can be trusted, else a search over fixed focal lengths."""
    if free:
        progress("reconstruct", 0, 3)
        first = solver.solve_ratio(1.2, True)
        progress("reconstruct", 1, 3)
        if first is not None and len(first.poses) == count and solver.sane(first):
            # Once more with pairs verified at the focal length found.
            again = solver.solve(solver.focals_of(first), True)
            return better(first, again) if again else first, True
    done = 0

    def solve(ratio: float) -> Solution | None:
        nonlocal done
        solution = solver.solve_ratio(ratio, False)
        done += 1
        progress("focal length", min(done, 9), 9)
        return solution

    result = search_focal(solve)
    if result is None:
        return None, False
    best: Solution | None = result.solution
    if free and best is not None:
        freed = solver.solve(solver.focals_of(best), True)
        if freed is not None and solver.sane(freed):
            return better(best, freed), True
    return best, result.determined


class _Solver:
    """Verifies pairs and maps views at a given focal length; matches stay the same."""

    def __init__(
        self, given: MappingInput, options: ClassicalOptions, pixel: float, seed: int,
        threads: int, scratch: Path,
    ) -> None:  # fmt: skip
        self.given = given
        self.options = options
        self.pixel = pixel
        self.seed = seed
        self.threads = threads
        self.scratch = scratch
        self._verified: dict[tuple[float, ...], dict[Pair, TwoView]] = {}
        self._last: dict[Pair, TwoView] = {}

    def solve_ratio(self, ratio: float, free: bool) -> Solution | None:
        return self.solve([ratio * lens.long_side for lens in self.given.lenses], free)

    def solve(self, focals: list[float], free: bool, mapper: str | None = None) -> Solution | None:
        """Verify all pairs at these focal lengths (pixels, one per lens), choose, and map."""
        edges = self._edges(focals)
        self._last = edges
        kept = trusted_edges(
            edges, len(self.given.positions),
            min_inliers=self.options.min_inliers, tree_coherence=self.options.min_coherence,
            cycle_angle=self.options.cycle_angle,
        )  # fmt: skip
        chosen = mapper or ("global" if self.options.mapper == "global" else "incremental")
        solution = map_views(
            self.given, {pair: edges[pair] for pair in kept}, focals,
            refine_focal=free, method=chosen,
            max_error=self.options.max_reprojection_error * self.pixel,
            min_tri_angle=self.options.min_tri_angle, seed=self.seed, scratch=self.scratch,
        )  # fmt: skip
        return solution if solution is not None and len(solution.poses) >= 2 else None

    def with_other_mapper(self, best: Solution, free: bool) -> Solution | None:
        """Try the global mapper where the incremental one left views out."""
        if self.options.mapper != "auto" or len(best.poses) == len(self.given.positions):
            return best
        other = self.solve(self.focals_of(best), free, "global")
        if other is None or len(other.poses) <= len(best.poses) or not self.sane(other):
            return best
        return other

    def sane(self, solution: Solution) -> bool:
        """Is the focal length one that a camera has, and the error small?"""
        ratios = [
            focal / self.given.lenses[self.given.lens_of_view[view]].long_side
            for view, focal in solution.focals.items()
        ]
        return (
            all(0.3 < ratio < 5 for ratio in ratios)
            and solution.error < self.options.max_reprojection_error * self.pixel
        )

    def focals_of(self, solution: Solution) -> list[float]:
        """Focal length in pixels of each lens; of one that no placed view has, by the others'."""
        lenses, lens_of_view = self.given.lenses, self.given.lens_of_view
        found = {lens_of_view[view]: focal for view, focal in solution.focals.items()}
        usual = float(np.median([focal / lenses[k].long_side for k, focal in found.items()]))
        return [found.get(k, usual * lens.long_side) for k, lens in enumerate(lenses)]

    def edges_used(self, solution: Solution | None) -> dict[Pair, TwoView]:
        """The two-view geometries at the focal length of a solution, or those tried last."""
        return self._last if solution is None else self._edges(self.focals_of(solution))

    def _edges(self, focals: list[float]) -> dict[Pair, TwoView]:
        key = tuple(round(focal, 3) for focal in focals)
        if key not in self._verified:
            given = self.given
            cameras = [lens.camera(focal) for lens, focal in zip(given.lenses, focals, strict=True)]

            def verify(pair: Pair) -> TwoView | None:
                return verify_pair(
                    given.correspondences[pair],
                    cameras[given.lens_of_view[pair[0]]],
                    cameras[given.lens_of_view[pair[1]]],
                    max_error=self.options.max_error * self.pixel,
                    coherence_radius=COHERENCE_RADIUS * self.pixel,
                    seed=self.seed,
                )

            pairs = sorted(given.correspondences)
            found = _in_threads(verify, pairs, self.threads)
            self._verified[key] = {
                pair: edge for pair, edge in zip(pairs, found, strict=True) if edge is not None
            }
        return self._verified[key]


def _in_threads(
    function: Callable[[Any], Result],
    items: Iterable[Any],
    threads: int,
    progress: Callable[[int], None] = lambda done: None,
) -> list[Result]:
    """Map in threads; results come in the order of the items, so that threads change nothing."""
    results = []
    with ThreadPoolExecutor(max(threads, 1)) as pool:
        for result in pool.map(function, items):
            results.append(result)
            progress(len(results))
    return results
