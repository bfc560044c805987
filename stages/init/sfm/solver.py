"""From matches to a reconstruction, for focal lengths that are known, to be refined, or unknown."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from pipeline.geometry.graph import Pair
from pipeline.kernels.threads import in_threads
from stages.init.sfm.focal import better, search_focal
from stages.init.sfm.mapping import Distortions, MappingInput, Solution, map_views
from stages.init.sfm.matching.roll import groups
from stages.init.sfm.matching.two_view import (
    Correspondences,
    TwoView,
    trusted_edges,
    verify_pair,
)
from stages.init.sfm.options import COHERENCE_RADIUS, ClassicalOptions
from stages.init.sfm.undistort import undistort_pixels

Array = npt.NDArray[np.float64]
Progress = Callable[[str, int, int], None]

#: Focal lengths over the long side that bundle adjustment starts from.
STARTS = (1.2, 2.0)
#: Two starts that end further apart than this (relative) don't determine the focal length.
SAME_FOCAL = 0.05
#: EXIF is believed rather than a result that is further off than this (relative): lens distortion,
#: which our cameras don't have, pulls a free focal length away by about as much (castle: 6 %) ...
EXIF_TOLERANCE = 0.05
#: ... unless the reprojection error shrinks to this share: then the photograph was cropped.
MUCH_BETTER = 0.75
#: From this many views on one start does.
MANY_VIEWS = 6


class Solver:
    """Verifies pairs and maps views at a given focal length; the matches stay the same.

    Args:
        given: lenses, keypoints and matches.
        pixel: size of the images relative to `REFERENCE_SIDE`.
        scratch: folder for the mapper's files.
    """

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
        self.view_count = len(given.positions)
        self._verified: dict[tuple[float | None, ...], dict[Pair, TwoView]] = {}
        self._last: dict[Pair, TwoView] = {}

    def on(self, given: MappingInput) -> Solver:
        """Another one of the same settings."""
        return Solver(given, self.options, self.pixel, self.seed, self.threads, self.scratch)

    def solve_ratio(self, ratio: float, free: bool) -> Solution | None:
        """`solve` with one focal length, over the long side, for all lenses."""
        return self.solve([ratio * lens.long_side for lens in self.given.lenses], free)

    def solve(
        self, focals: list[float], free: bool, mapper: str | None = None,
        distortions: Distortions | None = None,
    ) -> Solution | None:  # fmt: skip
        """Verify all pairs at these focal lengths (pixels, one per lens), choose pairs, and map.

        Args:
            free: refine the focal lengths.
            mapper: incremental or global; None: as the options say.
            distortions: for each lens the radial coefficient to start from, None for pinholes.
        """
        options = self.options
        edges = self._last = self._edges(focals, distortions)
        kept = trusted_edges(
            edges, self.view_count,
            min_evidence=options.min_evidence, min_inliers=options.min_inliers,
        )  # fmt: skip
        solution = map_views(
            self.given, {pair: edges[pair] for pair in kept}, focals,
            refine_focal=free,
            method=mapper or ("global" if options.mapper == "global" else "incremental"),
            max_error=options.max_reprojection_error * self.pixel,
            min_tri_angle=options.min_tri_angle, seed=self.seed, scratch=self.scratch,
            distortions=distortions,
        )  # fmt: skip
        return solution if solution is not None and len(solution.poses) >= 2 else None

    def links(self) -> list[Pair]:
        """The pairs that can be believed, at the focal lengths known or tried first."""
        return self.believed(self.first_edges())

    def first_edges(self) -> dict[Pair, TwoView]:
        """The two-view geometries at the focal lengths known or tried first."""
        return self._edges([lens.focal or STARTS[0] * lens.long_side for lens in self.given.lenses])

    def believed(self, edges: dict[Pair, TwoView]) -> list[Pair]:
        """Those of the pairs that can be believed."""
        return [
            pair
            for pair, edge in edges.items()
            if edge.evidence >= self.options.min_evidence
            and len(edge.inliers) >= self.options.min_inliers
        ]

    def with_other_mapper(self, best: Solution, free: bool) -> Solution:
        """Try the global mapper where the incremental one left views out that links lead to."""
        if self.options.mapper != "auto":
            return best
        group = groups(self.believed(self.edges_used(best)), self.view_count)
        if len(best.poses) >= max(map(group.count, group)):
            return best
        other = self.solve(self.focals_of(best), free, "global")
        if other is None or len(other.poses) <= len(best.poses) or not self.sane(other):
            return best
        return other

    def complete(self, solution: Solution) -> bool:
        """Are all views placed?"""
        return len(solution.poses) == self.view_count

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

    def distortions_of(self, solution: Solution) -> list[float]:
        """Radial coefficient of each lens; 0 of one that no placed view has."""
        of_view = self.given.lens_of_view
        found = {of_view[view]: k1 for view, k1 in solution.distortions.items()}
        return [found.get(k, 0.0) for k in range(len(self.given.lenses))]

    def edges_used(self, solution: Solution | None) -> dict[Pair, TwoView]:
        """The two-view geometries at the focal length of a solution, or those tried last."""
        if solution is None:
            return self._last
        bent: Distortions = [k1 or None for k1 in self.distortions_of(solution)]
        return self._edges(self.focals_of(solution), bent)

    def _edges(
        self, focals: list[float], distortions: Distortions | None = None
    ) -> dict[Pair, TwoView]:
        bends = [k1 or 0.0 for k1 in distortions or [None] * len(focals)]
        key = (*(round(focal, 3) for focal in focals), *(round(k1, 6) for k1 in bends))
        if key not in self._verified:
            given = self.given
            cameras = [lens.camera(focal) for lens, focal in zip(given.lenses, focals, strict=True)]

            def straight(view: int, pixels: Array) -> Array:
                lens = given.lens_of_view[view]
                if not bends[lens]:
                    return pixels
                size = (given.lenses[lens].width, given.lenses[lens].height)
                return undistort_pixels(pixels, focals[lens], bends[lens], size)

            def verify(pair: Pair) -> TwoView | None:
                found: Correspondences = given.correspondences[pair]
                return verify_pair(
                    replace(
                        found,
                        positions_i=straight(pair[0], found.positions_i),
                        positions_j=straight(pair[1], found.positions_j),
                    ),
                    cameras[given.lens_of_view[pair[0]]],
                    cameras[given.lens_of_view[pair[1]]],
                    max_error=self.options.max_error * self.pixel,
                    coherence_radius=COHERENCE_RADIUS * self.pixel,
                    seed=self.seed,
                )

            pairs = sorted(given.correspondences)
            found = in_threads(verify, pairs, self.threads)
            self._verified[key] = {
                pair: edge for pair, edge in zip(pairs, found, strict=True) if edge is not None
            }
        return self._verified[key]


def known_focal(solver: Solver, free: bool, progress: Progress) -> Solution | None:
    """Reconstruct with the lenses' focal lengths; refined, if the result stays near them."""
    focals = [float(lens.focal or 0) for lens in solver.given.lenses]
    progress("reconstruct", 0, 2)
    if not free:
        return solver.solve(focals, False)
    refined = solver.solve(focals, True)
    progress("reconstruct", 1, 2)
    if refined is not None and solver.complete(refined) and solver.sane(refined):
        drift = [
            abs(found / focal - 1)
            for found, focal in zip(solver.focals_of(refined), focals, strict=True)
        ]
        if max(drift) < EXIF_TOLERANCE:
            return refined
    fixed = solver.solve(focals, False)
    if refined is None or fixed is None or not solver.sane(refined):
        return fixed
    convincing = len(refined.poses) > len(fixed.poses) or (
        len(refined.poses) == len(fixed.poses) and refined.error < MUCH_BETTER * fixed.error
    )
    return refined if convincing else fixed


