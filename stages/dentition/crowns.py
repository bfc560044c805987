"""From the outlines of crowns in a photograph to a dentition: order, directions, landmarks."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from pipeline.artifacts.dental.fdi import JAWS, Jaw, other_side
from pipeline.artifacts.teeth import Crown, Dentition, moved_polygons

Array = npt.NDArray[np.float64]

#: A row of teeth that lies this flat, or stands this upright, is not turned further (radians): a
#: view from above or below tilts it as much.
NATURAL_TILT = math.radians(5)
#: Shares of the band's height within which the gum line or biting edge counts as its extremum: the
#: landmark is the middle of that stretch, for crowns end flat.
ZENITH_FLATNESS, TIP_FLATNESS, PARTING_FLATNESS = 0.035, 0.03, 0.015
#: Neighbours further apart than this share of the narrower one's width have no papilla in common.
GAP = 0.2
#: Neighbours no further from each other than where they are nearest, and this share of the band
#: (.7 mm), meet there. Landmarks of twelve patients lie 1.40 % of the band off their epipolar lines
#: (.02 to .06: 1.40 to 1.58 %); the evidence that photographs show one mouth is 10 and more for 25
#: of 32 generated ones, half of them with gaps all over (.03: 23, .02: 22; 19 where a gap left its
#: papilla anywhere).
MEETING = 0.045
#: A crown nearer to the border of the photograph than this share of its size goes on outside.
BORDER = 0.008
#: Crowns scoring less are doubtful.
SURE_SCORE = 0.5
#: Distance between the points of an outline from which landmarks are taken, as share of the band.
SAMPLING = 0.004


@dataclass(frozen=True)
class Outline:
    """One crown's outline in a photograph, before its landmarks are known.

    Attributes:
        polygon: [K, 2] pixels of the working image, pixel centres at .5.
        jaw: upper or lower.
        score: 0..1, how sure it is that this is one crown.
        numbers: FDI number -> probability by its looks.
        number, doubt: as in `Crown`.
    """

    polygon: Array
    jaw: Jaw
    score: float = 1.0
    numbers: Mapping[int, float] = field(default_factory=dict)
    number: int = 0
    doubt: float = 1.0


def outline_of(crown: Crown) -> Outline:
    """What a crown is without its landmarks."""
    return Outline(crown.outline, crown.jaw, crown.score, crown.numbers, crown.number, crown.doubt)


def dentition_of(
    outlines: Sequence[Outline],
    name: str,
    size: tuple[int, int],
    kind: str,
    roll: float | None = None,
    set_aside: str = "",
) -> Dentition:
    """Put the crowns of a photograph in order and find their landmarks.

    Args:
        outlines: of the crowns.
        name, size, kind, set_aside: as in `Dentition`.
        roll: radians by which the rows are turned clockwise; None: found from the outlines.
    """
    good = [outline for outline in outlines if len(outline.polygon) >= 3]
    base = Dentition(name, size, kind, set_aside=set_aside)
    if not good:
        return base
    turn = row_roll(good) if roll is None else roll
    upright = [replace(o, polygon=_turned(o.polygon, -turn)) for o in good]
    rows: dict[Jaw, list[int]] = {}
    for jaw in JAWS:
        mine = [k for k, outline in enumerate(upright) if outline.jaw == jaw]
        rows[jaw] = sorted(mine, key=lambda k: float(centroid(upright[k].polygon)[0]))
    band = _band_height([upright[k] for k in rows["upper"]], [upright[k] for k in rows["lower"]])
    made: dict[Jaw, tuple[Crown, ...]] = {}
    for jaw in JAWS:
        crowns = _row([upright[k] for k in rows[jaw]], jaw, band)
        made[jaw] = tuple(
            _turned_crown(crown, good[k], turn, size)
            for crown, k in zip(crowns, rows[jaw], strict=True)
        )
    return replace(
        base,
        upper=made["upper"],
        lower=made["lower"],
        roll=turn,
        band_height=band,
        jaws_apart=_jaws_apart(upright, rows, band),
    )


def with_outlines(dentition: Dentition, outlines: Sequence[Outline]) -> Dentition:
    """A photograph whose crowns have become others: all else is kept, landmarks are found again."""
    name, size, kind = dentition.name, dentition.size, dentition.kind
    made = dentition_of(outlines, name, size, kind, dentition.roll, dentition.set_aside)
    return replace(made, on_jaws=dentition.on_jaws, mirrored=dentition.mirrored)


def mirrored_dentition(dentition: Dentition, said_too: bool = False) -> Dentition:
    """The teeth in the picture turned over: those of a mirror image as they are.

    Numbers that a person has said (doubt 0) are the patient's, whatever the picture shows: only
    with `said_too` they become those of the other side like all others.
    """
    width = dentition.size[0]
    return replace(
        dentition,
        kind={"right": "left", "left": "right"}.get(dentition.kind, dentition.kind),
        upper=tuple(mirrored_crown(c, width, said_too) for c in reversed(dentition.upper)),
        lower=tuple(mirrored_crown(c, width, said_too) for c in reversed(dentition.lower)),
        roll=-dentition.roll,
        on_jaws=moved_polygons(dentition.on_jaws, lambda polygon: _turned_over(polygon, width)),
        mirrored=True,
    )


def mirrored_crown(crown: Crown, width: int, said_too: bool = False) -> Crown:
    """A crown in the picture, so many pixels wide, turned over (see `mirrored_dentition`)."""

    def over(point: Array | None) -> Array | None:
        return None if point is None else np.array([width - point[0], point[1]])

    zenith, tip = over(crown.zenith), over(crown.tip)
    assert zenith is not None and tip is not None
    turns = crown.number and (crown.doubt > 0 or said_too)
    return replace(
        crown,
        zenith=zenith,
        tip=tip,
        papilla_left=over(crown.papilla_right),
        papilla_right=over(crown.papilla_left),
        embrasure_left=over(crown.embrasure_right),
        embrasure_right=over(crown.embrasure_left),
        cut_left=crown.cut_right,
        cut_right=crown.cut_left,
        outline=_turned_over(crown.outline, width),
        numbers={other_side(tooth): share for tooth, share in crown.numbers.items()},
        number=other_side(crown.number) if turns else crown.number,
    )


def _turned_over(polygon: Array, width: int) -> Array:
    return (np.array([width, 0.0]) + polygon * [-1.0, 1.0])[::-1]


def centroid(polygon: Array) -> Array:
    """[2] centre of the area of a polygon [K, 2]."""
    x, y = polygon.T
    x2, y2 = np.roll(x, -1), np.roll(y, -1)
    cross = x * y2 - x2 * y
    area = float(cross.sum())
    if abs(area) < 1e-9:
        return np.asarray(polygon.mean(axis=0))
    return np.array([((x + x2) * cross).sum(), ((y + y2) * cross).sum()]) / (3 * area)


def row_roll(outlines: Sequence[Outline]) -> float:
    """Radians by which the rows of teeth are turned clockwise; upper teeth end up on top."""
    centres = np.array([centroid(outline.polygon) for outline in outlines])
    upper = np.array([outline.jaw == "upper" for outline in outlines])
    rows = [centres[side] - centres[side].mean(axis=0) for side in (upper, ~upper) if side.any()]
    spread = sum((row.T @ row for row in rows), start=np.zeros((2, 2)))
    angle = 0.5 * math.atan2(2 * spread[0, 1], spread[0, 0] - spread[1, 1])
    if upper.any() and not upper.all():
        up = centres[upper].mean(axis=0) - centres[~upper].mean(axis=0)
        if up @ [math.sin(angle), -math.cos(angle)] < 0:
            angle += math.pi if angle <= 0 else -math.pi
    quarter = round(angle / (math.pi / 2)) * (math.pi / 2)
    return quarter if abs(angle - quarter) < NATURAL_TILT else angle


def _turned(points: Array, angle: float) -> Array:
    """[N, 2] points turned clockwise (y down) by an angle about the origin."""
    c, s = math.cos(angle), math.sin(angle)
    return np.asarray(points @ np.array([[c, s], [-s, c]]))


def _band_height(upper: list[Outline], lower: list[Outline]) -> float:
    """Pixels from gum line to gum line with the jaws closed, from upright outlines."""
    if upper and lower:
        tops = np.array([[centroid(o.polygon)[0], o.polygon[:, 1].min()] for o in upper])
        ends = np.array([[centroid(o.polygon)[0], o.polygon[:, 1].max()] for o in lower])
        there = np.interp(tops[:, 0], ends[:, 0], ends[:, 1])
        inside = (tops[:, 0] >= ends[0, 0]) & (tops[:, 0] <= ends[-1, 0])
        band = float(np.median((there - tops[:, 1])[inside if inside.any() else slice(None)]))
    else:
        band = 0.0
    heights = [
        float(np.median([np.ptp(o.polygon[:, 1]) for o in row])) for row in (upper, lower) if row
    ]
    most = sum(heights) if len(heights) == 2 else 1.8 * heights[0]
    # Jaws that are apart show a higher band; two rows never overlap by more than one crown.
    return float(np.clip(band, max(heights), most)) if band else most


def _jaws_apart(outlines: list[Outline], rows: dict[Jaw, list[int]], band: float) -> float:
    """Share of the band between the biting edges where they are nearest; 0: in contact."""
    upper = [outlines[k].polygon for k in rows["upper"]]
    lower = [outlines[k].polygon for k in rows["lower"]]
    if not upper or not lower:
        return 0.0
    gaps = []
    for polygon in upper:
        middle = float(centroid(polygon)[0])
        below = [p for p in lower if p[:, 0].min() <= middle <= p[:, 0].max()]
        if below:
            edge = min(float(p[:, 1].min()) for p in below)
            gaps.append((edge - float(polygon[:, 1].max())) / band)
    return max(0.0, float(np.quantile(gaps, 0.25))) if gaps else 0.0


@dataclass(frozen=True)
class _Local:
    """A crown's outline in the upright frame: [N] along the row and [N] towards the gum.

    Both are the frame's own directions, also where a row climbs: the patient's upright is upright
    in the picture all along it.
    """

    along: Array
    gum: Array


def _resampled(polygon: Array, step: float) -> Array:
    """[N, 2] points on a polygon's sides, no further apart than step."""
    sides = np.roll(polygon, -1, axis=0) - polygon
    parts = np.maximum(np.ceil(np.linalg.norm(sides, axis=1) / step), 1).astype(int)
    side = np.repeat(np.arange(len(polygon)), parts)
    part = np.arange(len(side)) - np.repeat(np.cumsum(parts) - parts, parts)
    return polygon[side] + (part * (1 / parts)[side])[:, None] * sides[side]


