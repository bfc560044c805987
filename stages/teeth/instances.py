"""From the network's maps to single crowns: where one ends and the next begins."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt
from scipy import ndimage

from stages.teeth.network import Answer

Array = npt.NDArray[np.float64]
Labels = npt.NDArray[np.int32]
Map = npt.NDArray[np.float32]

_NEIGHBOURS = [(i, j) for i in (-1, 0, 1) for j in (-1, 0, 1) if i or j]
#: The maps are brought to this many times their size first.
_FINER = 2
#: Standard deviation of the blur before peaks are sought, pixels of the finer maps.
SMOOTHING = 1.2
#: A crown's middle is a peak of the distance to its border of at least this height...
LEAST_PEAK = 0.35
#: ... and two peaks are of one crown if the ridge between them is this share of the lower peak.
MERGING_RIDGE = 0.82
#: A border between two crowns is a valley of this depth (share of the height).
BORDER_DEPTH = 0.8
#: Crowns smaller than this share of the median one (area) are none.
LEAST_AREA = 0.06
#: Two parts that touch are one crown if with this probability both are the same tooth, and the
#: middles that they point to lie no further apart than this share of the root of their area. Of 698
#: outlined photographs that joins 65 pairs of parts of one crown and two of two crowns; of 24
#: generated mouths with braces 55 and 7.
ONE_TOOTH, ONE_MIDDLE = 0.5, 0.4
#: Wherever they point, if they are surely the same molar. Of the outlined photographs it joins four
#: pairs, each parts of one crown; .6 would join 15, four of them not.
ONE_MOLAR = 0.75
#: Place of the first molar in a quadrant, from 0.
_FIRST_MOLAR = 5
#: A crown's score is its mean probability of being tooth, less where its middle is lower than this.
SURE_PEAK = 0.8
#: Crowns scoring less are none. On photographs kept back from learning F1 grows from .86 at .45 to
#: .91 at .75, but what is lost on the way are faint teeth at the ends of rows and in deep bites;
#: many of those that count as wrong are such teeth, which have no outline there.
LEAST_SCORE = 0.55
#: Pixels of the finer maps, too.
LEAST_PIXELS = 40
#: Finer grid on which an outline is drawn.
_OUTLINE_SCALE = 3
#: Outlines are thinned to this many pixels of the finer maps.
_OUTLINE_TOLERANCE = 0.2


@dataclass(frozen=True)
class Found:
    """A crown in a photograph, before anything is made of it.

    Attributes:
        polygon: [K, 2] pixels of the photograph.
        score: 0..1.
        area: pixels of the photograph.
        lower, left, primary: logits.
        position: [8] log probabilities of the place in the quadrant.
    """

    polygon: Array
    score: float
    area: float
    lower: float
    left: float
    primary: float
    position: Array


def find_crowns(answer: Answer) -> list[Found]:
    """The crowns in a photograph, largest first."""
    size = (answer.tooth.shape[1] * _FINER, answer.tooth.shape[0] * _FINER)
    tooth = cv2.resize(answer.tooth, size, interpolation=cv2.INTER_LINEAR)
    parted = answer.inside * (1 - BORDER_DEPTH * answer.border)
    inside = np.asarray(cv2.resize(parted, size, interpolation=cv2.INTER_LINEAR), np.float32)
    mask = tooth > 0
    labels = _watershed(inside, mask)
    if not labels.any():
        return []
    share = 1 / (1 + np.exp(-tooth.astype(np.float64)))
    areas, scores = _sizes_and_scores(labels, share, inside)
    labels = _rejoined(labels, _are_crowns(areas, scores), answer)
    areas, scores = _sizes_and_scores(labels, share, inside)
    boxes = ndimage.find_objects(labels)
    linear = answer.answer_from_image
    scale2 = abs(float(np.linalg.det(linear[:, :2]))) * _FINER**2
    small = labels[_FINER // 2 :: _FINER, _FINER // 2 :: _FINER]
    crowns = []
    for number in np.flatnonzero(_are_crowns(areas, scores)) + 1:
        box = boxes[number - 1]
        polygon = _outline(labels[box] == number, share[box])
        within = tuple(slice(side.start // _FINER, side.stop // _FINER + 1) for side in box)
        own = small[within] == number
        if polygon is None or not own.any():
            continue
        corner = [box[1].start, box[0].start]
        weight = answer.inside[within] * own
        weight = weight / max(float(weight.sum()), 1e-9)
        crowns.append(
            Found(
                polygon=_to_image((polygon + corner) / _FINER, linear),
                score=float(scores[number - 1]),
                area=float(areas[number - 1]) / scale2,
                lower=float((answer.lower[within] * weight).sum()),
                left=float((answer.left[within] * weight).sum()),
                primary=float((answer.primary[within] * weight).sum()),
                position=np.asarray(
                    (answer.position[:, *within] * weight).sum(axis=(1, 2)), np.float64
                ),
            )
        )
    return sorted(crowns, key=lambda crown: -crown.area)


def _sizes_and_scores(labels: Labels, share: Array, inside: Map) -> tuple[Array, Array]:
    """[n] area in pixels, and [n] score 0..1, of regions 1..n."""
    numbers = np.arange(1, int(labels.max()) + 1)
    areas = ndimage.sum_labels(np.ones(labels.shape), labels, numbers)
    peaks = np.asarray(ndimage.maximum(inside, labels, numbers), np.float64)
    scores = ndimage.mean(share, labels, numbers) * np.minimum(1.0, peaks / SURE_PEAK)
    return np.asarray(areas), np.asarray(scores)


def _are_crowns(areas: Array, scores: Array) -> npt.NDArray[np.bool_]:
    """[n] which regions are large and sure enough to be crowns, by their areas and scores [n]."""
    least = max(LEAST_PIXELS, LEAST_AREA * float(np.median(areas)))
    return np.asarray((areas >= least) & (scores >= LEAST_SCORE))


def _watershed(inside: Map, mask: npt.NDArray[np.bool_]) -> Labels:
    """[H, W] number of the crown that each pixel of the mask belongs to, 0: none.

    From every pixel the steepest way up ends on a peak: a region for each peak. Regions between
    which there is no valley become one.
    """
    smooth = np.asarray(cv2.GaussianBlur(inside, (0, 0), SMOOTHING), np.float32)
    # Where the map is flat the way leads away from the border.
    depth = cv2.distanceTransform(mask.astype(np.uint8), cv2.DIST_L2, 5)
    height = np.where(mask, smooth + np.float32(1e-4) * depth, -1).astype(np.float32)
    rows, columns = mask.shape
    padded = np.pad(height, 1, constant_values=-1)
    steepest = np.arange(mask.size).reshape(mask.shape)
    highest = height.copy()
    for i, j in _NEIGHBOURS:
        neighbour = padded[1 + i : 1 + i + rows, 1 + j : 1 + j + columns]
        up = mask & (neighbour > highest)
        highest[up] = neighbour[up]
        steepest[up] = np.flatnonzero(up) + (i * columns + j)
    parent = steepest.ravel()
    while True:
        further = parent[parent]
        if np.array_equal(further, parent):
            break
        parent = further
    peaks = (parent == np.arange(mask.size)) & mask.ravel()
    regions = np.where(mask.ravel(), np.cumsum(peaks)[parent], 0)
    labels = regions.reshape(mask.shape).astype(np.int32)
    owner = _merged(labels, smooth, int(labels.max()))
    return _largest_pieces(np.asarray(owner[labels], np.int32))


def _ridges(labels: Labels, smooth: Map) -> tuple[Labels, Array]:
    """Numbers [P, 2] of regions that touch, and the height [P] of the ridge between them."""
    pairs, heights = [], []
    for a, b, low in (
        (labels[:-1], labels[1:], np.minimum(smooth[:-1], smooth[1:])),
        (labels[:, :-1], labels[:, 1:], np.minimum(smooth[:, :-1], smooth[:, 1:])),
    ):
        touch = (a != b) & (a > 0) & (b > 0)
        pairs.append(np.stack([np.minimum(a[touch], b[touch]), np.maximum(a[touch], b[touch])], 1))
        heights.append(low[touch])
    unique, which = np.unique(np.concatenate(pairs), axis=0, return_inverse=True)
    highest = np.zeros(len(unique))
    np.maximum.at(highest, which.ravel(), np.concatenate(heights))
    return unique, highest


def _merged(labels: Labels, smooth: Map, count: int) -> Labels:
    """[count + 1] number of each region once those without a valley between them are one."""
    peak = np.zeros(count + 1)
    peak[1:] = ndimage.maximum(smooth, labels, np.arange(1, count + 1))
    touching, highest = _ridges(labels, smooth)
    owner = np.arange(count + 1, dtype=np.int32)
    for k in np.argsort(-highest, kind="stable"):
        i, j = (int(number) for number in owner[touching[k]])
        if i == j:
            continue
        lower = min(peak[i], peak[j])
        if lower < LEAST_PEAK or highest[k] > MERGING_RIDGE * lower:
            keep, drop = (i, j) if peak[i] >= peak[j] else (j, i)
            owner[owner == drop] = keep
    owner[peak[owner] < LEAST_PEAK] = 0
    return owner


def _rejoined(labels: Labels, crowns: npt.NDArray[np.bool_], answer: Answer) -> Labels:
    """[H, W] labels once parts that touch and are surely of one tooth are one.

    A groove between the cusps of a molar can look like the border between two teeth, and a bracket
    or a wire parts a narrow crown. What lies on either side still points to one middle.

    Args:
        labels: [H, W] regions 1..n, 0: none.
        crowns: [n] which of them are crowns by themselves; others join none.
        answer: what the network says, at 1 / `_FINER` of that size.
    """
    numbers = np.arange(1, int(labels.max()) + 1)
    small = labels[_FINER // 2 :: _FINER, _FINER // 2 :: _FINER]
    weight = np.maximum(ndimage.sum_labels(answer.inside, small, numbers), 1e-9)

    def mean(values: Map) -> Array:
        return np.asarray(ndimage.sum_labels(values * answer.inside, small, numbers) / weight)

    place = np.exp(np.stack([mean(values) for values in answer.position]))
    place /= place.sum(0)
    sides = [1 / (1 + np.exp(-np.clip(mean(k), -30, 30))) for k in (answer.left, answer.lower)]
    y, x = np.mgrid[: small.shape[0], : small.shape[1]].astype(np.float32)
    middle = np.stack([mean(x + answer.centre[0]), mean(y + answer.centre[1])], 1)
    area = ndimage.sum_labels(np.ones(small.shape), small, numbers)
    owner = np.arange(len(numbers) + 1)
    for i, j in _ridges(labels, np.zeros(labels.shape, np.float32))[0] - 1:
        if not (crowns[i] and crowns[j]):
            continue
        same = place[:, i] @ place[:, j]
        for side in sides:
            same *= side[i] * side[j] + (1 - side[i]) * (1 - side[j])
        apart = np.linalg.norm(middle[i] - middle[j]) / np.sqrt(area[i] + area[j])
        molars = min(place[:, i].argmax(), place[:, j].argmax()) >= _FIRST_MOLAR
        if same >= (ONE_TOOTH if apart <= ONE_MIDDLE else ONE_MOLAR if molars else np.inf):
            owner[owner == owner[j + 1]] = owner[i + 1]
    _, renumbered = np.unique(owner, return_inverse=True)
    return np.asarray(renumbered.astype(np.int32)[labels])


def _largest_pieces(labels: Labels) -> Labels:
    """Numbers 1..n; of each region its largest connected piece."""
    result = np.zeros_like(labels)
    number = 0
    for value, box in enumerate(ndimage.find_objects(labels), 1):
        if box is None:
            continue
        number += 1
        pieces, _ = ndimage.label(labels[box] == value)
        sizes = np.bincount(pieces.ravel())[1:]
        result[box][pieces == 1 + int(np.argmax(sizes))] = number
    return result


def _outline(mine: npt.NDArray[np.bool_], share: Array) -> Array | None:
    """[K, 2] polygon around one crown, in pixels of its box with a margin taken off again."""
    pad = 2
    soft = np.pad(np.where(mine, np.maximum(share, 0.5), 0.0), pad).astype(np.float32)
    soft = np.asarray(cv2.GaussianBlur(soft, (0, 0), 0.8), np.float32)
    size = (soft.shape[1] * _OUTLINE_SCALE, soft.shape[0] * _OUTLINE_SCALE)
    fine = cv2.resize(soft, size, interpolation=cv2.INTER_CUBIC)
    contours, _ = cv2.findContours(
        (fine > 0.45).astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE
    )
    if not contours:
        return None
    contour = max(contours, key=cv2.contourArea)
    contour = cv2.approxPolyDP(contour, _OUTLINE_TOLERANCE * _OUTLINE_SCALE, True)[:, 0]
    if len(contour) < 3:
        return None
    # Contours run through the middles of the outermost pixels: half a pixel too far inside.
    points = (contour + 0.5) / _OUTLINE_SCALE - pad
    middle = points.mean(axis=0)
    away = points - middle
    length = np.maximum(np.linalg.norm(away, axis=1, keepdims=True), 1e-6)
    return np.asarray(points + away / length * 0.5 / _OUTLINE_SCALE, np.float64)


def _to_image(points: Array, answer_from_image: npt.NDArray[np.float64]) -> Array:
    """[N, 2] points of the maps (pixel centres at .5) in pixels of the photograph."""
    inverse = np.linalg.inv(answer_from_image[:, :2])
    return np.asarray((points - answer_from_image[:, 2]) @ inverse.T)
