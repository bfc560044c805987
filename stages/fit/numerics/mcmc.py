"""Densification as sampling (3DGS-MCMC, Kheradmand et al. 2024): the dead move to the living.

A Gaussian whose opacity has gone is put where a living one is; both are changed so that together
they look as the one did (equation 9 there). A fixed share is added each time until a hard cap is
reached, and noise, smaller the more opaque a Gaussian is, keeps the positions exploring.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from stages.fit.numerics.density import rotations

Floats = npt.NDArray[np.float32]
Ints = npt.NDArray[np.int64]
Bools = npt.NDArray[np.bool_]

#: Gaussians are added at this rate (5 %) each time, as in the paper
GROWTH = 0.05
#: noise falls to nothing for opacities above about 1 - this (logistic of steepness 100, as there)
NOISE_OPACITY, NOISE_STEEPNESS = 0.005, 100.0
#: so many may share one place; more change nothing
MOST_SHARERS = 51


def shared(opacity: npt.NDArray[np.float64], sharers: Ints) -> tuple[Floats, Floats]:
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
) -> tuple[Floats, Ints, Bools]:
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
