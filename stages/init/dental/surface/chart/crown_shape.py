"""Crowns of a jaw as bumps between their landmarks: the surface where photographs say nothing."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import numpy.typing as npt
from scipy.interpolate import RBFInterpolator

from pipeline.artifacts.dental.fdi import Jaw, teeth_of
from stages.init.dental.landmarks import Landmark
from stages.init.dental.surface.chart.grid import AXIS_DEPTH, ChartGrid, unroll
from stages.init.dental.template import GUM_STEPS

Array32 = npt.NDArray[np.float32]
Array64 = npt.NDArray[np.float64]

#: Positions across a crown (-1 and 1: where it meets its neighbours) and along it (0: zenith, 1:
#: tip) at which points are set.
_ACROSS = (-0.85, -0.6, -0.3, 0.0, 0.3, 0.6, 0.85)
_ALONG = (0.12, 0.35, 0.6, 0.85)
#: Where between zenith and tip a crown bulges most, and how wide the bulge is: the height of
#: contour lies in the third next to the gum.
_CONTOUR, _CONTOUR_WIDTH = 0.35, 0.35
#: Beyond the tip the surface turns inwards: mm past the tip, mm inwards.
_TIP_STEP = (3.0, 0.8)
#: The spline is evaluated on a grid so many times coarser: it has no finer detail.
_COARSER = 4


@dataclass(frozen=True)
class JawShape:
    """Landmarks of one jaw, ordered along the arch.

    Attributes:
        jaw: upper or lower.
        teeth: FDI numbers that the jaw has (missing ones left out), from the patient's right.
        landmarks: those of these teeth.
    """

    jaw: Jaw
    teeth: tuple[int, ...]
    landmarks: dict[Landmark, Array64]

    @property
    def gumwards(self) -> float:
        """Sign of y from the biting edges to the gum."""
        return 1.0 if self.jaw == "upper" else -1.0

    def boundary(self, first: int, second: int) -> tuple[Array64, Array64] | None:
        """Papilla and embrasure between two teeth."""
        papilla = self.landmarks.get(Landmark("papilla", first, second))
        embrasure = self.landmarks.get(Landmark("embrasure", first, second))
        return None if papilla is None or embrasure is None else (papilla, embrasure)

    def line(self, *kinds: str) -> tuple[Array64, Array64]:
        """Arc lengths, rising, and heights of the landmarks of some kinds."""
        points = np.array([p for mark, p in sorted(self.landmarks.items()) if mark.kind in kinds])
        arc, _ = unroll(points)
        order = np.argsort(arc, kind="stable")
        return arc[order], points[order, 1]


def jaw_shape(
    jaw: Jaw, shape: dict[Landmark, Array64], seen: set[int], missing: set[int]
) -> JawShape | None:
    """The teeth of a jaw that a surface is made for.

    Args:
        jaw: upper or lower.
        shape: every landmark of the arch, mm.
        seen: FDI numbers that a photograph shows.
        missing: FDI numbers known to be missing.

    Returns:
        The teeth from the first to the last seen, one more on either end (which may show in part),
        without the missing ones; None if none is seen.
    """
    order = teeth_of(jaw)
    places = [k for k, tooth in enumerate(order) if tooth in seen]
    if not places:
        return None
    teeth = order[max(places[0] - 1, 0) : places[-1] + 2]
    kept = tuple(
        tooth
        for tooth in teeth
        if tooth not in missing
        and Landmark("zenith", tooth) in shape
        and Landmark("tip", tooth) in shape
    )
    landmarks = {
        mark: np.asarray(point, np.float64)
        for mark, point in shape.items()
        if mark.tooth in kept and (mark.neighbour == 0 or mark.neighbour in kept)
    }
    return JawShape(jaw, kept, landmarks) if kept else None


def outward(point: Array64) -> Array64:
    """Unit vector from the chart's axis through a point [3]."""
    direction = np.array([point[0], 0.0, point[2] + AXIS_DEPTH])
    return direction / max(float(np.linalg.norm(direction)), 1e-9)


def crown_points(
    shape: JawShape, bulge: float, flatness: float, gum_height: float = 0.0
) -> Array64:
    """Points [N, 3] on the outer faces of a jaw's crowns and on the gum beyond them, mm.

    The gum goes on straight to `gum_height` where that is further than it usually bends.
    """
    points = [point for _, point in sorted(shape.landmarks.items())]
    steps = list(GUM_STEPS)
    if gum_height > steps[-1][0]:
        steps.append((gum_height, steps[-1][1]))
    for k, tooth in enumerate(shape.teeth):
        zenith = shape.landmarks[Landmark("zenith", tooth)]
        tip = shape.landmarks[Landmark("tip", tooth)]
        out = outward(zenith)
        up = np.array([0.0, shape.gumwards, 0.0])
        points += [zenith + up * rise + out * step for rise, step in steps]
        points.append(tip - up * _TIP_STEP[0] - outward(tip) * _TIP_STEP[1])
        right = shape.boundary(shape.teeth[k - 1], tooth) if k > 0 else None
        left = shape.boundary(tooth, shape.teeth[k + 1]) if k + 1 < len(shape.teeth) else None
        points += _bump(zenith, tip, right, left, out, bulge, flatness)
    return np.array(points)


