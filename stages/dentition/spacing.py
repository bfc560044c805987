"""What the spaces between neighbours in a row say about the teeth between them.

Teeth of a textbook's widths stand side by side; where two are further apart than that, one may be
missing. On films of 23 generated mouths the logarithm of a distance over the textbook's, in the
mouth's own unit, has a standard deviation of .135 between neighbours (506 pairs) and lies within .3
over gaps of one tooth (12).
"""

from __future__ import annotations

from collections.abc import Collection, Sequence

import numpy as np
import numpy.typing as npt

from pipeline.artifacts.dental.fdi import Jaw, primary_of, teeth_of
from pipeline.artifacts.dental.sizes import textbook_width
from stages.dentition.tooth_rows import POSITIONS

Array = npt.NDArray[np.float64]
#: Jaw, places [n, 3] from the patient's right to the left, and positions [n] of a row; `POSITIONS`
#: is that of no tooth.
Row = tuple[Jaw, Array, npt.NDArray[np.integer]]

#: Deviation of the logarithm of a distance; and what a distance says at most (crowding, closed
#: gaps), as log probability.
DEVIATION, MOST = 0.15, 8.0


def textbook_distances(jaw: Jaw, primary: Collection[int] = ()) -> Array:
    """[14, 14] mm along the row from the middle of a position to that of another, + to the left.

    Args:
        jaw: of the row.
        primary: permanent numbers in whose place primary teeth stand.
    """
    standing = (primary_of(tooth) if tooth in primary else tooth for tooth in teeth_of(jaw))
    widths = np.array([textbook_width(tooth) for tooth in standing])
    middles = np.cumsum(widths) - widths / 2
    return np.asarray(middles[None, :] - middles[:, None])


def unit_of(rows: Sequence[Row]) -> float | None:
    """Units of the world to a textbook's millimetre, the median over neighbours; None where no two
    teeth are neighbours."""
    ratios = _ratios(rows, ())
    return float(np.median(ratios)) if len(ratios) else None


def spacing_cost(rows: Sequence[Row], primary: Collection[int]) -> float:
    """Twice the negative log likelihood of the distances between neighbours, up to a constant, if
    primary teeth stand in the places of these permanent ones. The scale is whatever fits best:
    primary molars are wider than their incisors, premolars narrower."""
    ratios = np.log(np.maximum(_ratios(rows, primary), 1e-9))
    if not len(ratios):
        return 0.0
    off = (ratios - np.median(ratios)) / DEVIATION
    return float(np.minimum(off**2, 2 * MOST).sum())


def _ratios(rows: Sequence[Row], primary: Collection[int]) -> Array:
    """Distances between neighbours over the textbook's."""
    ratios = []
    for jaw, places, positions in rows:
        distances = textbook_distances(jaw, primary)
        for k in range(1, len(places)):
            before, here = positions[k - 1], positions[k]
            if here < POSITIONS and here == before + 1:
                apart = float(np.linalg.norm(places[k] - places[k - 1]))
                ratios.append(apart / distances[before, here])
    return np.array(ratios)


def spacing_evidence(jaw: Jaw, places: Array, unit: float) -> Array:
    """[n, 14, 14] log likelihood, up to a constant, of the position before and that of each tooth.

    By the distance to the one before; of the first nothing is said. Before a tooth further to the
    left nothing is possible anyhow (`row_probabilities`).

    Args:
        jaw: of the row.
        places: [n, 3] middles of the teeth, from the patient's right to the left.
        unit: as `unit_of` gives it.
    """
    evidence = np.zeros((len(places), POSITIONS, POSITIONS))
    distances = np.maximum(textbook_distances(jaw), 1e-3) * unit
    for k in range(1, len(places)):
        apart = max(float(np.linalg.norm(places[k] - places[k - 1])), 1e-9 * unit)
        off = np.log(apart / distances) / DEVIATION
        evidence[k] = np.maximum(-(off**2) / 2, -MOST)
    return evidence
