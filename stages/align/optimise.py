"""Joint optimisation of poses, focal lengths, depths and pair similarities.

DUSt3R's objective (section 3.4): the sum over pairs and both their views of the mean over pixels
of log(confidence) times the distance between what the pair says and where the view's depth puts
the pixel. Three things differ, all for accuracy on noisy maps:

- A pair's frame is the camera of its first view up to a scale, which pins the focal lengths. DUSt3R
  frees it; with 1 % of noise focal lengths are then 1 to 3 % off, instead of .1 %.
- Residuals are taken in the pair's frame, relative to the distance (see `linearise`).
- The loss is Huber's at the median residual, not the bare distance.

Solved by Levenberg-Marquardt with the depths eliminated: some ten steps, where Adam takes 300.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy import linalg
from threadpoolctl import threadpool_limits

from pipeline.artifacts.pointmaps import PointmapPair
from pipeline.geometry.start import Start
from stages.align.linearise import CAMERA, PAIR, linearise_view
from stages.align.problem import (
    AlignOptions,
    State,
    View,
    as_start,
    common_focal,
    free_directions,
    moved_by,
    problem,
)

__all__ = ["AlignOptions", "optimise"]

Array = npt.NDArray[np.float64]

#: Damping of the first step, relative to the diagonal; what it is multiplied by; where it ends.
_DAMPING, _LESS, _MORE, _MOST = 1e-3, 0.2, 8.0, 1e6
#: Seven directions (the world's own similarity) change nothing; this keeps them still.
_LEAST_DAMPING = 1e-9
#: A step that lowers the objective by a smaller share is the last one.
_TOLERANCE = 1e-5
#: Depths change by at most this factor (log) per step.
_LARGEST_DEPTH_STEP = 0.5


@dataclass
class _System:
    """Normal equations around a state.

    Attributes:
        loss: objective.
        blocks: per view matrix, gradient, cross, depth curvature and gradient.
        median: of the residuals; mean: weighted.
    """

    loss: float
    blocks: list[tuple[Array, Array, Array, Array, Array]]
    median: float
    mean: float


def optimise(
    pairs: Sequence[PointmapPair],
    start: Start,
    options: AlignOptions,
    progress: Callable[[int, int, float], None] = lambda done, total, loss: None,
) -> tuple[Start, float]:
    """Improve a start.

    One thread and float64, so that the result does not depend on the machine.

    Args:
        pairs: as given to the start.
        start: cameras and pair similarities.
        options: see `AlignOptions`.
        progress: called with (iteration, iterations, mean residual).

    Returns:
        The improved start and the mean weighted residual, relative to the distance.
    """
    used = [k for k, motion in enumerate(start.pair_from) if motion is not None]
    if not used:
        return start, 0.0
    names = sorted(start.cameras)
    with threadpool_limits(limits=1):
        views, state = problem(pairs, start, used, names, options.samples)
        if options.iterations == 0:
            return start, _linearise(views, state, 1.0).mean
        if options.shared_focal and options.free_focals:
            state.focals[:] = common_focal(start, names)
        state, mean = _minimise(views, state.tied(), options, progress)
    return as_start(start, used, names, state), mean


def _linearise(views: Sequence[View], state: State, delta: float) -> _System:
    loss = 0.0
    blocks, sizes, weights = [], [], []
    for v, view in enumerate(views):
        count = CAMERA + PAIR * len(view.pairs)
        block = (
            np.zeros((count, count)),
            np.zeros(count),
            np.zeros((len(view.pixels), count)),
            np.zeros(len(view.pixels)),
            np.zeros(len(view.pixels)),
        )
        size = np.zeros(view.weight.shape)
        loss += linearise_view(
            view.pixels, state.log_depths[v], state.rotations[v], state.translations[v],
            state.focals[v], state.pair_rotations[view.pairs], state.pair_scales[view.pairs],
            state.pair_shifts[view.pairs], view.points, view.weight, view.inverse_distance,
            float(delta), *block, size,
        )  # fmt: skip
        blocks.append(block)
        sizes.append(size[view.weight > 0])
        weights.append(view.weight[view.weight > 0])
    size, weight = np.concatenate(sizes), np.concatenate(weights)
    if len(size) == 0:
        return _System(0.0, blocks, 0.0, 0.0)
    return _System(
        float(loss), blocks, float(np.median(size)), float((size * weight).sum() / weight.sum())
    )


def _minimise(
    views: Sequence[View],
    state: State,
    options: AlignOptions,
    progress: Callable[[int, int, float], None],
) -> tuple[State, float]:
    # A residual below this is rounding, and a weight that divides by it would be noise.
    least = 1e-9
    delta = max(_linearise(views, state, 1.0).median, least)
    system = _linearise(views, state, delta)
    damping = _DAMPING
    for step in range(options.iterations):
        progress(step, options.iterations, system.mean)
        while True:
            moved = _step(views, state, system, options, damping)
            trial = _linearise(views, moved, delta) if moved is not None else None
            if trial is not None and trial.loss <= system.loss:
                break
            damping *= _MORE
            if damping > _MOST:
                return state, system.mean
        assert moved is not None
        gain = system.loss - trial.loss
        state, damping = moved, max(damping * _LESS, _LEAST_DAMPING)
        settled = gain <= _TOLERANCE * system.loss
        system = trial
        # Where residuals have shrunk, so does what counts as large; the loss is another one then.
        smaller = max(system.median, least)
        if smaller < 0.9 * delta:
            delta = smaller
            system = _linearise(views, state, delta)
        elif settled:
            break
    progress(options.iterations, options.iterations, system.mean)
    return state, system.mean


def _step(
    views: Sequence[View],
    state: State,
    system: _System,
    options: AlignOptions,
    damping: float,
) -> State | None:
    """One damped Gauss-Newton step; None if the equations can't be solved."""
    free = free_directions(state, options)
    size = free.shape[0]
    matrix, gradient = np.zeros((size, size)), np.zeros(size)
    curvatures = []
    offset = CAMERA * len(views)
    indices = []
    for v, (view, block) in enumerate(zip(views, system.blocks, strict=True)):
        own, own_gradient, cross, curvature, depth_gradient = block
        full = np.tril(own) + np.tril(own, -1).T
        damped = curvature * (1 + damping) + 1e-12 * max(float(curvature.max(initial=0)), 1e-300)
        index = np.concatenate(
            [CAMERA * v + np.arange(CAMERA)]
            + [offset + PAIR * e + np.arange(PAIR) for e in view.pairs]
        )
        scaled = cross / damped[:, None]
        matrix[np.ix_(index, index)] += full - cross.T @ scaled
        gradient[index] += own_gradient - scaled.T @ depth_gradient
        curvatures.append(damped)
        indices.append(index)
    reduced = free.T @ matrix @ free
    diagonal = np.diag(reduced).copy()
    diagonal = np.maximum(diagonal, 1e-12 * max(float(diagonal.max(initial=0)), 1e-300))
    reduced[np.diag_indices_from(reduced)] += (damping + _LEAST_DAMPING) * diagonal
    try:
        solution = free @ linalg.cho_solve(
            linalg.cho_factor(reduced, check_finite=False), -(free.T @ gradient)
        )
    except linalg.LinAlgError:
        return None
    if not np.isfinite(solution).all():
        return None
    log_depths = [
        depth
        - np.clip(
            (block[4] + block[2] @ solution[index]) / curvature,
            -_LARGEST_DEPTH_STEP, _LARGEST_DEPTH_STEP,
        )
        for depth, block, index, curvature in zip(
            state.log_depths, system.blocks, indices, curvatures, strict=True
        )
    ]  # fmt: skip
    moved = moved_by(state, solution, log_depths)
    return moved.tied()
