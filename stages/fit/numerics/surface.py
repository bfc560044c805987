"""Gaussians held to the surface that they start on, in proportion to how sure it is.

From three photographs a fit can explain every pixel with needles and gaps that only the three
cameras don't see. Where the surface is known, Gaussians start as flat discs along it, and what
takes them off it is drawn back after every step.

The surface itself may bend as a whole, so that the photographs agree on what lies on it.

Gaussians that each move on their own can't correct a surface: one image always pulls against the
other, and there are a thousand ways to give in. What all of them within a millimetre or two want
together is well determined. The surface moves along its normals by a smooth field (B-splines of
several widths), and its normals turn along, so that shading and highlights shape it as well as
texture. Preconditioning of this kind is what inverse rendering of meshes lives by (Nicolet et al.
2021, "Large Steps in Inverse Rendering of Geometry").
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numba import prange
from scipy.spatial import cKDTree

from pipeline.kernels import kernel
from stages.fit.arrays import Array, Bools, Floats, Indices
from stages.fit.numerics.spline_field import SplineField
from stages.splatting.adam import Adam
from stages.splatting.threads import KERNELS, workers

F = np.float32
#: a point is on the rim if the mean of so many neighbours is aside by this share of the distance to
#: the furthest of them: .42 on a straight edge, and 0 with a spread of .06 where there is none
RIM_NEIGHBOURS, RIM_ASIDE = 32, 0.3


@dataclass(frozen=True)
class Bent:
    """What one move of a warp did.

    Attributes:
        move: [N, 3] float32 by how much points moved.
        lean: [N, 3] float32 what was added to their normals, across those they started with.
    """

    move: Floats
    lean: Floats


def rim(positions: Array, normals: Array) -> Bools:
    """[N] points of a surface [N, 3] whose neighbours are on one side: where it ends."""
    tree = cKDTree(positions)
    distance, near = tree.query(positions, RIM_NEIGHBOURS, workers=workers())
    aside = positions[near].mean(1) - positions
    aside -= (aside * normals).sum(1, keepdims=True) * normals
    return np.asarray(np.linalg.norm(aside, axis=1) > RIM_ASIDE * distance[:, -1])


def inland(positions: Array, normals: Array, every: int) -> tuple[Indices, Array]:
    """Every so many points of a surface [N, 3], and how far from its end each is.

    Points without a normal (0) are no surface. Points come in the order of their places: every so
    many of them lie evenly.
    """
    known = np.flatnonzero(np.abs(normals).sum(1) > 0)
    if len(known) <= RIM_NEIGHBOURS:
        return known[:0], np.empty(0)
    chosen, ends = known[::every], rim(positions[known], normals[known])
    if not ends.any():
        return chosen, np.full(len(chosen), np.inf)
    distance, _ = cKDTree(positions[known[ends]]).query(positions[chosen], workers=workers())
    return chosen, np.asarray(distance)


class Warp:
    """A displacement along the normals that a surface starts with.

    Attributes:
        field: the displacement, in units of the frame.
        normals: [N, 3] float32 unit, or 0: to start with.
        facing: [N, 3] float32 the same now.
    """

    def __init__(
        self,
        positions: Array,
        normals: Array,
        spacing: float,
        levels: int,
        slope: float,
        views: int,
    ) -> None:
        """
        Args:
            positions, normals: [N, 3] the surface; where the normal is 0, it stays.
            spacing: of the finest splines, in units of the frame.
            levels: of splines, each twice as wide as the one before.
            slope: no level of splines gets steeper than about this.
            views: so many gradients make a move, one of each photograph.
        """
        self.field = SplineField(positions, spacing, levels)
        self.normals: Floats = normals.astype(np.float32)
        self.facing = self.normals
        self.adam = Adam((len(self.field.coefficients), 1))
        self.views = views
        widths = spacing * 2.0 ** np.arange(levels)
        #: [K] largest coefficients
        self.limits: Floats = np.repeat(slope * widths, self.field.sizes).astype(np.float32)
        self.collected = 0
        self.gradient: Floats = np.zeros((len(positions), 4), np.float32)
        #: [N, 4] displacement and lean so far
        self.shape: Floats = np.zeros((len(positions), 4), np.float32)

    def collect(self, by_position: Floats, by_normal: Floats | None) -> None:
        """Add a photograph's gradients [N, 3] by where Gaussians are and what they face."""
        lit = by_normal is not None
        normal_part = by_position if by_normal is None else by_normal
        with KERNELS:
            _collect(by_position, normal_part, lit, self.normals, self.gradient)
        self.collected += 1

    def move(self, rate: float) -> Bent | None:
        """Step if every photograph has had its say; None until then.

        Args:
            rate: learning rate per gradient collected, in units of the frame.
        """
        if self.collected < self.views:
            return None
        gradient = self.field.gather(self.gradient)
        rates = np.array([rate * self.collected], np.float32)
        # Adam's steps are no longer than the rate: shrunk like this, none gets past its limit
        self.field.coefficients *= 1 - np.minimum(rates / self.limits, F(1))
        self.adam.step(self.field.coefficients[:, None], gradient[:, None], rates)
        self.gradient[:] = 0
        self.collected = 0
        move, lean, facing = (np.empty_like(self.normals) for _ in range(3))
        displacement, slope = self.field.evaluate()
        with KERNELS:
            _bend(displacement, slope, self.normals, self.shape, move, lean, facing)
        self.facing = facing
        return Bent(move, lean)

    def reach(self) -> float:
        """By how much 95 % of the surface has moved at most, in units of the frame."""
        known = np.abs(self.normals).sum(1) > 0
        return float(np.quantile(np.abs(self.shape[known, 0]), 0.95)) if known.any() else 0.0

    def select(self, source: Indices) -> None:
        """Rows follow those of the packed scene."""
        self.field.select(source)
        for name in ("normals", "facing", "gradient", "shape"):
            setattr(self, name, np.ascontiguousarray(getattr(self, name)[source]))


