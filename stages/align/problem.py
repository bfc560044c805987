"""The unknowns of global alignment and the data that they are to explain."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from scipy import sparse
from scipy.spatial.transform import Rotation

from pipeline.artifacts.cameras import Camera
from pipeline.artifacts.pointmaps import PointmapPair
from pipeline.geometry.samples import grid_pixels, sampled
from pipeline.geometry.start import Motion, Start
from stages.align.linearise import CAMERA, PAIR

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class AlignOptions:
    """Settings of `optimise`.

    Attributes:
        iterations: Levenberg-Marquardt steps at most.
        samples: about so many pixels per view, on an even grid.
        free_focals, free_poses: what may move besides depths and similarities.
        shared_focal: where focal lengths may move, all views have one, relative to their long side.
    """

    iterations: int = 30
    samples: int = 3000
    free_focals: bool = True
    free_poses: bool = True
    shared_focal: bool = False


@dataclass
class View:
    """Data of one view, for the kernel.

    Attributes:
        pairs: [N] numbers of the pairs (among those used) that say something of it.
        pixels: [M, 2] from the principal point.
        points: [N, M, 3]; weight, inverse_distance: [N, M].
    """

    pairs: list[int]
    pixels: Array
    points: Array
    weight: Array
    inverse_distance: Array


@dataclass
class State:
    """The unknowns: cameras, pair_from_world similarities, log depths.

    `first` [E] are the numbers of the pairs' first views.
    """

    rotations: Array  # [V, 3, 3]
    translations: Array  # [V, 3]
    focals: Array  # [V, 2]
    pair_rotations: Array  # [E, 3, 3]
    pair_scales: Array  # [E]
    pair_shifts: Array  # [E, 3]
    log_depths: list[Array]
    first: npt.NDArray[np.int64]

    def tied(self) -> State:
        """The same with each pair's frame at the camera of its first view."""
        rotations = self.rotations[self.first]
        shifts = self.pair_scales[:, None] * self.translations[self.first]
        return replace(self, pair_rotations=rotations, pair_shifts=shifts)


def problem(
    pairs: Sequence[PointmapPair],
    start: Start,
    used: Sequence[int],
    names: Sequence[str],
    samples: int,
) -> tuple[list[View], State]:
    few = sampled([pairs[k] for k in used], samples)
    motions: list[Motion] = [m for k in used if (m := start.pair_from[k]) is not None]
    views, log_depths = [], []
    for name in names:
        camera = start.cameras[name]
        sides = [
            (e, side) for e, pair in enumerate(few) for side in pair.sides if side.name == name
        ]
        distances, depths = [], []
        for e, side in sides:
            scale, rotation, shift = motions[e]
            eye = (camera.centre - shift) @ rotation / scale
            distance = np.linalg.norm(side.points - eye, axis=1)
            known = side.weight > 0
            typical = float(np.median(distance[known])) if known.any() else 1.0
            distances.append(1 / np.maximum(distance, 0.3 * typical))
            world = scale * side.points @ rotation.T + shift
            depth = world @ camera.rotation[2] + camera.translation[2]
            depths.append(np.where(known & (depth > 0), depth, np.nan))
        pixels = grid_pixels(camera.height, camera.width, samples, camera.cx, camera.cy)
        count = max(1, len(pixels))
        views.append(
            View(
                [e for e, _ in sides],
                pixels,
                np.stack([side.points for _, side in sides]) if sides else np.zeros((0, count, 3)),
                np.stack([side.weight for _, side in sides]) / count
                if sides
                else np.zeros((0, count)),
                np.stack(distances) if sides else np.zeros((0, count)),
            )
        )
        log_depths.append(_first_log_depths(depths, count))
    inverse = [_inverse(motion) for motion in motions]
    cameras = [start.cameras[name] for name in names]
    return views, State(
        np.stack([camera.rotation for camera in cameras]),
        np.stack([camera.translation for camera in cameras]),
        np.array([[camera.fx, camera.fy] for camera in cameras]),
        np.stack([rotation for _, rotation, _ in inverse]),
        np.array([scale for scale, _, _ in inverse]),
        np.stack([shift for _, _, shift in inverse]),
        log_depths,
        np.array([names.index(pair.first.name) for pair in few], np.int64),
    )


