"""One coloured cloud, and a mesh, from the charts of both jaws."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from pipeline.kernels.threads import in_threads
from stages.init.dental.surface.chart.crown_shape import beyond_crowns, within_crowns
from stages.init.dental.surface.chart.grid import ChartGrid, faces_of
from stages.init.dental.surface.chart.jaws import (
    HIDDEN,
    PAST_EDGE,
    Chart,
    confidence_of,
    facing,
    smooth_normals,
)
from stages.init.dental.surface.chart.raster import raster_chart, sees
from stages.init.dental.surface.colour import (
    Showing,
    blend,
    even_rim,
    find_gains,
    find_tissue,
    hidden_edges,
    photo_weights,
    show,
    spread_colour,
)
from stages.init.dental.surface.options import SurfaceOptions
from stages.init.dental.surface.photos.photo import Photo

Array32 = npt.NDArray[np.float32]
Array64 = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]

#: A jaw covers what lies this far (mm) behind it.
_COVERED = 0.3
#: Cosine from which a sample is said to face a photograph.
_FACES = 0.15


@dataclass(frozen=True)
class Cloud:
    """See `ArchSurface`; gains [V, 3] are those of the photographs used.

    Per chart `reach` [H, W] float32 0..1 is the share of a sample's surroundings that is kept.
    """

    positions: Array32
    colors: Array32
    normals: Array32
    confidence: Array32
    tooth: Mask
    faces: npt.NDArray[np.int32]
    gains: Array64
    reach: list[Array32]


@dataclass(frozen=True)
class _Layer:
    """A chart at the cloud's density, with what the photographs show of it."""

    chart: Chart
    grid: ChartGrid
    points: Array32
    normals: Array32
    kept: Mask
    tooth: Array32
    showings: list[Showing]
    weights: list[Array32]


def coloured_cloud(
    charts: list[Chart],
    photos: list[Photo],
    shown: list[Photo],
    nearest: list[Array32],
    clear: list[Mask | None],
    anchor: int,
    options: SurfaceOptions,
    threads: int,
) -> Cloud:
    """Cut the charts to tooth and gum and take their colour from the photographs.

    Args:
        charts: of the jaws.
        photos: the photographs, to tell what hides what.
        shown: the same at the size that colours are taken from.
        nearest: per photograph the z-depth [h, w] of the nearest chart.
        clear: per chart where it may be kept, [H, W] bool; None: everywhere.
        anchor: the photograph whose exposure the others are brought to.
        options: settings.
        threads: number of threads.
    """
    layers = [
        _layer(chart, photos, shown, nearest, seen, options, threads)
        for chart, seen in zip(charts, clear, strict=True)
    ]
    gains = find_gains(
        [[showing.colour for showing in layer.showings] for layer in layers],
        [layer.weights for layer in layers],
        anchor,
    )
    parts: list[tuple[npt.NDArray[np.generic], ...]] = []
    start, reach = 0, []
    for layer in layers:
        colours = [showing.colour for showing in layer.showings]
        colour, total = blend(colours, layer.weights, gains, layer.grid.density)
        coloured = layer.kept & (total > 0)
        behind = _behind_other_jaw(layer, charts, photos, threads)
        crowns = behind & within_crowns(layer.grid, layer.chart.shape)
        seen_tooth = coloured & (layer.tooth > 0.5)
        hidden = hidden_edges(seen_tooth, crowns, layer.grid.density, options.hidden_edge)
        hidden &= ~coloured
        colour = spread_colour(colour, coloured)
        kept = coloured | hidden
        agreement = layer.chart.grid.resample(layer.chart.agreement, layer.grid)
        agreement = np.where(hidden, 0, agreement).astype(np.float32)
        reach.append(layer.grid.resample(kept.astype(np.float32), layer.chart.grid))
        number = np.cumsum(kept.ravel()) - 1 + start
        start += int(kept.sum())
        parts.append(
            (
                layer.points[kept],
                colour[kept],
                layer.normals[kept],
                confidence_of(agreement[kept], options.guess),
                (seen_tooth | hidden)[kept],
                number[faces_of(kept)].astype(np.int32),
            )
        )
    joined = [np.concatenate([part[k] for part in parts]) for k in range(6)]
    return Cloud(
        positions=joined[0].astype(np.float32),
        colors=joined[1].astype(np.float32),
        normals=joined[2].astype(np.float32),
        confidence=joined[3].astype(np.float32),
        tooth=joined[4].astype(bool),
        faces=joined[5].astype(np.int32),
        gains=gains,
        reach=reach,
    )


def _layer(
    chart: Chart,
    photos: list[Photo],
    shown: list[Photo],
    nearest: list[Array32],
    clear: Mask | None,
    options: SurfaceOptions,
    threads: int,
) -> _Layer:
    grid = chart.grid.resized(1 / options.cloud_spacing)
    radius = chart.grid.resample(chart.radius, grid)
    points, normals = grid.points(radius), smooth_normals(radius, grid)
    jaw = chart.shape.jaw

    def look(item: tuple[Photo, Photo, Array32]) -> Showing:
        photo, full, front = item
        seen = sees(photo, front, points, HIDDEN)
        return show(full, jaw, points, seen, facing(photo, points, normals))

    showings = in_threads(look, zip(photos, shown, nearest, strict=True), threads)
    gum, edge = beyond_crowns(grid, chart.shape)
    allowed = (gum < options.gum_height) & (edge < PAST_EDGE)
    if clear is not None:
        allowed &= chart.grid.resample(clear.astype(np.float32), grid) > 0.5
    kept, tooth = find_tissue(showings, grid.density, options.rim_smoothing, options.least_showing)
    kept = even_rim(kept & allowed, tooth > 0.5, gum, grid.density)
    weights = photo_weights(showings, kept, grid.density, options.colour_power)
    return _Layer(chart, grid, points, normals, kept, tooth, showings, weights)


def _behind_other_jaw(
    layer: _Layer, charts: list[Chart], photos: list[Photo], threads: int
) -> Mask:
    """[H, W] bool: samples that face some photograph, but are always behind the other jaw."""
    others = [(c.points, c.used(PAST_EDGE, 0)) for c in charts if c is not layer.chart]

    def covered(photo: Photo) -> tuple[Mask, Mask]:
        nothing = np.zeros(photo.size, np.float32)
        inside = sees(photo, nothing, layer.points, 0)
        inside &= facing(photo, layer.points, layer.normals) > _FACES
        hidden = np.zeros(inside.shape, bool)
        for points, used in others:
            front = raster_chart(photo, points, used)[0]
            hidden |= inside & ~sees(photo, front, layer.points, _COVERED)
        return inside, hidden

    found = in_threads(covered, photos, threads)
    faced = np.any([inside for inside, _ in found], axis=0)
    seen = np.any([inside & ~hidden for inside, hidden in found], axis=0)
    return np.asarray(faced & ~seen)
