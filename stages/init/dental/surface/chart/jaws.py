"""The charts of both jaws while they are worked on, and which photographs show what of them."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from pipeline.artifacts.dental.fdi import Jaw, is_upper, other_jaw, teeth_of
from pipeline.kernels.threads import in_threads
from stages.init.dental.solution import ArchFit
from stages.init.dental.surface.chart.crown_shape import (
    JawShape,
    beyond_crowns,
    crown_points,
    crown_radius,
    jaw_shape,
)
from stages.init.dental.surface.chart.grid import ChartGrid, grid_around, normals_of
from stages.init.dental.surface.chart.raster import nearest_of, raster_chart, sees
from stages.init.dental.surface.options import SurfaceOptions
from stages.init.dental.surface.photos.photo import Photo
from stages.init.dental.surface.photos.tissue import disc, without_fringes

Array32 = npt.NDArray[np.float32]
Mask = npt.NDArray[np.bool_]

#: The charts go on this far beyond the biting edges (mm): photographs may show their far side.
PAST_EDGE = 1.5
#: For hiding, less far: beyond its edge the surface is invented.
SOLID_PAST_EDGE = 0.3
#: A sample this far (mm) behind the nearest surface is hidden: more than rounding and the noise of
#: the surface, less than a tooth. Twice that while the surface is still being found.
HIDDEN = 0.8
#: A place is on a crown if that goes on around it for so far (mm), and it is not in a photograph
#: if that shows none so far around it. Landmarks of real photographs are off by .2 to .3 mm in the
#: median; the surface by as much.
WITHIN, APART = 0.5, 0.8
#: Confidence is 1 + exp(low + (high - low) * agreement), as the dense stereo gives it: low for a
#: guess (an option), high for a good match.
_SURE = 2.0
#: Smoothing of the normals that are given out, and of those that decide what faces a view (mm).
_NORMAL_SMOOTHING, FACING_SMOOTHING = 0.15, 1.5
#: And of those that decide how a photograph faces the row, not each side of its crowns: half a
#: tooth.
ROW_SMOOTHING = 4.5
#: From here to there beyond the gum line (mm) trust in matches fades: gum is wet, and highlights
#: move with the camera.
_GUM_FADES = (0.5, 2.0)
#: No tooth with the gum that goes with it is smaller (square mm; a lower incisor and 10 mm of gum).
_TOOTH_AND_GUM = 100.0


@dataclass
class Chart:
    """The chart of one jaw.

    Attributes:
        shape: the teeth it shows.
        grid: where its samples lie.
        radius: [H, W] float32 distance from the axis, mm.
        agreement: [H, W] float32 0..1: how well the photographs agree there.
        hardware: whether brackets and wires are fixed to its crowns.
    """

    shape: JawShape
    grid: ChartGrid
    radius: Array32
    agreement: Array32
    hardware: bool = False

    @property
    def points(self) -> Array32:
        """[H, W, 3] float32 positions, mm."""
        return self.grid.points(self.radius)

    def used(self, past_edge: float, past_gum: float) -> Mask:
        """[H, W] bool: no more than so many mm beyond the biting edges and the gum line."""
        gum, edge = beyond_crowns(self.grid, self.shape)
        return (gum < past_gum) & (edge < past_edge)

    def gum_fades(self, trust: float) -> Array32:
        """[H, W] float32: 1 on the crowns and beside them, `trust` on the gum further up."""
        gum, _ = beyond_crowns(self.grid, self.shape)
        share = np.clip((gum - _GUM_FADES[0]) / (_GUM_FADES[1] - _GUM_FADES[0]), 0, 1)
        return (1 - (1 - trust) * share).astype(np.float32)


def smooth_normals(
    radius: Array32, grid: ChartGrid, smoothing: float = _NORMAL_SMOOTHING
) -> Array32:
    """[H, W, 3] float32 unit normals of a chart's surface, smoothed over some mm."""
    smooth = cv2.GaussianBlur(radius, (0, 0), smoothing * grid.density)
    return normals_of(grid.points(np.asarray(smooth, np.float32)))


def confidence_of(agreement: Array32, guess: float) -> Array32:
    """Confidence > 1 as pointmap models give it, of an agreement in 0..1.

    Where nothing agrees it is 1 + exp(`guess`).
    """
    return (1 + np.exp(guess + (_SURE - guess) * np.clip(agreement, 0, 1))).astype(np.float32)


def teeth_present(fit: ArchFit) -> tuple[set[int], set[int]]:
    """Teeth that some photograph shows, and teeth that are missing between shown neighbours."""
    seen: set[int] = set()
    skipped: set[int] = set()
    jaws: tuple[Jaw, ...] = ("upper", "lower")
    for view, jaw in itertools.product(fit.views, jaws):
        if view is None:
            continue
        order, teeth = teeth_of(jaw), view.teeth(jaw)
        seen |= {tooth for tooth in teeth if tooth}
        for first, second in itertools.pairwise(teeth):
            if first and second:
                skipped |= set(order[order.index(first) + 1 : order.index(second)])
    return seen, skipped - seen


