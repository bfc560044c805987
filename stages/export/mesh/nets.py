"""The surface where a field of signed distances is zero, by surface nets (Gibson 1998)."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from pipeline.kernels import each, helper, kernel
from stages.export.mesh.field import BLOCK, Field, block_at

Array = npt.NDArray[np.float64]
Numbers = npt.NDArray[np.int32]
F = np.float32

#: Points of the smoothed field where fewer depth maps than this have a say are not meshed.
LEAST_WEIGHT = 0.5


def zero_surface(field: Field, step: int) -> tuple[Array, Numbers]:
    """The surface where a field is zero, by surface nets (Gibson 1998).

    A vertex in each cell that the surface passes, in the middle of where it cuts the edges and from
    there on to the surface; a quad, cut along its shorter diagonal, around each edge that is cut.

    Args:
        field: to mesh.
        step: edge of a cell in voxels: 1, 2, 4 or 8.

    Returns:
        Vertices [V, 3] and faces [F, 3], counter-clockwise as seen from outside.
    """
    side, count = BLOCK // step, len(field.blocks)
    places = np.empty((count, side, side, side, 3), np.float32)
    used = np.zeros((count, side, side, side), np.bool_)
    given = field.neighbours, field.values, field.weights, F(LEAST_WEIGHT), step
    each(_vertices_of_block, count, *given, places, used)
    index = (np.cumsum(used.ravel()) - 1).reshape(used.shape)
    index[~used] = -1
    quads = np.empty((count, side, side, side, 3, 4), np.int64)
    quads[..., 0] = -1
    each(_quads_of_block, count, *given, index, quads)
    first = field.blocks[np.nonzero(used)[0]] * BLOCK
    vertices = (first + places[used].astype(np.float64)) * field.voxel
    quad = quads.reshape(-1, 4)
    quad = quad[quad[:, 0] >= 0]
    a, b, c, d = (vertices[quad[:, corner]] for corner in range(4))
    along = ((a - c) ** 2).sum(1) <= ((b - d) ** 2).sum(1)
    two = np.where(along[:, None], quad[:, [0, 1, 2, 0, 2, 3]], quad[:, [1, 2, 3, 1, 3, 0]])
    return np.asarray(vertices, np.float64), two.reshape(-1, 3).astype(np.int32)


@helper
def _value_at(neighbours, values, weights, least, block, i, j, k):  # type: ignore[no-untyped-def]
    """The field at point (i, j, k) of a block, and whether it is known there."""
    there = block_at(neighbours, block, i, j, k)
    if there < 0 or weights[there, i % BLOCK, j % BLOCK, k % BLOCK] < least:
        return F(0), False
    return values[there, i % BLOCK, j % BLOCK, k % BLOCK], True


@helper
def _to_zero(neighbours, values, weights, least, block, x, y, z, eight):  # type: ignore[no-untyped-def]
    """The way, of a voxel at most, from (x, y, z) of a block down the field's slope to its zero."""
    i, j, k = int(x), int(y), int(z)
    for number in range(8):
        eight[number], known = _value_at(
            neighbours, values, weights, least, block, i + (number >> 2), j + (number >> 1 & 1),
            k + (number & 1),
        )  # fmt: skip
        if not known:
            return F(0), F(0), F(0)
    u, v, w = x - F(i), y - F(j), z - F(k)
    value, dx, dy, dz = F(0), F(0), F(0), F(0)
    for number in range(8):
        a = u if number & 4 else F(1) - u
        b = v if number & 2 else F(1) - v
        c = w if number & 1 else F(1) - w
        value += eight[number] * a * b * c
        dx += eight[number] * b * c * (F(1) if number & 4 else F(-1))
        dy += eight[number] * a * c * (F(1) if number & 2 else F(-1))
        dz += eight[number] * a * b * (F(1) if number & 1 else F(-1))
    square = dx * dx + dy * dy + dz * dz
    if value * value >= square:
        return F(0), F(0), F(0)
    share = -value / square
    return share * dx, share * dy, share * dz


