"""Names of the landmarks on the teeth."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

LandmarkKind = Literal["zenith", "tip", "papilla", "embrasure"]


@dataclass(frozen=True, order=True)
class Landmark:
    """A point that can be named on any patient's teeth.

    Attributes:
        kind: `zenith`, the highest point of the gum line on a crown; `tip`, the middle of its
            biting edge or cusp; `papilla`, the tip of the gum between two crowns; `embrasure`,
            where two crowns part at the biting edge.
        tooth: FDI number; of a papilla or embrasure, that of the tooth nearer the patient's right.
            The place counts: a primary tooth has the landmarks of the permanent one to come.
        neighbour: the other tooth of a papilla or embrasure, else 0.
    """

    kind: LandmarkKind
    tooth: int
    neighbour: int = 0
