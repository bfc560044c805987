"""What the spaces between neighbours in a row say about the teeth between them.

Teeth of a textbook's widths stand side by side; where two are further apart than that, one may be
missing. On films of 23 generated mouths the logarithm of a distance over the textbook's, in the
mouth's own unit, has a standard deviation of .135 between neighbours (506 pairs) and lies within .3
over gaps of one tooth (12).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from pipeline.artifacts.dental.fdi import Jaw, teeth_of
from pipeline.artifacts.dental.sizes import WIDTHS
from stages.dentition.tooth_rows import POSITIONS

Array = npt.NDArray[np.float64]

#: Deviation of the logarithm of a distance; and what a distance says at most (crowding, closed
#: gaps), as log probability.
DEVIATION, MOST = 0.15, 8.0


def textbook_distances(jaw: Jaw) -> Array:
    """[14, 14] mm along the row from the middle of a position to that of another, + to the left."""
    widths = np.array([WIDTHS[jaw][tooth % 10 - 1] for tooth in teeth_of(jaw)])
    middles = np.cumsum(widths) - widths / 2
    return np.asarray(middles[None, :] - middles[:, None])


def unit_of(rows: Sequence[tuple[Jaw, Array, npt.NDArray[np.integer]]]) -> float | None:
    """Units of the world to a textbook's millimetre, the median over neighbours.

    Args:
        rows: jaw, places [n, 3] from the patient's right to the left, and positions [n] of each
            row; `POSITIONS` is that of no tooth.

    Returns:
        None where no two teeth are neighbours.
    """
    ratios = []
    for jaw, places, positions in rows:
        distances = textbook_distances(jaw)
        for k in range(1, len(places)):
            before, here = positions[k - 1], positions[k]
            if here < POSITIONS and here == before + 1:
                apart = float(np.linalg.norm(places[k] - places[k - 1]))
                ratios.append(apart / distances[before, here])
    return float(np.median(ratios)) if ratios else None


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
