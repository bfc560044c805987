"""The dense surface of the teeth, from a few wide photographs with known cameras.

One chart per jaw: the crown shapes between their landmarks, swept until the photographs agree,
coloured once from all photographs, and seen from each of them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from threadpoolctl import threadpool_limits

from pipeline.artifacts.dental.fdi import Jaw
from pipeline.artifacts.teeth import Dentition
from pipeline.kernels import kernel_threads
from pipeline.kernels.threads import in_threads
from stages.init.dental.solution import ArchFit
from stages.init.dental.surface.chart.hardware import (
    free_of_hardware,
    raise_hardware,
    shows_hardware,
)
from stages.init.dental.surface.chart.jaws import (
    PAST_EDGE,
    Chart,
    comparable,
    nearest_depths,
    start_chart,
)
from stages.init.dental.surface.chart.looks import SurfaceView, look_at
from stages.init.dental.surface.cloud import coloured_cloud
from stages.init.dental.surface.grow import grow_gum
from stages.init.dental.surface.measured import bend_to
from stages.init.dental.surface.options import OUTLINE_ERROR, SurfaceOptions, SweepRound
from stages.init.dental.surface.photos.photo import FullSize, Photo, prepare_photo
from stages.init.dental.surface.sweep import choose_pairs, sweep

Array32 = npt.NDArray[np.float32]
Array64 = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]
Progress = Callable[[str, int, int], None]


@dataclass(frozen=True)
class ArchSurface:
    """The dense surface of both jaws, in the arch frame (mm).

    Attributes:
        views: one per photograph, None where it was not placed.
        positions: [N, 3] float32.
        colors: [N, 3] float32 sRGB in 0..1.
        normals: [N, 3] float32 unit vectors.
        confidence: [N] float32 >= 1.
        tooth: [N] bool: on a crown, not on the gum.
        faces: [F, 3] int32 triangles over the positions, counter-clockwise from outside.
        gains: [V, 3] float64 factors that were applied to each photograph's colour (1 where None).
    """

    views: tuple[SurfaceView | None, ...]
    positions: Array32
    colors: Array32
    normals: Array32
    confidence: Array32
    tooth: Mask
    faces: npt.NDArray[np.int32]
    gains: Array64


def dense_surface(
    images: list[Array32],
    valid: list[Mask],
    dentitions: list[Dentition | None],
    fit: ArchFit,
    options: SurfaceOptions | None = None,
    threads: int = 1,
    progress: Progress = lambda step, done, total: None,
    full: Sequence[FullSize | None] = (),
) -> ArchSurface:
    """Reconstruct the crowns and a strip of gum from a few wide photographs with known cameras.

    Args:
        images: [H, W, 3] float32 sRGB in 0..1; sizes may differ.
        valid: [H, W] bool per image: where it may be used.
        dentitions: what each photograph shows; None is skipped.
        fit: cameras, labels and the arch's shape.
        options: settings.
        threads: number of threads; does not change the result.
        progress: called with (step, done, total).
        full: the photographs at the size in which depths and colours are wanted, where that is
            another one.

    Raises:
        ValueError: lists of different length, sizes that don't agree, or no placed photograph.
    """
    options = options or SurfaceOptions()
    steps = 3 + len(options.rounds)
    with kernel_threads(threads), threadpool_limits(limits=1, user_api="blas"):
        progress("photographs", 0, steps)
        start = started_surface(images, valid, dentitions, fit, options, threads)
        photos, charts = start.photos, start.charts
        pairs = choose_pairs(photos, start.middle, options)
        near = replace(options, gum_height=min(options.gum_height, options.grow_from))
        for number, settings in enumerate(options.rounds if pairs else ()):
            progress("sweep", 2 + number, steps)
            _sweep(charts, photos, pairs, settings, near, threads, first=number == 0)
        if pairs and options.rounds and options.gum_height > options.grow_from:
            grow_gum(charts, photos, pairs, options, threads)
            _sweep(charts, photos, pairs, options.rounds[-1], options, threads)
        _raise(charts, photos, pairs, options, threads)
        progress("colour", steps - 1, steps)
        looked = look_at(charts, photos, full, options, threads)
        cloud = coloured_cloud(
            charts, looked.photos, looked.shown, looked.nearest, looked.clear,
            _anchor(photos, fit), options, threads,
        )  # fmt: skip
        views = looked.views_of(len(images), cloud.reach, threads)
        progress("colour", steps, steps)
    gains = np.ones((len(images), 3))
    for photo, gain in zip(photos, cloud.gains, strict=True):
        gains[photo.index] = gain
    return ArchSurface(
        views=views,
        positions=cloud.positions,
        colors=cloud.colors,
        normals=cloud.normals,
        confidence=cloud.confidence,
        tooth=cloud.tooth,
        faces=cloud.faces,
        gains=gains,
    )


@dataclass(frozen=True)
class StartedSurface:
    """The surface before anything has been measured of it.

    Attributes:
        photos: the photographs that were placed, prepared.
        charts: the jaws, as the crown shapes have them.
        middle: [3] of the landmarks, mm.
        count: number of photographs.
        options: settings.
    """

    photos: list[Photo]
    charts: list[Chart]
    middle: Array64
    count: int
    options: SurfaceOptions


def started_surface(
    images: list[Array32],
    valid: list[Mask],
    dentitions: list[Dentition | None],
    fit: ArchFit,
    options: SurfaceOptions,
    threads: int,
) -> StartedSurface:
    """Crown shapes between their landmarks; arguments and errors as for `dense_surface`."""
    if not len(images) == len(valid) == len(dentitions) == len(fit.views):
        raise ValueError(
            f"the surface needs one image, mask, dentition and camera per photograph, not "
            f"{len(images)}, {len(valid)}, {len(dentitions)} and {len(fit.views)}"
        )
    if not fit.shape:
        raise ValueError("the arch has no landmarks, so that there is no surface to make")
    middle = np.mean([fit.shape[mark] for mark in sorted(fit.shape)], axis=0)
    photos = _prepare(images, valid, dentitions, fit, middle, threads)
    jaws: tuple[Jaw, ...] = ("upper", "lower")
    started = in_threads(lambda jaw: start_chart(jaw, fit, options), jaws, threads)
    charts = [chart for chart in started if chart]
    if not photos or not charts:
        raise ValueError(
            "no photograph was placed with a named tooth, so that there is no surface to make; see "
            "the labelled overlay of the crowns and pass --set init.dental.order or FDI hints"
        )
    return StartedSurface(photos, charts, middle, len(images), options)


def completed_surface(
    start: StartedSurface, depths: list[Array32], threads: int, full: Sequence[FullSize | None]
) -> tuple[SurfaceView | None, ...]:
    """Crowns and gum as they go on from depth that is measured, seen from each photograph.

    Args:
        start: the crown shapes; they are bent in place.
        depths: [H, W] float32 z-depth of each image in mm, 0 where unknown.
        threads, full: as for `dense_surface`.

    Raises:
        ReconstructionError: what is measured lies elsewhere than the crowns.
    """
    with kernel_threads(threads), threadpool_limits(limits=1, user_api="blas"):
        measured = [depths[photo.index] for photo in start.photos]
        bend_to(start.charts, start.photos, measured, start.options, threads)
        looked = look_at(start.charts, start.photos, full, start.options, threads)
        return looked.views_of(start.count, [], threads)


def _sweep(
    charts: list[Chart],
    photos: list[Photo],
    pairs: list[list[int]],
    settings: SweepRound,
    options: SurfaceOptions,
    threads: int,
    first: bool = False,
) -> None:
    """One round over all charts, in place; the first one looks for brackets as well."""
    nearest = nearest_depths(charts, photos, options.gum_height, threads)

    @kernel_threads(threads)  # of the thread that it runs in
    def swept(chart: Chart) -> None:
        shown = comparable(chart, photos, nearest, options, settings.inset)
        trust = chart.gum_fades(options.gum_trust)
        if first:
            chart.hardware = shows_hardware(chart, photos, shown, pairs)
        if chart.hardware:
            trust = trust * free_of_hardware(chart, photos, shown)
        found = sweep(
            chart.grid, chart.radius, photos, shown, pairs, trust,
            chart.used(PAST_EDGE, options.gum_height), settings, options,
        )  # fmt: skip
        chart.radius, chart.agreement = found.radius, found.weight

    in_threads(swept, charts, threads)


def _raise(
    charts: list[Chart],
    photos: list[Photo],
    pairs: list[list[int]],
    options: SurfaceOptions,
    threads: int,
) -> None:
    """Brackets and wires stand out before the crowns of the charts that have some, in place."""
    if any(chart.hardware for chart in charts):
        nearest = nearest_depths(charts, photos, options.gum_height, threads)
        for chart in charts:
            if chart.hardware:
                seen = comparable(chart, photos, nearest, options, -OUTLINE_ERROR)
                raise_hardware(chart, photos, seen, pairs)


def _anchor(photos: list[Photo], fit: ArchFit) -> int:
    """The photograph whose exposure the others are brought to: the frontal one, if there is one."""
    roles = [view.role if view else "" for view in (fit.views[photo.index] for photo in photos)]
    return roles.index("frontal") if "frontal" in roles else len(roles) // 2


def _prepare(
    images: list[Array32],
    valid: list[Mask],
    dentitions: list[Dentition | None],
    fit: ArchFit,
    middle: Array64,
    threads: int,
) -> list[Photo]:
    placed = [
        (k, dentition, view)
        for k, (dentition, view) in enumerate(zip(dentitions, fit.views, strict=True))
        if dentition is not None and view is not None
    ]
    return in_threads(
        lambda item: prepare_photo(
            item[0], images[item[0]], valid[item[0]], item[1], item[2], middle,
        ),
        placed,
        threads,
    )  # fmt: skip
