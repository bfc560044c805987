"""Kernels of the bundle adjustment in `bundle`; that module says what the unknowns are."""

from __future__ import annotations

import numpy as np

from pipeline.kernels import kernel
from stages.init.dental.cameras.algebra import (
    apply,
    clear,
    cross_matrix,
    multiply,
    rotation_and_jacobian,
)

#: Unknowns per view, of the arch, and how strongly its parts vary (one standard deviation): stretch
#: along each axis, shift of the lower jaw (mm), its extra stretch.
PER_VIEW, PER_ARCH = 7, 9
STRETCH, LOWER_SHIFT, LOWER_STRETCH = 0.10, 1.5, 0.07
#: The centre of the arch lies in the camera frame within a few of these (mm): nearly free.
CENTRE_UNIT = 10.0
#: A photographer keeps a distance: relative standard deviation of that of a photograph from those
#: of the others.
OWN_DISTANCE = 0.1
#: Residuals beyond these many standard deviations count less (landmarks: pseudo-Huber, dense
#: matches: Cauchy).
LANDMARK_KNEE, DENSE_KNEE = 2.0, 1.5
#: How far to the front the point of the arch lies that cameras look at (mm).
CENTRE_Z = -16.0


@kernel(
    "void(float64[::1], int64, float64[:,:,::1], float64[:,::1], float64, float64[::1],"
    " float64[::1], float64[:,:,::1], float64[:,::1], float64[::1], float64[:,:,::1])",
    nogil=True,
    linked=True,
)
def place_cameras(  # type: ignore[no-untyped-def]
    x, views, nominal, angle_deviations, distance, focals, focal_deviations,
    rotations, centres, lens, jacobians,
):  # fmt: skip
    """Rotation, place of the arch's centre and focal length of each view from the unknowns."""
    turn = np.empty((3, 3))
    w = np.empty(3)
    for v in range(views):
        p = x[PER_VIEW * v : PER_VIEW * (v + 1)]
        for a in range(3):
            w[a] = p[a] * angle_deviations[v, a]
            centres[v, a] = CENTRE_UNIT * p[3 + a]
        centres[v, 2] += distance
        rotation_and_jacobian(w, turn, jacobians[v])
        for a in range(3):
            for b in range(3):
                total = 0.0
                for k in range(3):
                    total += turn[a, k] * nominal[v, k, b]
                rotations[v, a, b] = total
        lens[v] = focals[v] * np.exp(p[6] * focal_deviations[v])


@kernel(
    "float64(float64[::1], float64[:,::1], int64, int64[::1], int64[::1], float64[:,::1],"
    " float64[:,::1], float64[:,::1], boolean[::1], float64, float64[:,:,::1], float64[:,::1],"
    " float64[::1], float64[:,:,::1], float64[:,::1], float64[::1], boolean,"
    " float64[:,::1], float64[::1], float64[:,:,::1], float64[:,::1], float64[:,:,::1])",
    nogil=True,
    linked=True,
)
def add_landmarks(  # type: ignore[no-untyped-def]
    x, offsets, views, view_of, landmark_of, pixels, deviations, template, lower, offset_deviation,
    rotations, centres, lens, jacobians, angle_deviations, focal_deviations, derive,
    H, b, H_own, b_own, H_cross,
):  # fmt: skip
    """Cost of the landmarks; their part of the normal equations where `derive`.

    H must come symmetric: its lower half is added to, and mirrored.
    """
    cost = 0.0
    arch = PER_VIEW * views
    d_point = np.zeros((2, 3))
    row = np.zeros((2, PER_VIEW + PER_ARCH))
    own = np.zeros((2, 3))
    columns = np.empty(PER_VIEW + PER_ARCH, np.int64)
    X, own_place, stretch = np.empty(3), np.empty(3), np.empty(3)
    turned = np.empty(3)
    knee = LANDMARK_KNEE
    for o in range(len(view_of)):
        v, i = view_of[o], landmark_of[o]
        R = rotations[v]
        for a in range(3):
            own_place[a] = template[i, a] + offset_deviation * offsets[i, a]
            stretch[a] = 1 + STRETCH * x[arch + a]
            if lower[i]:
                stretch[a] += LOWER_STRETCH * x[arch + 6 + a]
            X[a] = stretch[a] * own_place[a]
            if lower[i]:
                X[a] += LOWER_SHIFT * x[arch + 3 + a]
        z0 = X[2] - CENTRE_Z
        for a in range(3):
            turned[a] = R[a, 0] * X[0] + R[a, 1] * X[1] + R[a, 2] * z0
        Z = max(turned[2] + centres[v, 2], 1.0)
        f = lens[v]
        px = f * (turned[0] + centres[v, 0]) / Z
        py = f * (turned[1] + centres[v, 1]) / Z
        rx = (px - pixels[o, 0]) / deviations[o, 0]
        ry = (py - pixels[o, 1]) / deviations[o, 1]
        sx = np.sqrt(1 + (rx / knee) ** 2)
        sy = np.sqrt(1 + (ry / knee) ** 2)
        cost += 2 * knee * knee * (sx + sy - 2)
        if not derive:
            continue
        d_point[0, 0] = d_point[1, 1] = f / Z
        d_point[0, 2], d_point[1, 2] = -px / Z, -py / Z
        J = jacobians[v]
        for r in range(2):
            scale = 1 / deviations[o, r]
            g0, g1, g2 = d_point[r, 0] * scale, d_point[r, 1] * scale, d_point[r, 2] * scale
            # Turning by a small rotation n moves the point by n x turned.
            m0 = turned[1] * g2 - turned[2] * g1
            m1 = turned[2] * g0 - turned[0] * g2
            m2 = turned[0] * g1 - turned[1] * g0
            for a in range(3):
                row[r, a] = (m0 * J[0, a] + m1 * J[1, a] + m2 * J[2, a]) * angle_deviations[v, a]
            row[r, 3], row[r, 4], row[r, 5] = g0 * CENTRE_UNIT, g1 * CENTRE_UNIT, g2 * CENTRE_UNIT
            row[r, 6] = (px if r == 0 else py) * scale * focal_deviations[v]
            for a in range(3):
                d_world = g0 * R[0, a] + g1 * R[1, a] + g2 * R[2, a]
                t = own_place[a]
                row[r, 7 + a] = d_world * t * STRETCH
                row[r, 10 + a] = d_world * LOWER_SHIFT if lower[i] else 0.0
                row[r, 13 + a] = d_world * t * LOWER_STRETCH if lower[i] else 0.0
                own[r, a] = d_world * stretch[a] * offset_deviation
        for k in range(PER_VIEW):
            columns[k] = PER_VIEW * v + k
        for k in range(PER_ARCH):
            columns[PER_VIEW + k] = arch + k
        for r in range(2):
            residual = rx if r == 0 else ry
            weight = 1 / (sx if r == 0 else sy)
            for k in range(PER_VIEW + PER_ARCH):
                value = weight * row[r, k]
                b[columns[k]] += value * residual
                for l in range(k + 1):
                    H[columns[k], columns[l]] += value * row[r, l]
                for a in range(3):
                    H_cross[i, columns[k], a] += value * own[r, a]
            for a in range(3):
                b_own[i, a] += weight * own[r, a] * residual
                for c in range(3):
                    H_own[i, a, c] += weight * own[r, a] * own[r, c]
    if derive:
        for k in range(len(H)):
            for l in range(k):
                H[l, k] = H[k, l]
    return cost


