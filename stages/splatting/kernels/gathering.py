"""From the sums of pairs (tile, Gaussian) to the gradient of each Gaussian, as a numba kernel."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from numba import prange

from pipeline.kernels import helper, kernel
from stages.splatting.lanes.vectors import load, spread, store

Floats = npt.NDArray[np.float32]
Ints = npt.NDArray[np.int32]
F = np.float32

#: sums of a pair come in rows of so many numbers
LANES = 16
CHUNK = 256
#: columns of the screen gradient before the features
GRADIENTS = 8


@helper
def _gather_chunk(chunk, first_slot, slot_sums, screen, gradient):  # type: ignore[no-untyped-def]
    """One chunk of `gather`."""
    number, columns = gradient.shape
    room = slot_sums.shape[1] // LANES
    features = columns - GRADIENTS
    total = np.empty((room, LANES), np.float32)
    for i in range(chunk * CHUNK, min(number, (chunk + 1) * CHUNK)):
        if first_slot[i] == first_slot[i + 1]:
            for j in range(columns):
                gradient[i, j] = F(0)
            continue
        for j in range(room):
            part = spread(F(0))
            for q in range(first_slot[i], first_slot[i + 1]):
                part += load(slot_sums, q * room + j)
            store(total, j, part)
        a, b, c = screen[i, 2], screen[i, 3], screen[i, 4]
        sy, sx = total[0, 1], total[0, 3]
        gradient[i, 0] = -(a * sx + b * sy)
        gradient[i, 1] = -(c * sy + b * sx)
        gradient[i, 2] = F(0.5) * total[0, 5]
        gradient[i, 3] = total[0, 4]
        gradient[i, 4] = F(0.5) * total[0, 2]
        gradient[i, 5] = -total[0, 0] / screen[i, 5]
        gradient[i, 6] = a * total[0, 6]
        gradient[i, 7] = total[0, 7]
        for j in range(features):
            m = GRADIENTS + j
            gradient[i, m] = total[m // LANES, m % LANES]


@kernel(parallel=True)
def gather(  # type: ignore[no-untyped-def]
    first_slot: Ints, slot_sums: Floats, screen: Floats, gradient: Floats
):
    """Add the slots of each Gaussian, in the order of its tiles, and make gradients of the sums.

    Args:
        first_slot: [N + 1], from where to where the slots of each Gaussian go.
        slot_sums: [M, 16 n] from `composite_backward`.
        gradient: [N, 8 + 3 + E] output: centre 2, conic a b c, opacity, sums of the absolute
            per-pixel gradients of the centre 2, features.
    """
    number = gradient.shape[0]
    for chunk in prange((number + CHUNK - 1) // CHUNK):
        _gather_chunk(np.int64(chunk), first_slot, slot_sums, screen, gradient)
