"""From what the network says of a crown to probabilities of its number."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from pipeline.artifacts.dental.fdi import Jaw, primary_of, teeth_of

Array = npt.NDArray[np.float64]


def looks(
    left: float, primary: float, position: Sequence[float] | Array, jaw: Jaw
) -> dict[int, float]:
    """FDI number -> probability of a crown's number by its looks alone.

    Args:
        left, primary: logits of the patient's left side and of a primary tooth.
        position: [8] log probabilities of the place in the quadrant, from the midline.
        jaw: of the crown.
    """
    on_left = 1 / (1 + np.exp(-np.clip(left, -30, 30)))
    milk = 1 / (1 + np.exp(-np.clip(primary, -30, 30)))
    place = np.exp(np.asarray(position, np.float64))
    place[6] += place[7]  # wisdom teeth are the last ones that are counted
    result = {}
    for tooth in teeth_of(jaw):
        at = tooth % 10
        share = place[at - 1] * (on_left if tooth // 10 in (2, 3) else 1 - on_left)
        if at <= 5:
            result[primary_of(tooth)] = float(share * milk)
            share *= 1 - milk
        result[tooth] = float(share)
    total = sum(result.values())
    return {tooth: share / total for tooth, share in result.items()}
