"""Lanes of numba kernels: functions of 16 numbers at once, and the blocks that ellipses touch."""

from __future__ import annotations

import numpy as np
from numba import njit

from stages.splatting.lanes.blocks import BLOCK, BLOCKS, SIDE, TILE, touched_blocks
from stages.splatting.lanes.vectors import exponential, load_from, log2, store_from

LANES = 16


@njit
def exponentials(values, out):
    for k in range(0, values.shape[0], LANES):
        store_from(out, k, exponential(load_from(values, k)))


@njit
def logarithms(values, out):
    for k in range(0, values.shape[0], LANES):
        store_from(out, k, log2(load_from(values, k)))


@njit
def touched(mx, my, e, slope, width, height, across, inverse_a):
    return touched_blocks(mx, my, e, slope, width, height, across, inverse_a)


def test_exponential() -> None:
    values = np.linspace(-87, 87, 64 * LANES).astype(np.float32)
    out = np.empty_like(values)
    exponentials(values, out)
    assert np.abs(out / np.exp(values.astype(np.float64)) - 1).max() < 6e-6
    # neither overflow nor nothing, and what is no number is not taken for one
    special = np.array([-1e4, 1e4, np.nan, np.inf, -np.inf] + [0.0] * 11, np.float32)
    out = np.empty_like(special)
    exponentials(special, out)
    assert 0 < out[0] < 1e-37 and 1e37 < out[1] < np.inf
    assert np.isnan(out[2:5]).all() and (out[5:] == 1).all()


def test_logarithm() -> None:
    values = (2.0 ** np.linspace(-100, 100, 64 * LANES)).astype(np.float32)
    out = np.empty_like(values)
    logarithms(values, out)
    truth = np.log2(values.astype(np.float64))
    assert (np.abs(out - truth) < 3e-7 * np.maximum(np.abs(truth), 1)).all()


def blocks_by_pixels(mx, my, a, b, c, reach) -> int:
    """The definition: blocks of which a pixel (at whole coordinates) lies in the ellipse."""
    y, x = np.mgrid[:TILE, :TILE].astype(np.float64)
    dx, dy = x - mx, y - my
    inside = a * dx * dx + 2 * b * dx * dy + c * dy * dy <= reach
    rows, columns = np.nonzero(inside)
    return sum(1 << int(k) for k in set(rows // BLOCK * SIDE + columns // BLOCK))


def rectangles_met(mx, my, a, b, c, reach) -> int:
    """Blocks whose span of pixels (the lines between them too) an ellipse a little larger meets."""
    bits = 0
    steps = np.linspace(0, BLOCK - 1, 61)
    for block in range(BLOCKS):
        dx = block % SIDE * BLOCK + steps[None] - mx
        dy = block // SIDE * BLOCK + steps[:, None] - my
        bits |= int((a * dx * dx + 2 * b * dx * dy + c * dy * dy <= reach).any()) << block
    return bits


def test_blocks_that_an_ellipse_touches() -> None:
    rng = np.random.default_rng(5)
    found_any = 0
    for _ in range(300):
        mx, my = rng.uniform(-20, TILE + 20, 2)
        wide, thin = np.exp(rng.uniform(np.log(0.4), np.log(15), 2))
        angle = rng.uniform(0, np.pi)
        turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        covariance = turn @ np.diag([wide**2, thin**2]) @ turn.T
        (a, b), (_, c) = np.linalg.inv(covariance)
        reach = rng.uniform(0.5, 9)
        half_width, half_height = np.sqrt(reach * np.diag(covariance))
        numbers = (
            mx, my, 1 / covariance[1, 1], b / a, half_width, half_height, -b / c * half_width, 1 / a
        )  # fmt: skip
        bits = int(touched(*(np.float32(n) for n in numbers))) & (2**64 - 1)
        needed = blocks_by_pixels(mx, my, a, b, c, reach)
        # as much larger as the kernel allows for rounding, and for the steps above
        larger = reach * (1 + 0.12 / min(wide, thin) / np.sqrt(reach)) ** 2
        assert needed & ~bits == 0
        assert bits & ~rectangles_met(mx, my, a, b, c, larger) == 0
        found_any += bits != 0
    assert 100 < found_any < 300