def outermost(along: Array, height: Array, flatness: float) -> tuple[float, float]:
    """(along, height) of the middle of the highest stretch of an outline's points [N]."""
    top = float(height.max())
    stretch = along[height >= top - flatness]
    return float((stretch.min() + stretch.max()) / 2), top


def _extreme(local: _Local, flatness: float, towards_gum: bool) -> tuple[float, float]:
    """(along, gumward) of the middle of the outermost stretch of an outline."""
    sign = 1.0 if towards_gum else -1.0
    along, height = outermost(local.along, sign * local.gum, flatness)
    return along, sign * height


def _envelope(coordinate: Array, value: Array, at: Array, largest: bool) -> Array:
    """Largest (or smallest) value of an outline's points at coordinates; nan where it has none.

    `at` is evenly spaced; the outline's points lie closer together than that.
    """
    sign = 1.0 if largest else -1.0
    step = float(at[1] - at[0])
    bins = np.floor((coordinate - at[0]) / step + 0.5).astype(np.int64)
    inside = (bins >= 0) & (bins < len(at))
    result = np.full(len(at), -np.inf)
    np.maximum.at(result, bins[inside], sign * value[inside])
    return np.where(np.isfinite(result), sign * result, np.nan)


def _steps(start: float, end: float, band: float) -> Array | None:
    """Evenly spaced coordinates for `_envelope`; None: too few."""
    step = max(SAMPLING * band * 1.5, 0.4)
    return np.arange(start, end, step) if end - start >= 4 * step else None


