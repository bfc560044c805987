"""From the crowns out over the gum: strip by strip, each going on from the last as it bent.

Only with cameras that are known exactly: the gum flares outwards where it turns into lip and cheek,
further than a sweep around a straight wall reaches.
"""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import numpy.typing as npt
from scipy import ndimage

from stages.init.dental.chart import ChartGrid
from stages.init.dental.crown_shape import beyond_crowns
from stages.init.dental.surface_charts import Chart, comparable, nearest_depths
from stages.init.dental.surface_options import SurfaceOptions
from stages.init.dental.surface_photo import Photo
from stages.init.dental.surface_sweep import sweep

Array32 = npt.NDArray[np.float32]

#: The slope that a strip goes on with is taken over this height (mm) and smoothed along the arch
#: over that length; steeper than this it does not get.
_SLOPE_OVER, _SLOPE_ALONG, _STEEPEST = 2.0, 3.0, 1.5
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
            seen = comparable(part, photos, nearest, limits)
            trust = np.ones(part.radius.shape, np.float32)
            found = sweep(
                part.grid, part.radius, photos, seen, pairs, trust, options.grow_round, options
            )
            gum, _ = beyond_crowns(part.grid, part.shape)
            # What is nearer to the crowns was swept before: go over to the new without a step.
            new = np.clip((gum - np.float32(reached - _OVERLAP)) / np.float32(_OVERLAP), 0, 1)
            chart.radius[rows] += new * (found.radius - part.radius)
        reached = further


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
