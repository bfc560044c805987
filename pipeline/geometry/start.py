"""Where global alignment starts: chain the pairs along their best spanning tree."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from pipeline.artifacts.cameras import Camera
from pipeline.artifacts.pointmaps import PointmapPair
from pipeline.geometry.graph import spanning_forest
from pipeline.geometry.samples import SampledPair, Side, grid_pixels, pair_score, sampled
from pipeline.geometry.similarity import pose_from_points, robust_similarity, weiszfeld_focal

Array = npt.NDArray[np.float64]
Motion = tuple[float, Array, Array]

#: Pixels per view that the start is found from: more change it by less than it is off anyway.
SAMPLES = 6000
#: Focal length over the long side where no pointmap tells (a phone's main camera is about .75, an
#: intra-oral close-up 1.5 to 2).
FALLBACK_FOCAL = 1.2


@dataclass(frozen=True)
class Start:
    """A first guess of everything.

    Attributes:
        cameras: placed views, by name.
        pair_from: per pair (scale, rotation [3, 3], translation [3]) that takes its frame to the
            world; None for a pair with an unplaced view.
    """

    cameras: dict[str, Camera]
    pair_from: list[Motion | None]


def _move(motion: Motion, points: Array) -> Array:
    scale, rotation, shift = motion
    return np.asarray(scale * (points @ rotation.T) + shift)


def start_from_tree(
    pairs: Sequence[PointmapPair],
    focals: Mapping[str, float] | None = None,
    samples: int = SAMPLES,
) -> Start:
    """Place the views of the largest tree of pairs in one world.

    The best edge's pair is the world; every next edge's pair is moved onto the pointmap of the view
    that is placed already (confidence-weighted similarity). Focal lengths by Weiszfeld from the
    pointmaps that are in their view's own frame. A view that is the first of a pair has the pose of
    that pair's frame; the others' poses by PnP.

    Args:
        pairs: at least one.
        focals: known focal lengths, pixels, by name of the view.
        samples: pixels per view that are looked at.

    Returns:
        Cameras and pair similarities; empty if no pair has any confidence.
    """
    shapes = {name: shape for pair in pairs for name, shape in _shapes(pair)}
    few = sampled(pairs, samples)
    edges = [(pair.first.name, pair.second.name, pair.score) for pair in few]
    trees = spanning_forest(edges)
    if not trees:
        return Start({}, [None] * len(pairs))
    motions: dict[int, Motion] = {}
    placed: dict[str, Side] = {}
    waiting = list(trees[0])
    first = waiting.pop(0)
    motions[first] = (1.0, np.eye(3), np.zeros(3))
    _place(few[first], motions[first], placed)
    while waiting:
        k = next(k for k in waiting if any(side.name in placed for side in few[k].sides))
        waiting.remove(k)
        motions[k] = _onto_placed(few[k], placed)
        _place(few[k], motions[k], placed)
    for k, pair in enumerate(few):
        joins = pair.first.name in placed and pair.second.name in placed and pair.score > 0
        if k not in motions and joins:
            motions[k] = _onto_placed(pair, placed)
    found = {
        **_focals(few, {name: shapes[name] for name in placed}, samples),
        **(focals or {}),
    }
    cameras = {}
    for name in sorted(placed):
        pose = _pose_of_frame(name, few, motions)
        height, width = shapes[name]
        if pose is None:
            pixels = grid_pixels(height, width, samples, width / 2, height / 2)
            world = placed[name]
            pose = pose_from_points(world.points, world.weight, found[name], pixels=pixels)
        if pose is not None:
            cameras[name] = Camera(
                name, width, height, found[name], found[name], width / 2, height / 2, pose
            )
    return Start(
        cameras,
        [
            motions.get(k) if {a, b} <= cameras.keys() and score > 0 else None
            for k, (a, b, score) in enumerate(edges)
        ],
    )


def _shapes(pair: PointmapPair) -> list[tuple[str, tuple[int, int]]]:
    return [
        (name, (int(confidence.shape[0]), int(confidence.shape[1])))
        for name, confidence in (
            (pair.name_i, pair.confidence_i),
            (pair.name_j, pair.confidence_j),
        )
    ]


def _place(pair: SampledPair, motion: Motion, placed: dict[str, Side]) -> None:
    for side in pair.sides:
        if side.name not in placed:
            placed[side.name] = Side(side.name, _move(motion, side.points), side.weight)


def _onto_placed(pair: SampledPair, placed: Mapping[str, Side]) -> Motion:
    """Similarity of a pair's frame to the world, from all of its views that are placed."""
    sides = [(side, placed[side.name]) for side in pair.sides if side.name in placed]
    source = np.concatenate([side.points for side, _ in sides])
    target = np.concatenate([world.points for _, world in sides])
    weight = np.concatenate([np.sqrt(side.weight * world.weight) for side, world in sides])
    known = weight > 0
    return robust_similarity(source[known], target[known], weight[known])


