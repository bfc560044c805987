"""Names of the teeth and of the landmarks on them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

#: FDI numbers of a jaw from the patient's right to the patient's left: the order, left to right, in
#: which a frontal photograph shows them. Wisdom teeth are left out: photographs don't show them.
UPPER_TEETH = (17, 16, 15, 14, 13, 12, 11, 21, 22, 23, 24, 25, 26, 27)
LOWER_TEETH = (47, 46, 45, 44, 43, 42, 41, 31, 32, 33, 34, 35, 36, 37)

Jaw = Literal["upper", "lower"]
LandmarkKind = Literal["zenith", "tip", "papilla", "embrasure"]


def teeth_of(jaw: Jaw) -> tuple[int, ...]:
    """FDI numbers of a jaw from the patient's right to the patient's left."""
    return UPPER_TEETH if jaw == "upper" else LOWER_TEETH


def is_upper(tooth: int) -> bool:
    """Does the tooth with this FDI number belong to the upper jaw?"""
    return tooth < 30


@dataclass(frozen=True, order=True)
class Landmark:
    """A point that can be named on any patient's teeth.

    Attributes:
        kind: `zenith`, the highest point of the gum line on a crown; `tip`, the middle of its
            biting edge or cusp; `papilla`, the tip of the gum between two crowns; `embrasure`,
            where two crowns part at the biting edge.
        tooth: FDI number; of a papilla or embrasure, that of the tooth nearer the patient's right.
        neighbour: the other tooth of a papilla or embrasure, else 0.
    """

    kind: LandmarkKind
    tooth: int
    neighbour: int = 0
