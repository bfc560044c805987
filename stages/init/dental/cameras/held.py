"""The bundle adjustment of `bundle` with cameras that are known: only the arch moves.

The cameras hold still relative to each other; free are a similarity (turn, shift, and how many
millimetres the cameras' unit is) that carries all of them around the arch, the arch's shape and the
landmarks. The normal equations are those of free cameras, projected onto what is left.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from pipeline.geometry.rigid import nearest_rotation
from pipeline.kernels import kernel
from stages.init.dental.cameras.algebra import apply, clear, invert, multiply
from stages.init.dental.cameras.kernels import CENTRE_UNIT, PER_ARCH, PER_VIEW

Array = npt.NDArray[np.float64]

#: Unknowns of the similarity: turn, shift, log scale.
PER_SIMILARITY = 7


@dataclass(frozen=True)
class HeldCameras:
    """Known cameras, in a world of any unit, as `Sightings` sees them (rolls taken out).

    Attributes:
        rotations: [V, 3, 3] camera from world.
        translations: [V, 3] in the unit of that world.
    """

    rotations: Array
    translations: Array

    def of(self, views: tuple[int, ...]) -> HeldCameras:
        """Those of some views."""
        chosen = list(views)
        return HeldCameras(self.rotations[chosen], self.translations[chosen])

    def from_first(self) -> tuple[Array, Array]:
        """Rotations [V, 3, 3] and translations [V, 3] from the first camera's frame; the distances
        of the cameras from the first one are 1 on average."""
        turn = self.rotations @ self.rotations[0].T
        shift = self.translations - turn @ self.translations[0]
        unit = max(float(np.linalg.norm(shift[1:], axis=1).mean()), 1e-12)
        return np.ascontiguousarray(turn), np.ascontiguousarray(shift / unit)


def roll_matrix(roll: float) -> Array:
    """[3, 3] camera from the same camera with the roll (radians) of the teeth taken out."""
    c, s = np.cos(roll), np.sin(roll)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def held_cameras(cameras: list[Array], rolls: list[float]) -> HeldCameras:
    """Known cameras ([4, 4] cam_from_world each) with the rolls of the teeth taken out."""
    poses = [roll_matrix(roll).T @ pose[:3] for pose, roll in zip(cameras, rolls, strict=True)]
    return HeldCameras(
        np.stack([pose[:, :3] for pose in poses]), np.stack([pose[:, 3] for pose in poses])
    )


def nearest_similarity(
    rotations: Array, centres: Array, turns: Array, shifts: Array
) -> tuple[Array, Array, float]:
    """The place of the arch before held cameras that comes nearest to free ones.

    Args:
        rotations: [V, 3, 3] of the free cameras, camera from arch.
        centres: [V, 3] mm, the arch's centre in their frames.
        turns, shifts: the held cameras (`HeldCameras.from_first`).

    Returns:
        Rotation [3, 3] of the arch and its centre [3] mm in the first camera's frame, and the
        logarithm of how many mm the unit of the shifts is.
    """
    rotation = nearest_rotation(np.einsum("vji,vjk->ik", turns, rotations))
    free = -np.einsum("vji,vj->vi", rotations, centres)
    held = -np.einsum("vji,vj->vi", turns, shifts)
    spread = float(np.linalg.norm(held - held.mean(0)))
    scale = max(float(np.linalg.norm(free - free.mean(0))), 1e-6) / max(spread, 1e-12)
    centre = np.einsum("vji,vj->vi", turns, centres - scale * shifts).mean(0)
    return np.ascontiguousarray(rotation), centre, float(np.log(scale))


@kernel(
    "void(float64[:,::1], float64[::1], float64, float64[:,:,::1], float64[:,::1],"
    " float64[:,:,::1], float64[:,::1], float64, float64[::1])",
    nogil=True,
    linked=True,
)
def unknowns_of(  # type: ignore[no-untyped-def]
    rotation, centre, log_scale, turns, shifts, nominal, angle_deviations, distance, x
):
    """Write the views' unknowns (those of `bundle`) of a similarity into x [7V + 9]."""
    scale = np.exp(log_scale)
    turned, D = np.empty((3, 3)), np.empty((3, 3))
    axis, place = np.empty(3), np.empty(3)
    for v in range(len(turns)):
        # exp([w]x) = (camera from arch) nominal^T.
        multiply(turns[v], rotation, turned)
        multiply(turned, nominal[v].T, D)
        axis[0], axis[1], axis[2] = D[2, 1] - D[1, 2], D[0, 2] - D[2, 0], D[1, 0] - D[0, 1]
        sine = 0.5 * np.sqrt(axis[0] ** 2 + axis[1] ** 2 + axis[2] ** 2)
        angle = np.arctan2(sine, 0.5 * (D[0, 0] + D[1, 1] + D[2, 2] - 1))
        factor = 0.5 if sine < 1e-9 else 0.5 * angle / sine
        apply(turns[v], centre, place)
        for a in range(3):
            x[PER_VIEW * v + a] = factor * axis[a] / angle_deviations[v, a]
            x[PER_VIEW * v + 3 + a] = (place[a] + scale * shifts[v, a]) / CENTRE_UNIT
        x[PER_VIEW * v + 5] -= distance / CENTRE_UNIT
        x[PER_VIEW * v + 6] = 0.0


@kernel(
    "void(float64, float64[:,:,::1], float64[:,::1], float64[:,:,::1], float64[:,::1],"
    " float64[:,::1])",
    nogil=True,
    linked=True,
)
def tangents(log_scale, turns, shifts, jacobians, angle_deviations, T):  # type: ignore[no-untyped-def]
    """T [7V + 9, 16]: how the views' unknowns and the arch's follow similarity and arch."""
    clear(T)
    views = len(turns)
    scale = np.exp(log_scale)
    inverse, turned = np.empty((3, 3)), np.empty((3, 3))
    for v in range(views):
        # Turning the arch by w in the first camera's frame turns it by (turn w) in this one.
        invert(jacobians[v], inverse)
        multiply(inverse, turns[v], turned)
        for a in range(3):
            for c in range(3):
                T[PER_VIEW * v + a, c] = turned[a, c] / angle_deviations[v, a]
                T[PER_VIEW * v + 3 + a, 3 + c] = turns[v, a, c]
            T[PER_VIEW * v + 3 + a, 6] = scale * shifts[v, a] / CENTRE_UNIT
    for k in range(PER_ARCH):
        T[PER_VIEW * views + k, PER_SIMILARITY + k] = 1
