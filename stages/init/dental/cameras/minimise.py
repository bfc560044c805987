"""The Levenberg-Marquardt loop of the bundle adjustment, for free and for held cameras.

Free cameras step in the unknowns of `bundle`. Held ones step in a similarity and the arch's shape:
the normal equations are projected onto these, and the views' unknowns follow.
"""

from __future__ import annotations

import numpy as np

from pipeline.kernels import helper, kernel
from stages.init.dental.cameras.algebra import (
    apply,
    cholesky,
    clear,
    copy_to,
    eliminate,
    multiply,
    rotation_and_jacobian,
    solve_cholesky,
)
from stages.init.dental.cameras.held import PER_SIMILARITY, tangents, unknowns_of
from stages.init.dental.cameras.kernels import (
    CENTRE_UNIT,
    OWN_DISTANCE,
    PER_ARCH,
    PER_VIEW,
    add_landmarks,
    add_matches,
    add_priors,
    place_cameras,
)


@helper
def _assess(  # type: ignore[no-untyped-def]
    x, offsets, view_of, landmark_of, pixels, deviations, template, lower, offset_deviation,
    nominal, angle_deviations, distance, distance_deviation, own_deviation, focals,
    focal_deviations, pairs, starts, matches, pair_weights, pair_deviations,
    rotations, centres, lens, jacobians, derive, H, b, H_own, b_own, H_cross,
):  # fmt: skip
    """Cost at x and offsets; where `derive`, with the normal equations."""
    views = len(nominal)
    if derive:
        clear(H)
        clear(b)
        clear(H_own)
        clear(b_own)
        clear(H_cross)
    place_cameras(
        x, views, nominal, angle_deviations, distance, focals, focal_deviations,
        rotations, centres, lens, jacobians,
    )  # fmt: skip
    cost = add_priors(
        x, offsets, views, distance, distance_deviation, own_deviation, centres, derive, H, b,
        H_own, b_own,
    )  # fmt: skip
    cost += add_landmarks(
        x, offsets, views, view_of, landmark_of, pixels, deviations, template, lower,
        offset_deviation, rotations, centres, lens, jacobians, angle_deviations,
        focal_deviations, derive, H, b, H_own, b_own, H_cross,
    )  # fmt: skip
    return cost + add_matches(
        pairs, starts, matches, pair_weights, pair_deviations, rotations, centres, lens,
        jacobians, angle_deviations, focal_deviations, derive, H, b,
    )  # fmt: skip


