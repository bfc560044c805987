"""Small matrix algebra for the kernels of the bundle adjustment.

In loops: for matrices as small as these they are no slower than what numba makes of `A @ B`, and
compiled in a tenth of the time.
"""

from __future__ import annotations

import numpy as np

from pipeline.kernels import helper, kernel


@helper
def clear(values):  # type: ignore[no-untyped-def]
    """All zero, whatever the shape."""
    for k in range(values.size):
        values.flat[k] = 0.0


@helper
def multiply(A, B, out):  # type: ignore[no-untyped-def]
    """out = A B."""
    for i in range(A.shape[0]):
        for j in range(B.shape[1]):
            total = 0.0
            for k in range(A.shape[1]):
                total += A[i, k] * B[k, j]
            out[i, j] = total


@helper
def apply(A, x, out):  # type: ignore[no-untyped-def]
    """out = A x."""
    for i in range(A.shape[0]):
        total = 0.0
        for k in range(A.shape[1]):
            total += A[i, k] * x[k]
        out[i] = total


@helper
def copy_to(values, out):  # type: ignore[no-untyped-def]
    """out = values, whatever the shape."""
    for k in range(values.size):
        out.flat[k] = values.flat[k]


@helper
def invert(A, out):  # type: ignore[no-untyped-def]
    """Inverse of A [3, 3] by its cofactors; returns the determinant."""
    out[0, 0] = A[1, 1] * A[2, 2] - A[1, 2] * A[2, 1]
    out[0, 1] = A[0, 2] * A[2, 1] - A[0, 1] * A[2, 2]
    out[0, 2] = A[0, 1] * A[1, 2] - A[0, 2] * A[1, 1]
    determinant = A[0, 0] * out[0, 0] + A[1, 0] * out[0, 1] + A[2, 0] * out[0, 2]
    out[1, 0] = A[1, 2] * A[2, 0] - A[1, 0] * A[2, 2]
    out[1, 1] = A[0, 0] * A[2, 2] - A[0, 2] * A[2, 0]
    out[1, 2] = A[0, 2] * A[1, 0] - A[0, 0] * A[1, 2]
    out[2, 0] = A[1, 0] * A[2, 1] - A[1, 1] * A[2, 0]
    out[2, 1] = A[0, 1] * A[2, 0] - A[0, 0] * A[2, 1]
    out[2, 2] = A[0, 0] * A[1, 1] - A[0, 1] * A[1, 0]
    for a in range(3):
        for b in range(3):
            out[a, b] /= determinant
    return determinant


@kernel(
    "void(float64[::1], float64[:,::1], float64[:,::1])",
    nogil=True,
    linked=True,
)
def rotation_and_jacobian(w, rotation, jacobian):  # type: ignore[no-untyped-def]
    """exp([w]x) and its left Jacobian: exp([w + d]x) = exp([jacobian d]x) exp([w]x)."""
    x, y, z = w[0], w[1], w[2]
    square = x * x + y * y + z * z
    angle = np.sqrt(square)
    if angle < 1e-4:
        s, c, j = 1.0 - square / 6, 0.5 - square / 24, 1.0 / 6 - square / 120
    else:
        s = np.sin(angle) / angle
        c = (1 - np.cos(angle)) / square
        j = (angle - np.sin(angle)) / (square * angle)
    for a in range(3):
        for b in range(3):
            outer = w[a] * w[b]
            rotation[a, b] = c * outer
            jacobian[a, b] = j * outer
        rotation[a, a] += 1 - c * square
        jacobian[a, a] += 1 - j * square
    rotation[0, 1] -= s * z
    rotation[0, 2] += s * y
    rotation[1, 0] += s * z
    rotation[1, 2] -= s * x
    rotation[2, 0] -= s * y
    rotation[2, 1] += s * x
    jacobian[0, 1] -= c * z
    jacobian[0, 2] += c * y
    jacobian[1, 0] += c * z
    jacobian[1, 2] -= c * x
    jacobian[2, 0] -= c * y
    jacobian[2, 1] += c * x


@kernel("void(float64[::1], float64[:,::1])", nogil=True, linked=True)
def cross_matrix(t, out):  # type: ignore[no-untyped-def]
    """[t]x, of which times v is t x v."""
    out[0, 0] = out[1, 1] = out[2, 2] = 0.0
    out[0, 1], out[0, 2], out[1, 2] = -t[2], t[1], -t[0]
    out[1, 0], out[2, 0], out[2, 1] = t[2], -t[1], t[0]


@kernel("float64(float64[:,::1], float64[:,::1])", nogil=True, linked=True)
def cholesky(A, L):  # type: ignore[no-untyped-def]
    """Lower factor of A into L; returns log det A, or nan where A is not positive definite."""
    n = len(A)
    log_determinant = 0.0
    for i in range(n):
        for j in range(i + 1):
            total = A[i, j]
            for k in range(j):
                total -= L[i, k] * L[j, k]
            if i == j:
                if not total > 0:
                    return np.nan
                L[i, i] = np.sqrt(total)
                log_determinant += np.log(total)
            else:
                L[i, j] = total / L[j, j]
    return log_determinant


@kernel("void(float64[:,::1], float64[::1], float64[::1])", nogil=True, linked=True)
def solve_cholesky(L, b, out):  # type: ignore[no-untyped-def]
    """Solve L Lt out = b."""
    n = len(b)
    for i in range(n):
        total = b[i]
        for k in range(i):
            total -= L[i, k] * out[k]
        out[i] = total / L[i, i]
    for i in range(n - 1, -1, -1):
        total = out[i]
        for k in range(i + 1, n):
            total -= L[k, i] * out[k]
        out[i] = total / L[i, i]


@kernel(
    "float64(float64[:,::1], float64[::1], float64[:,:,::1], float64[:,::1], float64[:,:,::1],"
    " float64, float64[:,::1], float64[::1], float64[:,:,::1])",
    nogil=True,
    linked=True,
)
def eliminate(H, b, H_own, b_own, H_cross, damping, S, s, own_inverse):  # type: ignore[no-untyped-def]
    """Schur complement over the landmarks; returns their part of the log determinant.

    Of S the lower half, which is what `cholesky` reads.
    """
    n = len(b)
    log_determinant = 0.0
    for k in range(n):
        s[k] = b[k]
        for l in range(k + 1):
            S[k, l] = H[k, l]
        S[k, k] *= 1 + damping
    A = np.empty((3, 3))
    used = np.empty(n, np.int64)
    product = np.empty((n, 3))
    for i in range(len(H_own)):
        for a in range(3):
            for c in range(3):
                A[a, c] = H_own[i, a, c]
            A[a, a] *= 1 + damping
        inverse = own_inverse[i]
        log_determinant += np.log(invert(A, inverse))
        count = 0
        for k in range(n):
            cross = H_cross[i, k]
            if cross[0] != 0 or cross[1] != 0 or cross[2] != 0:
                used[count] = k
                for a in range(3):
                    product[count, a] = (
                        cross[0] * inverse[0, a]
                        + cross[1] * inverse[1, a]
                        + cross[2] * inverse[2, a]
                    )
                count += 1
        for m in range(count):
            k = used[m]
            p0, p1, p2 = product[m, 0], product[m, 1], product[m, 2]
            s[k] -= p0 * b_own[i, 0] + p1 * b_own[i, 1] + p2 * b_own[i, 2]
            for q in range(m + 1):
                cross = H_cross[i, used[q]]
                S[k, used[q]] -= p0 * cross[0] + p1 * cross[1] + p2 * cross[2]
    return log_determinant
