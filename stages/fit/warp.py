"""Bending the surface as a whole, so that the photographs agree on what lies on it.

Gaussians that each move on their own can't correct a surface: one image always pulls against the
other, and there are a thousand ways to give in. What all of them within a millimetre or two want
together is well determined. The surface moves along its normals by a smooth field (B-splines of
several widths), and its normals turn along, so that shading and highlights shape it as well as
texture. Preconditioning of this kind is what inverse rendering of meshes lives by (Nicolet et al.
2021, "Large Steps in Inverse Rendering of Geometry").
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from stages.fit.checkpoint import Arrays
from stages.fit.spline_field import SplineField
from stages.splatting.adam import Adam

Array = npt.NDArray[np.float64]
Floats = npt.NDArray[np.float32]
F = np.float32


@dataclass(frozen=True)
class Bent:
    """What one move of a warp did.

    Attributes:
        move: [N, 3] float32 by how much points moved.
        lean: [N, 3] float32 what was added to their normals, across those they started with.
    """

    move: Floats
    lean: Floats


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
        self.adam = Adam((len(self.field.coefficients), 1), 0.9, 0.999, 1e-15)
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
        normals = self.normals
        self.gradient[:, 0] += (by_position * normals).sum(1)
        if by_normal is not None:
            # a slope of the displacement turns the normal against it
            along = (by_normal * normals).sum(1, keepdims=True)
            self.gradient[:, 1:] -= by_normal - along * normals
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
        shape = self._shape()
        change = shape - self.shape
        self.shape = shape
        facing = self.normals + shape[:, 1:]
        length = np.linalg.norm(facing, axis=1, keepdims=True)
        self.facing = facing / np.maximum(length, F(1e-12))
        return Bent(change[:, :1] * self.normals, change[:, 1:])

    def _shape(self) -> Floats:
        """[N, 4] displacement along the first normals, and what that adds to them."""
        displacement, slope = self.field.evaluate()
        known = np.abs(self.normals).sum(1, keepdims=True) > 0
        lean = (slope * self.normals).sum(1, keepdims=True) * self.normals - slope
        return np.concatenate([displacement[:, None], lean], 1) * known

    def reach(self) -> float:
        """By how much 95 % of the surface has moved at most, in units of the frame."""
        known = np.abs(self.normals).sum(1) > 0
        return float(np.quantile(np.abs(self.shape[known, 0]), 0.95)) if known.any() else 0.0

    def select(self, source: npt.NDArray[np.int64]) -> None:
        """Rows follow those of the packed scene."""
        self.field.select(source)
        for name in ("normals", "facing", "gradient", "shape"):
            setattr(self, name, np.ascontiguousarray(getattr(self, name)[source]))

    def arrays(self) -> Arrays:
        """The whole state, for a checkpoint."""
        return {
            "warp_coefficients": self.field.coefficients,
            "warp_nodes": self.field.nodes,
            "warp_offsets": self.field.offsets,
            "warp_normals": self.normals,
            "warp_facing": self.facing,
            "warp_shape": self.shape,
            "warp_gradient": self.gradient,
            "warp_first": self.adam.first,
            "warp_second": self.adam.second,
            "warp_steps": np.array([self.adam.steps, self.collected]),
        }

    def restore(self, arrays: Arrays) -> None:
        """Take up what `arrays` gave."""
        self.field.coefficients = arrays["warp_coefficients"]
        self.field.nodes, self.field.offsets = arrays["warp_nodes"], arrays["warp_offsets"]
        self.normals, self.facing = arrays["warp_normals"], arrays["warp_facing"]
        self.shape, self.gradient = arrays["warp_shape"], arrays["warp_gradient"]
        self.adam.first, self.adam.second = arrays["warp_first"], arrays["warp_second"]
        self.adam.steps, self.collected = (int(n) for n in arrays["warp_steps"])


def turned(quaternions: Floats, first: Floats, second: Floats) -> Floats:
    """Quaternions [N, 4] after the shortest turn that takes unit vectors `first` to `second`.

    Between opposite vectors it is one of the half turns; vectors of 0 turn nothing.
    """
    turn = np.concatenate([1 + (first * second).sum(1, keepdims=True), np.cross(first, second)], 1)
    opposite = turn[:, 0] < 1e-6
    # an axis across them: the cross product with the axis that they are furthest from
    furthest = np.eye(3)[np.abs(first[opposite]).argmin(1)]
    turn[opposite, 0], turn[opposite, 1:] = 0, np.cross(first[opposite], furthest)
    turn /= np.linalg.norm(turn, axis=1, keepdims=True)
    w, x, y, z = turn.T
    a, b, c, d = quaternions.T
    return np.stack(
        [
            w * a - x * b - y * c - z * d,
            w * b + x * a + y * d - z * c,
            w * c - x * d + y * a + z * b,
            w * d + x * c - y * b + z * a,
        ],
        axis=1,
    ).astype(np.float32)