@kernel(
    "float64(int64[:,::1], int64[::1], float64[:,::1], float64[::1], float64[::1],"
    " float64[:,:,::1], float64[:,::1], float64[::1], float64[:,:,::1], float64[:,::1],"
    " float64[::1], boolean, float64[:,::1], float64[::1])",
    nogil=True,
    linked=True,
)
def add_matches(  # type: ignore[no-untyped-def]
    pairs, starts, matches, pair_weights, pair_deviations,
    rotations, centres, lens, jacobians, angle_deviations, focal_deviations, derive, H, b,
):  # fmt: skip
    """Cost of dense matches: Sampson's distance (Hartley & Zisserman 11.4.3)."""
    cost = 0.0
    R, E, F = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    dR, dE, rest = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    d_fundamental, chained = np.zeros((14, 9)), np.empty((14, 9))
    gradient = np.empty(9)
    normal = np.empty((9, 9))
    right = np.empty(9)
    spin = np.empty((3, 3))
    t_cross = np.empty((3, 3))
    d_t_cross = np.empty((3, 3))
    unit, t, dt = np.empty(3), np.empty(3), np.empty(3)
    for p in range(len(pairs)):
        i, j = pairs[p, 0], pairs[p, 1]
        multiply(rotations[j], rotations[i].T, R)
        # In the frame of the arch's centre: camera = R X + centre, so that t = c_j - R c_i.
        apply(R, centres[i], t)
        for a in range(3):
            t[a] = centres[j, a] - t[a]
        cross_matrix(t, t_cross)
        multiply(t_cross, R, E)
        scale_i, scale_j = 1 / lens[i], 1 / lens[j]
        for a in range(3):
            for c in range(3):
                F[a, c] = E[a, c] * (scale_j if a < 2 else 1.0) * (scale_i if c < 2 else 1.0)
        clear(normal)
        clear(right)
        weight = pair_weights[p]
        deviation = pair_deviations[p]
        for m in range(starts[p], starts[p + 1]):
            ax, ay, bx, by = matches[m, 0], matches[m, 1], matches[m, 2], matches[m, 3]
            l0 = F[0, 0] * ax + F[0, 1] * ay + F[0, 2]
            l1 = F[1, 0] * ax + F[1, 1] * ay + F[1, 2]
            l2 = F[2, 0] * ax + F[2, 1] * ay + F[2, 2]
            k0 = F[0, 0] * bx + F[1, 0] * by + F[2, 0]
            k1 = F[0, 1] * bx + F[1, 1] * by + F[2, 1]
            error = bx * l0 + by * l1 + l2
            square = l0 * l0 + l1 * l1 + k0 * k0 + k1 * k1 + 1e-30
            length = np.sqrt(square)
            r = error / length / deviation
            q = (r / DENSE_KNEE) ** 2
            cost += weight * DENSE_KNEE * DENSE_KNEE * np.log1p(q)
            if not derive:
                continue
            w = weight / (1 + q)
            inverse = 1 / (length * deviation)
            share = error / square
            for a in range(3):
                bb = bx if a == 0 else (by if a == 1 else 1.0)
                la = l0 if a == 0 else (l1 if a == 1 else 0.0)
                for c in range(3):
                    aa = ax if c == 0 else (ay if c == 1 else 1.0)
                    kc = k0 if c == 0 else (k1 if c == 1 else 0.0)
                    gradient[3 * a + c] = (bb * aa - share * (la * aa + kc * bb)) * inverse
            for a in range(9):
                right[a] += w * gradient[a] * r
                for c in range(9):
                    normal[a, c] += w * gradient[a] * gradient[c]
        if not derive:
            continue
        for side in range(2):
            v = j if side else i
            for k in range(6):
                if k < 3:
                    for a in range(3):
                        unit[a] = jacobians[v, a, k] * angle_deviations[v, k]
                    cross_matrix(unit, spin)
                    if side:
                        multiply(spin, R, dR)
                    else:
                        multiply(R, spin.T, dR)  # spin^T = -spin
                    apply(dR, centres[i], dt)
                    for a in range(3):
                        dt[a] = -dt[a]
                    multiply(t_cross, dR, rest)
                else:
                    clear(rest)
                    for a in range(3):
                        dt[a] = CENTRE_UNIT * (a == k - 3) if side else -CENTRE_UNIT * R[a, k - 3]
                cross_matrix(dt, d_t_cross)
                multiply(d_t_cross, R, dE)
                for a in range(3):
                    for c in range(3):
                        value = dE[a, c] + rest[a, c]
                        value *= (scale_j if a < 2 else 1.0) * (scale_i if c < 2 else 1.0)
                        d_fundamental[PER_VIEW * side + k, 3 * a + c] = value
            for a in range(3):
                for c in range(3):
                    scaled = a < 2 if side else c < 2  # by this view's focal length
                    value = -F[a, c] * focal_deviations[v] if scaled else 0.0
                    d_fundamental[PER_VIEW * side + 6, 3 * a + c] = value
        multiply(d_fundamental, normal, chained)
        for k in range(14):
            row = PER_VIEW * (i if k < PER_VIEW else j) + k % PER_VIEW
            for c in range(9):
                b[row] += d_fundamental[k, c] * right[c]
            for l in range(14):
                column = PER_VIEW * (i if l < PER_VIEW else j) + l % PER_VIEW
                for c in range(9):
                    H[row, column] += chained[k, c] * d_fundamental[l, c]
    return cost


