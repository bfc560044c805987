"""Density control: which Gaussians are cloned, split and pruned (3DGS; AbsGS for splits).

And densification as sampling (3DGS-MCMC, Kheradmand et al. 2024): the dead move to the living.
A Gaussian whose opacity has gone is put where a living one is; both are changed so that together
they look as the one did (equation 9 there). A fixed share is added each time until a hard cap is
reached, and noise, smaller the more opaque a Gaussian is, keeps the positions exploring.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numba import prange

from pipeline.kernels import kernel
from stages.fit.arrays import Array, Bools, Floats, Indices
from stages.splatting.threads import KERNELS

#: a split Gaussian's halves are smaller by this factor (3DGS)
SPLIT_SHRINK = 1.6
#: Gaussians per chunk of a kernel
CHUNK = 4096
#: Gaussians are added at this rate (5 %) each time, as in the paper
GROWTH = 0.05
#: noise falls to nothing for opacities above about 1 - this (logistic of steepness 100, as there)
NOISE_OPACITY, NOISE_STEEPNESS = 0.005, 100.0
#: so many may share one place; more change nothing
MOST_SHARERS = 51


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


def shared(opacity: Array, sharers: Indices) -> tuple[Floats, Floats]:
    """Opacity, and factor on the scales, of each of `sharers` Gaussians that stand for one."""
    opacity = np.clip(opacity, 1e-6, 1 - 1e-6)
    share = 1 - (1 - opacity) ** (1 / sharers)
    total = np.zeros(len(opacity))
    for i in range(1, int(sharers.max(initial=1)) + 1):
        terms = sum(
            math.comb(i - 1, k) * (-1) ** k * share ** (k + 1) / math.sqrt(k + 1) for k in range(i)
        )
        total += np.where(i <= sharers, terms, 0)
    return share.astype(np.float32), (opacity / total).astype(np.float32)


def relocate(
    packed: Floats, min_opacity: float, cap: int, random: np.random.Generator
) -> tuple[Floats, Indices, Bools]:
    """Move dead Gaussians and add new ones.

    Args:
        packed: [N, D].
        min_opacity: below it a Gaussian is dead.
        cap: how many there may be.
        random: decides who gets company, in proportion to opacity.

    Returns:
        The new matrix, for each row the row it came from, and whether its optimiser starts anew.
    """
    opacity = 1 / (1 + np.exp(-packed[:, 10].astype(np.float64)))
    dead = opacity <= min_opacity
    alive = np.flatnonzero(~dead)
    wanted = min(cap, int((1 + GROWTH) * len(packed))) - len(packed)
    movers = int(dead.sum()) + max(wanted, 0)
    source = np.arange(len(packed))
    if not len(alive) or not movers:
        return packed, source, np.zeros(len(packed), bool)
    chance = opacity[alive] / opacity[alive].sum()
    hosts = random.choice(alive, movers, p=chance)
    source = np.concatenate([alive, hosts])
    sharers = np.minimum(1 + np.bincount(hosts, minlength=len(packed)), MOST_SHARERS)[source]
    result = packed[source]
    crowded = sharers > 1
    share, factor = shared(opacity[source[crowded]], sharers[crowded])
    share = np.maximum(share, np.float32(min_opacity))
    result[crowded, 10] = np.log(share / (1 - share))
    result[crowded, 7:10] += np.log(factor)[:, None]
    return np.ascontiguousarray(result), source, crowded


def add_noise(packed: Floats, rate: float, random: np.random.Generator) -> None:
    """Move positions at random along their Gaussians; `rate` is noise_lr times the position's."""
    opacity = 1 / (1 + np.exp(-packed[:, 10]))
    size = 1 / (1 + np.exp(np.minimum(NOISE_STEEPNESS * (opacity - NOISE_OPACITY), 50)))
    noise = random.standard_normal((len(packed), 3)).astype(np.float32)
    turn = rotations(packed[:, 3:7])
    inner = np.einsum("nij,ni->nj", turn, noise) * np.exp(2 * packed[:, 7:10])
    step = np.einsum("nij,nj->ni", turn, inner) * (np.float32(rate) * size)[:, None]
    packed[:, :3] += step.astype(np.float32)


def add_regularisers(
    packed: Floats, gradient: Floats, opacity_weight: float, scale_weight: float
) -> None:
    """Add gradients of `opacity_weight` mean(opacity) + `scale_weight` mean(scale)."""
    count = np.float32(len(packed))
    if opacity_weight > 0:
        opacity = 1 / (1 + np.exp(-packed[:, 10]))
        gradient[:, 10] += np.float32(opacity_weight) * opacity * (1 - opacity) / count
    if scale_weight > 0:
        gradient[:, 7:10] += np.float32(scale_weight) * np.exp(packed[:, 7:10]) / (3 * count)
