"""Read one photograph: two looks, crowns, jaws, order, numbers."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from scipy.special import softmax

from pipeline.artifacts.dental.fdi import JAWS, PRIMARY_PLACES, Jaw, primary_of, teeth_of
from pipeline.artifacts.teeth import Crown, Dentition
from stages.dentition.crowns import (
    Outline,
    centroid,
    dentition_of,
    outline_of,
    row_roll,
    with_outlines,
)
from stages.dentition.far_side import far_side_apart
from stages.dentition.tooth_rows import POSITIONS, position_evidence, row_probabilities
from stages.teeth.instances import Found, find_crowns
from stages.teeth.network import HEIGHT, KINDS, WIDTH, Answer, Transform, fitted, look
from stages.teeth.numbers import looks
from stages.teeth.tissue import on_jaws

Array32 = npt.NDArray[np.float32]
Bool = npt.NDArray[np.bool_]

#: Free space around the teeth in the second look, as shares of their width.
_MARGIN_X, _MARGIN_Y = 0.08, 0.10
#: The first look must find so many crowns for a second one.
_LEAST_CROWNS = 3
#: Photographs that look less upright than this (`uprightness`) are looked at the other ways up, and
#: turned for so much more, if both rows show so many crowns. Of 106 photographs from the front and
#: the sides 92 % look more upright, and none on its side above 2.3; turned by 90 degrees they lose
#: .6 at the least, and none of them gains more than .41 by 180.
_UPRIGHT, _MORE_UPRIGHT, _LEAST_IN_ROW = 2.8, 0.5, 3
#: Logit of the jaw that counts as much in that as certainty about a tooth's place.
_JAW_UNIT = 5.0
#: Around crowns seen through a gap there is no gum within this share of the band (a millimetre):
#: what the network takes for it are slivers of these crowns.
_BESIDE_FAR_SIDE = 0.06
#: Numbers less probable than this are not kept.
_LEAST_SHARE = 1e-4


@dataclass(frozen=True)
class Reading:
    """What one photograph shows.

    Attributes:
        dentition: its crowns; kind "none" where no teeth were found.
        kinds: kind of photograph -> probability.
        apart: 0..1 probability, by the whole picture, that the jaws are apart.
    """

    dentition: Dentition
    kinds: dict[str, float]
    apart: float


def read_photograph(
    image: Array32,
    valid: Bool,
    name: str,
    quarters: int = 0,
    glances: Glances | None = None,
) -> Reading:
    """Find the crowns in one photograph.

    Args:
        image: [H, W, 3] float32 sRGB in 0..1.
        valid: [H, W] bool: nothing is read outside.
        name: of the view.
        quarters: of a turn anticlockwise that bring the photograph upright, unless it clearly looks
            otherwise.
        glances: at it, where some were taken before.

    Returns:
        The reading, in pixels of the photograph.
    """
    height, width = image.shape[:2]
    size = (width, height)
    first, crowns = _first_look(glances or Glances(image, valid), quarters)
    answer = first
    if len(crowns) >= _LEAST_CROWNS:
        closer = look(image, valid, _closer(crowns), flip=True)
        again = find_crowns(closer)
        if sum(c.area for c in again) > 0.6 * sum(c.area for c in crowns):
            answer, crowns = closer, again
    kind = np.exp((first.kind + answer.kind) / 2)
    kinds = {name: float(share) for name, share in zip(KINDS, kind / kind.sum(), strict=True)}
    apart = 1 / (1 + math.exp(-float(np.clip((first.apart + answer.apart) / 2, -30, 30))))
    if not crowns:
        return Reading(Dentition(name, size, "none"), kinds, apart)
    likely = max(kinds, key=lambda k: kinds[k])
    dentition = numbered(dentition_of(_outlines(crowns), name, size, likely))
    near, behind = far_side_apart(dentition)
    if behind:
        dentition = numbered(with_outlines(dentition, [outline_of(crown) for crown in near]))
    margin = _BESIDE_FAR_SIDE * dentition.band_height
    jaws = on_jaws([first, answer], size, [crown.outline for crown in behind], margin)
    return Reading(replace(dentition, on_jaws=jaws), kinds, apart)


class Glances:
    """Looks at a whole photograph, upright or turned by quarters; each is taken once.

    Args:
        image: [H, W, 3] float32 sRGB in 0..1.
        valid: [H, W] bool: nothing is read outside.
    """

    def __init__(self, image: Array32, valid: Bool) -> None:
        self._image, self._valid = image, valid
        self._taken: dict[int, tuple[Answer, list[Found]]] = {}

    def turned(self, quarters: int) -> tuple[Answer, list[Found]]:
        """What it shows turned anticlockwise by some quarters of a turn."""
        quarters %= 4
        if quarters not in self._taken:
            transform = _quarter_turned(self._image.shape[:2], quarters)
            answer = look(self._image, self._valid, transform, flip=False)
            self._taken[quarters] = answer, find_crowns(answer)
        return self._taken[quarters]


def _first_look(glances: Glances, quarters: int) -> tuple[Answer, list[Found]]:
    """The whole photograph, the right way up if that is clear."""
    answer, crowns = glances.turned(quarters)
    upright = uprightness(answer, crowns)
    if len(crowns) < _LEAST_CROWNS or upright > _UPRIGHT:
        return answer, crowns
    least = upright + _MORE_UPRIGHT
    for more in (1, 2, 3):
        turned, found = glances.turned(quarters + more)
        value = uprightness(turned, found)
        if shows_both_rows(found) and value > least:
            answer, crowns, least = turned, found, value
    return answer, crowns


def shows_both_rows(crowns: list[Found]) -> bool:
    """Are there some crowns of either jaw?"""
    lower = sum(crown.lower > 0 for crown in crowns)
    return min(lower, len(crowns) - lower) >= _LEAST_IN_ROW


def _quarter_turned(shape: tuple[int, ...], quarters: int) -> Transform:
    """As `fitted`, of the photograph turned anticlockwise by some quarters of a turn."""
    height, width = shape[:2]
    c, s = round(math.cos(quarters * math.pi / 2)), round(math.sin(quarters * math.pi / 2))
    turn = np.array([[c, s], [-s, c]], np.float64)
    corners = np.array([[0, 0], [width, height]]) @ turn.T
    low, high = corners.min(axis=0), corners.max(axis=0)
    fit = fitted((int(high[1] - low[1]), int(high[0] - low[0])))
    return np.column_stack([fit[:, :2] @ turn, fit[:, 2] - fit[:, :2] @ low])


def uprightness(answer: Answer, crowns: list[Found]) -> float:
    """How much a photograph looks as if it stood upright, 0 to 4: sure of the crowns' places in
    their quadrants, of their jaws, and of a view from the front or a side."""
    if not crowns:
        return 0.0
    places = np.mean([softmax(crown.position).max() for crown in crowns])
    jaws = np.mean([min(abs(crown.lower) / _JAW_UNIT, 2.0) for crown in crowns])
    facing = np.exp(answer.kind[: KINDS.index("upper")]).sum()
    return float(places + jaws + facing)


def _closer(crowns: list[Found]) -> Transform:
    """The frame of the second look: upright, the teeth fill it."""
    outlines = [Outline(crown.polygon, _jaw(crown.lower)) for crown in crowns]
    roll = row_roll(outlines)
    c, s = math.cos(-roll), math.sin(-roll)
    turn = np.array([[c, -s], [s, c]])
    points = np.concatenate([crown.polygon for crown in crowns]) @ turn.T
    low, high = points.min(axis=0), points.max(axis=0)
    middle, extent = (low + high) / 2, high - low
    wanted = extent + 2 * extent[0] * np.array([_MARGIN_X, _MARGIN_Y])
    scale = min(WIDTH / wanted[0], HEIGHT / wanted[1])
    return np.column_stack([scale * turn, [WIDTH / 2, HEIGHT / 2] - scale * middle])


def _jaw(lower: float) -> Jaw:
    return "lower" if lower > 0 else "upper"


def _outlines(crowns: list[Found]) -> list[Outline]:
    """The crowns with their jaw and looks."""
    jaws = [_jaw(crown.lower) for crown in crowns]
    return [
        Outline(
            polygon=crown.polygon,
            jaw=jaw,
            score=crown.score,
            numbers={
                tooth: share
                for tooth, share in looks(crown.left, crown.primary, crown.position, jaw).items()
                if share >= _LEAST_SHARE
            },
        )
        for crown, jaw in zip(crowns, jaws, strict=True)
    ]


def numbered(dentition: Dentition) -> Dentition:
    """The dentition with each crown's most probable number and its doubt, by this photograph alone.

    Numbers that a person has said (doubt 0) stay.
    """
    rows: dict[Jaw, tuple[Crown, ...]] = {}
    for jaw in JAWS:
        crowns = dentition.crowns(jaw)
        evidence = [position_evidence(crown.numbers, jaw) for crown in crowns]
        shares = row_probabilities(np.array(evidence).reshape(-1, POSITIONS))
        rows[jaw] = tuple(
            crown if crown.doubt == 0 else _with_number(crown, jaw, share)
            for crown, share in zip(crowns, shares, strict=True)
        )
    return replace(dentition, upper=rows["upper"], lower=rows["lower"])


def _with_number(crown: Crown, jaw: Jaw, share: npt.NDArray[np.float64]) -> Crown:
    best = int(np.argmax(share))
    if best == POSITIONS:
        return replace(crown, number=0, doubt=1.0)
    tooth = teeth_of(jaw)[best]
    if tooth % 10 <= PRIMARY_PLACES:
        milk = primary_of(tooth)
        if crown.numbers.get(milk, 0.0) > crown.numbers.get(tooth, 0.0):
            tooth = milk
    return replace(crown, number=tooth, doubt=float(min(1.0, max(1e-4, 1 - share[best]))))


def row_extent(dentition: Dentition) -> float:
    """How far the crowns reach along or across a photograph, whichever is more, over its long
    side."""
    centres = np.array([centroid(crown.outline) for crown in dentition.all_crowns])
    return float(np.ptp(centres, axis=0).max() / max(dentition.size)) if len(centres) else 0.0