@kernel(
    "float64(float64[::1], float64[:,::1], int64, float64, float64, float64, float64[:,::1],"
    " boolean, float64[:,::1], float64[::1], float64[:,:,::1], float64[:,::1])",
    nogil=True,
    linked=True,
)
def add_priors(  # type: ignore[no-untyped-def]
    x, offsets, views, distance, distance_deviation, own_deviation, centres, derive, H, b,
    H_own, b_own,
):  # fmt: skip
    """Cost of the priors: unit variance but for the arch's centre, of which only depth has one.

    The logarithms of the depths vary together (distance_deviation) and each by itself
    (own_deviation): their precision is I / own^2 less `shared` everywhere (Sherman and Morrison).
    """
    cost = 0.0
    for k in range(len(x)):
        within = k % PER_VIEW
        if k < PER_VIEW * views and 3 <= within < 6:
            continue
        cost += x[k] * x[k]
        if derive:
            b[k] += x[k]
            H[k, k] += 1
    precision = 1 / own_deviation**2
    common = (distance_deviation * precision) ** 2
    shared = common / (1 + views * distance_deviation**2 * precision)
    total = 0.0
    for v in range(views):
        r = np.log(max(centres[v, 2], 20.0) / distance)
        total += r
        cost += precision * r * r
    cost -= shared * total * total
    for v in range(views):
        if derive:
            depth = max(centres[v, 2], 20.0)
            slope = CENTRE_UNIT / depth
            k = PER_VIEW * v + 5
            b[k] += slope * (precision * np.log(depth / distance) - shared * total)
            H[k, k] += slope * slope * precision
            for w in range(views):
                other = CENTRE_UNIT / max(centres[w, 2], 20.0)
                H[k, PER_VIEW * w + 5] -= slope * other * shared
            # A trace of a prior sideways keeps the equations regular where a view has no landmarks.
            H[k - 1, k - 1] += 1e-6
            H[k - 2, k - 2] += 1e-6
    for i in range(len(offsets)):
        for a in range(3):
            cost += offsets[i, a] ** 2
            if derive:
                b_own[i, a] += offsets[i, a]
                H_own[i, a, a] += 1
    return cost