def _first_log_depths(depths: list[Array], count: int) -> Array:
    """Median over the pairs; the view's own median where none knows (nothing pulls there)."""
    result = np.full(count, np.nan)
    if depths:
        stacked = np.log(np.stack(depths))
        some = np.isfinite(stacked).any(0)
        result[some] = np.nanmedian(stacked[:, some], axis=0)
    known = np.isfinite(result)
    result[~known] = np.median(result[known]) if known.any() else 0.0
    return result


def common_focal(start: Start, names: Sequence[str]) -> Array:
    """[V, 2] focal lengths that are one share of the long side, the median of those given."""
    cameras = [start.cameras[name] for name in names]
    sides = np.array([[max(camera.width, camera.height)] * 2 for camera in cameras], float)
    given = np.array([[camera.fx, camera.fy] for camera in cameras])
    return np.asarray(np.median(given / sides) * sides)


def _inverse(motion: Motion) -> Motion:
    scale, rotation, shift = motion
    return 1 / scale, rotation.T.copy(), -rotation.T @ shift / scale


def free_directions(state: State, options: AlignOptions) -> sparse.csr_array:
    """[all unknowns, free unknowns]: how the unknowns follow those that may move.

    A view that is never the first of a pair, whose own frame nothing is given in, says too little
    of its focal length: it follows that of another view.
    """
    entries: list[tuple[int, int, float]] = []
    count = len(state.rotations)
    column: dict[int, int] = {}
    focal: int | None = None
    free = 0
    order = sorted(range(count), key=lambda v: v not in state.first)
    for k in (CAMERA * v + part for v in order for part in range(CAMERA)):
        is_focal = k % CAMERA == CAMERA - 1
        if not (options.free_focals if is_focal else options.free_poses):
            continue
        follows = options.shared_focal or k // CAMERA not in state.first
        if is_focal and follows and focal is not None:
            column[k] = focal
        else:
            focal = free if is_focal else focal
            column[k] = free
            free += 1
        entries.append((k, column[k], 1.0))
    for e, first in enumerate(state.first):
        row, own = CAMERA * count + PAIR * e, CAMERA * int(first)
        # Y = a (R X + t): the camera's rotation and translation, and log a.
        for k in range(3):
            if own + k in column:
                entries.append((row + k, column[own + k], 1.0))
                entries.append((row + 3 + k, column[own + 3 + k], float(state.pair_scales[e])))
            entries.append((row + 3 + k, free, float(state.pair_shifts[e, k])))
        entries.append((row + 6, free, 1.0))
        free += 1
    rows, columns, values = zip(*entries, strict=True)
    shape = (CAMERA * count + PAIR * len(state.first), free)
    return sparse.csr_array((values, (rows, columns)), shape=shape)


def moved_by(state: State, solution: Array, log_depths: list[Array]) -> State:
    count = len(state.rotations)
    cameras = solution[: CAMERA * count].reshape(count, CAMERA)
    pairs = solution[CAMERA * count :].reshape(-1, PAIR)
    return State(
        Rotation.from_rotvec(cameras[:, :3]).as_matrix() @ state.rotations,
        state.translations + cameras[:, 3:6],
        state.focals * np.exp(np.clip(cameras[:, 6:], -0.5, 0.5)),
        Rotation.from_rotvec(pairs[:, :3]).as_matrix() @ state.pair_rotations,
        state.pair_scales * np.exp(np.clip(pairs[:, 6], -0.5, 0.5)),
        state.pair_shifts + pairs[:, 3:6],
        log_depths,
        state.first,
    )


def as_start(start: Start, used: Sequence[int], names: Sequence[str], state: State) -> Start:
    cameras: dict[str, Camera] = {}
    for v, name in enumerate(names):
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = state.rotations[v], state.translations[v]
        fx, fy = state.focals[v]
        cameras[name] = replace(
            start.cameras[name], fx=float(fx), fy=float(fy), cam_from_world=pose
        )
    pair_from = list(start.pair_from)
    for e, k in enumerate(used):
        scale, rotation, shift = _inverse(
            (float(state.pair_scales[e]), state.pair_rotations[e], state.pair_shifts[e])
        )
        pair_from[k] = (float(scale), rotation, shift)
    return Start(cameras, pair_from)
