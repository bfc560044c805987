"""The textbook arch: where the landmarks of 28 teeth of textbook size lie on a smooth arch.

Real patients differ from it by about 1.5 mm RMS after the nine stretches that `bundle` fits.
Frame: x to the patient's left, y up, z to the front, millimetres; the origin lies between the upper
central incisors' biting edges.
"""

from __future__ import annotations

from functools import lru_cache
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from pipeline.artifacts.dental.fdi import JAWS, PRIMARY_PLACES, Jaw, is_upper, teeth_of
from pipeline.artifacts.dental.sizes import HEIGHTS, PRIMARY_HEIGHTS, PRIMARY_WIDTHS, WIDTHS
from stages.dentition.tooth_rows import POSITIONS
from stages.init.dental.landmarks import Landmark

Array = npt.NDArray[np.float64]

#: Half width and depth of each arch's curve (mm), which ends behind the second molars.
ARCH_SIZE: dict[Jaw, tuple[float, float]] = {"upper": (30.5, 46.0), "lower": (28.0, 43.0)}
#: The same where all teeth before the molars are primary; it ends behind the first molars, seen or
#: not. A child's arch is deeper for its width than the front of an adult's: between the edges of
#: primary canines, of second molars, and from incisors back to these it is 29, 43 and 20 mm above,
#: 22, 39 and 17 below. The shape is between what four children's photographs make likeliest
#: (shallower by a twentieth) and casts of children (deeper by as much). Twice the log evidence of
#: the four is better by 5 and worse by 5 there; on the front of an adult's arch it is worse by 8.
PRIMARY_ARCH_SIZE: dict[Jaw, tuple[float, float]] = {"upper": (25.8, 36.1), "lower": (24.8, 34.7)}
#: How far the lower incisors reach up behind the upper ones, and lie behind them (mm).
OVERBITE, OVERJET = 2.5, 2.2
#: The gum goes on beyond the zeniths: steps (mm) gumwards and outwards, over the bulge of the
#: alveolar process and back into the vestibule.
GUM_STEPS = ((4.0, 0.8), (9.0, -0.5))
#: Teeth a side, without wisdom teeth.
TEETH_A_SIDE = 7
#: The curve goes on so far (mm) as a straight line.
STRAIGHT_ON = 30.0


def tooth_at(jaw: Jaw, position: int) -> int:
    """FDI number of a position along the row (0: the patient's right second molar)."""
    return teeth_of(jaw)[position]


def position_of(tooth: int) -> int:
    """Position along its row of the tooth with an FDI number."""
    return teeth_of("upper" if is_upper(tooth) else "lower").index(tooth)


@lru_cache(maxsize=1)
def landmark_names() -> tuple[Landmark, ...]:
    """All landmarks of the model, jaw by jaw: zeniths, tips, papillae, embrasures by position."""
    names: list[Landmark] = []
    for jaw in JAWS:
        teeth = teeth_of(jaw)
        names += [Landmark("zenith", tooth) for tooth in teeth]
        names += [Landmark("tip", tooth) for tooth in teeth]
        names += [Landmark("papilla", a, b) for a, b in pairwise(teeth)]
        names += [Landmark("embrasure", a, b) for a, b in pairwise(teeth)]
    return tuple(names)


#: Where each kind starts in a jaw's part of `landmark_names`, and how many a jaw has.
ZENITH, TIP, PAPILLA, EMBRASURE = 0, POSITIONS, 2 * POSITIONS, 3 * POSITIONS - 1
LANDMARKS_A_JAW = 4 * POSITIONS - 2


def landmark_index(jaw: Jaw, kind_start: int, position: int) -> int:
    """Index into `landmark_names` of a kind (`ZENITH`, ...) at a position (or right of a gap)."""
    return (0 if jaw == "upper" else LANDMARKS_A_JAW) + kind_start + position


def is_lower_landmark() -> npt.NDArray[np.bool_]:
    """[L] bool: which landmarks of `landmark_names` belong to the lower jaw."""
    return np.arange(2 * LANDMARKS_A_JAW) >= LANDMARKS_A_JAW


@lru_cache(maxsize=32)
def _arch_curve(half_width: float, depth: float, length: float) -> tuple[Array, Array, Array]:
    """Arc length, x and z of half an arch from the midline backwards, [4001] each.

    Not to be written to: they are cached.
    """
    t = np.linspace(0.0, np.pi / 2, 4000)
    x = half_width * np.sin(t) ** 0.9
    z = -depth * (1 - np.cos(t) ** 1.15)
    arc = np.concatenate([[0.0], np.cumsum(np.hypot(np.diff(x), np.diff(z)))])
    arc *= length / arc[-1]
    return (
        np.append(arc, length + STRAIGHT_ON),
        np.append(x, x[-1]),
        np.append(z, z[-1] - STRAIGHT_ON),
    )


def _curve_of(jaw: Jaw, child: float) -> tuple[float, float, float]:
    """Half width, depth and length of a jaw's curve, where this share of a side's teeth before the
    molars is primary: the arch of a child who changes teeth is between a child's and an adult's."""
    adults = np.array([*ARCH_SIZE[jaw], sum(WIDTHS[jaw])])
    childs = np.array([*PRIMARY_ARCH_SIZE[jaw], sum(PRIMARY_WIDTHS[jaw]) + WIDTHS[jaw][5]])
    half_width, depth, length = adults + child * (childs - adults)
    return float(half_width), float(depth), float(length)


