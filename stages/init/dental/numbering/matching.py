"""Dense matches of the photographs on the arch that a labelling unrolls.

They tell near rivals apart (`rivals`), and refine the cameras of the numbering found.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property

import numpy as np
import numpy.typing as npt

from pipeline.artifacts.teeth import Dentition
from pipeline.kernels.threads import in_threads
from stages.init.dental.cameras.bundle import Matches
from stages.init.dental.cameras.unrolled import (
    PairFigures,
    Photo,
    match_neighbours,
    prepare_photo,
)
from stages.init.dental.numbering.arch_options import ArchOptions
from stages.init.dental.numbering.labellings.scorer import (
    Labelling,
    Scored,
    Scorer,
)

Image = npt.NDArray[np.float32]
Mask = npt.NDArray[np.bool_]
Progress = Callable[[str, int, int], None]
_FirstRound = tuple[Scored, Matches, dict[tuple[int, int], PairFigures]]


class Matching:
    """The photographs of a fit, prepared and matched when they are asked for.

    Images [H, W, 3] float32 RGB in 0..1, masks [H, W] bool of where they may be used.
    """

    def __init__(
        self, scorer: Scorer, dentitions: list[Dentition], images: list[Image],
        valid: list[Mask], options: ArchOptions,
    ) -> None:  # fmt: skip
        self._scorer, self._options = scorer, options
        self._first: dict[Labelling, _FirstRound] = {}
        self._given = list(zip(images, valid, dentitions, strict=True))

    @cached_property
    def _photos(self) -> list[Photo]:
        return in_threads(
            lambda photo: prepare_photo(
                photo[0], photo[1], photo[2].mask, photo[2].roll, photo[2].band_height
            ),
            self._given,
            self._scorer.threads,
        )

    def shares(self, scored: Scored) -> dict[tuple[int, int], float]:
        """Pair of views -> the share of what both see that matches, cameras as the teeth say."""
        _, _, pairs = self._first_round(scored)
        return {pair: figures.share for pair, figures in pairs.items()}

    def refined(
        self, best: Scored, progress: Progress
    ) -> tuple[Scored, dict[tuple[int, int], PairFigures]]:
        """The cameras of a numbering: rounds of dense matches and bundle adjustment."""
        scorer, options = self._scorer, self._options
        if not options.dense_rounds:
            return self._as_cameras(best), {}
        best, matches, pairs = self._first_round(best)
        # With cameras that are known, matches can only speak for or against them.
        rounds = min(options.dense_rounds, 1) if scorer.held else options.dense_rounds
        for done in range(rounds):
            progress("dense matches on the arch", done, rounds)
            if done:
                matches, pairs = self._matched(best)
            if not scorer.held:
                start = (best.adjusted.unknowns, best.adjusted.offsets)
                best = scorer.solve(
                    best.labelling, start, matches=matches, deviation=options.landmark_deviation
                )
        progress("dense matches on the arch", rounds, rounds)
        return best, pairs

    def _first_round(self, scored: Scored) -> _FirstRound:
        """Solved for its cameras, and the matches on their arch; once for each labelling."""
        if scored.labelling not in self._first:
            solved = self._as_cameras(scored)
            self._first[scored.labelling] = (solved, *self._matched(solved))
        return self._first[scored.labelling]

    def _matched(self, scored: Scored) -> tuple[Matches, dict[tuple[int, int], PairFigures]]:
        options = self._options
        return match_neighbours(
            scored.adjusted, self._photos, options.chart_scale, options.dense_weight,
            self._scorer.threads,
        )  # fmt: skip

    def _as_cameras(self, scored: Scored) -> Scored:
        """Solved for its cameras rather than to compare it with others."""
        options = self._options
        offsets = scored.adjusted.offsets * (
            options.numbering_deviation / options.landmark_deviation
        )
        return self._scorer.solve(
            scored.labelling, (scored.adjusted.unknowns, offsets),
            deviation=options.landmark_deviation,
        )  # fmt: skip
