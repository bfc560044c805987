"""One step of Adam (Kingma & Ba 2015) on a matrix."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt
from numba import prange

from pipeline.kernels import kernel

Floats = npt.NDArray[np.float32]
F = np.float32
CHUNK = 256


@kernel(parallel=True)
def adam_step(  # type: ignore[no-untyped-def]
    parameters: Floats, gradient: Floats, first: Floats, second: Floats, rates: Floats,
    scale_first: np.float32, scale_second: np.float32, beta1: np.float32, beta2: np.float32,
    epsilon: np.float32,
):  # fmt: skip
    """One step in place on [N, D]; `rates` [D]; `scale_*` = 1 / (1 - beta ** step)."""
    number, columns = parameters.shape
    for chunk in prange((number + CHUNK - 1) // CHUNK):
        for i in range(chunk * CHUNK, min(number, (chunk + 1) * CHUNK)):
            for j in range(columns):
                g = gradient[i, j]
                m = beta1 * first[i, j] + (F(1) - beta1) * g
                v = beta2 * second[i, j] + (F(1) - beta2) * g * g
                first[i, j] = m
                second[i, j] = v
                step = rates[j] * (m * scale_first) / (math.sqrt(v * scale_second) + epsilon)
                parameters[i, j] -= step