def _pose_of_frame(
    name: str, pairs: Sequence[SampledPair], motions: Mapping[int, Motion]
) -> Array | None:
    """Pose of the best placed pair whose frame is the camera's; None if there is none."""
    own = [k for k in sorted(motions) if pairs[k].first.name == name]
    if not own:
        return None
    _, rotation, shift = motions[max(own, key=lambda k: pairs[k].score)]
    pose = np.eye(4)
    pose[:3, :3] = rotation.T
    pose[:3, 3] = -rotation.T @ shift
    return pose


def _focals(
    pairs: Sequence[SampledPair], shapes: Mapping[str, tuple[int, int]], samples: int
) -> dict[str, float]:
    """Focal length of each view: the median over its own pointmaps; else that of the others."""
    found: dict[str, list[float]] = {name: [] for name in shapes}
    for pair in pairs:
        side = pair.first
        if side.name in found:
            height, width = shapes[side.name]
            pixels = grid_pixels(height, width, samples, width / 2, height / 2)
            focal = weiszfeld_focal(side.points, side.weight, pixels=pixels)
            if focal > 0:
                found[side.name].append(focal)
    known = {name: float(np.median(values)) for name, values in found.items() if values}
    relative = [known[name] / max(shapes[name]) for name in sorted(known)]
    common = float(np.median(relative)) if relative else FALLBACK_FOCAL
    return {name: known.get(name, common * max(shape)) for name, shape in shapes.items()}


def start_from_cameras(pairs: Sequence[PointmapPair], cameras: Mapping[str, Camera]) -> Start:
    """Start from known cameras: only the scale of each pair is open.

    The pair's frame is camera i's up to scale s, and view j's points, scaled, must lie on the rays
    of camera j: ray x (s R X + t) = 0 gives an estimate of s per pixel, of which the median counts.
    Pairs without baseline keep scale 1.
    """
    pair_from: list[Motion | None] = []
    for pair in pairs:
        if pair.name_i not in cameras or pair.name_j not in cameras or pair_score(pair) <= 0:
            pair_from.append(None)
            continue
        camera = cameras[pair.name_i]
        scale = _pair_scale(pair, camera, cameras[pair.name_j])
        pair_from.append((scale, camera.rotation.T, camera.centre))
    return Start(dict(cameras), pair_from)


def _rays(camera: Camera, samples: int) -> Array:
    """[M, 3] rays of the grid's pixels, z = 1."""
    pixels = grid_pixels(camera.height, camera.width, samples, camera.cx, camera.cy)
    return np.column_stack([pixels / (camera.fx, camera.fy), np.ones(len(pixels))])


def _pair_scale(pair: PointmapPair, camera_i: Camera, camera_j: Camera) -> float:
    relative = camera_j.cam_from_world @ np.linalg.inv(camera_i.cam_from_world)
    side = sampled([pair], SAMPLES)[0].second
    known = side.weight > 0
    turned = side.points[known] @ relative[:3, :3].T
    ray = _rays(camera_j, SAMPLES)[known]
    across = np.cross(ray, turned)
    against = -np.cross(ray, relative[:3, 3])
    power = (across**2).sum(1)
    estimate = (across * against).sum(1) / np.maximum(power, 1e-30)
    usable = (power > 1e-12 * (turned**2).sum(1)) & (estimate > 0)
    if usable.sum() < 10:
        return 1.0
    scale = float(np.median(estimate[usable]))
    # Pointmaps made with these cameras have exactly their scale, up to rounding.
    return 1.0 if abs(scale - 1) < 2e-3 else scale
