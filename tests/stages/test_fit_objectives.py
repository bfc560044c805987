"""Gradients of what the fit compares beside colour, against finite differences."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from stages.fit.numerics.background import behind, pulled_back
from stages.fit.numerics.objectives import depth_loss, flow_loss

HEIGHT, WIDTH = 13, 17
F = np.float32


def made(*shape: int, low: float = -1, high: float = 1, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).uniform(low, high, (*shape, HEIGHT, WIDTH)).astype(F)


def transmittance() -> np.ndarray:
    """Of which a third of the pixels let too much light pass to be compared."""
    left = made(low=0.05, high=0.4, seed=1)
    left[:, ::3] += F(0.5)
    return left


def loss_and_slopes(kind: str, planes: np.ndarray, left: np.ndarray) -> tuple[float, Any, Any]:
    """A loss, and its gradients by [C, H, W] and by the transmittance [H, W]."""
    by_planes, by_left = np.zeros_like(planes), np.zeros_like(left)
    if kind == "flow":
        mask = (made(seed=2) > -0.4).astype(F)
        loss = flow_loss(planes, left, made(2, seed=3), mask, 1.0, by_planes, by_left)
    else:
        rendering: Any = SimpleNamespace(planes=planes, transmittance=left)
        depth = made(low=0.5, high=1.5, seed=4) * (made(seed=5) > -0.4)
        loss = depth_loss(rendering, depth, 1.0, by_planes[3], by_left)
    return loss, by_planes, by_left


@pytest.mark.parametrize(("kind", "channels"), [("depth", 4), ("flow", 2)])
def test_slopes_of_depth_and_flow(kind: str, channels: int) -> None:
    planes, left = made(channels, low=0.3, high=1.2, seed=6), transmittance()
    _, by_planes, by_left = loss_and_slopes(kind, planes, left)
    step, along, across = F(1e-3), made(channels, seed=7), made(seed=8)
    ends = [
        loss_and_slopes(kind, planes + sign * step * along, left + sign * step * across)[0]
        for sign in (1, -1)
    ]
    slope = float((by_planes * along).sum() + (by_left * across).sum())
    assert abs(slope) > 1e-3
    assert (ends[0] - ends[1]) / (2 * float(step)) == pytest.approx(slope, rel=0.01)
    assert not by_left[:, ::3].any()


def test_slopes_of_the_background() -> None:
    image, left, wanted = made(3, seed=9), transmittance(), made(3, seed=10)
    colour, turn, across = np.array([0.2, 0.5, 0.9]), np.array([0.7, -0.4, 0.3]), made(seed=11)
    by_left = np.zeros_like(left)
    by_colour = pulled_back(wanted, left, colour, by_left)
    step = 1e-2
    ends = [
        float((behind(image, left + F(sign * step) * across, colour + sign * step * turn)
               * wanted.astype(np.float64)).sum())
        for sign in (1, -1)
    ]  # fmt: skip
    slope = float((by_left * across).sum() + by_colour @ turn)
    assert (ends[0] - ends[1]) / (2 * step) == pytest.approx(slope, rel=1e-3)
