"""Joint optimisation of poses, focal lengths, depths and pair similarities (DUSt3R, section 3.4).

Minimises the sum over pairs e and both their views v of
    mean over pixels of log(confidence) * || X_v - s_e (R_e P_v,e + t_e) ||,
where X_v lifts the depth of view v into the world, with the mean of log s_e held at 0.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
import torch
from kornia.geometry.conversions import (
    quaternion_to_rotation_matrix,
    rotation_matrix_to_quaternion,
)

from pipeline.artifacts.pointmaps import PointmapPair
from stages.align.start import Start

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class AlignOptions:
    """Settings of `optimise`.

    Attributes:
        iterations: steps of Adam.
        learning_rate: at the start; falls to 1e-6 along a cosine.
        samples: about so many pixels per view, on an even grid.
        free_focals, free_poses: what may move besides depths and similarities.
    """

    iterations: int = 300
    learning_rate: float = 0.01
    samples: int = 3000
    free_focals: bool = True
    free_poses: bool = True


def _quats_wxyz(rotations: Sequence[Array]) -> torch.Tensor:
    return rotation_matrix_to_quaternion(torch.tensor(np.stack(rotations)))


def optimise(
    pairs: Sequence[PointmapPair],
    start: Start,
    options: AlignOptions,
    progress: Callable[[int, int, float], None] = lambda done, total, loss: None,
) -> tuple[Start, float]:
    """Improve a start.

    Runs on one thread in float64, so that the result does not depend on the machine's load.

    Args:
        pairs: as given to the start.
        start: cameras and pair similarities.
        options: see `AlignOptions`.
        progress: called with (iteration, iterations, objective).

    Returns:
        The improved start and the mean weighted residual relative to the median depth.
    """
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        return _optimise(pairs, start, options, progress)
    finally:
        torch.set_num_threads(threads)


def _optimise(
    pairs: Sequence[PointmapPair],
    start: Start,
    options: AlignOptions,
    progress: Callable[[int, int, float], None],
) -> tuple[Start, float]:
    used = [k for k, motion in enumerate(start.pair_from) if motion is not None]
    names = sorted(start.cameras)
    if not used:
        return start, 0.0
    grids = {name: _Grid(start, name, options.samples) for name in names}
    # Units in which depth is about 1, as the learning rate expects.
    observed, unit = [], []
    for k in used:
        motion = start.pair_from[k]
        assert motion is not None
        for name, points, confidence in _both(pairs[k]):
            local, weight = grids[name].sample(points, confidence)
            observed.append((used.index(k), name, local, weight))
            world = motion[0] * local @ motion[1].T + motion[2]
            unit.append(grids[name].observe(world, weight))
    depth_unit = float(np.median(np.concatenate(unit))) if unit else 1.0
    pair_scales = [start.pair_from[k][0] for k in used]  # type: ignore[index]
    mean_log = float(np.mean(np.log(pair_scales)))

    pose_q = _quats_wxyz([start.cameras[name].rotation for name in names])
    pose_t = torch.tensor(np.stack([start.cameras[n].translation for n in names])) / depth_unit
    log_focal = torch.tensor(np.log([[start.cameras[n].fx, start.cameras[n].fy] for n in names]))
    focal_change = torch.zeros(len(names), dtype=torch.float64)
    pair_q = _quats_wxyz([start.pair_from[k][1] for k in used])  # type: ignore[index]
    pair_t = torch.tensor(np.stack([start.pair_from[k][2] for k in used]) / depth_unit)  # type: ignore[index]
    pair_log = torch.tensor(np.log(pair_scales)) - mean_log
    log_depth = {name: torch.tensor(grids[name].log_depth(depth_unit)) for name in names}
    free = [*log_depth.values(), pair_q, pair_t, pair_log]
    if options.free_poses:
        free += [pose_q, pose_t]
    if options.free_focals:
        free.append(focal_change)
    for tensor in free:
        tensor.requires_grad_(True)
    data = [
        (k, names.index(name), name, torch.tensor(local / depth_unit), torch.tensor(weight))
        for k, name, local, weight in observed
    ]
    pixels = {name: torch.tensor(grids[name].centred) for name in names}
    optimiser = torch.optim.Adam(free, lr=options.learning_rate, betas=(0.9, 0.9))

    def objective() -> tuple[torch.Tensor, torch.Tensor]:
        rotations = quaternion_to_rotation_matrix(pose_q)
        turned = quaternion_to_rotation_matrix(pair_q)
        # The gauge: mean log scale stays where the start had it.
        scales = torch.exp(pair_log - pair_log.mean() + mean_log)
        focals = torch.exp(log_focal + focal_change[:, None])
        worlds = {}
        for v, name in enumerate(names):
            depth = torch.exp(log_depth[name])
            local = torch.cat([pixels[name] / focals[v], torch.ones_like(depth)[:, None]], 1)
            worlds[name] = (local * depth[:, None] - pose_t[v]) @ rotations[v]
        total = torch.zeros((), dtype=torch.float64)
        mass = torch.zeros((), dtype=torch.float64)
        for k, _, name, local, weight in data:
            target = scales[k] * (local @ turned[k].T) + pair_t[k]
            distance = torch.sqrt(((worlds[name] - target) ** 2).sum(1) + 1e-16)
            total = total + (weight * distance).mean()
            mass = mass + weight.mean()
        return total, total / mass.clamp(min=1e-12)

    for step in range(options.iterations):
        rate = 0.5 * (1 + np.cos(np.pi * step / options.iterations))
        for group in optimiser.param_groups:
            group["lr"] = 1e-6 + (options.learning_rate - 1e-6) * rate
        optimiser.zero_grad()
        loss, mean_distance = objective()
        loss.backward()
        optimiser.step()
        if step % 10 == 0 or step == options.iterations - 1:
            progress(step + 1, options.iterations, float(mean_distance.detach()))
    with torch.no_grad():
        _, mean_distance = objective()
        rotations = quaternion_to_rotation_matrix(pose_q).numpy()
        turned = quaternion_to_rotation_matrix(pair_q).numpy()
        scales = torch.exp(pair_log - pair_log.mean() + mean_log).numpy()
        factor = torch.exp(focal_change).numpy()
    cameras = {}
    for v, name in enumerate(names):
        camera = start.cameras[name]
        pose = np.eye(4)
        pose[:3, :3] = rotations[v]
        pose[:3, 3] = pose_t[v].detach().numpy() * depth_unit
        cameras[name] = replace(
            camera, fx=float(camera.fx * factor[v]), fy=float(camera.fy * factor[v]),
            cam_from_world=pose,
        )  # fmt: skip
    pair_from = list(start.pair_from)
    for n, k in enumerate(used):
        shift = pair_t[n].detach().numpy() * depth_unit
        pair_from[k] = (float(scales[n]), turned[n].copy(), shift)
    return Start(cameras, pair_from), float(mean_distance)


def _both(pair: PointmapPair) -> list[tuple[str, npt.NDArray, npt.NDArray]]:
    return [
        (pair.name_i, pair.points_i, pair.confidence_i),
        (pair.name_j, pair.points_j_in_i, pair.confidence_j),
    ]


class _Grid:
    """The sampled pixels of one view, and what the start says about their depth."""

    def __init__(self, start: Start, name: str, samples: int) -> None:
        self.camera = start.cameras[name]
        height, width = self.camera.height, self.camera.width
        stride = max(1, int(np.ceil(np.sqrt(height * width / samples))))
        self.rows = np.arange(stride // 2, height, stride)
        self.columns = np.arange(stride // 2, width, stride)
        v, u = np.meshgrid(self.rows + 0.5, self.columns + 0.5, indexing="ij")
        self.centred = np.stack([u.ravel() - self.camera.cx, v.ravel() - self.camera.cy], -1)
        self.sum = np.zeros(u.size)
        self.mass = np.zeros(u.size)

    def sample(self, points: npt.NDArray, confidence: npt.NDArray) -> tuple[Array, Array]:
        """Pointmap and log confidence at the grid: [M, 3], [M] float64."""
        index = np.ix_(self.rows, self.columns)
        weight = np.log(np.maximum(confidence[index].astype(np.float64), 1.0))
        return points[index].reshape(-1, 3).astype(np.float64), weight.ravel()

    def observe(self, world: Array, weight: Array) -> Array:
        """Add what a pair says of the depths; returns those that count."""
        depth = world @ self.camera.rotation[2] + self.camera.translation[2]
        good = (depth > 0) & (weight > 0)
        self.sum[good] += weight[good] * np.log(depth[good])
        self.mass[good] += weight[good]
        return np.asarray(depth[good])

    def log_depth(self, unit: float) -> Array:
        """Mean log depth in `unit`s; 0 where nothing is known (nothing pulls there either)."""
        mean = self.sum / np.maximum(self.mass, 1e-12) - np.log(unit)
        return np.where(self.mass > 0, mean, 0.0)
