"""What belongs to the teeth and the gum, and its colour, taken once from all photographs."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt
from scipy import ndimage

from pipeline.artifacts.dental.fdi import Jaw
from stages.init.dental.surface.photos.photo import Photo
from stages.init.dental.surface.photos.tissue import disc, without_fringes

Array32 = npt.NDArray[np.float32]
Array64 = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]

#: A photograph's weight grows from 0 at the rim of what it shows over this length (mm): no seam
#: where a photograph ends.
_FEATHER = 1.0
#: Weight of a highlight against the same place without one.
_HIGHLIGHT = 0.1
#: A highlight's glow goes this far beyond it (mm).
_GLOW = 0.4
#: Least share of a pixel that must be tooth or gum to lend it colour.
_LEAST_TISSUE = 0.5
#: Votes (squared cosines) below this are none.
_LEAST_VOTE = 0.02
#: Smaller pieces (square mm) are left out: half of what the smallest crown shows.
_CRUMB = 10.0
#: The gum's rim is made even over this length of the arch (mm).
_EVEN = 4.0
#: Shades are what varies over more than this (mm): a highlight on a crown is smaller.
_SHADE = 2.0
#: Weights below this are none.
_LEAST_WEIGHT = np.float32(1e-9)
#: A gain from fewer common samples than this is not believed.
_LEAST_COMMON = 200
#: Gains are kept within this factor: beyond, something else is wrong.
_MOST_GAIN = 2.0


@dataclass(frozen=True)
class Showing:
    """What one photograph shows of one chart.

    Attributes:
        seen: [H, W] bool: projects into the photograph, unhidden, facing it.
        facing: [H, W] float32 cosine between normal and line of sight.
        tooth: [H, W] float32 share of tooth of this jaw.
        gum: [H, W] float32 share of gum.
        colour: [H, W, 3] float32.
        dull: [H, W] float32: 0 in highlights.
    """

    seen: Mask
    facing: Array32
    tooth: Array32
    gum: Array32
    colour: Array32
    dull: Array32


def show(photo: Photo, jaw: Jaw, points: Array32, seen: Mask, facing: Array32) -> Showing:
    """Look a chart's samples up in a photograph.

    Args:
        photo: the photograph.
        jaw: the chart's.
        points: [H, W, 3] float32, mm.
        seen: [H, W] bool: not hidden and inside the photograph.
        facing: [H, W] float32 cosine between normal and line of sight.
    """
    pixels, _ = photo.project(points)
    usable = photo.valid & (photo.covered == 0)
    return Showing(
        seen=seen & (photo.sample(usable.astype(np.float32), pixels) > 0.5),
        facing=facing,
        tooth=photo.sample(photo.tooth_of(jaw), pixels),
        gum=photo.sample(photo.gum_of(jaw), pixels),
        colour=photo.sample(photo.image, pixels),
        dull=photo.sample(photo.dull, pixels),
    )


def find_tissue(
    showings: list[Showing], density: float, smoothing: float, least_facing: float
) -> tuple[Mask, Array32]:
    """Where a chart is tooth or gum, by the votes of the photographs, with a clean rim.

    Args:
        showings: what each photograph shows.
        density: samples per mm.
        smoothing: mm over which votes are smoothed.
        least_facing: cosine from which a photograph votes.

    Returns:
        [H, W] bool, and the share of tooth [H, W] float32 0..1.
    """
    shape = showings[0].seen.shape
    votes = np.zeros((3, *shape), np.float32)
    for showing in showings:
        # Squared: a view from the side says little about where tooth ends on the surface.
        weight = np.where(showing.seen & (showing.facing > least_facing), showing.facing**2, 0)
        votes += weight * np.stack([np.ones(shape, np.float32), showing.tooth, showing.gum])
    total, tooth, gum = (
        np.asarray(cv2.GaussianBlur(vote, (0, 0), smoothing * density), np.float32)
        for vote in votes
    )
    known = total > _LEAST_VOTE
    share = (tooth + gum) / np.maximum(total, np.float32(1e-6))
    toothy = (tooth / np.maximum(total, np.float32(1e-6))).astype(np.float32)
    kept = without_fringes(known & (share > _LEAST_TISSUE), density)
    return _with_teeth(kept, known & (toothy > _LEAST_TISSUE), density), toothy


def _with_teeth(kept: Mask, tooth: Mask, density: float) -> Mask:
    """Pieces that carry tooth, at least 4 square mm of it or a sixth of the piece; no crumbs."""
    count, label = cv2.connectedComponents(kept.astype(np.uint8), connectivity=4)
    area = np.bincount(label.ravel(), minlength=count)
    teeth = np.bincount(label[tooth & kept], minlength=count)
    good = (teeth > 4 * density**2) | (teeth * 6 > area)
    good[0] = False
    good &= area > _CRUMB * density**2
    return good[label]


def even_rim(kept: Mask, tooth: Mask, beyond_gum: Array32, density: float) -> Mask:
    """Cut the gum's rim to an even line: as far as it is kept all along some mm of the arch.

    Args:
        kept: [H, W] bool: tooth or gum.
        tooth: [H, W] bool: tooth, which is never cut.
        beyond_gum: [H, W] float32 mm beyond the gum line.
        density: samples per mm.

    Returns:
        [H, W] bool.
    """
    some = kept.any(axis=0)
    if not some.any():
        return kept
    furthest = np.where(kept, beyond_gum, -np.inf).max(axis=0)
    columns = np.arange(kept.shape[1])
    furthest = np.interp(columns, columns[some], furthest[some])
    size = int(_EVEN * density) | 1
    least = ndimage.minimum_filter1d(furthest, size, mode="nearest")
    line = ndimage.gaussian_filter1d(least, size / 4, mode="nearest")
    even = kept & without_fringes(kept & (tooth | (beyond_gum <= line[None])), density)
    return _with_teeth(even, tooth & kept, density)


def photo_weights(
    showings: list[Showing], kept: Mask, density: float, power: float
) -> list[Array32]:
    """[H, W] float32 per photograph: how much it has to say about the colour of each sample."""
    weights = []
    for showing in showings:
        tissue = (showing.tooth + showing.gum) > _LEAST_TISSUE
        usable = showing.seen & tissue & kept & (showing.facing > 0.05)
        # The border of the chart is no rim.
        inner = cv2.distanceTransform(
            np.pad(usable, 1, mode="edge").astype(np.uint8), cv2.DIST_L2, 3
        )[1:-1, 1:-1]
        feather = np.clip(inner / (density * _FEATHER), 0, 1) ** 2
        plain = _HIGHLIGHT + (1 - _HIGHLIGHT) * _fading(showing.dull, density)
        cosine = np.clip(showing.facing, 0, 1) ** power
        weights.append((np.where(usable, feather * cosine * plain + 1e-6, 0)).astype(np.float32))
    return weights


def _fading(dull: Array32, density: float) -> Array32:
    """1 away from highlights, 0 in them, with a soft rim: their glow goes further than they do."""
    glow = _GLOW * density
    return np.asarray(cv2.GaussianBlur(cv2.erode(dull, disc(glow)), (0, 0), glow))


def find_gains(colours: list[list[Array32]], weights: list[list[Array32]], anchor: int) -> Array64:
    """Factors per photograph and channel that make photographs agree where they overlap.

    Args:
        colours: per chart, per photograph [H, W, 3].
        weights: per chart, per photograph [H, W].
        anchor: the photograph whose gain is 1.

    Returns:
        [V, 3] float64; least squares over the medians of the log ratios of all pairs.
    """
    count = len(colours[0]) if colours else 0
    system = np.zeros((count, count))
    right = np.zeros((count, 3))
    for a in range(count):
        for b in range(a + 1, count):
            ratios = []
            for colour, weight in zip(colours, weights, strict=True):
                both = (weight[a] > 0.02) & (weight[b] > 0.02)
                ratios.append(
                    np.log(np.maximum(colour[a][both], 0.03))
                    - np.log(np.maximum(colour[b][both], 0.03))
                )
            ratio = np.concatenate(ratios)
            if len(ratio) < _LEAST_COMMON:
                continue
            median = np.median(ratio.astype(np.float64), axis=0)
            trust = float(np.sqrt(len(ratio)))
            # gain_b - gain_a = median
            system[[a, b], [a, b]] += trust
            system[[a, b], [b, a]] -= trust
            right[a] -= trust * median
            right[b] += trust * median
    # A photograph without a partner keeps its exposure.
    system += np.eye(count) * 1e-3
    system[anchor, anchor] += 1e6
    limit = np.log(_MOST_GAIN)
    return np.exp(np.clip(np.linalg.solve(system, right), -limit, limit))


def blend(
    colours: list[Array32], weights: list[Array32], gains: Array64, density: float
) -> tuple[Array32, Array32]:
    """Colour [H, W, 3] float32 in 0..1 from all photographs, and the sum of their weights [H, W].

    Shades and detail are taken apart (Burt and Adelson, A multiresolution spline with application
    to image mosaics, 1983, with two bands). The shade under a highlight is that of the same
    photograph around it: another photograph lends the detail, but sees the place from its side,
    darker.

    Args:
        colours, weights: per photograph [H, W, 3] and [H, W].
        gains: [V, 3] factors of the photographs.
        density: samples per mm.
    """
    total = np.zeros(weights[0].shape, np.float32)
    detail = np.zeros((*total.shape, 3), np.float32)
    shade, around = np.zeros_like(detail), np.zeros_like(total)
    for colour, weight, gain in zip(colours, weights, gains, strict=True):
        own = colour * gain.astype(np.float32)
        reach = _widely(weight, density)
        smooth = _widely(own * weight[..., None], density) / (reach + _LEAST_WEIGHT)[..., None]
        detail += weight[..., None] * (own - smooth)
        total += weight
        shade += reach[..., None] * smooth
        around += reach
    detail /= np.maximum(total, _LEAST_WEIGHT)[..., None]
    shade /= np.maximum(around, _LEAST_WEIGHT)[..., None]
    return np.clip(shade + detail, 0, 1), total


def _widely(values: Array32, density: float) -> Array32:
    """Values [H, W] or [H, W, C] blurred over `_SHADE` mm."""
    height, width = values.shape[:2]
    step = max(int(_SHADE * density / 4), 1)
    size = (max(width // step, 1), max(height // step, 1))
    small = cv2.resize(values, size, interpolation=cv2.INTER_AREA)
    sigma = _SHADE * density / step
    blurred = cv2.GaussianBlur(small, (0, 0), sigma, borderType=cv2.BORDER_REFLECT)
    return np.asarray(
        cv2.resize(blurred, (width, height), interpolation=cv2.INTER_LINEAR), np.float32
    )


def hidden_edges(tooth: Mask, crowns: Mask, density: float, length: float) -> Mask:
    """[H, W] bool: parts of the crowns that other teeth hide, next to parts that are seen.

    Args:
        tooth: [H, W] bool: seen tooth.
        crowns: [H, W] bool: where the crown shape has crowns.
        density: samples per mm.
        length: mm to go on.
    """
    distance = cv2.distanceTransform((~tooth).astype(np.uint8), cv2.DIST_L2, 5)
    return ~tooth & crowns & (distance <= length * density)


def spread_colour(colour: Array32, known: Mask) -> Array32:
    """Colour [H, W, 3] where samples that are not known take that of the nearest known one."""
    if known.all() or not known.any():
        return colour
    _, label = cv2.distanceTransformWithLabels(
        (~known).astype(np.uint8), cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL
    )
    source = np.zeros(int(label.max()) + 1, np.int64)
    source[label[known]] = np.flatnonzero(known)
    return np.asarray(colour.reshape(-1, 3)[source[label]], np.float32)