def _papilla(first: _Local, second: _Local, band: float) -> Array | None:
    """(along, gumward) where two neighbours meet below the gum: nearest to it, hardly further from
    each other (`MEETING`) than where they are nearest.

    Crowns that overlap in the picture meet in a corner, but their sides are nearly parallel there,
    and it slides along them with every pixel of overlap, down to where the crowns are widest. A
    little further up the sides part quickly. Crowns with a little gap between them have their
    papilla where those that touch have it.

    Args:
        first, second: their outlines, left and right.
    """
    heights = _steps(
        float(max(first.gum.min(), second.gum.min())),
        float(min(first.gum.max(), second.gum.max())), band,
    )  # fmt: skip
    if heights is None:
        return None
    before = _envelope(first.gum, first.along, heights, largest=True)
    after = _envelope(second.gum, second.along, heights, largest=False)
    opening = after - before
    if np.isfinite(opening).sum() < 4:
        return None
    nearest = max(float(np.nanmin(opening)), 0.0)
    k = int(np.flatnonzero(opening <= nearest + MEETING * band)[-1])
    return np.array([(before[k] + after[k]) / 2, heights[k]])


def _embrasure(first: _Local, second: _Local, band: float) -> Array | None:
    """(along, gumward) where two neighbours part at the biting edge.

    Args:
        first, second: their outlines, left and right.
    """
    start, end = (_extreme(local, TIP_FLATNESS * band, False)[0] for local in (first, second))
    at = _steps(start, end, band)
    if at is None:
        return None
    profiles = [_envelope(local.along, local.gum, at, largest=False) for local in (first, second)]
    line = np.min(np.where(np.isnan(profiles), np.inf, profiles), axis=0)
    known = np.isfinite(line)
    if known.sum() < 4:
        return None
    highest = float(line[known].max())
    stretch = at[known & (line >= highest - PARTING_FLATNESS * band)]
    return np.array([(stretch.min() + stretch.max()) / 2, highest])


