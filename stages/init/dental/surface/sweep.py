"""Surface-aligned sweep: which offset along the normals makes the photographs agree?

The chart's samples are moved along their smoothed normals, plane by plane; at each offset the
textures of neighbouring views are compared on the chart itself, so that a window follows the curve
of the crown; semi-global matching along the chart decides.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import cv2
import numpy as np
import numpy.typing as npt

from pipeline.kernels import each, helper, kernel
from stages.init.dental.surface.carve import carved, in_void
from stages.init.dental.surface.chart.grid import ChartGrid, normals_of
from stages.init.dental.surface.fit import fit_offsets
from stages.init.dental.surface.options import SurfaceOptions, SweepRound
from stages.init.dental.surface.photos.photo import Photo
from stages.stereo.aggregate import aggregate, decide, edge_aware_penalty
from stages.stereo.consistency import stacked
from stages.stereo.tiles import Volume

Array32 = npt.NDArray[np.float32]
Array64 = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]

#: Normals to sweep along are those of the surface smoothed over this length (mm): neighbouring
#: samples must not cross.
_NORMAL_SMOOTHING = 1.5
#: Cost where no two views see a sample: neither good nor bad.
_NEUTRAL = 0.55
#: Variance below this (textures are in units of their own spread) has nothing to correlate.
_LEAST_VARIANCE = 0.01
#: The belief in the surface swept around grows no more beyond this (in units of `prior`).
_MOST_PRIOR = 1.5
#: Less agreement than this is none: there, silhouettes decide.
_NO_AGREEMENT = 0.05
#: How fast the jump penalty falls with the texture's gradient.
_EDGE_FALLOFF = 2.0


@dataclass(frozen=True)
class Evidence:
    """What a sweep found.

    Attributes:
        radius: [H, W] float32 the chart after it.
        weight: [H, W] float32 0..1: how well the photographs agree there.
    """

    radius: Array32
    weight: Array32


@dataclass(frozen=True)
class Matches:
    """Offsets of a chart along its normals at which photographs agree, before any fit.

    Attributes:
        points, normals: [H, W, 3] float32 the chart and where it is moved along.
        offsets: [D] float32 those tried, mm.
        offset: [H, W] float32 the best one.
        weight: [H, W] float32 0..1: how well the photographs agree there.
    """

    points: Array32
    normals: Array32
    offsets: Array32
    offset: Array32
    weight: Array32


@helper(fastmath=True)
def _bilinear(image, height, width, x, y):  # type: ignore[no-untyped-def]
    x = min(max(x - np.float32(0.5), np.float32(0)), np.float32(width - 1.001))
    y = min(max(y - np.float32(0.5), np.float32(0)), np.float32(height - 1.001))
    j, i = int(x), int(y)
    fx, fy = x - np.float32(j), y - np.float32(i)
    top = image[i, j] + fx * (image[i, j + 1] - image[i, j])
    low = image[i + 1, j] + fx * (image[i + 1, j + 1] - image[i + 1, j])
    return top + fy * (low - top)


@helper(fastmath=True)
def _box(values, radius, sums, out):  # type: ignore[no-untyped-def]
    """Mean over a (2 radius + 1)^2 window, cut at the borders."""
    rows, cols = values.shape
    for i in range(rows):
        total = np.float32(0)
        for j in range(min(radius, cols)):
            total += values[i, j]
        for j in range(cols):
            if j + radius < cols:
                total += values[i, j + radius]
            if j - radius - 1 >= 0:
                total -= values[i, j - radius - 1]
            width = min(j + radius, cols - 1) - max(j - radius, 0) + 1
            sums[i, j] = total / np.float32(width)
    column = np.zeros(cols, np.float32)
    for i in range(min(radius, rows)):
        for j in range(cols):
            column[j] += sums[i, j]
    for i in range(rows):
        if i + radius < rows:
            for j in range(cols):
                column[j] += sums[i + radius, j]
        if i - radius - 1 >= 0:
            for j in range(cols):
                column[j] -= sums[i - radius - 1, j]
        scale = np.float32(1) / np.float32(min(i + radius, rows - 1) - max(i - radius, 0) + 1)
        for j in range(cols):
            out[i, j] = column[j] * scale


@kernel(fastmath=True, nogil=True)
def _plane(  # type: ignore[no-untyped-def]
    d, points, normals, offsets, textures, sizes, cameras, pairs, seen, radius, neutral, floor,
    volume,
):  # fmt: skip
    """Plane d: sample every view, correlate every pair, average the pairs that see."""
    rows, cols = points.shape[:2]
    views = textures.shape[0]
    samples = np.zeros((views, rows, cols), np.float32)
    means = np.zeros((views, rows, cols), np.float32)
    spreads = np.zeros((views, rows, cols), np.float32)
    product = np.zeros((rows, cols), np.float32)
    sums = np.zeros((rows, cols), np.float32)
    both = np.zeros((rows, cols), np.float32)
    cost = np.zeros((rows, cols), np.float32)
    count = np.zeros((rows, cols), np.float32)
    for v in range(views):
        c = cameras[v]
        for i in range(rows):
            for j in range(cols):
                X = points[i, j, 0] + offsets[d] * normals[i, j, 0]
                Y = points[i, j, 1] + offsets[d] * normals[i, j, 1]
                Z = points[i, j, 2] + offsets[d] * normals[i, j, 2]
                x = c[0] * X + c[1] * Y + c[2] * Z + c[9]
                y = c[3] * X + c[4] * Y + c[5] * Z + c[10]
                z = max(c[6] * X + c[7] * Y + c[8] * Z + c[11], np.float32(1))
                value = _bilinear(
                    textures[v], sizes[v, 0], sizes[v, 1],
                    c[12] * x / z + c[13], c[12] * y / z + c[14],
                )  # fmt: skip
                samples[v, i, j] = value
                product[i, j] = value * value
        _box(samples[v], radius, sums, means[v])
        _box(product, radius, sums, spreads[v])
        for i in range(rows):
            for j in range(cols):
                variance = spreads[v, i, j] - means[v, i, j] * means[v, i, j]
                spreads[v, i, j] = np.float32(1) / np.sqrt(max(variance, floor))
    for p in range(pairs.shape[0]):
        a, b = pairs[p, 0], pairs[p, 1]
        for i in range(rows):
            for j in range(cols):
                product[i, j] = samples[a, i, j] * samples[b, i, j]
        _box(product, radius, sums, both)
        for i in range(rows):
            for j in range(cols):
                if seen[a, i, j] and seen[b, i, j]:
                    covariance = both[i, j] - means[a, i, j] * means[b, i, j]
                    cost[i, j] += np.float32(1) - covariance * spreads[a, i, j] * spreads[b, i, j]
                    count[i, j] += np.float32(1)
    for i in range(rows):
        for j in range(cols):
            if count[i, j] > 0:
                mean = cost[i, j] / count[i, j]
                volume[i, j, d] = min(max(mean, np.float32(0)), np.float32(1.4))
            else:
                volume[i, j, d] = neutral


def choose_pairs(photos: list[Photo], middle: Array64, options: SurfaceOptions) -> list[list[int]]:
    """Pairs of photographs to compare: neighbours along the arch, neither too near nor too far.

    Returns:
        Pairs of indices into `photos`, each view with up to `options.partners` next ones that are
        far enough; sorted.
    """
    lines = [photo.centre - middle for photo in photos]
    lines = [line / np.linalg.norm(line) for line in lines]
    yaw = [float(np.arctan2(line[0], line[2])) for line in lines]
    order = sorted(range(len(photos)), key=lambda k: (yaw[k], k))
    pairs = set()
    for rank, first in enumerate(order):
        found = 0
        for second in order[rank + 1 :]:
            cosine = np.clip(lines[first] @ lines[second], -1, 1)
            angle = np.degrees(np.arccos(cosine))
            if options.least_pair_angle <= angle <= options.most_pair_angle:
                pairs.add((min(first, second), max(first, second)))
                found += 1
                if found == options.partners:
                    break
    return [list(pair) for pair in sorted(pairs)]


def sweep(
    grid: ChartGrid,
    radius: Array32,
    photos: list[Photo],
    seen: npt.NDArray[np.bool_],
    pairs: list[list[int]],
    trust: Array32,
    used: Mask,
    settings: SweepRound,
    options: SurfaceOptions,
) -> Evidence:
    """One round: sweep around a chart, decide, and fit a smooth surface to what was found.

    Args:
        grid: where the chart's samples lie.
        radius: [H, W] float32 the chart.
        photos: photographs to compare.
        seen: [V, H, W] bool: the photograph shows this sample.
        pairs: which photographs to compare with one another.
        trust: [H, W] float32: weight of what is found at a sample, 0..1.
        used: [H, W] bool: samples that are surface, wherever it lies.
        settings: of this round.
        options: of the surface.
    """
    found = match(grid, radius, photos, seen, pairs, trust, settings, options)

    smooth = found.offset, found.weight, settings.stiffness, options.anchor, options.outlier
    if options.carve:
        unmatched = used & (found.weight < _NO_AGREEMENT)
        void = in_void(found.points, found.normals, found.offsets, photos) & unmatched[..., None]
        fitted = carved(*smooth, void, found.offsets)
    else:
        fitted = fit_offsets(*smooth)
    return Evidence(grid.radius_of(found.points + fitted[..., None] * found.normals), found.weight)


def match(
    grid: ChartGrid,
    radius: Array32,
    photos: list[Photo],
    seen: npt.NDArray[np.bool_],
    pairs: list[list[int]],
    trust: Array32,
    settings: SweepRound,
    options: SurfaceOptions,
) -> Matches:
    """Sweep around a chart and decide at each sample; arguments as for `sweep`."""
    points = grid.points(radius)
    smooth = cv2.GaussianBlur(radius, (0, 0), _NORMAL_SMOOTHING * grid.density)
    normals = normals_of(grid.points(np.asarray(smooth, np.float32)))
    count = round(settings.reach / settings.step)
    offsets = (np.arange(-count, count + 1) * settings.step).astype(np.float32)
    half = max(round(settings.window * grid.density / 2 - 0.5), 1)
    volume = matching_cost(points, normals, offsets, photos, seen, pairs, half)
    prior = settings.prior * np.minimum((offsets / 2) ** 2, _MOST_PRIOR)
    penalty = edge_aware_penalty(_reference(photos, points, seen), options.sgm_p2, _EDGE_FALLOFF)
    likely = Volume.of(volume + prior.astype(np.float32))
    total = aggregate(likely, penalty, options.sgm_p1)
    plane, correlation, _ = decide(total, Volume.of(volume))
    offset = offsets[0] + settings.step * plane
    both = np.zeros(radius.shape, bool)
    for a, b in pairs:
        both |= seen[a] & seen[b]
    span = options.correlation_full - options.correlation_floor
    weight = np.clip((correlation - options.correlation_floor) / span, 0, 1) ** 2
    weight = np.where(both, weight * trust, 0).astype(np.float32)
    return Matches(points, normals, offsets, offset.astype(np.float32), weight)


def matching_cost(
    points: Array32,
    normals: Array32,
    offsets: Array32,
    photos: list[Photo],
    seen: npt.NDArray[np.bool_],
    pairs: list[list[int]],
    half_window: int,
) -> Array32:
    """1 - ZNCC of the photographs' textures on a chart moved along its normals.

    Args:
        points, normals: [H, W, 3] float32.
        offsets: [D] float32, mm.
        photos: photographs to compare.
        seen: [V, H, W] bool: the photograph shows this sample.
        pairs: which photographs to compare with one another.
        half_window: samples to either side of a window's middle.

    Returns:
        [H, W, D] float32 in 0..1.4: mean over the pairs that both see the sample; a constant where
        there is none.
    """
    volume = np.full((*points.shape[:2], len(offsets)), _NEUTRAL, np.float32)
    for first, last, compared in _stretches(seen, pairs):
        # With a margin of half a window the costs are those of the whole chart.
        left, right = max(first - half_window, 0), min(last + half_window, points.shape[1])
        views = sorted({view for pair in compared for view in pair})
        shown = [photos[view] for view in views]
        part = np.empty((len(points), right - left, len(offsets)), np.float32)
        each(
            _plane, len(offsets),
            np.ascontiguousarray(points[:, left:right]),
            np.ascontiguousarray(normals[:, left:right]), offsets,
            stacked([photo.texture for photo in shown]),
            np.array([photo.size for photo in shown], np.int64),
            np.array([photo.camera for photo in shown], np.float32),
            np.array([[views.index(a), views.index(b)] for a, b in compared], np.int64),
            np.ascontiguousarray(np.asarray(seen)[views, :, left:right]), half_window,
            np.float32(_NEUTRAL), np.float32(_LEAST_VARIANCE), part,
        )  # fmt: skip
        volume[:, first:last] = part[:, first - left : last - left]
    return volume


def _stretches(
    seen: npt.NDArray[np.bool_], pairs: list[list[int]]
) -> list[tuple[int, int, list[list[int]]]]:
    """First column, the one after the last, and the pairs that see something in between: a chart
    cut where the first or last column of some pair is. What no pair sees is left out."""
    spans = []
    for a, b in pairs:
        columns = np.flatnonzero((seen[a] & seen[b]).any(axis=0))
        if len(columns):
            spans.append((int(columns[0]), int(columns[-1]) + 1, [a, b]))
    cuts = sorted({cut for first, last, _ in spans for cut in (first, last)})
    stretches = []
    for first, last in pairwise(cuts):
        compared = [pair for a, b, pair in spans if a <= first and last <= b]
        if compared:
            stretches.append((first, last, compared))
    return stretches


def _reference(photos: list[Photo], points: Array32, seen: npt.NDArray[np.bool_]) -> Array32:
    """Mean texture on the chart, of the photographs that show a sample."""
    total = np.zeros(points.shape[:2], np.float32)
    for photo, mask in zip(photos, seen, strict=True):
        total += np.where(mask, photo.sample(photo.texture, photo.project(points)[0]), 0)
    return (total / np.maximum(seen.sum(axis=0), 1)).astype(np.float32)
