"""What teeth did as two comparisons say it: from the first visit to the second, and back.

Optical flow that starts too far off is lost, and mostly one way only. Where both ways say that a
tooth did something else, the pictures of both choose before either is brought to its end.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from pipeline.kernels.threads import opencv_threads
from pipeline.studies.register import solving
from pipeline.studies.register.estimate import (
    CLEAR,
    Estimate,
    Started,
    compared_pairs,
    finished,
    started,
)
from pipeline.studies.register.geometry import inverted
from pipeline.studies.register.pictures.photometric import (
    CLEARLY,
    FINE,
    LEAST_PHOTOGRAPHS,
    facings,
    photographs,
    pictures_of,
    score,
)
from pipeline.studies.register.visit import Visit

Array = npt.NDArray[np.float64]


def both_ways(
    first: Visit, second: Visit, first_from_second: Array, agreeing: Sequence[int]
) -> tuple[Estimate, Estimate]:
    """The motions from the first visit to the second, and from the second to the first.

    Args:
        first, second: visits.
        first_from_second: [4, 4] similarity to begin with.
        agreeing: teeth that seem to have stood still, by that similarity.
    """
    with opencv_threads(1):
        there = started(first, second, first_from_second, agreeing)
        back = started(second, first, inverted(first_from_second), agreeing)
        there, back = agreed(there, back)
        return finished(there), finished(back)


def mirrored(motion: Array, frame: Array) -> Array:
    """[4, 4] what a motion of the way back is on the way there.

    Args:
        motion: [4, 4] of a tooth of the second visit, in its frame.
        frame: [4, 4] similarity from the second visit's frame to the first's.
    """
    return np.asarray(frame @ np.linalg.inv(motion) @ np.linalg.inv(frame), np.float64)


def agreed(there: Started, back: Started) -> tuple[Started, Started]:
    """Both ways, each tooth with the motion by which the pictures of both fit clearly better.

    Where they agree (within `estimate.CLEAR`), where few photographs show the tooth, or where the
    pictures do not decide, each keeps what it says: what they differ by tells how sure they are.
    """
    to_first, to_second = there.first_from_second, inverted(there.first_from_second)
    ways = [_Way(there), _Way(back)]
    forwards, backwards = dict(there.state.motions), dict(back.state.motions)
    for n in sorted(set(forwards) & set(backwards)):
        other = mirrored(backwards[n], to_first)
        if _apart(forwards[n], other, there.centres[n]) < CLEAR:
            continue
        own = mirrored(forwards[n], to_second)
        fits = (
            ways[0].fit(n, forwards[n]), ways[1].fit(n, own),
            ways[0].fit(n, other), ways[1].fit(n, backwards[n]),
        )  # fmt: skip
        if min(fit.photographs for fit in fits) < LEAST_PHOTOGRAPHS:
            continue
        better = fits[0].score + fits[1].score - fits[2].score - fits[3].score
        if better > 2 * CLEARLY:
            backwards[n] = own
        elif better < -2 * CLEARLY:
            forwards[n] = other
    return (
        replace(there, state=replace(there.state, motions=forwards)),
        replace(back, state=replace(back.state, motions=backwards)),
    )


def _apart(one: Array, other: Array, centre: Array) -> float:
    """How far two motions [4, 4] of a crown with this centre [3] are from each other, mm."""
    reached = other[:3, :3] @ centre + other[:3, 3]
    return solving.travel(solving.displacement(one @ np.linalg.inv(other), reached))


class _Fit(NamedTuple):
    """Correlation of a tooth's pictures, -1..1, and how many photographs of a visit show it."""

    score: float
    photographs: int


class _Way:
    """One way's pictures, made once."""

    def __init__(self, found: Started) -> None:
        self.state = found.state
        self.pictures = pictures_of(found.first), pictures_of(found.second)
        self.pairs = compared_pairs(found.first, found.state)

    def fit(self, tooth: int, motion: Array) -> _Fit:
        """How well a tooth's pictures fit by a motion [4, 4]."""
        state = replace(self.state, motions={**self.state.motions, tooth: motion})
        views = facings(tooth, *self.pictures, state, self.pairs)
        return _Fit(score(views, FINE, motion), photographs(views))
