"""Which of several motions of a tooth makes its photographs agree best.

Optical flow finds the nearest motion that explains a picture, and on a smooth crown a wrong one may
do. So the motion of a tooth is improved on the contrast of its pictures itself, and where that fits
badly it is tried from several turns and shifts; the correlation over all pairs of photographs
chooses.

What contrast over several pixels takes along is shading, which stays with the light when a tooth
turns; see `marks` for what does not.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

import cv2
import numpy as np
import numpy.typing as npt

from pipeline.artifacts.cameras import Camera
from pipeline.studies.register import solving
from pipeline.studies.register.pictures.matching import GREY, Prepared, Spots
from pipeline.studies.register.solving import State
from pipeline.studies.register.visit import Floats, Labels, Look

Array = npt.NDArray[np.float64]

#: Turns to begin with, degrees about the tooth's axes: tip, torque, rotation.
STARTS = (
    (0, 0, 0), (0, 0, 8), (0, 0, -8), (6, 0, 0), (-6, 0, 0), (0, 8, 0), (0, -8, 0),
)  # fmt: skip
#: Shifts to begin with along the arch and out of the gum, mm; so many of the best are followed.
SHIFTS, BEST_SHIFTS = (-1.4, -0.7, 0.0, 0.7, 1.4), 3
#: A crown whose picture correlates by this fits; another motion is clearly better by so much.
FITS, CLEARLY = 0.6, 0.05
#: Blur of the pictures, pixels of one 512 wide, and steps with each.
COARSE_TO_FINE = ((2.0, 6), (1.0, 5))
FINE = len(COARSE_TO_FINE) - 1
#: Points of a crown in each pair, and how few are too few.
POINTS, LEAST, PAIRS = 250, 40, 12
#: So many points side by side say the same: contrast reaches over several pixels.
ALIKE = 10.0
#: From so many photographs of a visit on a tooth's pictures are not few: what two or three show (a
#: last molar) a wrong motion may fit as well as the true one.
LEAST_PHOTOGRAPHS = 4
#: What a tooth does between two visits: 1 mm, 6 degrees (standard deviations).
PRIOR = np.diag([1.0] * 3 + [1 / np.radians(6.0) ** 2] * 3)


@dataclass(frozen=True)
class Facing:
    """A crown in a pair of photographs.

    Attributes:
        tooth: FDI number.
        first, second: indices of the photographs, of the first and the second visit.
        points: [N, 3] of the first visit's crown, mm.
        values: per blur, [N] contrast in the first photograph, mean 0 and deviation 1.
        pictures: per blur, [H, W, 3] contrast of the second photograph and its derivatives.
        crown: [h, w] 1 where the second photograph shows the crown, 0 beside it: the part of it
            that begins at `corner`. There is no crown around it.
        clear: [h, w] 1 well inside it and without highlights.
        corner: column and row.
        camera: of the second photograph.
    """

    tooth: int
    first: int
    second: int
    points: Array
    values: tuple[Array, ...]
    pictures: tuple[Floats, ...]
    crown: Floats
    clear: Floats
    corner: tuple[int, int]
    camera: Camera


@dataclass(frozen=True)
class Fit:
    """A motion [4, 4], the correlation it gives (-1..1), and how sure it is ([6, 6])."""

    motion: Array
    score: float
    information: Array


class Crowns(Protocol):
    """A photograph, and [H, W] the tooth well inside whose crown a pixel lies."""

    @property
    def look(self) -> Look: ...
    @property
    def core(self) -> Labels: ...


class Pictures:
    """Blurred contrast of a visit's photographs and its derivatives, made once.

    Args:
        crowns: the photographs.
        contrasts: [H, W] uint8 of each.
        blurs: the levels, from the most blurred one on, in pixels.
    """

    def __init__(
        self, crowns: Sequence[Crowns], contrasts: Sequence[npt.NDArray[np.uint8]],
        blurs: Sequence[float],
    ) -> None:  # fmt: skip
        self.crowns = crowns
        self.made = [tuple(_with_slopes(blurred(c, s)) for s in blurs) for c in contrasts]


def pictures_of(prepared: Sequence[Prepared]) -> Pictures:
    """The contrast that optical flow goes by, at the levels of `COARSE_TO_FINE`."""
    scale = max((max(p.contrast.shape) for p in prepared), default=0) / 512
    contrasts = [p.contrast for p in prepared]
    return Pictures(prepared, contrasts, [sigma * scale for sigma, _ in COARSE_TO_FINE])


def blurred(contrast: npt.NDArray[np.uint8], sigma: float) -> Floats:
    """[H, W] contrast about 0, blurred by so many pixels."""
    return np.asarray(cv2.GaussianBlur(contrast.astype(np.float32) - GREY, (0, 0), sigma))


def _with_slopes(picture: Floats) -> Floats:
    slopes = (cv2.Scharr(picture, cv2.CV_32F, *axis) / 32 for axis in ((1, 0), (0, 1)))
    return np.dstack([picture, *slopes])


def facings(
    tooth: int, a: Pictures, b: Pictures, state: State, pairs: Sequence[tuple[int, int]],
    most_points: int = POINTS, most: int = PAIRS,
) -> list[Facing]:  # fmt: skip
    """The crown in the pairs of photographs that show it, where it is largest first.

    Args:
        tooth: FDI number.
        a, b: pictures of the first and the second visit.
        state: of which the tooth's motion and the cameras count.
        pairs: indices of the photographs.
        most_points, most: points of the crown in each pair, and pairs, at most.
    """
    found, sizes = [], []
    motion = state.motions[tooth]
    for i, j in pairs:
        one, other = a.crowns[i], b.crowns[j]
        camera = state.cameras[j].resized(*other.core.shape[::-1])
        crown = one.core == tooth
        if crown.sum() < LEAST:
            continue
        points = one.look.points_at(crown)
        pixels, z = camera.project(points @ motion[:3, :3].T + motion[:3, 3])
        column, row = np.floor(pixels).astype(int).T
        inside = (
            (z > 1) & (column >= 0) & (row >= 0) & (column < camera.width) & (row < camera.height)
        )
        names = other.look.enamel[row[inside], column[inside]]
        if (names > 0).sum() < LEAST:
            continue
        theirs = (other.look.enamel == np.bincount(names[names > 0]).argmax()).astype(np.float32)
        near = cv2.dilate(theirs, np.ones((5, 5), np.uint8)) > 0
        kept = np.flatnonzero(inside)[near[row[inside], column[inside]]]
        if len(kept) < max(LEAST, 0.3 * len(points)):
            continue
        kept = kept[np.linspace(0, len(kept) - 1, min(len(kept), most_points)).astype(int)]
        clear = ((other.core > 0) & (theirs > 0)).astype(np.float32)
        values = tuple(level[..., 0][crown][kept].astype(np.float64) for level in a.made[i])
        left, top, width, height = cv2.boundingRect(theirs.astype(np.uint8))
        left, top = max(left - 1, 0), max(top - 1, 0)
        part = slice(top, top + height + 2), slice(left, left + width + 2)
        found.append(
            Facing(
                tooth, i, j, points[kept], values, b.made[j],
                theirs[part].copy(), clear[part].copy(), (left, top), camera,
            )
        )  # fmt: skip
        sizes.append(int(crown.sum()))
    return [found[k] for k in np.argsort(sizes, kind="stable")[::-1][:most]]


def photographs(views: Sequence[Facing]) -> int:
    """How many photographs of the second visit these are."""
    return len({facing.second for facing in views})


def _sampled(facing: Facing, level: int, motion: Array) -> tuple[Array, Array, Array, Array]:
    """Pixels [N, 2], contrast and derivatives [N, 3], [N] on the crown, [N] clear."""
    pixels, z = facing.camera.project(facing.points @ motion[:3, :3].T + motion[:3, 3])
    x, y = np.where(z > 1, pixels.T - 0.5, -9).astype(np.float32)[:, None]
    value = cv2.remap(facing.pictures[level], x, y, cv2.INTER_LINEAR)[0]
    x, y = x - facing.corner[0], y - facing.corner[1]
    crown = cv2.remap(facing.crown, x, y, cv2.INTER_LINEAR)[0]
    clear = cv2.remap(facing.clear, x, y, cv2.INTER_LINEAR)[0] > 0.5
    return pixels, value.astype(np.float64), crown, clear


def contrast_spots(facing: Facing, level: int, motion: Array) -> Spots | None:
    """Where a crown's points would look as they do in the first photograph (Lucas and Kanade).

    Each is as sure as the picture is steep there; along an edge nothing is said.

    Args:
        facing: the crown in a pair of photographs.
        level: which of its blurs.
        motion: [4, 4] of the tooth in the first visit's frame, mm.

    Returns:
        Spots, their `likeness` the correlation of the pictures; None where too few are seen.
    """
    pixels, value, _, clear = _sampled(facing, level, motion)
    if clear.sum() < LEAST / 2:
        return None
    x, y = facing.values[level][clear], value[clear, 0]
    x = (x - x.mean()) / max(float(x.std()), 1.0)
    size = max(float(y.std()), 1.0)
    off = x - (y - y.mean()) / size
    slope = value[clear, 1:] / size
    steep = (slope**2).sum(1)
    unlike = float(np.mean(off**2))
    return Spots(
        facing.tooth, facing.first, facing.second, facing.points[clear],
        pixels[clear] + slope * (off / np.maximum(steep, 1e-6))[:, None],
        slope[:, :, None] * slope[:, None, :] / (max(unlike, 0.05) * ALIKE),
        1 - unlike / 2, int(clear.sum()),
    )  # fmt: skip


def score(views: Sequence[Facing], level: int, motion: Array) -> float:
    """Correlation over all pairs, weighted by points; points beside the crown count as misses."""
    total = weight = 0.0
    for facing in views:
        _, value, crown, clear = _sampled(facing, level, motion)
        if clear.sum() < LEAST / 2:
            continue
        x, y = facing.values[level][clear], value[clear, 0]
        x, y = x - x.mean(), y - y.mean()
        likeness = float(x @ y / np.sqrt(max(x @ x, 1e-6) * max(y @ y, 1e-6)))
        total += len(crown) * (likeness * float(crown.mean()))
        weight += len(crown)
    return total / weight if weight else -1.0


def improved(views: Sequence[Facing], start: Array, centre: Array) -> Fit:
    """Improve a motion by Gauss-Newton steps on the contrast itself."""
    motion, information = start, np.eye(6)
    for level, (_, steps) in enumerate(COARSE_TO_FINE):
        for _ in range(steps):
            matrix, vector = np.zeros((6, 6)), np.zeros(6)
            for facing in views:
                spots = contrast_spots(facing, level, motion)
                if spots is not None:
                    block = solving.block_of(spots, motion, facing.camera, centre)
                    matrix += block.matrix[:6, :6]
                    vector += block.vector[:6]
            information = matrix
            drift = solving.displacement(motion, centre)
            change = np.linalg.solve(matrix + PRIOR, vector - PRIOR @ drift)
            motion = solving.moved_tooth(motion, change, centre)
            if solving.travel(change) < 2e-3:
                break
    return Fit(motion, score(views, FINE, motion), information)


def best_motion(views: Sequence[Facing], now: Array, centre: Array, axes: Array) -> Fit:
    """The best of the motions that several starts lead to.

    Args:
        views: of the tooth.
        now: [4, 4] the motion to begin with.
        centre: [3] of the tooth as it was. axes: [3, 3] of it (see `movement.tooth_axes`).
    """
    mesial, buccal, own = axes

    def turned(start: Array, tip: float, torque: float, rotation: float) -> Array:
        turn = np.radians(tip * buccal + torque * mesial + rotation * own)
        change = np.concatenate([np.zeros(3), turn])
        return solving.moved_tooth(start, change, centre)

    starts = [turned(now, *angles) for angles in STARTS]
    shifted: list[tuple[float, int, Array]] = []
    for along in SHIFTS:
        for up in SHIFTS:
            start = now.copy()
            start[:3, 3] += along * mesial + up * own
            shifted.append((score(views, 0, start), len(shifted), start))
    starts += [start for _, _, start in sorted(shifted, key=lambda s: -s[0])[:BEST_SHIFTS]]
    return max((improved(views, start, centre) for start in starts), key=lambda fit: fit.score)


def searched(
    first: Sequence[Prepared], second: Sequence[Prepared], state: State, still: Sequence[int],
    centres: Mapping[int, Array], axes: Mapping[int, Array], pairs: Sequence[tuple[int, int]],
) -> dict[int, Fit]:  # fmt: skip
    """Better motions, by FDI number, of teeth whose pictures fit better with one.

    Args:
        first, second: photographs of both visits.
        state: motions to begin with, and the second visit's cameras, which stay.
        still: teeth that seem to have stood still: these need a bad fit to be tried at all, and
            other starts must fit clearly better.
        centres: of all teeth. axes: of all teeth (see `movement.tooth_axes`).
        pairs: which photographs are compared (see `matching.pairs_of`).
    """
    a, b = pictures_of(first), pictures_of(second)
    found = {}
    for tooth in sorted(state.motions):
        views = facings(tooth, a, b, state, pairs)
        now = state.motions[tooth]
        fit = score(views, FINE, now)
        if not views or (tooth in still and fit >= FITS):
            continue
        best = improved(views, now, centres[tooth])
        # Another start has to be clearly better than the nearest motion, or a bad fit is traded
        # for another one.
        if best.score < FITS:
            other = best_motion(views, now, centres[tooth], axes[tooth])
            best = other if other.score > best.score + CLEARLY else best
        if best.score > fit + (CLEARLY if tooth in still else 0.0):
            found[tooth] = best
    return found


def judged(
    first: Sequence[Prepared], second: Sequence[Prepared], state: State, still: Sequence[int],
    centres: Mapping[int, Array], pairs: Sequence[tuple[int, int]],
) -> tuple[dict[int, Array], dict[int, float]]:  # fmt: skip
    """Better motions [4, 4], by FDI number, of teeth that few photographs show, and how well the
    pictures of every tooth fit (-1..1), with that or as it is.

    With more photographs optical flow is right on the mean, while contrast takes the light that
    stays for a tooth that did not turn.

    Args:
        first, second, state, centres, pairs: as for `searched`.
        still: teeth that stood still; their motion stays.
    """
    a, b = pictures_of(first), pictures_of(second)
    better, likeness = {}, {}
    for tooth, motion in sorted(state.motions.items()):
        views = facings(tooth, a, b, state, pairs)
        if not views:
            continue
        likeness[tooth] = score(views, FINE, motion)
        if tooth in still or photographs(views) >= LEAST_PHOTOGRAPHS:
            continue
        best = improved(views, motion, centres[tooth])
        if best.score > likeness[tooth]:
            better[tooth], likeness[tooth] = best.motion, best.score
    return better, likeness