@lru_cache(maxsize=256)
def _half_jaw(jaw: Jaw, absent: frozenset[int], primary: frozenset[int]) -> Array:
    """Landmarks of a jaw's left half: [4, 7, 3] by kind and position from the midline.

    Absent and primary teeth are named by their index from the midline, from 0.

    Of papillae and embrasures, position i is the mesial one of tooth i. Not to be written to: it is
    cached, for the hypotheses of a search differ in one half of a jaw.
    """
    upper = jaw == "upper"
    usual = [PRIMARY_WIDTHS[jaw][i] if i in primary else w for i, w in enumerate(WIDTHS[jaw])]
    widths = np.array([0.0 if i in absent else w for i, w in enumerate(usual)])
    heights = np.array(
        [PRIMARY_HEIGHTS[jaw][i] if i in primary else h for i, h in enumerate(HEIGHTS[jaw])]
    )
    arc, x, z = _arch_curve(*_curve_of(jaw, len(primary) / PRIMARY_PLACES))
    borders = np.concatenate([[0.0], np.cumsum(widths)])
    towards_gum = 1.0 if upper else -1.0

    def on_arch(s: float) -> Array:
        return np.array([np.interp(s, arc, x), 0.0, np.interp(s, arc, z)])

    def outward(s: float) -> Array:
        along = on_arch(s + 0.5) - on_arch(max(s - 0.5, 0.0))
        along /= np.linalg.norm(along)
        return np.array([-along[2], 0.0, along[0]])

    def lift(tooth: int) -> float:
        """Height of the biting edge: the lower incisors overlap; both rows rise to the back."""
        bite = 0.0 if upper else OVERBITE * (1 - 0.12 * tooth)
        return bite + 0.2 * max(0, tooth - 2)

    back = np.array([0.0, 0.0, 0.0 if upper else -OVERJET])
    points = np.zeros((4, TEETH_A_SIDE, 3))
    for i in range(TEETH_A_SIDE):
        middle = float(borders[i] + borders[i + 1]) / 2
        base, normal = on_arch(middle) + back, outward(middle)
        cusp = -0.4 * towards_gum if i == 2 else 0.0
        inward = 0.8 if i < 3 else 1.8
        points[0, i] = base - normal + [0, towards_gum * heights[i] + lift(i), 0]
        points[1, i] = base - inward * normal + [0, lift(i) + cusp, 0]
        base, normal = on_arch(float(borders[i])) + back, outward(float(borders[i]))
        if i == 0:
            height, inset = heights[0], np.array([0.0, 0.0, 1.0])
            depths, shares, level = (1.5, 1.2), (0.5, 0.2), lift(0)
        else:
            height, inset = (heights[i - 1] + heights[i]) / 2, normal
            depths, shares, level = (2.2, 2.0), (0.55, 0.22), lift(i - 1)
        for kind in (0, 1):
            up = towards_gum * shares[kind] * height + level
            points[2 + kind, i] = base - depths[kind] * inset + [0, up, 0]
    points.flags.writeable = False
    return points


def _side_of(teeth: frozenset[int], jaw: Jaw, side: int) -> frozenset[int]:
    """Indices from the midline of those of some teeth that are in a jaw's half (1: left)."""
    positions = [position_of(t) for t in teeth if is_upper(t) == (jaw == "upper")]
    return frozenset(p - 7 if side == 1 else 6 - p for p in positions if (p >= 7) == (side == 1))


@lru_cache(maxsize=128)
def textbook_arch(
    closed_gaps: frozenset[int] = frozenset(), primary: frozenset[int] = frozenset()
) -> Array:
    """Positions of all landmarks of `landmark_names` on the textbook arch.

    Args:
        closed_gaps: FDI numbers of teeth that are missing and whose space the teeth behind have
            closed. Their landmarks are placed where the neighbours meet.
        primary: numbers of the permanent teeth (11-45) in whose place primary ones stand.

    Returns:
        [L, 3] float64, mm, arch frame. Not to be written to (it is cached).
    """
    result = np.empty((2 * LANDMARKS_A_JAW, 3))
    for jaw in JAWS:
        for side in (1, -1):
            absent, milk = (_side_of(teeth, jaw, side) for teeth in (closed_gaps, primary))
            half = _half_jaw(jaw, absent, milk) * np.array([side, 1, 1])
            for i in range(TEETH_A_SIDE):
                position = 7 + i if side == 1 else 6 - i
                result[landmark_index(jaw, ZENITH, position)] = half[0, i]
                result[landmark_index(jaw, TIP, position)] = half[1, i]
                # A gap is named by the position on its (patient's) right.
                gap = 6 + i if side == 1 else 6 - i
                result[landmark_index(jaw, PAPILLA, gap)] = half[2, i]
                result[landmark_index(jaw, EMBRASURE, gap)] = half[3, i]
    result.flags.writeable = False
    return result


@lru_cache(maxsize=1)
def facing_yaws() -> Array:
    """[L] degrees from which one looks at each landmark of the textbook arch face to face (0: from
    the front, positive: from the patient's left). Not to be written to."""
    arch = textbook_arch()
    result = np.empty(len(arch))
    for index, name in enumerate(landmark_names()):
        jaw: Jaw = "upper" if is_upper(name.tooth) else "lower"
        first = position_of(name.tooth)
        last = first + 1
        if not name.neighbour:
            first, last = max(first - 1, 0), min(last, POSITIONS - 1)
        along = arch[landmark_index(jaw, ZENITH, last)] - arch[landmark_index(jaw, ZENITH, first)]
        result[index] = np.degrees(np.arctan2(-along[2], along[0]))
    result.flags.writeable = False
    return result
