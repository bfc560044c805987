"""What teeth do between two visits: rigid movements in the terms of orthodontics."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from .arrange import Arch, Row, Tooth

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Move:
    """What a tooth does between two visits: its crown's centre moves, and it turns about that.

    Attributes:
        mesial, buccal, extrusion: mm, of the centre of the crown: towards the midline along the
            arch, outwards, and out of the gum.
        tip, torque, rotation: degrees, as one rotation vector: the edge goes to the mesial side,
            the edge goes outwards, the mesial side goes outwards.
    """

    mesial: float = 0.0
    buccal: float = 0.0
    extrusion: float = 0.0
    tip: float = 0.0
    torque: float = 0.0
    rotation: float = 0.0


def axes_of(arch: Arch, tooth: Tooth) -> Array:
    """[3, 3] rows: the directions mesial, buccal and extrusion of a tooth's place on its arch."""
    _, tangent, normal = arch.at(tooth.along)
    return np.stack([-tooth.side * tangent, normal, (0.0, -float(tooth.plan.up), 0.0)])


def motion_of(arch: Arch, tooth: Tooth, move: Move) -> Array:
    """[4, 4] what a move does to points of the tooth, in the world (mm)."""
    axes = axes_of(arch, tooth)
    hand = np.sign(np.linalg.det(axes))  # a rotation's sign depends on the side of the mouth
    vector = hand * np.radians([-move.torque, move.tip, move.rotation]) @ axes
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_rotvec(vector).as_matrix()
    shift = np.array([move.mesial, move.buccal, move.extrusion]) @ axes
    matrix[:3, 3] = tooth.centre + shift - matrix[:3, :3] @ tooth.centre
    return matrix


def moved_row(row: Row, moves: Mapping[int, Move]) -> Row:
    """A row in which some teeth, by FDI number, have moved."""
    return replace(row, teeth=tuple(_moved(row, t, moves.get(t.plan.fdi)) for t in row.teeth))


def _moved(row: Row, tooth: Tooth, move: Move | None) -> Tooth:
    if move is None:
        return tooth
    matrix = motion_of(row.arch, tooth, move)

    def carried(points: Array) -> Array:
        return points @ matrix[:3, :3].T + matrix[:3, 3]

    return replace(
        tooth, along=tooth.along - tooth.side * move.mesial, edge=tooth.edge - move.extrusion,
        vertices=carried(tooth.vertices), centre=carried(tooth.centre),
        labial=carried(tooth.labial), outward=tooth.outward @ matrix[:3, :3].T,
    )  # fmt: skip
