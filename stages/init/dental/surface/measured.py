"""Charts bent to depth that is measured already: crowns and gum go on beyond it as they have to.

Dense stereo measures what two photographs show; the flanks of a mouth only one of them shows. There
the crown shapes go on from what is measured, smoothly and outside of every silhouette.
"""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt

from pipeline.errors import ReconstructionError
from pipeline.kernels import kernel_threads
from pipeline.kernels.threads import in_threads
from stages.init.dental.surface.carve import carved, in_void
from stages.init.dental.surface.chart.grid import MEAN_RADIUS, ChartGrid, unroll
from stages.init.dental.surface.chart.jaws import PAST_EDGE, Chart
from stages.init.dental.surface.fit import fit_offsets
from stages.init.dental.surface.options import SurfaceOptions
from stages.init.dental.surface.photos.photo import Photo

Array32 = npt.NDArray[np.float32]

#: Depth further than this (mm) from the crown shapes is not of the crowns and their gum.
_REACH, _STEP = 8.0, 0.15
#: Nor are they crowns that lie this far from it (mm) in the median; right ones do by up to 1.
_ELSEWHERE = 2.0
#: Of the fit to it (`SweepRound.stiffness`).
_STIFFNESS = 4.0


def bend_to(
    charts: list[Chart],
    photos: list[Photo],
    depths: list[Array32],
    options: SurfaceOptions,
    threads: int = 1,
) -> None:
    """Bend the charts, in place, to what is measured; `Chart.agreement` says where that is.

    Args:
        charts: of the jaws, as the crown shapes have them.
        photos: the photographs.
        depths: of each photograph [h, w] float32 z-depth in mm, 0 where unknown.
        options: settings.
        threads: number of threads; does not change the result.

    Raises:
        ReconstructionError: it lies elsewhere than the crowns.
    """
    count = round(_REACH / _STEP)
    steps = (np.arange(-count, count + 1) * _STEP).astype(np.float32)

    @kernel_threads(threads)  # of the thread that it runs in
    def bent(chart: Chart) -> tuple[Array32, Array32]:
        offset, weight = _measured(chart, photos, depths)
        crowns = chart.used(0, 0) & (weight > 0)
        if crowns.any() and abs(float(np.median(offset[crowns]))) > _ELSEWHERE:
            raise ReconstructionError(
                f"The {chart.shape.jaw} crowns would lie {np.median(offset[crowns]):.1f} mm from "
                "the depth that is measured there."
            )
        smooth = offset, weight, _STIFFNESS, options.anchor, options.outlier
        if not options.carve:
            return fit_offsets(*smooth), weight
        unmatched = chart.used(PAST_EDGE, options.gum_height) & (weight == 0)
        void = in_void(chart.points, _outwards(chart.grid), steps, photos)
        return carved(*smooth, void & unmatched[..., None], steps), weight

    for chart, (bend, weight) in zip(charts, in_threads(bent, charts, threads), strict=True):
        chart.radius, chart.agreement = chart.radius + bend, weight


def _measured(chart: Chart, photos: list[Photo], depths: list[Array32]) -> tuple[Array32, Array32]:
    """Offset [H, W] mm of what is measured from the chart, along its radius, and 1 where it is."""
    rows, cols = chart.grid.shape
    total, count = np.zeros(rows * cols), np.zeros(rows * cols)
    for photo, depth in zip(photos, depths, strict=True):
        jaw = chart.shape.jaw
        own = (photo.tooth_of(jaw) > 0) | (photo.gum_of(jaw) > 0)
        arc, radius, height = _unrolled(photo, np.where(own, depth, 0).astype(np.float32))
        column = np.rint((arc - chart.grid.left) * chart.grid.density).astype(np.int64)
        row = np.rint((chart.grid.top - height) * chart.grid.density).astype(np.int64)
        inside = (column >= 0) & (column < cols) & (row >= 0) & (row < rows)
        cell = row[inside] * cols + column[inside]
        off = radius[inside] - chart.radius.ravel()[cell]
        near = np.abs(off) < _REACH
        total += np.bincount(cell[near], off[near], rows * cols)
        count += np.bincount(cell[near], minlength=rows * cols)
    # A pixel says something of all samples that it covers.
    covered = int(np.ceil(chart.grid.density / min(photo.density for photo in photos))) | 1
    mean, share = (
        np.asarray(cv2.blur(values.reshape(rows, cols), (covered, covered)))
        for values in (total, count)
    )
    known = share > 0.5 / covered**2
    offset = np.where(known, mean / np.maximum(share, 1e-9), 0)
    return offset.astype(np.float32), known.astype(np.float32)


def _unrolled(photo: Photo, depth: Array32) -> tuple[npt.NDArray[np.float64], ...]:
    """Arc length, distance from the axis and height [N] mm of the pixels that have depth."""
    row, column = np.nonzero(depth)
    z = depth[row, column].astype(np.float64)
    middle = photo.camera[13:15]
    x, y = ((at + 0.5 - c) / photo.camera[12] for at, c in zip((column, row), middle, strict=True))
    local = np.stack([x * z, y * z, z], axis=-1) - photo.camera[9:12]
    points = local @ photo.camera[:9].reshape(3, 3)
    return (*unroll(points), points[:, 1])


def _outwards(grid: ChartGrid) -> Array32:
    """[H, W, 3] unit vectors from the axis to the samples of a chart."""
    angle = (grid.arcs / MEAN_RADIUS).astype(np.float32)
    out = np.stack([np.sin(angle), np.zeros_like(angle), np.cos(angle)], axis=-1)
    return np.ascontiguousarray(np.broadcast_to(out, (*grid.shape, 3)))