@kernel(parallel=True)
def _collect(  # type: ignore[no-untyped-def]
    by_position: Floats, by_normal: Floats, lit: bool, normals: Floats, gradient: Floats
):
    """Add what a photograph says to the gradient [N, 4] by displacement and lean."""
    for i in prange(len(normals)):
        along, outward = F(0), F(0)
        for k in range(3):
            outward += by_position[i, k] * normals[i, k]
            along += by_normal[i, k] * normals[i, k]
        gradient[i, 0] += outward
        if lit:
            # a slope of the displacement turns the normal against it
            for k in range(3):
                gradient[i, 1 + k] -= by_normal[i, k] - along * normals[i, k]


@kernel(parallel=True)
def _bend(  # type: ignore[no-untyped-def]
    displacement: Floats, slope: Floats, normals: Floats, shape: Floats, move: Floats,
    lean: Floats, facing: Floats,
):  # fmt: skip
    """What a field [N] and its gradient [N, 3] make of a surface; `shape` is brought up to date."""
    for i in prange(len(normals)):
        x, y, z = normals[i, 0], normals[i, 1], normals[i, 2]
        known = F(1) if x != F(0) or y != F(0) or z != F(0) else F(0)
        along = slope[i, 0] * x + slope[i, 1] * y + slope[i, 2] * z
        outward = displacement[i] * known
        square = F(0)
        for k in range(3):
            added = (along * normals[i, k] - slope[i, k]) * known
            move[i, k] = (outward - shape[i, 0]) * normals[i, k]
            lean[i, k] = added - shape[i, 1 + k]
            shape[i, 1 + k] = added
            facing[i, k] = normals[i, k] + added
            square += facing[i, k] * facing[i, k]
        shape[i, 0] = outward
        length = max(math.sqrt(square), F(1e-12))
        for k in range(3):
            facing[i, k] /= length


