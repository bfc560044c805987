"""The numbers of the teeth: FDI (ISO 3950), its neighbours and the Universal system."""

from __future__ import annotations

from typing import Literal

Jaw = Literal["upper", "lower"]
JAWS: tuple[Jaw, Jaw] = ("upper", "lower")

#: FDI numbers of a jaw from the patient's right to the patient's left: the order, left to right, in
#: which a frontal photograph shows them. Wisdom teeth are left out: photographs don't show them.
UPPER_TEETH = (17, 16, 15, 14, 13, 12, 11, 21, 22, 23, 24, 25, 26, 27)
LOWER_TEETH = (47, 46, 45, 44, 43, 42, 41, 31, 32, 33, 34, 35, 36, 37)
#: Every number there is: quadrants 1-4 permanent, 5-8 primary.
ALL_TEETH = frozenset(
    [10 * q + p for q in range(1, 5) for p in range(1, 9)]
    + [10 * q + p for q in range(5, 9) for p in range(1, 6)]
)
#: Which those are, as the end of a message.
THE_NUMBERS = (
    "FDI numbers are 11-18, 21-28, 31-38 and 41-48; of primary teeth 51-55, 61-65, 71-75 and 81-85"
)
#: Primary teeth have so many places from the midline.
PRIMARY_PLACES = 5
#: Place of a wisdom tooth from the midline.
WISDOM = 8
_PRIMARY_LETTERS = "ABCDEFGHIJKLMNOPQRST"


def other_jaw(jaw: Jaw) -> Jaw:
    """The jaw that bites on this one."""
    return "lower" if jaw == "upper" else "upper"


def teeth_of(jaw: Jaw) -> tuple[int, ...]:
    """FDI numbers of a jaw's permanent teeth from the patient's right to the patient's left."""
    return UPPER_TEETH if jaw == "upper" else LOWER_TEETH


def is_primary(tooth: int) -> bool:
    """Is this the FDI number of a primary tooth (51-85)?"""
    return tooth > 50


def permanent_of(tooth: int) -> int:
    """The permanent tooth in the place of a tooth: 11 for 51 (and for 11)."""
    return tooth - 40 if is_primary(tooth) else tooth


def primary_of(tooth: int) -> int:
    """The primary tooth in the place of a permanent one: 51 for 11.

    Raises:
        ValueError: molars have no predecessor.
    """
    if tooth % 10 > PRIMARY_PLACES:
        raise ValueError(f"no primary tooth stands where {tooth} will")
    return tooth if is_primary(tooth) else tooth + 40


def is_upper(tooth: int) -> bool:
    """Does the tooth with this FDI number belong to the upper jaw?"""
    return permanent_of(tooth) < 30


def is_left(tooth: int) -> bool:
    """Does the tooth with this FDI number belong to the patient's left side?"""
    return 20 < permanent_of(tooth) < 40


def other_side(tooth: int) -> int:
    """The tooth in the same place on the other side: 21 for 11, 75 for 85."""
    quadrant, place = divmod(tooth, 10)
    return 10 * (quadrant + 1 if quadrant % 2 else quadrant - 1) + place


def universal_number(tooth: int) -> str:
    """A tooth's number in the Universal system (ADA): "8" for 11, "E" for 51.

    Raises:
        ValueError: no such tooth.
    """
    if tooth not in ALL_TEETH:
        raise ValueError(f"{tooth} is no FDI number of a tooth (11-48, 51-85)")
    count = PRIMARY_PLACES if is_primary(tooth) else 8
    place = tooth % 10
    quadrant = permanent_of(tooth) // 10
    # Clockwise as the dentist sees it: upper right, upper left, lower left, lower right.
    index = {1: count - place, 2: count + place - 1, 3: 3 * count - place, 4: 3 * count + place - 1}
    return _PRIMARY_LETTERS[index[quadrant]] if is_primary(tooth) else str(index[quadrant] + 1)
