"""Where a row of teeth ends in a photograph: what is red beyond is cheek, lip, or what holds them.

A chart goes on a tooth's width beyond the last tooth, which may show in part, and colour does not
tell gum from what photographs show there: the cheek behind the last molar, lips before the far side
of the mouth, a retractor with the skin through it. Laid on the chart they became dark strips.
"""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import numpy.typing as npt

from pipeline.kernels.threads import in_threads
from stages.init.dental.surface.chart.jaws import HIDDEN, PAST_EDGE, Chart
from stages.init.dental.surface.chart.raster import raster_chart, sees
from stages.init.dental.surface.options import SurfaceOptions
from stages.init.dental.surface.photos.photo import Photo
from stages.init.dental.surface.photos.tissue import disc

Array32 = npt.NDArray[np.float32]

#: Narrower than twice this (mm) is no tooth, but the rim of one on a surface that is a little off.
_NARROW = 0.5
#: Share of a sample's surroundings from which it is tooth.
_HALF = 0.5
#: So far from the midline along the arch (mm; the canines') the other jaw's teeth say as well how
#: far a row goes: in a deep bite they hide the front teeth, and not the gum below.
_FRONT = 20.0

#: Arc lengths (mm) from which and up to which something goes.
Span = tuple[float, float]


def within_rows(
    charts: list[Chart], photos: list[Photo], nearest: list[Array32], options: SurfaceOptions,
    threads: int,
) -> list[Photo]:  # fmt: skip
    """The photographs with what they show `options.past_row` mm beyond their teeth no longer gum.

    Args:
        charts: of the jaws, where the surface is.
        photos: the photographs.
        nearest: per photograph the z-depth [h, w] of the nearest chart.
        options: settings.
        threads: number of threads; does not change the result.
    """
    if options.past_row is None:
        return photos
    past = options.past_row

    def cut(item: tuple[Photo, Array32]) -> Photo:
        photo, front = item
        beyond = np.zeros(photo.size, bool)
        rows = [_row(chart, photo, front) for chart in charts]
        for chart, (first, last) in zip(charts, _with_hidden_fronts(rows), strict=True):
            used = chart.used(PAST_EDGE, options.gum_height)
            depth, place = raster_chart(photo, chart.points, used)
            near = (depth > 0) & (depth < front + np.float32(HIDDEN))
            arc = chart.grid.left + place[..., 0] / chart.grid.density
            beyond |= near & ((arc < first - past) | (arc > last + past))
        free = (~beyond | (photo.upper > 0) | (photo.lower > 0)).astype(np.float32)
        return replace(
            photo, upper_gum=photo.upper_gum * free, lower_gum=photo.lower_gum * free,
            covered=np.maximum(photo.covered, 1 - free),
        )  # fmt: skip

    return in_threads(cut, zip(photos, nearest, strict=True), threads)


def _row(chart: Chart, photo: Photo, front: Array32) -> Span | None:
    """From where to where a photograph, with the depth [h, w] of what is nearest, shows teeth."""
    points = chart.points
    there = photo.sample(photo.tooth_of(chart.shape.jaw), photo.project(points)[0]) > _HALF
    there &= sees(photo, front, points, HIDDEN) & chart.used(PAST_EDGE, 0)
    narrow = disc(_NARROW * chart.grid.density)
    tooth = cv2.morphologyEx(there.astype(np.uint8), cv2.MORPH_OPEN, narrow) > 0
    arcs = chart.grid.arcs[tooth.any(axis=0)]
    return (float(arcs[0]), float(arcs[-1])) if len(arcs) else None


def _with_hidden_fronts(rows: list[Span | None]) -> list[Span]:
    """The rows of both jaws; among the front teeth as far as either of them goes."""
    shown = [row for row in rows if row]
    first = max(min((row[0] for row in shown), default=np.inf), -_FRONT)
    last = min(max((row[1] for row in shown), default=-np.inf), _FRONT)
    return [(min(row[0], first), max(row[1], last)) if row else (first, last) for row in rows]