def _row(outlines: list[Outline], jaw: Jaw, band: float) -> list[Crown]:
    """Crowns with landmarks, in the upright frame, of outlines from left to right."""
    if not outlines:
        return []
    sign = -1.0 if jaw == "upper" else 1.0  # rows of pixels grow downwards
    points = [_resampled(o.polygon, max(SAMPLING * band, 0.25)) for o in outlines]
    locals_ = [_Local(p[:, 0], sign * p[:, 1]) for p in points]
    partings: list[tuple[Array | None, Array | None]] = []
    for before, after in pairwise(locals_):
        width = min(np.ptp(before.along), np.ptp(after.along))
        apart = float(after.along.min() - before.along.max())
        joined = apart <= GAP * width
        partings.append(
            (_papilla(before, after, band), _embrasure(before, after, band))
            if joined else (None, None)
        )  # fmt: skip

    def placed(point: Array | tuple[float, float]) -> Array:
        return np.array([point[0], sign * point[1]])

    crowns = []
    for k, (outline, local) in enumerate(zip(outlines, locals_, strict=True)):
        left = partings[k - 1] if k > 0 else (None, None)
        right = partings[k] if k < len(partings) else (None, None)
        beside = [None if p is None else placed(p) for p in (*left, *right)]
        crowns.append(
            Crown(
                jaw=jaw,
                zenith=placed(_extreme(local, ZENITH_FLATNESS * band, True)),
                tip=placed(_extreme(local, TIP_FLATNESS * band, False)),
                papilla_left=beside[0], embrasure_left=beside[1],
                papilla_right=beside[2], embrasure_right=beside[3],
                width=float(np.ptp(local.along)),
                height=max(float(np.ptp(local.gum)), 1.0),
                cut_left=k == 0, cut_right=k == len(outlines) - 1,
                score=outline.score, numbers=outline.numbers,
                number=outline.number, doubt=outline.doubt,
            )
        )  # fmt: skip
    return crowns


def _turned_crown(crown: Crown, outline: Outline, turn: float, size: tuple[int, int]) -> Crown:
    """A crown of the upright frame in the photograph as it is."""

    def back(point: Array | None) -> Array | None:
        return None if point is None else _turned(point[None], turn)[0]

    zenith, tip = back(crown.zenith), back(crown.tip)
    assert zenith is not None and tip is not None
    low, high = outline.polygon.min(axis=0), outline.polygon.max(axis=0)
    margin = BORDER * max(size)
    cut = bool((low < margin).any() or (high > np.array(size) - margin).any())
    return replace(
        crown,
        zenith=zenith,
        tip=tip,
        papilla_left=back(crown.papilla_left),
        papilla_right=back(crown.papilla_right),
        embrasure_left=back(crown.embrasure_left),
        embrasure_right=back(crown.embrasure_right),
        outline=outline.polygon,
        doubtful=cut or outline.score < SURE_SCORE,
    )
