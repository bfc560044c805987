"""What each photograph sees of the finished charts: depth, normals and confidence."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from pipeline.artifacts.dental.fdi import Jaw
from pipeline.kernels.threads import in_threads
from stages.init.dental.surface.chart.hardware import behind_flanks, metal
from stages.init.dental.surface.chart.jaws import (
    PAST_EDGE,
    Chart,
    clearly_seen,
    comparable,
    confidence_of,
    nearest_depths,
    smooth_normals,
)
from stages.init.dental.surface.chart.partial import partial_crowns
from stages.init.dental.surface.chart.raster import at_places, raster_chart
from stages.init.dental.surface.cover import uncovered
from stages.init.dental.surface.ends import within_rows
from stages.init.dental.surface.options import OUTLINE_ERROR, SurfaceOptions
from stages.init.dental.surface.photos.photo import FullSize, Photo, at_full_size
from stages.init.dental.surface.photos.tissue import joined_to, without_fringes

Array32 = npt.NDArray[np.float32]
Mask = npt.NDArray[np.bool_]

#: The agreement found is smoothed over this length (mm).
_AGREEMENT_SMOOTHING = 0.4


@dataclass(frozen=True)
class SurfaceView:
    """The surface seen from one photograph.

    Attributes:
        depth: [H, W] float32 z in mm, 0 where there is no tooth or gum.
        normal: [H, W, 3] float32 unit vectors, arch frame; 0 where there is no depth.
        confidence: [H, W] float32 >= 1; exactly 1 where there is no depth.
    """

    depth: Array32
    normal: Array32
    confidence: Array32


@dataclass(frozen=True)
class Looked:
    """The finished charts, looked at.

    Attributes:
        photos: what is tooth and gum in each photograph, at the size that was worked at.
        shown: the same at the size that depths and colours are wanted in.
        nearest: per photograph the z-depth [h, w] of the nearest chart.
        clear: per chart where it is seen clearly, [H, W] bool; None: everywhere.
        flanks: per chart and photograph where metal stands before it, [H, W] bool; empty: nowhere.
        partial: the same of crowns that others show whole.
        charts: of the jaws.
        options: settings.
    """

    photos: list[Photo]
    shown: list[Photo]
    nearest: list[Array32]
    clear: list[Mask | None]
    flanks: list[list[Mask]]
    partial: list[list[Mask]]
    charts: list[Chart]
    options: SurfaceOptions

    def views_of(
        self, count: int, reach: list[Array32], threads: int
    ) -> tuple[SurfaceView | None, ...]:
        """One per photograph of so many, None where it was not placed; `_look` has `reach`."""
        looks = in_threads(lambda k: _look(k, self, reach), range(len(self.shown)), threads)
        views: list[SurfaceView | None] = [None] * count
        for photo, look in zip(self.photos, looks, strict=True):
            views[photo.index] = look
        return tuple(views)


def look_at(
    charts: list[Chart],
    photos: list[Photo],
    full: Sequence[FullSize | None],
    options: SurfaceOptions,
    threads: int,
) -> Looked:
    """What each photograph sees of the charts; their agreement is smoothed on the way."""
    nearest = nearest_depths(charts, photos, options.gum_height, threads)
    photos = uncovered(charts, photos, nearest, options, threads)
    photos = within_rows(charts, photos, nearest, options, threads)
    for chart in charts:
        sigma = _AGREEMENT_SMOOTHING * chart.grid.density
        smooth = cv2.GaussianBlur(chart.agreement, (0, 0), sigma)
        chart.agreement = np.asarray(smooth, np.float32)
    shown = [
        at_full_size(photo, whole) if full and (whole := full[photo.index]) else photo
        for photo in photos
    ]
    clear: list[Mask | None] = [None] * len(charts)
    if options.only_clear:
        clear[:] = in_threads(
            lambda chart: clearly_seen(chart, photos, nearest, options), charts, threads
        )
    flanks = [
        behind_flanks(chart, photos, comparable(chart, photos, nearest, options, -OUTLINE_ERROR))
        if chart.hardware
        else []
        for chart in charts
    ]
    partial = [
        partial_crowns(chart, photos, nearest, options, threads) if options.only_clear else []
        for chart in charts
    ]
    return Looked(photos, shown, nearest, clear, flanks, partial, charts, options)


def _look(number: int, looked: Looked, reach: list[Array32]) -> SurfaceView:
    """The surface as a photograph sees it: tooth where it shows tooth, gum where it shows gum.

    Args:
        number: of the photograph among those that were looked from.
        looked: the charts.
        reach: per chart [H, W] float32 0..1, gum ends where it is half; empty: as far as it is
            shown. What a fit is to explain must not go on where the cloud ends.
    """
    photo = looked.shown[number]
    depth = np.zeros(photo.size, np.float32)
    normal = np.zeros((*photo.size, 3), np.float32)
    agreement = np.zeros(photo.size, np.float32)
    own: dict[Jaw, Mask] = {
        "upper": (photo.upper > 0) | (photo.upper_gum > 0),
        "lower": (photo.lower > 0) | (photo.lower_gum > 0),
    }
    tissue = own["upper"] | own["lower"]
    certain = np.zeros(photo.size, bool)
    hidden = np.zeros(photo.size, bool)
    tooth = (photo.upper > 0) | (photo.lower > 0)
    unsaid = np.zeros(photo.size, bool)
    rims: Sequence[Array32 | None] = reach or [None] * len(looked.charts)
    for chart, seen, flanks, partial, rim in zip(
        looked.charts, looked.clear, looked.flanks, looked.partial, rims, strict=True
    ):
        z, place = raster_chart(
            photo, chart.points, chart.used(PAST_EDGE, looked.options.gum_height)
        )
        if seen is not None:
            z = z * at_places(seen, place)
        if rim is not None:
            z = z * (tooth | at_places(rim, place))
        mine = own[chart.shape.jaw]
        if flanks:
            hidden |= (z > 0) & at_places(flanks[number], place)
        if partial:
            unsaid |= (z > 0) & at_places(partial[number], place) & mine
        # The photograph itself says which jaw it shows; without a chart of that jaw, the other's.
        better = (z > 0) & tissue & ((depth == 0) | (z < depth)) & ~certain
        better |= (z > 0) & mine
        certain |= (z > 0) & mine
        normals = smooth_normals(chart.radius, chart.grid)
        x, y = np.ascontiguousarray(place[..., 0]), np.ascontiguousarray(place[..., 1])
        turned = np.asarray(cv2.remap(normals, x, y, cv2.INTER_LINEAR), np.float32)
        turned /= np.maximum(np.linalg.norm(turned, axis=-1, keepdims=True), 1e-9)
        agreed = np.asarray(cv2.remap(chart.agreement, x, y, cv2.INTER_LINEAR))
        depth = np.where(better, z, depth)
        normal = np.where(better[..., None], turned, normal)
        agreement = np.where(better, agreed, agreement)
    if hidden.any():
        depth *= ~(hidden & metal(photo))
    depth *= ~unsaid
    depth *= tooth | without_fringes(depth > 0, photo.density)
    depth *= joined_to(depth > 0, tooth)  # no crumbs of gum
    sure = confidence_of(agreement, looked.options.guess)
    confidence = np.where(depth > 0, sure, 1).astype(np.float32)
    normal *= (depth > 0)[..., None]
    return SurfaceView(depth, normal.astype(np.float32), confidence)