def _bump(
    zenith: Array64,
    tip: Array64,
    right: tuple[Array64, Array64] | None,
    left: tuple[Array64, Array64] | None,
    out: Array64,
    bulge: float,
    flatness: float,
) -> list[Array64]:
    """Points on one crown between its boundaries (papilla, embrasure) on both sides."""
    if right is None and left is None:
        return []
    if right is None:
        right = _mirrored(left, zenith, tip, out)  # type: ignore[arg-type]
    if left is None:
        left = _mirrored(right, zenith, tip, out)
    points = []
    for along in _ALONG:
        middle = zenith + (tip - zenith) * along
        middle = middle + out * bulge * np.exp(-(((along - _CONTOUR) / _CONTOUR_WIDTH) ** 2))
        for across in _ACROSS:
            papilla, embrasure = right if across < 0 else left
            edge = papilla + (embrasure - papilla) * along
            share = abs(across)
            point = middle * (1 - share) + edge * share
            # As deep as the middle, less a part of the fall to the edge.
            point = point + out * ((middle - point) @ out)
            point = point - out * ((middle - edge) @ out) * share**flatness
            point[1] = middle[1] * (1 - share) + edge[1] * share
            points.append(point)
    return points


def _mirrored(
    boundary: tuple[Array64, Array64], zenith: Array64, tip: Array64, out: Array64
) -> tuple[Array64, Array64]:
    """The boundary on the other side of a crown, in the plane through its axis facing outwards."""
    along = np.array([out[2], 0.0, -out[0]])
    centre = (zenith + tip) / 2
    papilla, embrasure = (p - 2 * along * ((p - centre) @ along) for p in boundary)
    return papilla, embrasure


def crown_radius(grid: ChartGrid, points: Array64, smoothing: float) -> Array32:
    """Radius [H, W] float32 of a chart by a smoothing thin-plate spline through points [N, 3]."""
    arc, radius = unroll(points)
    spline = RBFInterpolator(
        np.column_stack([arc, points[:, 1]]),
        radius,
        smoothing=smoothing,
        kernel="thin_plate_spline",
    )
    coarse = grid.resized(grid.density / _COARSER)
    # One more row and column, so that the coarse grid reaches past the fine one.
    coarse = ChartGrid(
        coarse.left, coarse.top, coarse.density, (coarse.shape[0] + 1, coarse.shape[1] + 1)
    )
    arcs, heights = np.meshgrid(coarse.arcs, coarse.heights)
    values = spline(np.column_stack([arcs.ravel(), heights.ravel()])).reshape(coarse.shape)
    return coarse.resample(values.astype(np.float32), grid)


def beyond_crowns(grid: ChartGrid, shape: JawShape) -> tuple[Array32, Array32]:
    """How far each sample of a chart lies beyond the crowns.

    Returns:
        mm beyond the gum line and mm beyond the line of the biting edges, [H, W] float32 each;
        negative on the crowns' side.
    """
    up = shape.gumwards
    gum = np.interp(grid.arcs, *shape.line("zenith"))
    edge = np.interp(grid.arcs, *shape.line("tip"))
    height = grid.heights[:, None]
    return (
        (up * (height - gum[None])).astype(np.float32),
        (-up * (height - edge[None])).astype(np.float32),
    )


def within_crowns(grid: ChartGrid, shape: JawShape) -> npt.NDArray[np.bool_]:
    """[H, W] bool: between the zeniths and the biting edges with the notches between them."""
    up = shape.gumwards
    gum = np.interp(grid.arcs, *shape.line("zenith"))
    edge = np.interp(grid.arcs, *shape.line("tip", "embrasure"))
    height = grid.heights[:, None]
    return (up * (height - gum[None]) < 0) & (up * (height - edge[None]) > 0)


def tooth_of_columns(grid: ChartGrid, shape: JawShape) -> npt.NDArray[np.int32]:
    """[W] FDI number of the tooth that each column of a chart goes through; 0 beside the row.

    Teeth end midway between papilla and embrasure, the first and the last one as far from its
    middle as it begins.
    """
    middles = [
        float(
            unroll(
                np.array([shape.landmarks[Landmark(kind, tooth)] for kind in ("zenith", "tip")])
            )[0].mean()
        )
        for tooth in shape.teeth
    ]
    bounds = [np.nan]
    for (one, two), around in zip(pairwise(shape.teeth), pairwise(middles), strict=True):
        edge = shape.boundary(one, two)
        bounds.append(float(np.mean(around if edge is None else unroll(np.array(edge))[0])))
    if len(bounds) == 1:
        return np.full(len(grid.arcs), shape.teeth[0], np.int32)
    bounds = [2 * middles[0] - bounds[1], *bounds[1:], 2 * middles[-1] - bounds[-1]]
    place = np.searchsorted(bounds, grid.arcs)
    return np.array([0, *shape.teeth, 0], np.int32)[place]