def start_chart(jaw: Jaw, fit: ArchFit, options: SurfaceOptions) -> Chart | None:
    """The chart of a jaw as the crown shapes have it; None if no photograph shows its teeth."""
    seen, missing = teeth_present(fit)
    seen = {tooth for tooth in seen if is_upper(tooth) == (jaw == "upper")}
    shape = jaw_shape(jaw, fit.shape, seen, missing)
    if shape is None:
        return None
    points = crown_points(shape, options.crown_bulge, options.crown_flatness, options.gum_height)
    up = shape.gumwards
    heights = np.array([point[1] for _, point in sorted(shape.landmarks.items())]) * up
    ends = (heights.min() - PAST_EDGE) * up, (heights.max() + options.gum_height) * up
    around = points.copy()
    around[:, 1] = np.clip(around[:, 1], min(ends), max(ends))
    grid = grid_around(around, 1.0, options.chart_density)
    radius = crown_radius(grid, points, options.crown_smoothing)
    return Chart(shape, grid, radius, np.zeros(grid.shape, np.float32))


def nearest_depths(
    charts: list[Chart], photos: list[Photo], gum: float, threads: int
) -> list[Array32]:
    """Per photograph the z-depth [h, w] of the nearest chart: what hides what.

    Where a photograph shows one jaw the other one hides nothing: its chart goes on beyond its
    edges, and past the notches between crowns, over what is seen below them.
    """
    meshes = [(chart.shape.jaw, chart.points, chart.used(SOLID_PAST_EDGE, gum)) for chart in charts]

    def nearest(photo: Photo) -> Array32:
        depths = []
        for jaw, points, used in meshes:
            depth = raster_chart(photo, points, used)[0]
            other = other_jaw(jaw)
            depth[(photo.tooth_of(other) > 0) | (photo.gum_of(other) > 0)] = 0
            depths.append(depth)
        return nearest_of(depths)

    return in_threads(nearest, photos, threads)


def facing(photo: Photo, points: Array32, normals: Array32) -> Array32:
    """[H, W] float32 cosine between normals and the lines of sight."""
    line = photo.centre.astype(np.float32) - points
    length = np.linalg.norm(line, axis=-1)
    return np.asarray((line * normals).sum(-1) / np.maximum(length, 1e-6), np.float32)


def comparable(
    chart: Chart,
    photos: list[Photo],
    nearest: list[Array32],
    options: SurfaceOptions,
    inset: float,
) -> npt.NDArray[np.bool_]:
    """[V, H, W] bool: samples of a chart that a photograph shows well enough to compare.

    Args:
        inset: how far within the jaw's tissue they have to lie (mm); below 0: how far beyond it
            they may.
    """
    points = chart.points
    normals = smooth_normals(chart.radius, chart.grid, FACING_SMOOTHING)
    used = chart.used(PAST_EDGE, options.gum_height)
    masks = []
    for photo, front in zip(photos, nearest, strict=True):
        tissue = _tissue_within(photo, chart.shape.jaw, inset)
        shown = photo.sample(tissue, photo.project(points)[0]) > 0.5
        faces = facing(photo, points, normals) > options.least_facing
        masks.append(used & shown & faces & sees(photo, front, points, 2 * HIDDEN))
    return np.stack(masks)


def clearly_seen(
    chart: Chart,
    photos: list[Photo],
    nearest: list[Array32],
    options: SurfaceOptions,
) -> Mask:
    """[H, W] bool: samples of a chart that some photograph shows, and not at too low an angle.

    Where another photograph faces the row better and yet does not show it, because it ends there or
    a lip is before it, the angle must be better: what is left beyond is drawn out, and in crumbs.
    The rim is even, and pieces too small for a tooth and its gum are left out.
    """
    points = chart.points
    normals = smooth_normals(chart.radius, chart.grid, ROW_SMOOTHING)
    faces = np.stack([facing(photo, points, normals) for photo in photos])
    best = faces == faces.max(axis=0)
    clear = np.zeros(chart.grid.shape, bool)
    for photo, front, cosine, first in zip(photos, nearest, faces, best, strict=True):
        free = photo.valid & (photo.covered == 0) & (photo.void == 0)
        shown = photo.sample(free.astype(np.float32), photo.project(points)[0]) > 0.5
        least = np.where(first, options.least_showing, options.least_beside)
        clear |= shown & (cosine > least) & sees(photo, front, points, 2 * HIDDEN)
    clear = without_fringes(clear, chart.grid.density)
    used = chart.used(PAST_EDGE, options.gum_height)
    return clear & ~_scraps(clear & used, chart.grid.density)


def _scraps(mask: Mask, density: float) -> Mask:
    """[H, W] bool: pieces of a mask [H, W] that are too small for a tooth and its gum.

    The largest piece is none of them.
    """
    count, label = cv2.connectedComponents(mask.astype(np.uint8), connectivity=4)
    area = np.bincount(label[mask], minlength=count)
    return mask & (area < min(_TOOTH_AND_GUM * density**2, area.max()))[label]


def _tissue_within(photo: Photo, jaw: Jaw, inset: float) -> Array32:
    """[h, w] float32: this jaw's teeth and gum less so many mm of their rim, or more."""
    tissue = np.maximum(photo.tooth_of(jaw), photo.gum_of(jaw))
    if inset == 0:
        return tissue
    change = cv2.erode if inset > 0 else cv2.dilate
    return np.asarray(change(tissue, disc(abs(inset) * photo.density)), np.float32)
