"""Jaws that do not stand to each other as they did at the other visit.

A mouth that was photographed open at one of the visits, or that bites elsewhere, is no rigid thing:
laid on by the teeth of one jaw, all teeth of the other seem to have moved. Each jaw is one, so each
is then compared by itself.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from pipeline.artifacts.dental.fdi import JAWS, Jaw, is_upper
from pipeline.studies.register.geometry import first_frame, inverted, refined_frame
from pipeline.studies.register.visit import Visit

Array = npt.NDArray[np.float64]

#: Jaws that meet as they did come out within this of each other, mm: at .2 to .44 in five pairs of
#: visits of generated mouths, four of them of three photographs.
FARTHEST = 1.0


def is_of(tooth: int, jaw: Jaw) -> bool:
    """Does the tooth with this FDI number belong to the jaw?"""
    return is_upper(tooth) == (jaw == "upper")


def of_jaw(visit: Visit, jaw: Jaw) -> Visit:
    """The visit with the teeth of one jaw alone."""

    mine = np.array([n if is_of(n, jaw) else 0 for n in range(256)], np.uint8)
    return replace(
        visit,
        looks=tuple(replace(look, labels=mine[look.labels]) for look in visit.looks),
        teeth={n: points for n, points in visit.teeth.items() if is_of(n, jaw)},
        covered={n: middle for n, middle in visit.covered.items() if is_of(n, jaw)},
    )


def stand_otherwise(first: Visit, second: Visit, least: int) -> bool:
    """Do the jaws stand to each other otherwise than they did at the first visit?

    So they do if by the teeth of the upper jaw alone the lower one went somewhere. Where one of
    them has no place of its own, that can't be told.

    Args:
        least: teeth that a jaw's place rests on at least, and more than half of those in common.
    """
    frames = []
    for jaw in JAWS:
        a, b = of_jaw(first, jaw), of_jaw(second, jaw)
        try:
            frame, agreeing = first_frame(b.centres, a.centres)
        except ValueError:
            return False
        if len(agreeing) < max(least, len(set(a.centres) & set(b.centres)) // 2 + 1):
            return False
        frames.append(refined_frame(a, b, frame, agreeing))
    return way_of_lower(first.centres, frames[0], frames[1]) > FARTHEST


def way_of_lower(centres: Mapping[int, Array], by_upper: Array, by_lower: Array) -> float:
    """How far the lower jaw went against the upper one: the median way of its teeth, mm.

    Args:
        centres: FDI number -> [3] middle of the crown at the first visit, in its frame.
        by_upper, by_lower: [4, 4] first_from_second by the teeth of each jaw.
    """
    middles = np.array([middle for n, middle in centres.items() if is_of(n, "lower")])
    motion = by_upper @ inverted(by_lower)
    moved = middles @ motion[:3, :3].T + motion[:3, 3]
    return float(np.median(np.linalg.norm(moved - middles, axis=1)))
