"""Where global alignment starts: chain the pairs along their best spanning tree."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from pipeline.artifacts.cameras import Camera
from pipeline.artifacts.pointmaps import PointmapPair
from stages.align.geometry import pose_from_points, robust_similarity, weiszfeld_focal

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Start:
    """A first guess of everything.

    Attributes:
        cameras: placed views, by name.
        pair_from: per pair (scale, rotation [3, 3], translation [3]) that takes its frame to the
            world; None for a pair with an unplaced view.
    """

    cameras: dict[str, Camera]
    pair_from: list[tuple[float, Array, Array] | None]


def pair_score(pair: PointmapPair) -> float:
    """Worth of a pair as an edge: mean(conf_i) * mean(conf_j), both above 1 (DUSt3R)."""
    above_i = float(np.mean(pair.confidence_i, dtype=np.float64)) - 1
    above_j = float(np.mean(pair.confidence_j, dtype=np.float64)) - 1
    return above_i * above_j


def spanning_tree(edges: Sequence[tuple[str, str, float]]) -> list[list[int]]:
    """Maximum spanning forest (Kruskal).

    Args:
        edges: (name, name, score); edges of no score join nothing.

    Returns:
        For each tree, the numbers of its edges, best first; the tree with most edges first.
    """
    parent = {name: name for a, b, _ in edges for name in (a, b)}

    def root(name: str) -> str:
        while parent[name] != name:
            name = parent[name]
        return name

    used: list[int] = []
    for k in sorted(range(len(edges)), key=lambda k: (-edges[k][2], edges[k][:2])):
        a, b = root(edges[k][0]), root(edges[k][1])
        if a != b and edges[k][2] > 0:
            parent[max(a, b)] = min(a, b)
            used.append(k)
    trees: dict[str, list[int]] = {}
    for k in used:
        trees.setdefault(root(edges[k][0]), []).append(k)
    return sorted(trees.values(), key=lambda tree: (-len(tree), -edges[tree[0]][2]))


def _log_confidence(confidence: npt.NDArray[np.float32]) -> Array:
    return np.log(np.maximum(confidence.astype(np.float64), 1.0))


def _align(source: npt.NDArray, target: npt.NDArray, weight: Array) -> tuple[float, Array, Array]:
    chosen = np.flatnonzero(weight.ravel() > 0)
    chosen = chosen[:: max(1, len(chosen) // 20_000)]
    return robust_similarity(
        np.asarray(source, np.float64).reshape(-1, 3)[chosen],
        np.asarray(target, np.float64).reshape(-1, 3)[chosen],
        weight.ravel()[chosen],
    )


def _move(motion: tuple[float, Array, Array], points: npt.NDArray) -> Array:
    scale, rotation, shift = motion
    return np.asarray(scale * (points.astype(np.float64) @ rotation.T) + shift)


def start_from_tree(pairs: Sequence[PointmapPair]) -> Start:
    """Place the views of the largest tree of pairs in one world.

    The best edge's pair is the world; every next edge's pair is moved onto the pointmap of the view
    that is placed already (confidence-weighted similarity). Focal lengths by Weiszfeld from the
    pointmaps that are in their view's own frame, poses by PnP.

    Args:
        pairs: at least one.

    Returns:
        Cameras and pair similarities; empty if no pair has any confidence.
    """
    edges = [(pair.name_i, pair.name_j, pair_score(pair)) for pair in pairs]
    trees = spanning_tree(edges)
    if not trees:
        return Start({}, [None] * len(pairs))
    motions: dict[int, tuple[float, Array, Array]] = {}
    # Per view: its world points [H, W, 3] and their weight [H, W].
    placed: dict[str, tuple[Array, Array]] = {}
    waiting = list(trees[0])
    first = waiting.pop(0)
    _place(pairs[first], (1.0, np.eye(3), np.zeros(3)), placed)
    motions[first] = (1.0, np.eye(3), np.zeros(3))
    while waiting:
        k = next(k for k in waiting if pairs[k].name_i in placed or pairs[k].name_j in placed)
        waiting.remove(k)
        motions[k] = _onto_placed(pairs[k], placed)
        _place(pairs[k], motions[k], placed)
    focals = _focals(pairs, {name: points.shape[:2] for name, (points, _) in placed.items()})
    cameras = {}
    for name in sorted(placed):
        points, weight = placed[name]
        pose = pose_from_points(points, weight, focals[name])
        if pose is not None:
            height, width = weight.shape
            cameras[name] = Camera(
                name, width, height, focals[name], focals[name], width / 2, height / 2, pose
            )
    pair_from: list[tuple[float, Array, Array] | None] = []
    for k, pair in enumerate(pairs):
        if pair.name_i not in cameras or pair.name_j not in cameras or edges[k][2] <= 0:
            pair_from.append(None)
        else:
            pair_from.append(motions[k] if k in motions else _onto_placed(pair, placed))
    return Start(cameras, pair_from)


def _place(
    pair: PointmapPair,
    motion: tuple[float, Array, Array],
    placed: dict[str, tuple[Array, Array]],
) -> None:
    for name, points, confidence in (
        (pair.name_i, pair.points_i, pair.confidence_i),
        (pair.name_j, pair.points_j_in_i, pair.confidence_j),
    ):
        if name not in placed:
            placed[name] = (_move(motion, points), _log_confidence(confidence))


def _onto_placed(
    pair: PointmapPair, placed: Mapping[str, tuple[Array, Array]]
) -> tuple[float, Array, Array]:
    """Similarity of a pair's frame to the world, from all of its views that are placed."""
    sources, targets, weights = [], [], []
    for name, points, confidence in (
        (pair.name_i, pair.points_i, pair.confidence_i),
        (pair.name_j, pair.points_j_in_i, pair.confidence_j),
    ):
        if name in placed:
            world, weight = placed[name]
            sources.append(points.reshape(-1, 3))
            targets.append(world.reshape(-1, 3))
            weights.append(np.sqrt(weight * _log_confidence(confidence)).ravel())
    return _align(np.concatenate(sources), np.concatenate(targets), np.concatenate(weights))


