"""Dense matches between photographs on the unrolled arch.

Where photographs are 40 degrees apart no feature matches; unrolled onto the surface through the
landmarks they look nearly alike, and optical flow finds what is left between them.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import cv2
import numpy as np
import numpy.typing as npt
from threadpoolctl import threadpool_limits

from pipeline.artifacts.dental.fdi import is_upper
from pipeline.geometry.rigid import skew
from pipeline.kernels.threads import in_threads, opencv_threads
from stages.init.dental.cameras.bundle import Adjusted, Matches, view_angles
from stages.init.dental.template import GUM_STEPS, landmark_names
from stages.init.sfm.matching.epipolar import sampson_distance

Array = npt.NDArray[np.float64]
Single = npt.NDArray[np.float32]
Mask = npt.NDArray[np.bool_]

#: The unrolled arch: angles about a vertical axis behind the incisors (mm), this wide and high.
AXIS_Z, RADIUS = -26.0, 30.0
HALF_ANGLE = float(np.radians(100.0))
HALF_HEIGHT = 17.0
#: The surface is smooth: it is computed on every this-many-th pixel of the chart.
COARSENESS = 6
#: Smoothing of the thin plate through the landmarks (mm^2 of its kernel).
PLATE_SMOOTHING = 2.0
#: Used is what faces the camera (cosine) and lies within this share of the band from a tooth.
MIN_FACING = 0.3
BAND_MARGIN = 0.5
#: Grey that tells gum from tooth: these parts of L and a (Lab, 0 to 255), normalised in a window of
#: this size (mm).
LIGHTNESS, REDNESS = 0.6, -0.8
NORMALISE_WINDOW = 1.2
#: A match goes there and back within this (mm), moves no more than this, and correlates at least so
#: much in a window of this size (mm); matches are taken this far apart.
MAX_LOOP, MAX_FLOW, MIN_CORRELATION = 0.083, 2.5, 0.8
CORRELATION_WINDOW, STEP = 1.75, 0.5
#: Variance of the normalised grey (0 to 255) below which nothing can be matched.
MIN_VARIANCE = 150.0
#: Standard deviation of a match across its epipolar line, as a share of the band.
MATCH_DEVIATION = 0.015
#: Photographs further apart than this are not matched densely unless they are neighbours (degrees).
MATCHED_YAW = 32.0
#: Fewer matches than this are not used.
MIN_MATCHES = 20


@dataclass(frozen=True)
class Photo:
    """What unrolling needs of a photograph.

    Attributes:
        grey: [H, W] float32, by `LIGHTNESS` and `REDNESS`.
        usable: [H, W] float32, 1 where near teeth and valid, else 0.
        roll: radians by which the row of teeth is turned clockwise.
        band: height of the band of teeth, pixels.
    """

    grey: Single
    usable: Single
    roll: float
    band: float


@dataclass(frozen=True)
class Unrolled:
    """One photograph on the chart.

    Attributes:
        grey: [h, w] uint8, locally normalised.
        seen: [h, w] bool.
        pixels: [h, w, 2] float32, where in the photograph (about the centre, roll taken out).
    """

    grey: npt.NDArray[np.uint8]
    seen: Mask
    pixels: Single


@dataclass(frozen=True)
class PairFigures:
    """How well two photographs agree on the chart.

    Attributes:
        matches: how many dense matches were kept.
        share: of the chart that both see, which part they cover.
        epipolar_error: median distance from the epipolar line, as a share of the band, before the
            cameras were fitted to these matches.
    """

    matches: int
    share: float
    epipolar_error: float


def prepare_photo(image: Single, valid: Mask, teeth: Mask, roll: float, band: float) -> Photo:
    """Grey and usable part of a photograph.

    Args:
        image: [H, W, 3] float32 RGB, 0 to 1.
        valid: [H, W] bool.
        teeth: [H, W] bool, True on teeth.
        roll: radians; band: pixels (see `Dentition`).
    """
    lab = cv2.cvtColor(np.ascontiguousarray(image, np.float32), cv2.COLOR_RGB2Lab)
    grey = LIGHTNESS * 2.55 * lab[..., 0] + REDNESS * lab[..., 1]
    # Not by distance, though that is quicker: half a pixel more or less at the rim turns cameras
    # by a degree.
    reach = max(int(BAND_MARGIN * band), 1)
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * reach + 1, 2 * reach + 1))
    near = cv2.dilate(teeth.astype(np.uint8), kernel) > 0
    return Photo(
        np.asarray(grey, np.float32), (near & valid).astype(np.float32), float(roll), float(band)
    )


def chart_surface(points: Array, scale: float) -> Array:
    """Smooth surface through the landmarks on the chart.

    Args:
        points: [L, 3] all landmarks, mm.
        scale: pixels per mm.

    Returns:
        [h, w, 3] float64, mm; the angle grows along x (to the patient's left), y falls along rows.
    """
    names = landmark_names()
    axis = np.array([0.0, 0.0, AXIS_Z])
    gum = []
    for name, point in zip(names, points, strict=True):
        if name.kind == "zenith":
            out = (point - axis) * np.array([1.0, 0.0, 1.0])
            out /= np.linalg.norm(out)
            up = 1.0 if is_upper(name.tooth) else -1.0
            gum += [point + out * far + np.array([0.0, up * high, 0.0]) for high, far in GUM_STEPS]
    samples = np.concatenate([points, np.array(gum)]) - axis
    flat = np.stack([np.arctan2(samples[:, 0], samples[:, 2]) * RADIUS, samples[:, 1]], axis=1)
    radius = np.hypot(samples[:, 0], samples[:, 2])
    height, width = round(2 * HALF_HEIGHT * scale), round(2 * HALF_ANGLE * RADIUS * scale)
    angle = np.linspace(-HALF_ANGLE, HALF_ANGLE, width)
    level = np.linspace(HALF_HEIGHT, -HALF_HEIGHT, height)
    coarse_angle = np.linspace(-HALF_ANGLE, HALF_ANGLE, width // COARSENESS)
    coarse_level = np.linspace(HALF_HEIGHT, -HALF_HEIGHT, height // COARSENESS)
    grid = np.stack(np.meshgrid(coarse_angle * RADIUS, coarse_level), axis=-1)
    with threadpool_limits(limits=1):
        coarse = _thin_plate(flat, radius, grid.reshape(-1, 2)).reshape(grid.shape[:2])
    # Linear interpolation with the grids' ends aligned.
    row = np.linspace(0, len(coarse_level) - 1, height, dtype=np.float32)
    column = np.linspace(0, len(coarse_angle) - 1, width, dtype=np.float32)
    x, y = np.meshgrid(column, row)
    r = cv2.remap(coarse.astype(np.float32), x, y, cv2.INTER_LINEAR)
    return np.stack(
        [
            r * np.sin(angle),
            np.broadcast_to(level[:, None], r.shape),
            AXIS_Z + r * np.cos(angle),
        ],
        axis=-1,
    )


def _thin_plate(sites: Array, values: Array, queries: Array) -> Array:
    """Smoothed thin-plate spline: [N, 2] sites with [N] values, at [Q, 2] queries."""

    def kernel(a: Array, b: Array) -> Array:
        square = ((a[:, None] - b[None]) ** 2).sum(-1)
        return np.asarray(0.5 * square * np.log(np.maximum(square, 1e-12)))

    n = len(sites)
    system = np.zeros((n + 3, n + 3))
    system[:n, :n] = kernel(sites, sites) + PLATE_SMOOTHING * np.eye(n)
    system[:n, n] = system[n, :n] = 1
    system[:n, n + 1 :] = sites
    system[n + 1 :, :n] = sites.T
    solution = np.linalg.solve(system, np.concatenate([values, np.zeros(3)]))
    return np.asarray(
        kernel(queries, sites) @ solution[:n] + solution[n] + queries @ solution[n + 1 :]
    )


def unroll(
    surface: Array, normal: Array, adjusted: Adjusted, view: int, photo: Photo, scale: float
) -> Unrolled:
    """One photograph unrolled onto the chart.

    Args:
        surface: [h, w, 3] of `chart_surface`.
        normal: [h, w, 3] of the surface.
        adjusted: the cameras.
        view: which of them.
        photo: the photograph.
        scale: pixels per mm of the chart.
    """
    height, width = photo.grey.shape
    rotation, translation = adjusted.rotations[view], adjusted.translations[view]
    to_camera = -rotation.T @ translation - surface
    to_camera /= np.linalg.norm(to_camera, axis=-1, keepdims=True)
    facing = (normal * to_camera).sum(-1)
    # Element by element: large matrix products would differ with the threads of BLAS.
    x, y, z = (surface[..., k] for k in range(3))
    local = [r[0] * x + r[1] * y + r[2] * z + t for r, t in zip(rotation, translation, strict=True)]
    right, down = (adjusted.focals[view] * local[k] / local[2] for k in (0, 1))
    c, s = np.cos(photo.roll), np.sin(photo.roll)
    map_x = (c * right - s * down + (width - 1) / 2).astype(np.float32)
    map_y = (s * right + c * down + (height - 1) / 2).astype(np.float32)
    grey = cv2.remap(photo.grey, map_x, map_y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)
    usable = cv2.remap(photo.usable, map_x, map_y, cv2.INTER_LINEAR, borderValue=0)
    seen = (facing > MIN_FACING) & (usable > 0.99)
    sigma = NORMALISE_WINDOW * scale
    weight = cv2.GaussianBlur(seen.astype(np.float32), (0, 0), sigma) + np.float32(1e-3)
    grey = np.where(seen, grey, 0).astype(np.float32)
    mean = cv2.GaussianBlur(grey, (0, 0), sigma) / weight
    variance = cv2.GaussianBlur(grey * grey, (0, 0), sigma) / weight - mean**2
    normalised = (grey - mean) / (np.sqrt(np.maximum(variance, 0)) + 4) * 45 + 128
    normalised[~seen] = 128
    return Unrolled(
        np.clip(normalised, 0, 255).astype(np.uint8),
        seen,
        np.stack([right, down], axis=-1).astype(np.float32),
    )


def flow_matches(first: Unrolled, second: Unrolled, scale: float) -> tuple[Array, float]:
    """Dense matches of two unrolled photographs.

    Returns:
        [M, 4] pixels in the first and the second photograph (about the centre, roll taken out), and
        the share of the chart seen by both that they cover.
    """
    both = first.seen & second.seen
    if both.sum() < MIN_MATCHES:
        return np.zeros((0, 4)), 0.0
    flow = cv2.DISOpticalFlow_create(  # type: ignore[attr-defined]
        cv2.DISOPTICAL_FLOW_PRESET_MEDIUM
    )
    flow.setFinestScale(1)
    flow.setPatchSize(8)
    flow.setPatchStride(3)
    forward = flow.calc(first.grey, second.grey, None)
    backward = flow.calc(second.grey, first.grey, None)
    height, width = both.shape
    x, y = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32))
    to_x, to_y = x + forward[..., 0], y + forward[..., 1]
    back = cv2.remap(backward, to_x, to_y, cv2.INTER_LINEAR)
    loop = np.hypot(forward[..., 0] + back[..., 0], forward[..., 1] + back[..., 1])
    a = first.grey.astype(np.float32)
    b = cv2.remap(second.grey, to_x, to_y, cv2.INTER_LINEAR).astype(np.float32)
    window = (round(CORRELATION_WINDOW * scale) | 1,) * 2
    mean_a, mean_b = cv2.blur(a, window), cv2.blur(b, window)
    variance_a = cv2.blur(a * a, window) - mean_a**2
    variance_b = cv2.blur(b * b, window) - mean_b**2
    covariance = cv2.blur(a * b, window) - mean_a * mean_b
    correlation = covariance / np.sqrt(np.maximum(variance_a * variance_b, 25.0))
    moved = np.hypot(forward[..., 0], forward[..., 1])
    good = both & (loop < MAX_LOOP * scale) & (correlation > MIN_CORRELATION)
    good &= (moved < MAX_FLOW * scale) & (variance_a > MIN_VARIANCE)
    good = cv2.erode(good.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    share = float(good.sum() / both.sum())
    step = max(round(STEP * scale), 1)
    rows, columns = np.nonzero(good[::step, ::step])
    rows, columns = rows * step, columns * step
    if len(rows) == 0:
        return np.zeros((0, 4)), share
    there = cv2.remap(
        second.pixels, to_x[rows, columns][None], to_y[rows, columns][None], cv2.INTER_LINEAR
    )[0]
    return np.concatenate([first.pixels[rows, columns], there], axis=1).astype(np.float64), share


def sampson_distances(adjusted: Adjusted, i: int, j: int, pixels: Array) -> Array:
    """[M] distance in pixels of matches [M, 4] of views i and j from their epipolar lines."""
    rotation = adjusted.rotations[j] @ adjusted.rotations[i].T
    t = adjusted.translations[j] - rotation @ adjusted.translations[i]
    to_i = np.diag([1 / adjusted.focals[i], 1 / adjusted.focals[i], 1.0])
    to_j = np.diag([1 / adjusted.focals[j], 1 / adjusted.focals[j], 1.0])
    fundamental = to_j @ skew(t) @ rotation @ to_i
    return sampson_distance(fundamental, pixels[:, :2], pixels[:, 2:])


def dense_matches(
    adjusted: Adjusted,
    photos: list[Photo],
    pairs: list[tuple[int, int]],
    scale: float,
    total_weight: float,
    threads: int = 1,
) -> tuple[Matches, dict[tuple[int, int], PairFigures]]:
    """Dense matches of pairs of photographs, and how well each pair agrees.

    Args:
        adjusted: cameras and landmarks, one view per photograph.
        photos: the photographs.
        pairs: which to match.
        scale: pixels per mm of the chart.
        total_weight: of all matches of a pair.
        threads: number of threads; changes nothing but the time.
    """
    surface = chart_surface(adjusted.points, scale)
    normal = np.cross(np.gradient(surface, axis=0), np.gradient(surface, axis=1))
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True) + 1e-9
    views = sorted({view for pair in pairs for view in pair})
    kept: list[Array] = []
    used: list[tuple[int, int]] = []
    weights: list[float] = []
    deviations: list[float] = []
    figures: dict[tuple[int, int], PairFigures] = {}
    with opencv_threads(1):
        unrolled = in_threads(
            lambda view: unroll(surface, normal, adjusted, view, photos[view], scale),
            views, threads,
        )  # fmt: skip
        charts = dict(zip(views, unrolled, strict=True))
        found = in_threads(
            lambda pair: flow_matches(charts[pair[0]], charts[pair[1]], scale), pairs, threads
        )
    for (i, j), (pixels, share) in zip(pairs, found, strict=True):
        band = (photos[i].band + photos[j].band) / 2
        error = np.nan
        if len(pixels) >= MIN_MATCHES:
            error = float(np.median(sampson_distances(adjusted, i, j, pixels))) / band
            kept.append(pixels)
            used.append((i, j))
            weights.append(min(1.0, total_weight / len(pixels)))
            deviations.append(MATCH_DEVIATION * band)
        figures[i, j] = PairFigures(len(pixels), share, error)
    return (
        Matches(
            pairs=np.array(used, np.int64).reshape(-1, 2),
            starts=np.cumsum([0] + [len(k) for k in kept]).astype(np.int64),
            pixels=np.concatenate(kept) if kept else np.zeros((0, 4)),
            weights=np.array(weights, np.float64),
            deviations=np.array(deviations, np.float64),
        ),
        figures,
    )


def match_neighbours(
    adjusted: Adjusted, photos: list[Photo], scale: float, total_weight: float, threads: int = 1
) -> tuple[Matches, dict[tuple[int, int], PairFigures]]:
    """`dense_matches` of neighbouring photographs, and of those but one apart that are near."""
    yaws = view_angles(adjusted)[:, 0]
    order = np.argsort(yaws, kind="stable")
    wanted = {(int(a), int(b)) for a, b in pairwise(order)}
    wanted |= {
        (int(a), int(b))
        for a, b in zip(order[:-2], order[2:], strict=True)
        if yaws[b] - yaws[a] < MATCHED_YAW
    }
    return dense_matches(adjusted, photos, sorted(wanted), scale, total_weight, threads)
