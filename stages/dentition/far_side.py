"""Teeth of the other side, seen through the gap of an open bite.

Where the front teeth do not meet, a photograph from the side shows behind them, between the rows,
the inner sides of teeth across the mouth. They are crowns, but of neither row: in a row they would
stand between neighbours and hide where these meet.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from pipeline.artifacts.dental.fdi import JAWS, Jaw
from pipeline.artifacts.teeth import Crown, Dentition

Array = npt.NDArray[np.float64]

#: A crown between the rows reaches less far towards the gum than this share of its neighbours'
#: height: of 133 such crowns of 72 generated mouths 127 (.66 at most). Of crowns that have a number
#: 2 % reach no further either, and these stay.
REACH = 0.5
#: Neighbours are crowns no further away than this many median widths.
NEAR = 1.0


def far_side(dentition: Dentition, jaw: Jaw) -> npt.NDArray[np.bool_]:
    """[n] which crowns of a row, by the photograph alone no tooth of it, lie between the rows."""
    crowns = dentition.crowns(jaw)
    found = np.zeros(len(crowns), bool)
    suspect = [k for k, crown in enumerate(crowns) if not crown.number]
    if not suspect or len(crowns) - len(suspect) < 2:
        return found
    starts, ends, gum, edge = _extents(dentition, crowns, 1.0 if jaw == "lower" else -1.0)
    teeth = np.array([k for k in range(len(crowns)) if k not in suspect])
    width = np.median((ends - starts)[teeth])
    for k in suspect:
        away = np.maximum(starts[teeth] - ends[k], starts[k] - ends[teeth])
        near = teeth[away <= NEAR * width]
        before = starts[near].min(initial=np.inf) < starts[k]
        after = ends[near].max(initial=-np.inf) > ends[k]
        if len(near) >= 2 and before and after:
            line, biting = np.median(gum[near]), np.median(edge[near])
            found[k] = gum[k] < biting + REACH * (line - biting)
    return found


def _extents(
    dentition: Dentition, crowns: tuple[Crown, ...], down: float
) -> tuple[Array, Array, Array, Array]:
    """Along the row from and to, and towards the gum to and from, of each crown; pixels."""
    along, across = zip(
        *(dentition.levelled(c.outline[:, 0], c.outline[:, 1]) for c in crowns), strict=True
    )
    return (
        np.array([x.min() for x in along]), np.array([x.max() for x in along]),
        np.array([(down * y).max() for y in across]), np.array([(down * y).min() for y in across]),
    )  # fmt: skip


def far_side_apart(dentition: Dentition) -> tuple[list[Crown], list[Crown]]:
    """The crowns of both rows, and those seen through the gap between them."""
    near: list[Crown] = []
    behind: list[Crown] = []
    for jaw in JAWS:
        for crown, far in zip(dentition.crowns(jaw), far_side(dentition, jaw), strict=True):
            (behind if far else near).append(crown)
    return near, behind
