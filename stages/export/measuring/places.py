"""Where the landmarks of a mouth lie: of some teeth, of a group on average; the size of a tooth."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence

import numpy as np
import numpy.typing as npt

from pipeline.artifacts.dental.fdi import PRIMARY_PLACES, permanent_of
from stages.export.measuring.landmarks import Name

Array = npt.NDArray[np.float64]
#: (name, FDI number) -> [3] frame of the exports.
Places = Mapping[tuple[Name, int], Array]


def with_primary(group: Sequence[int]) -> list[int]:
    """Permanent teeth, and the primary ones that may stand in their places."""
    return [*group, *(n + 40 for n in group if n % 10 <= PRIMARY_PLACES)]


def places_of(places: Places, teeth: Collection[int]) -> Places:
    """The places of some teeth alone."""
    return {key: place for key, place in places.items() if key[1] in teeth}


def centres_of(places: Places) -> dict[int, Array]:
    """FDI number -> [3] the crown's middle."""
    return {number: point for (name, number), point in places.items() if name == "centre"}


def mean_place(places: Places, name: Name, group: Sequence[int]) -> Array:
    """[3] mean of a landmark over those of a group of teeth (or primary ones) that have it."""
    there = [places[name, n] for n in with_primary(group) if (name, n) in places]
    return np.asarray(np.mean(there, axis=0))


def spacing_of(places: Places) -> float:
    """Median distance between neighbouring crowns: the size of a tooth in these units."""
    centres = centres_of(places)
    gaps = [
        float(np.linalg.norm(point - centres[number + 1]))
        for number, point in centres.items()
        if permanent_of(number) % 10 < 8 and number + 1 in centres
    ]
    return float(np.median(gaps)) if gaps else 0.0
