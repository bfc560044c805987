"""The overbite where no photograph shows the lower incisors' edges: an estimate.

What is seen of a lower incisor reaches from the gum to the upper incisors' edge. The rest of its
crown lies behind: the overbite is the crown's height less what is seen. How high the crown is,
nobody sees; the textbook says it, beside the distances of the other teeth here. So the estimate
needs no scale, and is as sure as crowns are alike in height.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.artifacts.dental.fdi import is_primary
from pipeline.artifacts.dental.sizes import millimetres_per_unit, textbook_height
from stages.export.measuring.landmarks import Name, Reading
from stages.export.measuring.places import Array, Places, centres_of, mean_place, places_of

UPPER, LOWER = (11, 21), (31, 41)
#: Standard deviation of the height that a permanent lower central incisor shows above the gum, as a
#: share of it, among mouths whose teeth are as wide: some 11 % of the crown (.9 mm in tables of
#: tooth measurements), and some 6 % of its wear and of where the gum's edge lies (recession, and
#: passive eruption: between the years 8 and 18 the height grows by .8 mm).
SPREAD = 0.13
BECAUSE = "the upper teeth cover the edges of the lower ones in every photograph"
METHOD = (
    f"estimated, not measured, for {BECAUSE}: the textbook height of a lower central incisor's "
    "crown, beside the distances of neighbouring teeth here, less what is seen of it"
)


@dataclass(frozen=True)
class CoveredBite:
    """What the overbite is estimated at.

    Attributes:
        teeth: FDI numbers of the central incisors of both jaws that are seen well enough.
    """

    teeth: frozenset[int]

    def heights(self, places: Places, axes: Array) -> tuple[float, float]:
        """The lower crowns' height and how much of it is seen, along the mouth's up.

        Lower incisors stand upright on the occlusal plane: their faces lean by few degrees
        (Andrews 1972: -1 on average), which takes hardly anything off.

        Args:
            places: of all teeth.
            axes: [3, 3] rows left, up, out.

        Returns:
            Both in units of the places.
        """
        millimetres = millimetres_per_unit(centres_of(places))
        assert millimetres is not None  # else `covered_bite` says that there is nothing
        mine = places_of(places, self.teeth)
        gum = mean_place(mine, "zenith", LOWER)
        return textbook_height(31) / millimetres, float(axes[1] @ (self._edge(mine) - gum))

    def points(self, places: Places, axes: Array, value: float) -> Array:
        """[2, 3] from the upper edge to the height where the lower one should be behind it."""
        edge = self._edge(places_of(places, self.teeth))
        return np.array([edge, edge + value * axes[1]])

    def _edge(self, places: Places) -> Array:
        return mean_place(places, "rim", UPPER)


def covered_bite(reading: Reading, most_doubt: float) -> CoveredBite | str:
    """What to estimate the overbite at, or why it can't be.

    Args:
        reading: the landmarks.
        most_doubt: teeth whose number is more doubtful take no part.

    Returns:
        A sentence where it can't be; an empty one where this is no bite whose lower edges alone
        are covered (of a reverse bite the estimate would say no more than a population's mean).
    """
    below, above = ({*group, *(n + 40 for n in group)} for group in (LOWER, UPPER))
    if not reading.covered & below or reading.covered & above:
        return ""
    certain = {key for key, mark in reading.landmarks.items() if mark.doubt <= most_doubt}
    if any(is_primary(number) for _, number in certain):
        return (
            "nor is it estimated where there are primary teeth: they wear off, and permanent "
            "incisors beside them may not have come through at their full height"
        )

    def seen(name: Name, group: tuple[int, int]) -> set[int]:
        return {number for number in group if (name, number) in certain}

    if not seen("zenith", LOWER):
        return "nor can it be estimated, for no photograph shows all of the gum's edge at 31 or 41"
    if not seen("rim", UPPER):
        return ""
    if millimetres_per_unit(centres_of(reading.places)) is None:
        return "nor can it be estimated, for no two neighbours show how large the teeth are"
    return CoveredBite(frozenset(seen("zenith", LOWER) | seen("rim", UPPER)))
