"""From the crowns of a photograph and their labels to landmarks seen.

A label here is a position along the row, 0 (patient's right second molar) to 13, or `NO_TOOTH`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from itertools import accumulate, pairwise

import numpy as np
import numpy.typing as npt

from pipeline.artifacts.dental.fdi import JAWS, Jaw
from pipeline.artifacts.teeth import Dentition, Point
from stages.dentition.crowns import TIP_FLATNESS, ZENITH_FLATNESS, outermost
from stages.dentition.parts import perhaps_one
from stages.dentition.tooth_rows import (
    NO_TOOTH,
    POSITIONS,
    SAID_OTHERWISE,
    Labels,
    crown_evidence,
)
from stages.init.dental.cameras.bundle import Sightings
from stages.init.dental.template import (
    EMBRASURE,
    PAPILLA,
    TIP,
    ZENITH,
    facing_yaws,
    is_lower_landmark,
    landmark_index,
    landmark_names,
)

Array = npt.NDArray[np.float64]

#: Place of a primary tooth -> shares in which it is taken for a tooth of that place, the next, and
#: the next but one.
TAKEN_FOR = {4: (0.45, 0.35, 0.20), 5: (0.30, 0.45, 0.25)}
#: How well landmarks are found, as shares of the band of teeth (about 15 mm), across x along the
#: row; a zenith or tip is in addition uncertain along the row by a share of its crown's width.
ZENITH_DEVIATION, ZENITH_OF_WIDTH = (0.018, 0.018), 0.10
TIP_DEVIATION, TIP_OF_WIDTH = (0.018, 0.024), 0.12
PAPILLA_DEVIATION = (0.024, 0.029)
EMBRASURE_DEVIATION = (0.035, 0.041)
#: Where neighbours meet and part wanders with the side that one looks from: the nearer crown bulges
#: before the place. Seen face to face a papilla lies so far towards the biting edge (share of the
#: band), along the row as far from it, and the other way round where crowns part; in between by the
#: cosine of twice the angle. Twelve patients: .036, .065, .012 and .037 (papillae above in front,
#: at the sides, below in front, at the sides), -.050 and -.050 (partings); leaving one out changes
#: none by more than .01. 72 generated mouths: .039 to .055, -.064 and -.047. (Measured with a
#: `crowns.MEETING` of .03.)
PAPILLA_WANDERS, EMBRASURE_WANDERS = 0.04, -0.05
#: A papilla beside a doubtful crown is this much less certain; likewise one beside a gap.
DOUBTFUL_FACTOR = 3.0
GAP_FACTOR = 2.0


@dataclass(frozen=True)
class Whole:
    """Two neighbours of a row taken as one crown, in the units of `SeenRow`.

    Attributes:
        zenith, tip: [2]; nan where not to be relied on.
        width: pixels.
    """

    zenith: Array
    tip: Array
    width: float


@dataclass(frozen=True)
class SeenRow:
    """One row of crowns: landmarks in pixels about the principal point, the roll taken out.

    Attributes:
        jaw: upper or lower.
        middles: [n, 2] between zenith and tip.
        widths: [n] pixels.
        lefts, rights: [n] where each crown begins and ends along the row.
        band: height of the band of teeth, pixels.
        zeniths, tips: [n, 2]; nan where not to be relied on.
        papillae_left, papillae_right, embrasures_left, embrasures_right: [n, 2]; nan where none.
        doubtful: [n] bool.
        looks: [n, 14] log probability of each position by the crowns' looks.
        scores: [n] 0..1, how sure it is that each is a crown.
        wholes: of neighbours that may be parts of one crown, by the place of the first: that crown.
    """

    jaw: Jaw
    middles: Array
    widths: Array
    lefts: Array
    rights: Array
    band: float
    zeniths: Array
    tips: Array
    papillae_left: Array
    papillae_right: Array
    embrasures_left: Array
    embrasures_right: Array
    doubtful: npt.NDArray[np.bool_]
    looks: Array
    scores: Array
    wholes: Mapping[int, Whole] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.widths)

    @property
    def said_wholes(self) -> set[int]:
        """Those of `wholes` of which a person has given both parts a number."""
        said = self.looks.min(axis=1, initial=0.0) <= SAID_OTHERWISE
        return {first for first in self.wholes if said[first] and said[first + 1]}

    @cached_property
    def landmark_count(self) -> int:
        """How many landmarks the row offers to a labelling without gaps."""
        return len(row_landmarks(self, tuple(range(len(self))), bounded=False)[0])

    def count_with_parts(self, labels: Labels) -> int:
        """The same where neighbours with equal labels are parts of one crown."""
        parts = [a == b != NO_TOOTH for a, b in pairwise(labels)]
        if not any(parts):
            return self.landmark_count
        whole = tuple(accumulate((not part for part in parts), initial=0))
        return len(row_landmarks(self, whole, bounded=False)[0])


def upright(points: Array, roll: float, width: int, height: int) -> Array:
    """[N, 2] pixels of the image to pixels about its centre with the roll taken out."""
    centred = points - np.array([width / 2, height / 2])
    c, s = np.cos(roll), np.sin(roll)
    return np.asarray(centred @ np.array([[c, -s], [s, c]]))


def seen_rows(dentition: Dentition) -> tuple[SeenRow, SeenRow]:
    """The upper and the lower row of a photograph."""
    height, width = dentition.mask.shape
    rows = []
    for jaw in JAWS:
        crowns = dentition.crowns(jaw)

        def collect(points: list[Point | None]) -> Array:
            array = np.array(
                [(np.nan, np.nan) if p is None else p for p in points], np.float64
            ).reshape(-1, 2)
            return upright(array, dentition.roll, width, height)

        doubtful = np.array([crown.doubtful for crown in crowns], bool)
        ends = np.array([crown.cut_left or crown.cut_right for crown in crowns], bool)
        zeniths = collect([crown.zenith for crown in crowns])
        tips = collect([crown.tip for crown in crowns])
        middles = (zeniths + tips) / 2
        weak = doubtful | ends
        zeniths[weak] = np.nan
        tips[weak] = np.nan
        if jaw == "lower":
            # The upper crowns overlap the lower ones' edges.
            tips[:] = np.nan
        hidden = np.full((len(crowns), 2), np.nan)
        # A crown without an outline is as wide as it is said to be.
        along = [
            upright(crown.outline, dentition.roll, width, height)[:, 0]
            if len(crown.outline)
            else middle + np.array([-0.5, 0.5]) * crown.width
            for crown, middle in zip(crowns, middles[:, 0], strict=True)
        ]
        upper = jaw == "upper"
        rows.append(
            SeenRow(
                jaw=jaw,
                middles=middles,
                widths=np.array([crown.width for crown in crowns], np.float64),
                lefts=np.array([x.min() for x in along]),
                rights=np.array([x.max() for x in along]),
                band=float(dentition.band_height),
                zeniths=zeniths,
                tips=tips,
                papillae_left=collect([crown.papilla_left for crown in crowns]),
                papillae_right=collect([crown.papilla_right for crown in crowns]),
                embrasures_left=collect([c.embrasure_left for c in crowns]) if upper else hidden,
                embrasures_right=collect([c.embrasure_right for c in crowns]) if upper else hidden,
                doubtful=doubtful,
                looks=np.array([crown_evidence(crown, jaw) for crown in crowns]).reshape(
                    -1, POSITIONS
                ),
                scores=np.array([crown.score for crown in crowns], np.float64),
                wholes={
                    k: _whole(
                        [upright(c.outline, dentition.roll, width, height) for c in pair],
                        jaw,
                        float(dentition.band_height),
                        bool(weak[k] or weak[k + 1]),
                    )
                    for k, pair in enumerate(pairwise(crowns))
                    if perhaps_one(*pair)
                },
            )
        )
    return rows[0], rows[1]


def _whole(parts: list[Array], jaw: Jaw, band: float, weak: bool) -> Whole:
    """One crown of two outlines [K, 2]."""
    points = np.concatenate(parts)
    gumwards = -1.0 if jaw == "upper" else 1.0  # rows of pixels grow downwards
    marks = []
    for sign, flatness, seen in (
        (gumwards, ZENITH_FLATNESS, not weak),
        (-gumwards, TIP_FLATNESS, not weak and jaw == "upper"),
    ):
        x, height = outermost(points[:, 0], sign * points[:, 1], flatness * band)
        marks.append(np.array([x, sign * height]) if seen else np.full(2, np.nan))
    return Whole(marks[0], marks[1], float(np.ptp(points[:, 0])))


def as_a_childs(row: SeenRow) -> SeenRow:
    """The row with its crowns' looks taken for those of primary teeth.

    Primary molars look like the molars behind them, and the reader has seen few children.
    """
    confused = np.eye(POSITIONS)
    for place, shares in TAKEN_FOR.items():
        for middle, step in ((POSITIONS // 2 - 1, -1), (POSITIONS // 2, 1)):
            truth = middle + step * (place - 1)
            confused[truth] = 0
            for further, share in enumerate(shares):
                confused[truth, truth + step * further] = share
    looks = np.log(np.exp(row.looks) @ confused.T)
    said = row.looks.min(axis=1, initial=0.0) <= SAID_OTHERWISE
    return replace(row, looks=np.where(said[:, None], row.looks, looks))


def row_landmarks(
    row: SeenRow, labels: Labels, bounded: bool = True
) -> tuple[list[int], list[tuple[float, float, float, float]]]:
    """Landmark indices and (x, y, deviation x, deviation y) that a row shows under its labels.

    Args:
        row: the row of crowns.
        labels: position of each crown, or `NO_TOOTH`; parts of one crown have the same.
        bounded: False counts positions beyond the row's end too (to know how many there could be).
    """
    indices: list[int] = []
    values: list[tuple[float, float, float, float]] = []
    last = POSITIONS if bounded else 10 * POSITIONS

    def add(
        kind: int,
        position: int,
        point: Array,
        size: tuple[float, float],
        along: float,
        factor: float,
    ) -> None:
        if np.isnan(point[0]):
            return
        indices.append(landmark_index(row.jaw, kind, position))
        values.append(
            (
                float(point[0]),
                float(point[1]),
                factor * (size[0] * row.band + along),
                factor * size[1] * row.band,
            )
        )

    count = len(row)
    for i, label in enumerate(labels):
        if label == NO_TOOTH or not 0 <= label < last:
            continue
        following = labels[i + 1] if i + 1 < count else NO_TOOTH
        preceding = labels[i - 1] if i > 0 else NO_TOOTH
        zenith, tip, width = row.zeniths[i], row.tips[i], float(row.widths[i])
        if preceding == label:
            whole = row.wholes[i - 1]
            zenith, tip, width = whole.zenith, whole.tip, whole.width
        if following != label:
            add(ZENITH, label, zenith, ZENITH_DEVIATION, ZENITH_OF_WIDTH * width, 1.0)
            add(TIP, label, tip, TIP_DEVIATION, TIP_OF_WIDTH * width, 1.0)
        if label + 1 < last and following != label:
            factor = _factor(row, i, i + 1, following in (label + 1, NO_TOOTH))
            add(PAPILLA, label, row.papillae_right[i], PAPILLA_DEVIATION, 0.0, factor)
            add(EMBRASURE, label, row.embrasures_right[i], EMBRASURE_DEVIATION, 0.0, factor)
        if label >= 1 and preceding not in (label - 1, label) and i > 0:
            # Its left papilla is not the right one of the crown before: a gap, or that is none.
            factor = _factor(row, i, i - 1, preceding == NO_TOOTH)
            add(PAPILLA, label - 1, row.papillae_left[i], PAPILLA_DEVIATION, 0.0, factor)
            add(EMBRASURE, label - 1, row.embrasures_left[i], EMBRASURE_DEVIATION, 0.0, factor)
    return indices, values


@lru_cache(maxsize=64)
def _wandering(yaw: float) -> Array:
    """[L] by how much of the band landmarks appear too low, seen from a yaw (degrees)."""
    height = {"papilla": PAPILLA_WANDERS, "embrasure": EMBRASURE_WANDERS}
    names = landmark_names()
    wanders = np.array([height.get(name.kind, 0.0) for name in names])
    towards_edge = np.where(is_lower_landmark(), -1.0, 1.0)
    return np.asarray(wanders * towards_edge * np.cos(2 * np.radians(yaw - facing_yaws())))


def _factor(row: SeenRow, own: int, neighbour: int, adjoining: bool) -> float:
    """How much less certain a papilla is that two crowns share."""
    doubtful = row.doubtful[own] or (0 <= neighbour < len(row) and row.doubtful[neighbour])
    return (DOUBTFUL_FACTOR if doubtful else 1.0) * (1.0 if adjoining else GAP_FACTOR)


class SightingCache:
    """Sightings of labelled rows; the same rows come back many times in a search."""

    def __init__(self, rows: list[tuple[SeenRow, SeenRow]]) -> None:
        self.rows = rows
        self._known: dict[tuple[int, int, Labels], tuple[npt.NDArray[np.int64], Array]] = {}

    def of_row(self, view: int, jaw: int, labels: Labels) -> tuple[npt.NDArray[np.int64], Array]:
        """Landmarks [K] and x, y, deviations [K, 4] of one row."""
        key = (view, jaw, labels)
        if key not in self._known:
            indices, values = row_landmarks(self.rows[view][jaw], labels)
            self._known[key] = (
                np.array(indices, np.int64),
                np.array(values, np.float64).reshape(-1, 4),
            )
        return self._known[key]

    def unused(self, view: int, jaw: int, labels: Labels) -> int:
        """How many landmarks of a row its labels leave without a name."""
        row, named = self.rows[view][jaw], len(self.of_row(view, jaw, labels)[0])
        offered = row.count_with_parts(labels)
        # A gap names the papilla before it twice, which makes good for none between parts.
        return row.landmark_count - offered + max(offered - named, 0)

    def collect(
        self, views: Sequence[int], labels: Sequence[tuple[Labels, Labels]],
        yaws: Sequence[float] | None,
    ) -> Sightings:  # fmt: skip
        """Sightings of some views under their labels; views are numbered as in `views`.

        Args:
            views: which.
            labels: of their rows.
            yaws: degrees from which they look, roughly; None: landmarks stay where they were seen.
        """
        parts = [
            (number, *self.of_row(view, jaw, labels[number][jaw]))
            for number, view in enumerate(views)
            for jaw in (0, 1)
        ]
        values = np.concatenate([part[2] for part in parts])
        landmark = np.concatenate([part[1] for part in parts])
        pixels = np.ascontiguousarray(values[:, :2])
        counts = [len(part[1]) for part in parts]
        if yaws is not None:
            bands = [self.rows[view][jaw].band for view in views for jaw in (0, 1)]
            wandering = [_wandering(float(yaws[number]))[marks] for number, marks, _ in parts]
            pixels[:, 1] -= np.repeat(bands, counts) * np.concatenate(wandering)
        return Sightings(
            view=np.repeat([part[0] for part in parts], counts),
            landmark=landmark,
            pixels=pixels,
            deviations=np.ascontiguousarray(values[:, 2:]),
        )