def _focals(
    pairs: Sequence[PointmapPair], shapes: Mapping[str, tuple[int, ...]]
) -> dict[str, float]:
    """Focal length of each view: the median over its own pointmaps; else that of the others."""
    found: dict[str, list[float]] = {name: [] for name in shapes}
    for pair in pairs:
        if pair.name_i in found:
            focal = weiszfeld_focal(pair.points_i, _log_confidence(pair.confidence_i))
            if focal > 0:
                found[pair.name_i].append(focal)
    known = {name: float(np.median(values)) for name, values in found.items() if values}
    relative = [known[name] / max(shapes[name]) for name in sorted(known)]
    common = float(np.median(relative)) if relative else 1.2
    return {name: known.get(name, common * max(shape)) for name, shape in shapes.items()}


def start_from_cameras(pairs: Sequence[PointmapPair], cameras: Mapping[str, Camera]) -> Start:
    """Start from known cameras: only the scale of each pair is open.

    The pair's frame is camera i's up to scale s, and view j's points, scaled, must lie on the rays
    of camera j: ray x (s R X + t) = 0 gives an estimate of s per pixel, of which the median counts.
    Pairs without baseline keep scale 1.
    """
    pair_from: list[tuple[float, Array, Array] | None] = []
    for pair in pairs:
        if pair.name_i not in cameras or pair.name_j not in cameras or pair_score(pair) <= 0:
            pair_from.append(None)
            continue
        scale = _pair_scale(pair, cameras[pair.name_i], cameras[pair.name_j])
        camera = cameras[pair.name_i]
        pair_from.append((scale, camera.rotation.T, camera.centre))
    return Start(dict(cameras), pair_from)


def _pair_scale(pair: PointmapPair, camera_i: Camera, camera_j: Camera) -> float:
    relative = camera_j.cam_from_world @ np.linalg.inv(camera_i.cam_from_world)
    height, width = pair.confidence_j.shape
    v, u = np.mgrid[:height, :width] + 0.5
    ray = np.stack(
        [(u - camera_j.cx) / camera_j.fx, (v - camera_j.cy) / camera_j.fy, np.ones_like(u)], -1
    )
    weight = _log_confidence(pair.confidence_j).ravel()
    chosen = np.flatnonzero(weight > 0)
    chosen = chosen[:: max(1, len(chosen) // 20_000)]
    turned = pair.points_j_in_i.astype(np.float64).reshape(-1, 3)[chosen] @ relative[:3, :3].T
    ray = ray.reshape(-1, 3)[chosen]
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
