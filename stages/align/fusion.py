"""Fuse the depth maps of all views into one coloured cloud, each piece of surface once."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from pipeline.artifacts.cameras import Camera
from pipeline.artifacts.confidence import FILLED
from pipeline.geometry.normals import UNSURE, depth_normals
from pipeline.geometry.order import nearest_views
from pipeline.kernels import each, helper, kernel, kernel_threads
from stages.stereo.consistency import camera_table, stacked

Array = npt.NDArray[np.float32]

#: Sum of the three channels by which views may differ in the colour of the same surface.
_ALIKE = np.float32(0.3)
#: Of the fill, one pixel in so many (in x and y) is considered.
_FILL_STRIDE = 3


@dataclass(frozen=True)
class FusionOptions:
    """Settings of `fuse`.

    Attributes:
        fill_confidence: depths of no more confidence are fill: used where nothing better is.
        relative_depth: relative difference of depth within which two views see the same surface.
        front: a depth this share in front of what another view sees there is refuted.
        min_agreeing: other views that must agree, all where there are fewer; 0: nothing but not
            being refuted.
        merge: drop a pixel that a more confident view explains (else every view's pixel stays).
    """

    fill_confidence: float = FILLED
    relative_depth: float = 0.01
    front: float = 0.02
    min_agreeing: int = 0
    merge: bool = True


@dataclass(frozen=True)
class FusedCloud:
    """A coloured cloud.

    Attributes:
        positions: [N, 3] float32 world.
        colors: [N, 3] float32 sRGB.
        normals: [N, 3] float32, unit, facing the view that the point comes from.
        confidence: [N] float32 >= 1.
        fill: how many of the points are fill.
        residual: median relative depth difference between agreeing views; nan if none agree.
    """

    positions: Array
    colors: Array
    normals: Array
    confidence: Array
    fill: int
    residual: float

    def __len__(self) -> int:
        return len(self.positions)


@helper
def _weighted_median(values, weights, count, order):  # type: ignore[no-untyped-def]
    """Which of the first `count` values it is; `order` becomes their order."""
    total = np.float32(0)
    for k in range(count):
        total += weights[k]
        place = k
        while place > 0 and values[order[place - 1]] > values[k]:
            order[place] = order[place - 1]
            place -= 1
        order[place] = k
    running = np.float32(0)
    for k in range(count):
        running += weights[order[k]]
        if running >= np.float32(0.5) * total or k == (count - 1) // 2:
            return order[k]
    return order[0]


@kernel(nogil=True)
def _fuse_row(  # type: ignore[no-untyped-def]
    y, index, others, depths, confidences, images, cameras, fill_confidence, relative, front,
    min_agreeing, merge, keep, depth_out, color_out, residual_out,
):  # fmt: skip
    """`fuse` for one row of one view."""
    here = cameras[index]
    views = len(others) + 1
    colors = np.empty((views, 3), np.float32)
    lumas = np.empty(views, np.float32)
    weights = np.empty(views, np.float32)
    order = np.empty(views, np.int64)
    for x in range(keep.shape[1]):
        z = np.float64(depths[index, y, x])
        own = confidences[index, y, x]
        if z <= 0 or own <= np.float32(1):
            continue
        is_fill = own <= fill_confidence
        a = (x + 0.5 - here[2]) / here[0] * z - here[15]
        b = (y + 0.5 - here[3]) / here[1] * z - here[16]
        c = z - here[17]
        X = here[6] * a + here[9] * b + here[12] * c
        Y = here[7] * a + here[10] * b + here[13] * c
        Z = here[8] * a + here[11] * b + here[14] * c
        weights[0] = own - np.float32(1)
        for k in range(3):
            colors[0, k] = images[index, y, x, k]
        lumas[0] = colors[0, 0] + colors[0, 1] + colors[0, 2]
        mass = np.float64(own) - 1
        mean = z * mass
        residual = 0.0
        agree = 0
        refuted = 0
        explained = False
        for v in others:
            there = cameras[v]
            zv = there[12] * X + there[13] * Y + there[14] * Z + there[17]
            if zv <= 1e-9:
                continue
            p = there[6] * X + there[7] * Y + there[8] * Z + there[15]
            q = there[9] * X + there[10] * Y + there[11] * Z + there[16]
            j = np.int64(np.floor(there[0] * p / zv + there[2]))
            i = np.int64(np.floor(there[1] * q / zv + there[3]))
            if i < 0 or j < 0 or i >= there[5] or j >= there[4]:
                continue
            seen = np.float64(depths[v, i, j])
            other = confidences[v, i, j]
            if seen <= 0 or other <= np.float32(1):
                continue
            other_fill = other <= fill_confidence
            if other_fill and not is_fill:
                continue  # a guess says nothing about a measurement
            if zv < seen * (1 - front) and not other_fill:
                refuted += 1
                continue
            # Fill is smooth and rough at once: what lies near it is it.
            within = 4 * relative if is_fill else relative
            if abs(seen - zv) > within * zv:
                continue
            if other > own or (other == own and v < index) or (is_fill and not other_fill):
                explained = True
            agree += 1
            residual += abs(seen - zv) / zv
            weight = np.float64(other) - 1
            mean += weight * (z + (seen - zv) * z / zv)
            mass += weight
            weights[agree] = other - np.float32(1)
            for k in range(3):
                colors[agree, k] = images[v, i, j, k]
            lumas[agree] = colors[agree, 0] + colors[agree, 1] + colors[agree, 2]
        if refuted > 0 and (refuted >= agree or is_fill):
            continue
        if explained and merge:
            continue
        if not is_fill and agree < min_agreeing:
            continue
        keep[y, x] = 2 if is_fill else 1
        depth_out[y, x] = np.float32(z if is_fill else mean / mass)
        residual_out[y, x] = np.float32(residual / agree if agree > 0 else -1)
        # Highlights move with the camera and are brighter than the surface: from the weighted
        # median by luma (the darker one of two), take the mean of all that look like it.
        count = agree + 1
        chosen = _weighted_median(lumas, weights, count, order)
        total = np.float32(0)
        for k in range(count):
            if abs(lumas[k] - lumas[chosen]) <= _ALIKE:
                total += weights[k]
                for q in range(3):
                    color_out[y, x, q] += weights[k] * colors[k, q]
        for q in range(3):
            color_out[y, x, q] /= total


def fuse(
    depths: Sequence[Array],
    confidences: Sequence[Array],
    images: Sequence[Array],
    cameras: Sequence[Camera],
    options: FusionOptions,
    threads: int = 1,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> FusedCloud:
    """Fuse depth maps: confident surfaces once, fill where nothing better is, colours without
    highlights.

    A depth stays unless as many views see through it as agree with it (two of three wide
    photographs draw the upper incisors too long, over the lower ones that the third one sees).
    Where views agree, the most confident pixel stays with the depth that all of them say (weighted
    by confidence - 1) and the weighted median colour; the others are dropped, as in InstantSplat's
    co-visibility pruning. Fill is dropped wherever a confident surface explains or refutes it.

    Args:
        depths: V arrays [H, W] float32 z-depth, 0 where there is none; sizes may differ.
        confidences: V arrays [H, W] float32 >= 1; 1 means nothing known.
        images: V arrays [H, W, 3] float32 sRGB.
        cameras: V cameras.
        options: see `FusionOptions`.
        threads: does not change the result.
        progress: called with (views done, views).

    Returns:
        The cloud, in the order of views and pixels.
    """
    depth_stack, confidence_stack, image_stack = map(stacked, (depths, confidences, images))
    table = camera_table(cameras)
    parts: list[tuple[Array, ...]] = []
    residuals = []
    fill = 0
    with kernel_threads(threads):
        for v, camera in enumerate(cameras):
            shape = depths[v].shape
            seen = camera.unproject(depths[v])[confidences[v] > 1]
            others = nearest_views(v, list(cameras), seen)
            keep = np.zeros(shape, np.uint8)
            depth = np.zeros(shape, np.float32)
            color = np.zeros((*shape, 3), np.float32)
            residual = np.full(shape, -1, np.float32)
            each(
                _fuse_row, shape[0], v, others, depth_stack, confidence_stack, image_stack, table,
                np.float32(options.fill_confidence), float(options.relative_depth),
                float(options.front), min(options.min_agreeing, len(others)), bool(options.merge),
                keep, depth, color, residual,
            )  # fmt: skip
            thinned = np.zeros(shape, bool)
            thinned[_FILL_STRIDE // 2 :: _FILL_STRIDE, _FILL_STRIDE // 2 :: _FILL_STRIDE] = True
            kept = (keep == 1) | ((keep == 2) & thinned)
            fill += int(((keep == 2) & thinned).sum())
            residuals.append(residual[(keep == 1) & (residual >= 0)])
            normals = depth_normals(depths[v], np.maximum(confidences[v] - 1, UNSURE), camera)
            parts.append(
                (
                    camera.unproject(depth)[kept].astype(np.float32),
                    color[kept],
                    normals[kept],
                    confidences[v][kept],
                )
            )
            progress(v + 1, len(cameras))
    positions, colors, normals, trust = (np.concatenate(a) for a in zip(*parts, strict=True))
    agreed = np.concatenate(residuals)
    residual_median = float(np.median(agreed)) if len(agreed) else float("nan")
    return FusedCloud(positions, colors, normals, trust, fill, residual_median)
