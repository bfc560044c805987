"""Rims of a mesh made even: where the cells of a field or the votes of vertices end, they end in
steps."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt
from scipy.sparse import coo_matrix

from stages.export.mesh.surface import Mesh, face_normals

Bools = npt.NDArray[np.bool_]
Ints = npt.NDArray[np.int64]

#: How often each vertex of a rim goes half way to the middle of its two neighbours. This evens
#: steps of an edge or two, as cells make them, and hardly moves what is longer.
ROUNDS = 8
#: Vertices are held again so often where moving them turned a triangle over.
_MOST_HOLDS = 10


def even_rims(mesh: Mesh, side: Bools | None = None) -> Mesh:
    """The mesh with its rims evened along themselves; the surface between stays.

    Nothing moves where rims meet, and no triangle is turned over.

    Args:
        mesh: the mesh.
        side: [F] the faces whose border with the others is a rim as well.
    """
    rim = _rim_edges(mesh.faces, np.zeros(len(mesh), bool) if side is None else side)
    count = len(mesh.vertices)
    moves = np.bincount(rim.ravel(), minlength=count) == 2
    ends = np.concatenate([rim, rim[:, ::-1]])
    neighbours = coo_matrix((np.full(len(ends), 0.5), ends.T), shape=(count, count)).tocsr()
    before = face_normals(mesh)
    for _ in range(_MOST_HOLDS):
        vertices = mesh.vertices.copy()
        pull = neighbours[moves]
        for _ in range(ROUNDS):
            vertices[moves] = (vertices[moves] + pull @ vertices) / 2
        even = replace(mesh, vertices=vertices)
        over = (face_normals(even) * before).sum(1) < 0
        held = np.unique(mesh.faces[over])
        if not moves[held].any():
            return even
        moves[held] = False
    return mesh


def _rim_edges(faces: npt.NDArray[np.int32], side: Bools) -> Ints:
    """[E, 2] vertices of the edges of one face [F, 3], or of two on different sides [F]."""
    start, end = faces.ravel().astype(np.int64), faces[:, [1, 2, 0]].ravel().astype(np.int64)
    count = int(faces.max(initial=0)) + 1
    edges, place = np.unique(
        np.minimum(start, end) * count + np.maximum(start, end), return_inverse=True
    )
    sharing, on_side = np.bincount(place), np.bincount(place, np.repeat(side, 3))
    rim = edges[(sharing == 1) | ((sharing == 2) & (on_side == 1))]
    return np.stack([rim // count, rim % count], axis=1)
