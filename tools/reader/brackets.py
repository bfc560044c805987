"""Braces drawn onto real crowns: of the labelled photographs, none shows any."""

from __future__ import annotations

import colorsys
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt
from network import VIEWS
from samples import UNNUMBERED, Sample

Array = npt.NDArray[np.float64]
#: Fewer crowns than these are no row.
LEAST_ROW = 3
#: Drawn so much larger than the picture, then made smaller: edges as a lens shows them.
FINER = 2
#: Pixels of a crown that are more than enough for its spread.
SPREAD_PIXELS = 400


@dataclass(frozen=True)
class _Place:
    """Where a bracket sits: middle [2], half its width and height as vectors [2], pixels."""

    middle: Array
    along: Array
    downward: Array

    def corners(self, x: float, y: float, w: float, h: float) -> npt.NDArray[np.int32]:
        """A box around (x, y) with half sizes (w, h), all in halves of the bracket."""
        signs = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)])
        points = np.array([x, y]) + signs * [w, h]
        return np.int32(np.round(self.middle + points @ np.stack([self.along, self.downward])))


@dataclass(frozen=True)
class _Kind:
    """How the brackets of a mouth look: colours 0..255, `shown` of what is drawn."""

    base: Array
    wings: Array
    slot: Array
    ligature: Array | None
    wire: Array
    thickness: int
    shown: float


def _kind(enamel: Array, size: float, rng: np.random.Generator) -> _Kind:
    shade = rng.uniform(30, 200)
    steel = np.clip(shade + np.array([0, 0, 6]) + rng.normal(0, 5, 3), 0, 255)
    sort = rng.random()
    if sort < 0.2:  # ceramic
        base = np.clip(enamel * rng.uniform(0.85, 1.15) + rng.normal(0, 6, 3), 0, 255)
    elif sort < 0.25:
        base = np.array([190, 155, 90]) * rng.uniform(0.6, 1.2)
    else:
        base = steel
    ligature = None
    if rng.random() < 0.5:
        hue = colorsys.hsv_to_rgb(rng.random(), rng.uniform(0, 1), rng.uniform(0.15, 1.0))
        ligature = 255 * np.array(hue)
    return _Kind(
        base=base,
        wings=np.clip(base * rng.uniform(1.0, 1.5) + rng.uniform(0, 40), 0, 255),
        slot=base * rng.uniform(0.2, 0.7),
        ligature=ligature,
        wire=steel if rng.random() < 0.9 else enamel,
        thickness=max(1, round(FINER * size * rng.uniform(0.03, 0.09))),
        shown=float(rng.uniform(0.8, 1.0)),
    )


