"""From the crowns out over the gum: strip by strip, each going on from the last as it bent.

Only with cameras that are known exactly: the gum flares outwards where it turns into lip and cheek,
further than a sweep around a straight wall reaches. Each strip is therefore tried at several
slopes: correlation windows that lean like the gum agree best.
"""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import numpy.typing as npt
from scipy import ndimage

from stages.init.dental.surface.chart.crown_shape import beyond_crowns
from stages.init.dental.surface.chart.grid import ChartGrid
from stages.init.dental.surface.chart.jaws import PAST_EDGE, Chart, comparable, nearest_depths
from stages.init.dental.surface.options import SurfaceOptions
from stages.init.dental.surface.photos.photo import Photo
from stages.init.dental.surface.sweep import match, sweep

Array32 = npt.NDArray[np.float32]
Mask = npt.NDArray[np.bool_]

#: The slope that a strip goes on with is taken over this height (mm) and smoothed along the arch
#: over that length; steeper than this it does not get.
_SLOPE_OVER, _SLOPE_ALONG, _STEEPEST = 2.0, 3.0, 1.5
#: Slopes tried for a strip, relative to the last one's. Each costs agreement in proportion.
_BENDS, _BEND_COST = (-0.4, 0.0, 0.5, 1.0), 0.02
#: Agreement is compared over this length along the arch (mm); less than this decides nothing.
_COMPARED_OVER, _LEAST_AGREEMENT = 4.0, 0.1
#: The slopes chosen are smoothed over the first length (mm); where nothing was decided, what was
#: decided within the second one counts, with the weight that follows.
_BEND_NEAR, _BEND_FAR, _FAR_WEIGHT = 1.0, 14.0, 0.1
#: A strip is swept together with so much of the last ones (mm), to be fitted to them.
_OVERLAP = 5.0


def grow_gum(
    charts: list[Chart], photos: list[Photo], pairs: list[list[int]], options: SurfaceOptions,
    threads: int,
) -> None:  # fmt: skip
    """Sweep the charts (changed in place) from `grow_from` beyond the gum line to `gum_height`.

    Args:
        charts: of the jaws, swept up to `options.grow_from`.
        photos: photographs to compare.
        pairs: which with one another.
        options: settings.
        threads: number of threads.
    """
    reached = options.grow_from
    while reached < options.gum_height:
        further = min(reached + options.grow_step, options.gum_height)
        for chart in charts:
            go_on_straight(chart, reached)
        limits = replace(options, gum_height=further)
        nearest = nearest_depths(charts, photos, further, threads)
        for chart in charts:
            part, rows = _strip(chart, reached - _OVERLAP, further)
            grown = _sweep_strip(part, reached, photos, pairs, nearest, limits)
            # What is nearer to the crowns was swept before: go over to the new without a step.
            gum, _ = beyond_crowns(part.grid, part.shape)
            new = np.clip((gum - np.float32(reached - _OVERLAP)) / np.float32(_OVERLAP), 0, 1)
            chart.radius[rows] += new * (grown - part.radius)
        reached = further


def _sweep_strip(
    part: Chart, reached: float, photos: list[Photo], pairs: list[list[int]],
    nearest: list[Array32], options: SurfaceOptions,
) -> Array32:  # fmt: skip
    """[H, W] radius of a strip, swept at the slope beyond `reached` at which it agrees best."""
    gum, _ = beyond_crowns(part.grid, part.shape)
    used = part.used(PAST_EDGE, options.gum_height)
    beyond = np.maximum(gum - np.float32(reached), 0)
    new = used & (beyond > 0)
    trust = np.ones(part.radius.shape, np.float32)

    inset = options.grow_round.inset

    def bent(bend: Array32 | float) -> tuple[Array32, list[Photo], Mask]:
        chart = replace(part, radius=(part.radius + bend * beyond).astype(np.float32))
        return chart.radius, photos, comparable(chart, photos, nearest, options, inset)

    count = np.maximum(new.sum(axis=0), 1)
    agreements = []
    for bend in _BENDS:
        found = match(part.grid, *bent(bend), pairs, trust, options.grow_round, options)
        agreements.append((found.weight * new).sum(axis=0) / count)
    best = bent(best_bend(np.stack(agreements), part.grid.density))
    return sweep(part.grid, *best, pairs, trust, used, options.grow_round, options).radius


def best_bend(agreement: npt.NDArray[np.floating], density: float) -> Array32:
    """The bend, one of `_BENDS` or between them, for each column of a strip.

    Args:
        agreement: [B, W] of the photographs, 0..1, for each bend.
        density: columns per mm.

    Returns:
        [W] float32: smooth; 0 where nothing agrees far around.
    """
    bends = np.array(_BENDS)
    score = ndimage.gaussian_filter1d(agreement, _COMPARED_OVER * density, axis=1)
    score = score - _BEND_COST * np.abs(bends)[:, None]
    clear = score.max(axis=0) - np.median(score, axis=0)
    clear = np.where(score.max(axis=0) > _LEAST_AGREEMENT, clear, 0)
    chosen = clear * bends[score.argmax(axis=0)]

    def around(values: npt.NDArray[np.floating]) -> npt.NDArray[np.floating]:
        near = ndimage.gaussian_filter1d(values, _BEND_NEAR * density)
        far = ndimage.gaussian_filter1d(values, _BEND_FAR * density)
        return np.asarray(near + _FAR_WEIGHT * far)

    return np.asarray(around(chosen) / np.maximum(around(clear), 1e-9), np.float32)


def go_on_straight(chart: Chart, reached: float) -> None:
    """Let the chart go on beyond `reached` mm from the gum line with the slope that it has there.

    Changes `chart.radius` in place; what is nearer to the crowns stays.
    """
    gum, _ = beyond_crowns(chart.grid, chart.shape)
    near, far = (_line_at(chart, gum, reached - back) for back in (0.5 + _SLOPE_OVER, 0.5))
    sigma = _SLOPE_ALONG * chart.grid.density
    slope = ndimage.median_filter((far - near) / _SLOPE_OVER, int(sigma) | 1, mode="nearest")
    slope = ndimage.gaussian_filter1d(np.clip(slope, -_STEEPEST, _STEEPEST), sigma, mode="nearest")
    straight = far[None] + slope[None] * (gum - np.float32(reached - 0.5))
    chart.radius = np.where(gum > reached, straight, chart.radius).astype(np.float32)


def _line_at(chart: Chart, gum: Array32, height: float) -> Array32:
    """[W] radius so many mm beyond the gum line, averaged over a mm up and down."""
    smooth = cv2.blur(chart.radius, (1, int(chart.grid.density) | 1))
    rows = np.abs(gum - np.float32(height)).argmin(axis=0)
    return np.asarray(smooth[rows, np.arange(gum.shape[1])], np.float32)


def _strip(chart: Chart, first: float, last: float) -> tuple[Chart, slice]:
    """The rows of a chart that lie between two heights beyond the gum line somewhere."""
    gum, _ = beyond_crowns(chart.grid, chart.shape)
    inside = np.flatnonzero(((gum > first) & (gum < last)).any(axis=1))
    rows = slice(int(inside[0]), int(inside[-1]) + 1)
    grid = chart.grid
    part = ChartGrid(
        grid.left, grid.top - rows.start / grid.density, grid.density,
        (rows.stop - rows.start, grid.shape[1]),
    )  # fmt: skip
    return Chart(chart.shape, part, chart.radius[rows].copy(), chart.agreement[rows].copy()), rows
