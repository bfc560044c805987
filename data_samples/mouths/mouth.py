"""A mouth: one mesh of everything that is fixed to the jaws, with numbers and tissues."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import IntEnum
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt
from anatomy import turn
from appearance import Noise
from make_samples import sky_share, vertex_normals

from .arrange import Row, Tooth, arrange
from .hardware import brackets
from .moves import Move, moved_row
from .options import MouthOptions, random_options
from .rays import ray_scene
from .tissue import above_gum, grow_gum, tongue

Array = npt.NDArray[np.float64]
RAYS = 11  # for the share of the sky
HINGE = np.array([0.0, 22.0, -80.0])  # the lower jaw turns about an axis through here


class Tissue(IntEnum):
    """What a vertex is made of."""

    ENAMEL = 0
    GUM = 1
    MUCOSA = 2
    TONGUE = 3
    CHEEK = 4
    BRACKET = 5
    WIRE = 6


@dataclass(frozen=True)
class Mouth:
    """A mouth with the teeth closed; the lower jaw can be opened (`posed`).

    Attributes:
        options: what was asked of it.
        vertices, normals, local: [N, 3]; positions in the world (mm), unit normals, and where the
            point lies on its tissue (see `crown_mesh` and `Sheet`).
        triangles: [M, 3]; bits of different tissues never share a triangle.
        fdi: [N] uint8 number of the tooth (also on its bracket), 0 for everything else.
        tissue: [N] uint8 (`Tissue`).
        lower: [N] bool, whether it moves with the lower jaw.
        tooth: [N] int index into `teeth`, -1 where there is none.
        teeth: the teeth, upper jaw first, from the patient's right to the left.
        rows: the two rows.
        noise: the random fields of its surfaces.
    """

    options: MouthOptions
    vertices: Array
    normals: Array
    local: Array
    triangles: npt.NDArray[np.int32]
    fdi: npt.NDArray[np.uint8]
    tissue: npt.NDArray[np.uint8]
    lower: npt.NDArray[np.bool_]
    tooth: npt.NDArray[np.int32]
    teeth: tuple[Tooth, ...]
    rows: tuple[Row, Row]
    noise: Noise

    @cached_property
    def openness_closed(self) -> Array:
        """[N] share of the sky that each vertex sees with the teeth closed, 0..1."""
        scene = ray_scene((self.vertices, self.triangles))
        return sky_share(scene, self.vertices, self.normals, RAYS)

    @cached_property
    def openness_apart(self) -> Array:
        """[N] the same when the jaws are so far apart that neither shadows the other."""
        share = np.zeros(len(self.vertices))
        for jaw in (False, True):
            where = self.lower == jaw
            scene = ray_scene((self.vertices, self.triangles[where[self.triangles[:, 0]]]))
            share[where] = sky_share(scene, self.vertices[where], self.normals[where], RAYS)
        return share

    def jaw_motion(self, opening: float) -> Array:
        """[4, 4] that moves the lower jaw so that the front teeth part by `opening` mm."""
        matrix = np.eye(4)
        matrix[:3, :3] = turn(0, np.degrees(opening / 82.0))
        matrix[:3, 3] = HINGE - matrix[:3, :3] @ HINGE
        return matrix

    def posed(self, opening: float) -> tuple[Array, Array]:
        """Vertices and normals [N, 3] with the front teeth parted by `opening` mm."""
        if opening == 0:
            return self.vertices, self.normals
        motion = self.jaw_motion(opening)
        vertices, normals = self.vertices.copy(), self.normals.copy()
        vertices[self.lower] = vertices[self.lower] @ motion[:3, :3].T + motion[:3, 3]
        normals[self.lower] = normals[self.lower] @ motion[:3, :3].T
        return vertices, normals

    def tooth_centres(self, opening: float = 0.0) -> dict[int, Array]:
        """Middle [3] of each crown in the world, mm, by FDI number."""
        motion = self.jaw_motion(opening)
        found = {}
        for tooth in self.teeth:
            move = motion if tooth.plan.up < 0 else np.eye(4)
            found[tooth.plan.fdi] = move[:3, :3] @ tooth.centre + move[:3, 3]
        return found

    @property
    def pivot(self) -> Array:
        """[3] what cameras around the closed mouth look at, mm."""
        centres = np.array(list(self.tooth_centres().values()))
        return (centres.min(0) + centres.max(0)) / 2 * [1, 1, 0] + [0, 0, -12.0]


def random_mouth(rng: np.random.Generator, **overrides: Any) -> Mouth:
    """Grow a mouth.

    Args:
        rng: the options that are not given are sampled from it.
        overrides: attributes of `MouthOptions`.
    """
    return build_mouth(random_options(rng, **overrides))


def build_mouth(options: MouthOptions, moves: Mapping[int, Move] | None = None) -> Mouth:
    """Grow the mouth that the options describe; the same options give the same mouth.

    Args:
        options: of the mouth.
        moves: FDI number -> what this tooth did since the mouth was as the options say; the gum
            grows around the teeth where they stand now.
    """
    rng = np.random.default_rng(options.seed)
    upper, lower_row = (moved_row(row, moves or {}) for row in arrange(options, rng))
    rows = upper, lower_row
    teeth = rows[0].teeth + rows[1].teeth
    bits: list[tuple[Array, Array, Array, npt.NDArray[np.int32]]] = []
    marks: list[tuple[int, Tissue, bool, int]] = []

    def add(
        vertices: Array, local: Array, faces: npt.NDArray[np.int32], tissue: Tissue,
        lower: bool, tooth: int = -1,
    ) -> None:  # fmt: skip
        if len(vertices):
            fdi = teeth[tooth].plan.fdi if tooth >= 0 else 0
            bits.append((vertices, vertex_normals(vertices, faces), local, faces))
            marks.append((fdi, tissue, lower, tooth))

    index = {tooth.plan.fdi: n for n, tooth in enumerate(teeth)}
    for row, braces in zip(rows, (options.braces_upper, options.braces_lower), strict=True):
        lower = row.up < 0
        for tooth in row.teeth:
            faces = above_gum(row, tooth, options)
            add(tooth.vertices, tooth.local, faces, Tissue.ENAMEL, lower, index[tooth.plan.fdi])
        gum, vault = grow_gum(row, options, rng)
        add(gum.vertices, gum.local, gum.triangles, Tissue.GUM, lower)
        add(vault.vertices, vault.local, vault.triangles, Tissue.MUCOSA, lower)
        if braces:
            made, wire = brackets(row, rng)
            for fdi, (vertices, faces) in made.items():
                add(vertices, vertices, faces, Tissue.BRACKET, lower, index[fdi])
            add(wire[0], wire[0], wire[1], Tissue.WIRE, lower)
    sheet = tongue(rows, rng)
    add(sheet.vertices, sheet.local, sheet.triangles, Tissue.TONGUE, True)

    counts = [len(bit[0]) for bit in bits]
    starts = np.cumsum([0, *counts[:-1]])
    vertices, normals, local = (np.concatenate([bit[k] for bit in bits]) for k in range(3))
    triangles = np.concatenate([bit[3] + n for bit, n in zip(bits, starts, strict=True)])
    lower_mask = np.repeat([mark[2] for mark in marks], counts)
    return Mouth(
        options, vertices, normals, local, triangles.astype(np.int32),
        np.repeat(np.array([mark[0] for mark in marks], np.uint8), counts),
        np.repeat(np.array([int(mark[1]) for mark in marks], np.uint8), counts),
        lower_mask, np.repeat(np.array([mark[3] for mark in marks], np.int32), counts),
        teeth, rows, Noise(options.seed % 2**31, size=48),
    )  # fmt: skip