@kernel(parallel=True)
def _turned(  # type: ignore[no-untyped-def]
    quaternions: Floats, first: Floats, second: Floats, result: Floats
):
    for i in prange(len(quaternions)):
        ax, ay, az = first[i, 0], first[i, 1], first[i, 2]
        bx, by, bz = second[i, 0], second[i, 1], second[i, 2]
        w = F(1) + ax * bx + ay * by + az * bz
        x, y, z = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
        if w < F(1e-6):
            # an axis across them: the cross product with the axis that they are furthest from
            w = F(0)
            if abs(ax) <= abs(ay) and abs(ax) <= abs(az):
                x, y, z = F(0), az, -ay
            elif abs(ay) <= abs(az):
                x, y, z = -az, F(0), ax
            else:
                x, y, z = ay, -ax, F(0)
        length = math.sqrt(w * w + x * x + y * y + z * z)
        w, x, y, z = w / length, x / length, y / length, z / length
        a, b, c, d = quaternions[i, 0], quaternions[i, 1], quaternions[i, 2], quaternions[i, 3]
        result[i, 0] = w * a - x * b - y * c - z * d
        result[i, 1] = w * b + x * a + y * d - z * c
        result[i, 2] = w * c - x * d + y * a + z * b
        result[i, 3] = w * d + x * c - y * b + z * a


def turned(quaternions: Floats, first: Floats, second: Floats) -> Floats:
    """Quaternions [N, 4] after the shortest turn that takes unit vectors `first` to `second`.

    Between opposite vectors it is one of the half turns; vectors of 0 turn nothing.
    """
    result = np.empty((len(quaternions), 4), np.float32)
    # contiguous, all of them: one kernel instead of one for each mixture
    given = (np.ascontiguousarray(array, np.float32) for array in (quaternions, first, second))
    with KERNELS:
        _turned(*given, result)
    return result


def along_normals(packed: Floats, normals: Array, flatness: float) -> None:
    """Turn Gaussians so that their third axis is the normal, and flatten them along it.

    Args:
        packed: [N, D], changed in place.
        normals: [N, 3] unit, 0 where unknown (those stay as they are).
        flatness: standard deviation along the normal, relative to that across it.
    """
    known = np.abs(normals).sum(1) > 0
    unturned = np.tile(np.array([1, 0, 0, 0], np.float32), (int(known.sum()), 1))
    ahead = np.tile(np.array([0.0, 0.0, 1.0]), (len(unturned), 1))
    packed[known, 3:7] = turned(unturned, ahead, normals[known])
    packed[known, 9] += np.float32(np.log(flatness))


@kernel(parallel=True)
def _pull(packed: Floats, anchor: Floats, turn: Floats):  # type: ignore[no-untyped-def]
    for i in prange(len(packed)):
        firmness, widest = anchor[i, 7], anchor[i, 8]
        off = F(0)
        for k in range(3):
            off += (packed[i, k] - anchor[i, k]) * anchor[i, 3 + k]
        for k in range(3):
            packed[i, k] -= off * firmness * anchor[i, 3 + k]
        for k in range(4):
            packed[i, 3 + k] += firmness * (turn[i, k] - packed[i, 3 + k])
        packed[i, 9] += firmness * (anchor[i, 6] - packed[i, 9])
        for k in range(7, 10):
            packed[i, k] = min(packed[i, k], widest)


def pull(packed: Floats, anchor: Floats, turn: Floats) -> None:
    """Draw Gaussians [N, D] back onto their surface: position, turn, thickness; bound the width.

    Args:
        anchor: [N, 9] position, normal (0: free), log of the thickness, firmness 0..1, log of the
            largest width.
        turn: [N, 4] quaternions to be kept.
    """
    with KERNELS:
        _pull(packed, anchor, turn)