def _rows(sample: Sample) -> list[list[tuple[int, Array, Array]]]:
    """Crowns (number in the picture, middle [2], pixels [N, 2]) of each jaw from left to right."""
    crowns = []
    for number in np.unique(sample.crowns)[1:]:
        y, x = np.nonzero(sample.crowns == number)
        step = max(1, len(x) // SPREAD_PIXELS)
        pixels = np.stack([x, y], -1).astype(float)[::step]
        tooth = int(sample.teeth[y[0], x[0]])
        crowns.append((int(number), pixels.mean(0), pixels, tooth))
    middle = float(np.median([c[1][1] for c in crowns])) if crowns else 0.0
    rows: list[list[tuple[int, Array, Array]]] = [[], []]
    for number, centre, pixels, tooth in crowns:
        known = tooth not in (0, UNNUMBERED)
        lower = tooth // 10 in (3, 4, 7, 8) if known else centre[1] > middle
        rows[int(lower)].append((number, centre, pixels))
    return [sorted(row, key=lambda c: c[1][0]) for row in rows]


def _places(row: list, transform: Array, size: float, rng: np.random.Generator) -> list[_Place]:
    """A bracket for most crowns of a row; `size`: of the crowns' widths and heights."""
    turn, move = FINER * transform[:, :2], FINER * transform[:, 2]
    centres = np.array([c[1] for c in row]) @ turn.T + move
    places = []
    for k, (_, _, pixels) in enumerate(row):
        ahead = centres[min(k + 1, len(row) - 1)] - centres[max(k - 1, 0)]
        along = ahead / max(float(np.linalg.norm(ahead)), 1e-6)
        lean = np.radians(rng.normal(0, 6))
        along = np.array([np.cos(lean), np.sin(lean)]) @ np.array([along, [-along[1], along[0]]])
        downward = np.array([-along[1], along[0]])
        at = (pixels - pixels.mean(0)) @ turn.T
        # A box's side is 3.5 times its deviation.
        wide, tall = (1.73 * float(np.std(at @ axis)) for axis in (along, downward))
        middle = (
            centres[k] + downward * tall * rng.normal(0, 0.12) + along * wide * rng.normal(0, 0.1)
        )
        wide *= size * rng.uniform(0.9, 1.1)
        tall = min(tall * size * rng.uniform(0.85, 1.1), 1.6 * wide + 2)
        places.append(_Place(middle, wide * along, tall * downward))
    return [place for place in places if rng.random() > 0.06]


def _draw(canvas: npt.NDArray[np.uint8], place: _Place, kind: _Kind, tube: bool) -> None:
    """One bracket, or the tube of a molar, on a canvas [H, W, 4] whose last channel says where."""

    def fill(box: tuple[float, float, float, float], colour: Array) -> None:
        cv2.fillConvexPoly(canvas, place.corners(*box), (*map(int, colour), 255), cv2.LINE_AA)

    fill((0.08, 0.12, 1.05, 1.05), kind.slot * 0.6)  # its shadow
    fill((0, 0, 1.0, 0.6 if tube else 1.0), kind.base)
    if tube:
        fill((0, -0.25, 0.8, 0.15), kind.wings)
        return
    for x in (-0.6, 0.6):
        for y in (-0.6, 0.6):
            fill((x, y, 0.35, 0.35), kind.wings)
    fill((0, 0, 1.0, 0.16), kind.slot)
    if kind.ligature is not None:
        ring = place.corners(0, 0, 0.75, 0.75)
        colour = (*map(int, kind.ligature), 255)
        cv2.polylines(canvas, [ring], True, colour, kind.thickness + 1, cv2.LINE_AA)


def draw_braces(
    image: npt.NDArray[np.uint8], sample: Sample, transform: npt.NDArray[np.float64],
    rng: np.random.Generator,
) -> None:  # fmt: skip
    """Brackets on the crowns and a wire between them, in place; what they hide stays tooth.

    Args:
        image: [H, W, 3] uint8 RGB.
        sample: whose picture this is.
        transform: [2, 3] from its pixels to the image's.
        rng: what they look like.
    """
    if sample.view in (VIEWS.index("upper"), VIEWS.index("lower")):
        return
    rows = [row for row in _rows(sample) if len(row) >= LEAST_ROW]
    if sum(map(len, rows)) < 2 * LEAST_ROW:
        return
    enamel = np.median(sample.image[sample.crowns > 0], axis=0)
    scale = float(np.sqrt(abs(np.linalg.det(transform[:, :2]))))
    area = [(sample.crowns == number).sum() for row in rows for number, *_ in row]
    kind = _kind(enamel.astype(float), scale * float(np.sqrt(np.median(area))), rng)
    size = rng.uniform(0.32, 0.6)
    canvas = np.zeros((FINER * image.shape[0], FINER * image.shape[1], 4), np.uint8)
    for row in rows:
        if rng.random() < 0.2:
            continue
        places = _places(row, transform, size, rng)
        if len(places) < 2:
            continue
        tubes = rng.random() < 0.5
        for k, place in enumerate(places):
            _draw(canvas, place, kind, tubes and k in (0, len(places) - 1))
        path = np.int32([place.middle for place in places])
        if kind.ligature is not None and rng.random() < 0.2:  # a chain
            colour = (*map(int, kind.ligature), 255)
            cv2.polylines(canvas, [path], False, colour, 3 * kind.thickness, cv2.LINE_AA)
        wire, shine = (*map(int, kind.wire), 255), (*map(int, (kind.wire + 510) / 3), 255)
        cv2.polylines(canvas, [path], False, wire, kind.thickness, cv2.LINE_AA)
        if kind.thickness > 1:
            cv2.polylines(canvas, [path - [0, 1]], False, shine, 1, cv2.LINE_AA)
    canvas = cv2.resize(canvas, image.shape[1::-1], interpolation=cv2.INTER_AREA)
    # Anti-aliased drawing mixes the colour with the empty canvas's black: undone by its own share.
    share = canvas[..., 3:].astype(np.float32) / 255
    colour = canvas[..., :3] / np.maximum(share, 1e-3)
    mixed = image * (1 - kind.shown * share) + np.minimum(colour, 255) * kind.shown * share
    image[...] = mixed.astype(np.uint8)
