"""Dense stereo over all views: sweep each, check them against each other, complete what is left."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
import numpy.typing as npt

from pipeline.artifacts.cameras import Camera
from pipeline.artifacts.confidence import COMPLETED
from pipeline.geometry.normals import depth_normals
from pipeline.geometry.order import nearest_views
from pipeline.kernels import kernel_threads
from stages.stereo.aggregate import aggregate, decide, edge_aware_penalty
from stages.stereo.appearance import highlights, to_gray
from stages.stereo.consistency import camera_table, check, stacked
from stages.stereo.fill import complete, distance_to
from stages.stereo.options import METHODS, DenseOptions, DenseView
from stages.stereo.polish import polish, source_maps
from stages.stereo.pyramid import Level, halved, level_count, planes_at
from stages.stereo.sgbm import ASSUMED_CORRELATION, sgbm_depth
from stages.stereo.sources import (
    inverse_depth_range,
    plane_count,
    scene_points,
    select_sources,
)
from stages.stereo.sweep import cost_volume, plane_homographies, stack_sources
from stages.stereo.tiles import Buffer, ranges_around

Array = npt.NDArray[np.float32]
Mask = npt.NDArray[np.bool_]
Integers = npt.NDArray[np.int64]

#: Views agree within so many pixels of the image; a depth by this share in front of what another
#: view sees there is refuted.
_REPROJECTION, _FRONT = 1.5, 0.02
#: The completed depth is tried at these shares of the way (in inverse depth) to the far plane.
_RETREATS = (0.0, 0.25, 0.5, 0.75, 1.0)


def dense_depths(
    images: list[Array],
    valid: list[Mask],
    cameras: list[Camera],
    sparse: list[npt.NDArray[np.floating]],
    options: DenseOptions,
    threads: int,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> list[DenseView]:
    """Depth, confidence and normals of every view from the others.

    Args:
        images: V arrays [H, W, 3] float32 sRGB in 0..1; sizes may differ.
        valid: V arrays [H, W] bool; nothing is matched and nothing returned outside.
        cameras: V cameras at the images' sizes.
        sparse: V arrays [M_i, 3] of world points that each view sees (they tell the depth range
            and the triangulation angles).
        options: see `DenseOptions`.
        threads: number of threads; does not change the result.
        progress: called with (views done, views) after each view.

    Returns:
        One `DenseView` per view.

    Raises:
        ValueError: the lists differ in length, an image does not have its camera's size, or the
            method is unknown.
    """
    if not len(images) == len(valid) == len(cameras) == len(sparse):
        raise ValueError("dense_depths needs one image, mask, camera and point list per view")
    for image, mask, camera in zip(images, valid, cameras, strict=True):
        if image.shape != (camera.height, camera.width, 3) or mask.shape != image.shape[:2]:
            raise ValueError(
                f"view {camera.name}: image {image.shape}, mask {mask.shape}, but the camera is "
                f"{camera.width}x{camera.height}"
            )
    if options.method not in METHODS:
        raise ValueError(f"unknown dense method '{options.method}'; there are {METHODS}")
    with kernel_threads(threads):
        return _dense_depths(images, valid, cameras, sparse, options, progress)


def complete_depths(
    images: list[Array],
    valid: list[Mask],
    cameras: list[Camera],
    depths: list[Array],
    confidences: list[Array],
    options: DenseOptions,
    threads: int,
) -> list[DenseView]:
    """Depth that is known otherwise, completed as that of stereo, with normals.

    Args:
        images, valid, cameras, options, threads: as for `dense_depths`.
        depths: V arrays [H, W] float32 z-depth, 0 where unknown.
        confidences: V arrays [H, W] float32 >= 1 of it.
    """
    with kernel_threads(threads):
        grays = [to_gray(image) for image in images]
        others = [
            nearest_views(index, cameras, camera.unproject(depth)[depth > 0])
            for index, (camera, depth) in enumerate(zip(cameras, depths, strict=True))
        ]
        return _finish(depths, confidences, grays, valid, cameras, others, options)


def _dense_depths(
    images: list[Array],
    valid: list[Mask],
    cameras: list[Camera],
    sparse: list[npt.NDArray[np.floating]],
    options: DenseOptions,
    progress: Callable[[int, int], None],
) -> list[DenseView]:
    count = len(images)
    grays = [to_gray(image) for image in images]
    shiny = [highlights(image) > 0 for image in images]
    usable = [mask & ~bright for mask, bright in zip(valid, shiny, strict=True)]
    pyramids = [
        [Level(camera, gray, use)] for camera, gray, use in zip(cameras, grays, usable, strict=True)
    ]
    if options.method == "sweep":
        longest = max(max(camera.width, camera.height) for camera in cameras)
        for levels in pyramids:
            for _ in range(level_count(longest, options.max_planes)):
                levels.append(halved(levels[-1]))
    points = scene_points(cameras, sparse)
    everything = np.concatenate(points) if points else np.zeros((0, 3))
    buffers = Buffer(), Buffer()
    depths, scores = [], []
    for index in range(count):
        chosen = select_sources(index, cameras, points[index], options.sources)
        find = _sweep_view if options.method == "sweep" else _sgbm_view
        depth, ncc = find(
            index, chosen, pyramids, points[index], everything, buffers, options
        )  # fmt: skip
        keep = valid[index] & (ncc > options.min_ncc)
        depths.append(np.where(keep, depth, 0).astype(np.float32))
        scores.append(ncc)
        progress(index + 1, count)
    others = [nearest_views(k, cameras, points[k]) for k in range(count)]
    depths, agreeing, angles = _consistent(depths, scores, cameras, others, options)
    confidences = [
        confidence_of(depth, score, number, angle, bright)
        for depth, score, number, angle, bright in zip(
            depths, scores, agreeing, angles, shiny, strict=True
        )
    ]
    return _finish(depths, confidences, grays, valid, cameras, others, options)


def _sweep_view(
    index: int,
    chosen: list[int],
    pyramids: list[list[Level]],
    points: npt.NDArray[np.float64],
    everything: npt.NDArray[np.float64],
    buffers: tuple[Buffer, Buffer],
    options: DenseOptions,
) -> tuple[Array, Array]:
    """Depth and ZNCC [H, W] of one view, before any check; depth 0 if it has no source.

    From coarse to fine: the half-size sweep says between which planes the next one looks.
    """
    camera = pyramids[index][0].camera
    if not chosen:
        empty = np.zeros((camera.height, camera.width), np.float32)
        return empty, empty
    lenses = [pyramids[k][0].camera for k in chosen]
    ends = inverse_depth_range(camera, points, everything)
    most = min(options.max_planes, max(options.max_volume // (camera.height * camera.width), 16))
    least = min(options.planes, most)
    planes = plane_count(camera, lenses, ends, least, most)
    levels = level_count(max(camera.width, camera.height), planes)
    ranges = None
    for level in range(levels, -1, -1):
        own, *others = (pyramids[k][level] for k in [index, *chosen])
        number = planes_at(level, planes)
        stack, sizes = stack_sources([o.gray for o in others], [o.usable for o in others])
        homographies = plane_homographies(
            own.camera, [o.camera for o in others], np.linspace(ends[0], ends[1], number)
        )
        volume = cost_volume(
            own.gray, own.usable, stack, sizes, homographies, options.window, ranges, buffers[0],
        )  # fmt: skip
        penalty = edge_aware_penalty(own.gray, options.p2)
        total = aggregate(volume, penalty, options.p1, buffers[1])
        plane, ncc, _ = decide(total, volume)
        if level:
            finer = pyramids[index][level - 1].gray.shape
            found = plane / np.float32(number - 1)
            ranges = ranges_around(found, own.usable, finer, planes_at(level - 1, planes))
    # The first and the last plane stand for all that lies beyond the range.
    ncc = np.where((plane < 1) | (plane > planes - 2), np.float32(-1), ncc).astype(np.float32)
    depth = 1.0 / (ends[0] + (ends[1] - ends[0]) / (planes - 1) * plane)
    if not options.polish:
        return depth.astype(np.float32), ncc
    kept = np.where(ncc > options.min_ncc, depth, 0).astype(np.float32)
    step = (ends[1] - ends[0]) / (planes - 1) / max(float(np.mean(ends)), 1e-12)
    return polish(
        own.gray, own.usable, stack, sizes, source_maps(camera, lenses), kept, ncc,
        options.polish, options.polish_window, float(step), index,
    )  # fmt: skip


def _sgbm_view(
    index: int,
    chosen: list[int],
    pyramids: list[list[Level]],
    points: npt.NDArray[np.float64],
    everything: npt.NDArray[np.float64],
    buffers: tuple[Buffer, Buffer],
    options: DenseOptions,
) -> tuple[Array, Array]:
    """As `_sweep_view`, from rectified pairs: the median of what the sources say."""
    own = pyramids[index][0]
    camera = own.camera
    ends = inverse_depth_range(camera, points, everything)
    found = [
        sgbm_depth(
            own.gray, own.usable, camera, other.gray, other.usable, other.camera,
            (float(ends[0]), float(ends[1])), options.window,
        )
        for other in (pyramids[k][0] for k in chosen)
    ]  # fmt: skip
    if not found:
        empty = np.zeros((camera.height, camera.width), np.float32)
        return empty, empty
    stack = np.stack(found)
    stack.sort(axis=0)  # zeros first
    count = (stack > 0).sum(0)
    middle = len(found) - count + (count - 1) // 2
    depth = np.take_along_axis(stack, np.clip(middle, 0, len(found) - 1)[None], 0)[0]
    known = count > 0
    score = np.where(known, np.float32(ASSUMED_CORRELATION), np.float32(-1))
    return np.where(known, depth, 0).astype(np.float32), score.astype(np.float32)


def _consistent(
    depths: list[Array], scores: list[Array], cameras: list[Camera], others: list[Integers],
    options: DenseOptions,
) -> tuple[list[Array], list[npt.NDArray[np.int32]], list[Array]]:  # fmt: skip
    """Keep what enough other views agree with, averaged with what they say."""
    # What is wrong finds a second witness easily where there are many.
    needed = options.min_agreeing or 1 + (len(depths) >= 6) + (len(depths) >= 12)
    needed = min(needed, max(len(depths) - 1, 1))
    table = camera_table(cameras)
    stack = stacked(depths)
    weights = stacked([np.maximum(score, 0.05) ** 2 for score in scores])
    kept, agreeing, angles = [], [], []
    for index, depth in enumerate(depths):
        agree, conflict, fused, angle = check(
            index, stack, weights, table, depth.shape,
            options.relative_depth, _REPROJECTION, _FRONT, others[index],
        )  # fmt: skip
        good = (agree >= needed) & (agree >= conflict)
        good &= large_islands(fused, good, options.speckle, 2 * options.relative_depth)
        kept.append(np.where(good, fused, 0).astype(np.float32))
        agreeing.append(np.where(good, agree, 0).astype(np.int32))
        angles.append(angle)
    return kept, agreeing, angles


def large_islands(depth: Array, known: Mask, pixels: int, jump: float) -> Mask:
    """Pixels that belong to a connected piece of surface of at least so many pixels.

    Args:
        depth: [H, W] float32.
        known: [H, W] bool, where there is depth.
        pixels: least size of a piece; 0 or 1 keeps all.
        jump: relative difference of depth between neighbours that separates two pieces.

    Returns:
        [H, W] bool.
    """
    if pixels < 2 or not known.any():
        return known
    # Steps of equal ratio, 8 to a jump, so that int16 holds any range that matters.
    steps = np.zeros(depth.shape, np.int16)
    ratio = np.log(depth[known] / depth[known].min()) * (8 / np.log1p(jump))
    steps[known] = np.clip(ratio, 0, 30000).astype(np.int16)
    steps[~known] = -16000
    cv2.filterSpeckles(steps, -16000, pixels - 1, 8)
    return np.asarray(steps != -16000)


def confidence_of(
    depth: Array,
    ncc: Array,
    agreeing: npt.NDArray[np.int32],
    angle: Array,
    shiny: Mask,
) -> Array:
    """Confidence as pointmap models give it: 1 + exp(s), exactly 1 where there is no depth.

    s = 2 max(ncc, 0) + log(min(agreeing, 5)) + log(min(angle / 10 deg, 1)) - [in a highlight]:
    better correlated, seen by more views, at a wider angle, and not mirrored light.

    Args:
        depth: [H, W] float32, 0 where there is none.
        ncc: [H, W] float32 correlation with the sources.
        agreeing: [H, W] int32 other views that agree.
        angle: [H, W] float32 widest triangulation angle, radians.
        shiny: [H, W] bool, inside a highlight.

    Returns:
        [H, W] float32 >= 1.
    """
    exponent = (
        2 * np.maximum(ncc, 0)
        + np.log(np.clip(agreeing, 1, 5))
        + np.log(np.clip(angle / np.radians(10.0), 0.05, 1))
        - shiny
    )
    return np.where(depth > 0, 1 + np.exp(exponent), 1).astype(np.float32)


def _finish(
    depths: list[Array],
    confidences: list[Array],
    grays: list[Array],
    valid: list[Mask],
    cameras: list[Camera],
    others: list[Integers],
    options: DenseOptions,
) -> list[DenseView]:
    """Complete every view and add normals."""
    table = camera_table(cameras)
    stack = stacked(depths)
    result = []
    for index, (depth, confidence) in enumerate(zip(depths, confidences, strict=True)):
        known = depth > 0
        filled = np.zeros_like(depth)
        if options.fill and known.any():
            filled = _fill(index, stack, table, grays[index], confidence, others[index], options)
            filled = np.where(valid[index], filled, 0).astype(np.float32)
            trust = 1.01 + (COMPLETED - 1.01) * np.exp(-distance_to(known) / 20)
            confidence = np.where(known | (filled <= 0), confidence, trust).astype(np.float32)
        merged = np.where(known, depth, filled)
        weight = np.where(known, np.float32(1), np.float32(0.01))
        normal = depth_normals(merged, weight, cameras[index])
        result.append(DenseView(depth, confidence, normal, filled))
    return result


def _fill(
    index: int,
    stack: Array,
    table: npt.NDArray[np.float64],
    gray: Array,
    confidence: Array,
    others: Integers,
    options: DenseOptions,
) -> Array:
    """Completed depth [H, W] of a view, 0 where it would hide what another view sees."""
    height, width = gray.shape
    depth = stack[index, :height, :width].copy()
    known = depth > 0
    inverse = np.where(known, 1 / np.where(known, depth, 1), 0).astype(np.float32)
    far = 0.85 * float(np.percentile(inverse[known], 1))
    weight = np.where(known, np.minimum(confidence - 1, 5), 0).astype(np.float32)
    smooth = complete(inverse, weight, gray, far)
    result = depth.copy()
    open_pixels = ~known
    weights = np.ones_like(stack)  # a view of one number would be a kernel of its own
    for retreat in _RETREATS:
        trial = 1 / ((1 - retreat) * smooth + retreat * np.float32(far))
        stack[index] = 0
        stack[index, :height, :width] = np.where(open_pixels, trial, 0)
        _, conflict, _, _ = check(
            index, stack, weights, table, (height, width),
            options.relative_depth, _REPROJECTION, _FRONT, others,
        )  # fmt: skip
        accept = open_pixels & (conflict == 0)
        result[accept] = trial[accept]
        open_pixels &= ~accept
        if not open_pixels.any():
            break
    stack[index] = 0
    stack[index, :height, :width] = depth
    return result