def unknown_focal(solver: Solver, free: bool, progress: Progress) -> tuple[Solution | None, bool]:
    """Reconstruct without knowing the focal length.

    Bundle adjustment finds it from several starts; where that fails, or there are too few views
    for it (`free` is False), fixed focal lengths are searched.

    Returns:
        The reconstruction, and whether the photographs determine the focal length.
    """
    many = solver.view_count >= MANY_VIEWS
    if free:
        found, determined = _freed(solver, many, progress)
        if found is not None and (many or solver.complete(found)):
            return found, determined
    tried = 0

    def solve(ratio: float) -> Solution | None:
        nonlocal tried
        solution = solver.solve_ratio(ratio, False)
        tried += 1
        progress("focal length", min(tried, 9), 9)
        return solution

    result = search_focal(solve)
    if result is None:
        return None, False
    return result.solution, result.determined and len(result.solution.poses) > 2


def _freed(solver: Solver, many: bool, progress: Progress) -> tuple[Solution | None, bool]:
    """The best of the free reconstructions from `STARTS`, and whether they agree."""
    best: Solution | None = None
    ends: list[float] = []
    for number, start in enumerate(STARTS):
        progress("reconstruct", number, len(STARTS) + 1)
        solution = solver.solve_ratio(start, True)
        if solution is not None and solver.sane(solution):
            best = better(best, solution)
            ends.append(float(np.median(list(solution.focals.values()))))
            if many and solver.complete(solution):
                return solution, True
    if best is None:
        return None, False
    # Once more, with the pairs verified at the focal length found: they gain matches.
    again = solver.solve(solver.focals_of(best), True)
    if again is not None and solver.sane(again) and len(again.poses) >= len(best.poses):
        best = again
    agree = len(ends) == len(STARTS) and max(ends) / min(ends) - 1 < SAME_FOCAL
    # Two views fit nearly any focal length; what further views say doesn't hang on all of them.
    return best, agree and len(best.poses) > 2
