"""Density control: which Gaussians are cloned, split and pruned (3DGS; AbsGS for splits)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numba import prange

from pipeline.kernels import kernel
from stages.fit.arrays import Bools, Floats, Indices
from stages.splatting.threads import KERNELS

#: a split Gaussian's halves are smaller by this factor (3DGS)
SPLIT_SHRINK = 1.6
#: Gaussians per chunk of a kernel
CHUNK = 4096


@kernel(parallel=True)
def _accumulate(  # type: ignore[no-untyped-def]
    centres: Floats, absolute: Floats, visible: Bools, half_width: np.float32,
    half_height: np.float32, signed_sum: Floats, absolute_sum: Floats, seen: Floats,
):  # fmt: skip
    """Add the norms of gradients [N, 2] of the visible Gaussians, and count these."""
    number = centres.shape[0]
    for chunk in prange((number + CHUNK - 1) // CHUNK):
        for i in range(chunk * CHUNK, min(number, (chunk + 1) * CHUNK)):
            if visible[i]:
                x, y = centres[i, 0] * half_width, centres[i, 1] * half_height
                signed_sum[i] += math.sqrt(x * x + y * y)
                x, y = absolute[i, 0] * half_width, absolute[i, 1] * half_height
                absolute_sum[i] += math.sqrt(x * x + y * y)
                seen[i] += np.float32(1)


@dataclass
class DensityStatistics:
    """What has been seen since the last densification.

    Attributes:
        signed, absolute: [N] float32 sums over views of the norm of the screen gradient, in NDC.
        seen: [N] float32 number of views.
    """

    signed: Floats
    absolute: Floats
    seen: Floats

    @classmethod
    def empty(cls, count: int) -> DensityStatistics:
        return cls(*(np.zeros(count, np.float32) for _ in range(3)))

    def add(
        self, centres: Floats, absolute: Floats, visible: Bools, width: int, height: int
    ) -> None:
        """Add one view's gradients [N, 2], px^-1; they are kept per half image (NDC)."""
        with KERNELS:
            _accumulate(
                np.ascontiguousarray(centres, np.float32),
                np.ascontiguousarray(absolute, np.float32), np.ascontiguousarray(visible),
                np.float32(width / 2), np.float32(height / 2), self.signed, self.absolute,
                self.seen,
            )  # fmt: skip


def rotations(quats: Floats) -> Floats:
    """[N, 3, 3] rotation matrices of quaternions wxyz [N, 4] of any length."""
    w, x, y, z = (quats / np.linalg.norm(quats, axis=1, keepdims=True)).T
    rows = [
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    ]  # fmt: skip
    return np.stack(rows, 1).reshape(-1, 3, 3)


def choose(
    statistics: DensityStatistics, largest_scale: Floats, *, small: float, absgrad: str,
    grad_threshold: float, abs_grad_threshold: float, room: int,
) -> tuple[Bools, Bools]:  # fmt: skip
    """Which Gaussians to clone and which to split.

    Args:
        statistics: since the last call.
        largest_scale: [N] largest standard deviation.
        small: up to this scale a Gaussian is cloned, above it split.
        absgrad: ``"split"`` (AbsGS: split on absolute gradients, clone on signed), ``"both"``
            (absolute gradients for both, as gsplat) or ``"off"`` (3DGS).
        grad_threshold, abs_grad_threshold: for signed and absolute gradients.
        room: how many more Gaussians there may be; the largest gradients come first.
    """
    views = np.maximum(statistics.seen, 1)
    signed = statistics.signed / views / grad_threshold
    absolute = statistics.absolute / views / abs_grad_threshold
    is_small = largest_scale <= small
    for_clone = absolute if absgrad == "both" else signed
    for_split = signed if absgrad == "off" else absolute
    clone = (for_clone >= 1) & is_small
    split = (for_split >= 1) & ~is_small
    excess = int(clone.sum() + split.sum()) - max(room, 0)
    if excess > 0:
        score = np.where(clone, for_clone, 0) + np.where(split, for_split, 0)
        # stable, so that equal scores are decided by their order
        ranked = np.argsort(-score, kind="stable")[: max(room, 0)]
        allowed = np.zeros(len(score), bool)
        allowed[ranked] = True
        clone &= allowed
        split &= allowed
    return clone, split


def grow(
    packed: Floats, clone: Bools, split: Bools, keep: Bools, random: np.random.Generator
) -> tuple[Floats, Indices, Bools]:
    """Clone, split and prune.

    Args:
        packed: [N, D] Gaussians.
        clone, split: [N] what `choose` chose; a split Gaussian is replaced by two samples of it.
        keep: [N] False for what is pruned.
        random: for the samples.

    Returns:
        The new packed matrix, for each of its rows the old row that it came from, and whether it is
        new (its optimiser state starts from zero).
    """
    survivors = np.flatnonzero(keep & ~split)
    clones = np.flatnonzero(clone & keep)
    halves = np.repeat(np.flatnonzero(split & keep), 2)
    source = np.concatenate([survivors, clones, halves])
    fresh = np.arange(len(source)) >= len(survivors)
    result = packed[source]
    if len(halves):
        rows = slice(len(survivors) + len(clones), None)
        half = result[rows]
        noise = random.standard_normal((len(half), 3)).astype(np.float32) * np.exp(half[:, 7:10])
        half[:, 0:3] += np.einsum("nij,nj->ni", rotations(half[:, 3:7]), noise)
        half[:, 7:10] -= np.float32(np.log(SPLIT_SHRINK))
        result[rows] = half
    return np.ascontiguousarray(result), source, fresh