@kernel(
    "UniTuple(float64, 2)(float64[::1], float64[:,::1], int64[::1], int64[::1], float64[:,::1],"
    " float64[:,::1], float64[:,::1], boolean[::1], float64, float64[:,:,::1], float64[:,::1],"
    " float64, float64, float64[::1], float64[::1], int64[:,::1], int64[::1], float64[:,::1],"
    " float64[::1], float64[::1], boolean, float64[:,::1], float64[::1], float64,"
    " float64[:,:,::1], float64[:,::1], int64, float64, float64[:,::1])",
    nogil=True,
)
def minimise(  # type: ignore[no-untyped-def]
    x, offsets, view_of, landmark_of, pixels, deviations, template, lower, offset_deviation,
    nominal, angle_deviations, distance, distance_deviation, focals, focal_deviations,
    pairs, starts, matches, pair_weights, pair_deviations,
    held, rotation, centre, log_scale, turns, shifts, max_steps, tolerance, S,
):  # fmt: skip
    """Levenberg-Marquardt from x [n = 7V + 9] and offsets [N, 3], both changed in place.

    Args:
        held: the cameras (turns [V, 3, 3], shifts [V, 3]) hold still relative to each other; the
            start is the similarity (rotation [3, 3], centre [3], log_scale), which is changed in
            place too, and the arch's part of x.

    Returns:
        Cost and log determinant of the Hessian at the end. S becomes the reduced Hessian: [n, n],
        or [16, 16] of similarity and arch.
    """
    views, n, count = len(nominal), len(x), len(offsets)
    # How far known cameras are from each other, they say themselves.
    own_deviation = distance_deviation if held else OWN_DISTANCE
    m = PER_SIMILARITY + PER_ARCH if held else n
    rotations, jacobians = np.empty((views, 3, 3)), np.empty((views, 3, 3))
    centres, lens = np.empty((views, 3)), np.empty(views)
    H, b = np.zeros((n, n)), np.zeros(n)
    H_own, b_own = np.zeros((count, 3, 3)), np.zeros((count, 3))
    H_cross, own_inverse = np.zeros((count, n, 3)), np.empty((count, 3, 3))
    free_H, free_b, free_cross = H, b, H_cross  # in what the steps are taken
    T, H_T, w = np.empty((n, m)), np.empty((n, m)), np.empty(3)
    small, small_jacobian = np.empty((3, 3)), np.empty((3, 3))
    if held:
        free_H, free_b, free_cross = np.empty((m, m)), np.empty(m), np.empty((count, m, 3))
        unknowns_of(
            rotation, centre, log_scale, turns, shifts, nominal, angle_deviations, distance, x
        )
    L, s, step = np.zeros((m, m)), np.empty(m), np.empty(m)
    trial, trial_offsets = np.empty(n), np.empty((count, 3))
    trial_rotation, trial_centre, trial_scale = np.empty((3, 3)), np.empty(3), log_scale
    copy_to(rotation, trial_rotation)
    copy_to(centre, trial_centre)
    damping, cost, finished = 1e-3, 0.0, False
    derive = np.bool_(True)  # a literal would have `_assess` compiled for each of both
    for iteration in range(max_steps + 1):
        cost = _assess(
            x, offsets, view_of, landmark_of, pixels, deviations, template, lower,
            offset_deviation, nominal, angle_deviations, distance, distance_deviation,
            own_deviation, focals, focal_deviations, pairs, starts, matches, pair_weights,
            pair_deviations, rotations, centres, lens, jacobians, derive, H, b, H_own, b_own,
            H_cross,
        )  # fmt: skip
        if held:
            tangents(log_scale, turns, shifts, jacobians, angle_deviations, T)
            multiply(H, T, H_T)
            multiply(T.T, H_T, free_H)
            apply(T.T, b, free_b)
            for i in range(count):
                multiply(T.T, H_cross[i], free_cross[i])
        if finished or iteration == max_steps:
            break
        improved = False
        for _ in range(8):
            eliminate(free_H, free_b, H_own, b_own, free_cross, damping, S, s, own_inverse)
            if np.isnan(cholesky(S, L)):
                damping = max(damping, 1e-4) * 10
                continue
            solve_cholesky(L, s, step)
            for i in range(count):
                g0, g1, g2 = b_own[i, 0], b_own[i, 1], b_own[i, 2]
                for k in range(m):
                    cross = free_cross[i, k]
                    g0 -= cross[0] * step[k]
                    g1 -= cross[1] * step[k]
                    g2 -= cross[2] * step[k]
                for a in range(3):
                    inverse = own_inverse[i, a]
                    change = inverse[0] * g0 + inverse[1] * g1 + inverse[2] * g2
                    trial_offsets[i, a] = offsets[i, a] - change
            if held:
                for a in range(3):
                    w[a] = -step[a]
                    trial_centre[a] = centre[a] - CENTRE_UNIT * step[3 + a]
                rotation_and_jacobian(w, small, small_jacobian)
                multiply(small, rotation, trial_rotation)
                trial_scale = log_scale - step[6]
                for k in range(PER_ARCH):
                    trial[PER_VIEW * views + k] = x[PER_VIEW * views + k] - step[PER_SIMILARITY + k]
                unknowns_of(
                    trial_rotation, trial_centre, trial_scale, turns, shifts, nominal,
                    angle_deviations, distance, trial,
                )  # fmt: skip
            else:
                for k in range(n):
                    trial[k] = x[k] - step[k]
            new_cost = _assess(
                trial, trial_offsets, view_of, landmark_of, pixels, deviations, template, lower,
                offset_deviation, nominal, angle_deviations, distance, distance_deviation,
                own_deviation, focals, focal_deviations, pairs, starts, matches, pair_weights,
                pair_deviations, rotations, centres, lens, jacobians, not derive, H, b, H_own,
                b_own, H_cross,
            )  # fmt: skip
            if new_cost < cost:
                improved = True
                finished = cost - new_cost < tolerance
                copy_to(trial, x)
                copy_to(trial_offsets, offsets)
                copy_to(trial_rotation, rotation)
                copy_to(trial_centre, centre)
                log_scale = trial_scale
                damping = max(damping * 0.2, 1e-7)
                break
            damping = max(damping, 1e-5) * 8
        if not improved:
            finished = True
    log_determinant = eliminate(free_H, free_b, H_own, b_own, free_cross, 0.0, S, s, own_inverse)
    log_determinant += cholesky(S, L)
    for k in range(m):
        for l in range(k):
            S[l, k] = S[k, l]
    return cost, log_determinant
