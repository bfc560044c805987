"""How many photographs features may link: asked of small copies, in a tenth of the time."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from stages.init.sfm.mapping import MappingInput
from stages.init.sfm.matching.features import Features, reduced
from stages.init.sfm.matching.roll import groups
from stages.init.sfm.options import REFERENCE_SIDE, ClassicalOptions
from stages.init.sfm.reconstruct import find_features, group_lenses, match_pairs, overlaps
from stages.init.sfm.solver import Solver

#: Share of `min_evidence` that has to show, without squeezed copies, on copies of `REFERENCE_SIDE`.
#: Of twelve real mouths (right, frontal, left) none could be placed by features, and the weaker one
#: of the two pairs that would link them had at most .04 there (the stronger one .13); of rendered
#: ones, 21 to 35 degrees apart, which can, it had .19 and more.
SHARE = 0.1


@dataclass(frozen=True)
class Sounding:
    """Attributes:
    linked: how many of the views there is any hope for that features link them with each other.
    features: those of the views themselves, without squeezed copies; None where smaller ones than
        the views were asked.
    """

    linked: int
    features: list[Features] | None = None


def sound(
    grays: list[npt.NDArray[np.uint8]],
    valid: list[npt.NDArray[np.bool_]],
    focals: list[float | None],
    ordered: bool,
    options: ClassicalOptions,
    *,
    seed: int,
    threads: int,
    scratch: Path,
) -> Sounding:
    """Ask how many views features may link.

    Args:
        grays, valid: N images [H, W] uint8 and their masks.
        focals: N focal lengths in pixels, or None where unknown.
        ordered, seed, threads, scratch: as for `stages.init.sfm.reconstruct.reconstruct`.
        options: those of the real attempt.
    """
    small = [reduced(*pair, REFERENCE_SIDE) for pair in zip(grays, valid, strict=True)]
    scales = [few.shape[1] / gray.shape[1] for (few, _), gray in zip(small, grays, strict=True)]
    shapes = [gray.shape for gray, _ in small]
    lenses, lens_of_view = group_lenses(
        shapes,
        [focal and focal * scale for focal, scale in zip(focals, scales, strict=True)],
    )
    options = replace(
        options, squeezes=(1.0,), min_evidence=SHARE * options.min_evidence, min_inliers=0
    )
    pixel = max(max(gray.shape) for gray, _ in small) / REFERENCE_SIDE
    features = find_features(
        [gray for gray, _ in small], [inside for _, inside in small], options, threads,
        lambda *_: None, scratch=scratch,
    )  # fmt: skip
    pairs = [*overlaps(features, ordered, options)]
    found = match_pairs(features, pairs, options, pixel, threads, lambda *_: None)
    given = MappingInput.of(lenses, lens_of_view, features, found, shapes)
    links = Solver(given, options, pixel, seed, threads, scratch).links()
    whole = all(few is gray for (few, _), gray in zip(small, grays, strict=True))
    linked = max(Counter(groups(links, len(grays))).values())
    return Sounding(linked, features if whole else None)
