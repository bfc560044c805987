"""A smooth field through scattered, partly wrong offsets."""

from __future__ import annotations

from functools import lru_cache

import cv2
import numpy as np
import numpy.typing as npt
import scipy.sparse as sparse
from scipy.linalg import solveh_banded
from threadpoolctl import threadpool_limits

Array32 = npt.NDArray[np.float32]

#: The field is solved for on a grid so many times coarser than the chart (half a mm at the default
#: density), where stiffness is counted.
_COARSER = 4
#: Rounds in which offsets that stand out lose weight.
REWEIGHTINGS = 3


def fit_offsets(
    offset: Array32,
    weight: Array32,
    stiffness: float,
    anchor: float,
    outlier: float,
    held: Array32 | None = None,
    target: Array32 | None = None,
    reweightings: int = REWEIGHTINGS,
) -> Array32:
    """Minimise sum w (x - o)^2 + h (x - t)^2 + stiffness |D2 x|^2 + anchor x^2, robustly.

    D2 are second differences (xx, yy and twice xy: the thin plate). Weights fall as
    1 / (1 + ((x - o) / outlier)^2) in iteratively reweighted least squares. Where there is no
    weight the plate bridges and falls back to 0.

    Args:
        offset: [H, W] float32.
        weight: [H, W] float32 >= 0.
        stiffness: of the plate.
        anchor: pull to 0.
        outlier: scale of the reweighting, in the units of the offset.
        held, target: [H, W] float32 weight >= 0 and offset t of what is no measurement, and never
            an outlier.
        reweightings: how often weights are found anew.

    Returns:
        [H, W] float32.
    """
    rows, cols = (max(n // _COARSER, 3) for n in offset.shape)
    size = (cols, rows)
    shape = (offset.shape[1], offset.shape[0])
    plate = _plate(cols, rows, float(stiffness))
    trust = weight
    fitted = np.zeros_like(offset)
    with threadpool_limits(limits=1):
        for step in range(reweightings + 1):
            # Sample by sample: once averaged over a cell, an outlier can't be told any more.
            if step:
                trust = reweighted(offset, weight, fitted, outlier)
            # Columns one after the other: the chart is wide, so that the band is narrow.
            total, moment = trust, trust * offset
            if held is not None and target is not None:
                total, moment = total + held, moment + held * target
            mass = _reduced(total, size).T.ravel()
            system = plate.copy()
            system[0] += mass + anchor
            right = _reduced(moment, size).T.ravel()
            field = solveh_banded(system, right, lower=True, overwrite_ab=True)
            coarse = np.ascontiguousarray(field.reshape(cols, rows).T, np.float32)
            fitted = np.asarray(cv2.resize(coarse, shape, interpolation=cv2.INTER_CUBIC))
    return np.asarray(fitted, np.float32)


def reweighted(offset: Array32, weight: Array32, fitted: Array32, outlier: float) -> Array32:
    """The weights [H, W] that offsets keep beside a field that was fitted to them."""
    return np.asarray(weight / (1 + ((fitted - offset) / np.float32(outlier)) ** 2), np.float32)


def _reduced(values: Array32, size: tuple[int, int]) -> npt.NDArray[np.float64]:
    """Means over the cells of a coarser grid (columns, rows)."""
    return np.asarray(cv2.resize(values, size, interpolation=cv2.INTER_AREA), np.float64)


@lru_cache(maxsize=2)  # some MB each: fits of a jaw's chart follow each other
def _plate(slow: int, fast: int, stiffness: float) -> npt.NDArray[np.float64]:
    """[2 fast + 1, slow * fast] lower band of the thin plate's matrix on a grid (slow, fast).

    Not to be changed: it is kept.
    """

    def second(n: int) -> sparse.csr_matrix:
        return sparse.diags_array(
            [np.ones(n - 2), np.full(n - 2, -2.0), np.ones(n - 2)],
            offsets=[0, 1, 2],
            shape=(n - 2, n),
        ).tocsr()

    def first(n: int) -> sparse.csr_matrix:
        return sparse.diags_array(
            [-np.ones(n - 1), np.ones(n - 1)], offsets=[0, 1], shape=(n - 1, n)
        ).tocsr()

    along = sparse.kron(second(slow), sparse.eye_array(fast))
    across = sparse.kron(sparse.eye_array(slow), second(fast))
    mixed = sparse.kron(first(slow), first(fast))
    matrix = (along.T @ along + across.T @ across + 2 * (mixed.T @ mixed)) * stiffness
    matrix = matrix.todia()
    band = np.zeros((2 * fast + 1, slow * fast))
    for offset, diagonal in zip(matrix.offsets, matrix.data, strict=True):
        # A dia matrix keeps element (i, j) at column j; the lower band wants it there as well.
        if -2 * fast <= offset <= 0:
            band[-offset, : len(diagonal)] = diagonal[: slow * fast]
    return band
