"""Textbook sizes of crowns, and how large the teeth of a mouth are beside them."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from pipeline.artifacts.dental.fdi import JAWS, Jaw, is_primary, is_upper, permanent_of, teeth_of

#: Mesiodistal widths and visible crown heights, from central incisor to second molar (mm; Wheeler's
#: dental anatomy, tables of tooth measurements; gum covers some of the height).
WIDTHS: dict[Jaw, tuple[float, ...]] = {
    "upper": (8.5, 6.5, 7.6, 7.0, 6.8, 10.0, 9.0),
    "lower": (5.2, 5.7, 6.9, 7.0, 7.1, 11.0, 10.5),
}
HEIGHTS: dict[Jaw, tuple[float, ...]] = {
    "upper": (9.6, 8.2, 9.0, 7.6, 6.8, 6.2, 5.5),
    "lower": (8.2, 8.4, 9.3, 8.0, 7.0, 6.6, 5.8),
}
#: The same of primary teeth, central incisor to second molar.
PRIMARY_WIDTHS: dict[Jaw, tuple[float, ...]] = {
    "upper": (6.5, 5.1, 7.0, 7.3, 8.2),
    "lower": (4.2, 4.1, 5.0, 7.7, 9.9),
}
PRIMARY_HEIGHTS: dict[Jaw, tuple[float, ...]] = {
    "upper": (6.0, 5.6, 6.5, 5.1, 5.7),
    "lower": (5.0, 5.2, 6.0, 6.0, 5.5),
}
#: Relative standard deviation of a scale from textbook teeth, however many are seen. People's rows
#: are longer or shorter than a textbook's by 5 %, crowded or spaced; and edges that are seen in
#: front of the line of contacts are further apart in the curve of the arch. On eight films of
#: generated mouths, four of them children's, and one of crowns scanned from a patient it is off by
#: 7 % (root mean square; 13 % in a child with small teeth). Where teeth place the cameras: by 5 %
#: on 44 generated mouths, by 9 % on the one real patient of whom a scan says it.
TEXTBOOK_DEVIATION = 0.1


def textbook_width(tooth: int) -> float:
    """Mesiodistal width in mm of the crown with an FDI number; wisdom teeth: a second molar's."""
    return _of(tooth, PRIMARY_WIDTHS if is_primary(tooth) else WIDTHS)


def textbook_height(tooth: int) -> float:
    """Height in mm of the crown from the gum to the edge, of the tooth with an FDI number."""
    return _of(tooth, PRIMARY_HEIGHTS if is_primary(tooth) else HEIGHTS)


def _of(tooth: int, table: Mapping[Jaw, tuple[float, ...]]) -> float:
    row = table["upper" if is_upper(tooth) else "lower"]
    return row[min(tooth % 10, len(row)) - 1]


def millimetres_per_unit(centres: Mapping[int, npt.NDArray[np.float64]]) -> float | None:
    """What a unit of length is worth if neighbouring crowns are as far apart as the textbook's.

    Args:
        centres: FDI number -> [3] centre of the crown, in any unit.

    Returns:
        The median over all neighbours; None: there are no two.
    """
    places = {permanent_of(n): n for n in centres}
    ratios = []
    for jaw in JAWS:
        for one, next_ in pairwise(teeth_of(jaw)):
            if one in places and next_ in places:
                a, b = places[one], places[next_]
                apart = float(np.linalg.norm(centres[a] - centres[b]))
                ratios.append((textbook_width(a) + textbook_width(b)) / 2 / max(apart, 1e-9))
    return float(np.median(ratios)) if ratios else None