@kernel(nogil=True)
def _vertices_of_block(block, neighbours, values, weights, least, step, vertices, used):  # type: ignore[no-untyped-def]
    """One block of `zero_surface`: its vertices, in voxels, and which cells have one."""
    side = BLOCK // step
    corner = np.empty((side + 1, side + 1, side + 1), np.float32)
    known = np.empty((side + 1, side + 1, side + 1), np.bool_)
    for i in range(side + 1):
        for j in range(side + 1):
            for k in range(side + 1):
                corner[i, j, k], known[i, j, k] = _value_at(
                    neighbours, values, weights, least, block, i * step, j * step, k * step
                )
    sums, eight = np.empty(3, np.float32), np.empty(8, np.float32)
    for i in range(side):
        for j in range(side):
            for k in range(side):
                inside, all_known = 0, True
                for number in range(8):
                    a, b, c = i + (number >> 2), j + (number >> 1 & 1), k + (number & 1)
                    all_known &= known[a, b, c]
                    inside += int(corner[a, b, c] < F(0))
                if not all_known or inside == 0 or inside == 8:
                    continue
                sums[:] = F(0)
                cuts = F(0)
                for number in range(8):
                    start = corner[i + (number >> 2), j + (number >> 1 & 1), k + (number & 1)]
                    for axis in range(3):
                        bit = 4 >> axis
                        if number & bit:
                            continue
                        other = number | bit
                        end = corner[i + (other >> 2), j + (other >> 1 & 1), k + (other & 1)]
                        if (start < F(0)) == (end < F(0)):
                            continue
                        cuts += F(1)
                        for along in range(3):
                            sums[along] += F(number >> (2 - along) & 1)
                        sums[axis] += start / (start - end)
                used[block, i, j, k] = True
                x = (F(i) + sums[0] / cuts) * F(step)
                y = (F(j) + sums[1] / cuts) * F(step)
                z = (F(k) + sums[2] / cuts) * F(step)
                dx, dy, dz = _to_zero(neighbours, values, weights, least, block, x, y, z, eight)
                vertices[block, i, j, k, 0] = x + dx
                vertices[block, i, j, k, 1] = y + dy
                vertices[block, i, j, k, 2] = z + dz


@kernel(nogil=True)
def _quads_of_block(block, neighbours, values, weights, least, step, index, quads):  # type: ignore[no-untyped-def]
    """One block of `zero_surface`: the quads around the edges that leave its points upwards."""
    side = BLOCK // step
    for i in range(side):
        for j in range(side):
            for k in range(side):
                start, known = _value_at(
                    neighbours, values, weights, least, block, i * step, j * step, k * step
                )
                if not known:
                    continue
                for axis in range(3):
                    a, b, c = int(axis == 0), int(axis == 1), int(axis == 2)
                    end, known = _value_at(
                        neighbours, values, weights, least, block, (i + a) * step, (j + b) * step,
                        (k + c) * step,
                    )  # fmt: skip
                    if not known or (start < F(0)) == (end < F(0)):
                        continue
                    whole = True
                    for number in range(4):
                        # the four cells around the edge, counter-clockwise seen from its end
                        p, q = int(number == 1 or number == 2), int(number >= 2)
                        # axis 0: back along 1 and 2; axis 1: along 2 and 0; axis 2: along 0 and 1
                        di = -(q * b + p * c)
                        dj = -(p * a + q * c)
                        dk = -(q * a + p * b)
                        x, y, z = i + di, j + dj, k + dk
                        there = block_at(neighbours, block, x * step, y * step, z * step)
                        cell = index[there, x % side, y % side, z % side] if there >= 0 else -1
                        whole &= cell >= 0
                        place = number if start < F(0) else 3 - number
                        quads[block, i, j, k, axis, place] = cell
                    if not whole:
                        quads[block, i, j, k, axis, 0] = -1
