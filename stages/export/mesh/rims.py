"""Rims of a mesh made even: where the cells of a field or the votes of vertices end, they end in
steps."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import dijkstra

from stages.export.mesh.surface import Mesh, edge_lengths, face_normals, keep_vertices

Bools = npt.NDArray[np.bool_]
Ints = npt.NDArray[np.int64]

#: How often each vertex of a rim goes half way to the middle of its two neighbours. This evens
#: steps of an edge or two, as cells make them, and hardly moves what is longer.
ROUNDS = 8
#: Vertices are held again so often where moving them turned a triangle over.
_MOST_HOLDS = 10


def even_rims(mesh: Mesh) -> Mesh:
    """The mesh with its rims evened along themselves; the surface between stays.

    Nothing moves where rims meet, and no triangle is turned over.
    """
    return _evened(mesh, rim_edges(mesh.faces))


def without_fringes(mesh: Mesh, reach: float) -> Mesh:
    """The mesh without what is narrower than twice `reach` at its rims, as measured along edges: an
    opening, as of a picture. One with edges too long to tell, or of nothing wider, stays."""
    rim = np.unique(rim_edges(mesh.faces))
    if not len(rim):
        return mesh
    lengths = edge_lengths(mesh)
    edge = float(lengths.data.mean())
    if 2 * edge > reach:
        return mesh
    inside = ~np.isfinite(dijkstra(lengths, indices=rim, min_only=True, limit=reach))
    if not inside.any():
        return mesh
    back = reach + edge  # to the rim again, though edges lie askew
    near = dijkstra(lengths, indices=np.flatnonzero(inside), min_only=True, limit=back)
    return keep_vertices(mesh, np.isfinite(near))


def even_border(mesh: Mesh, side: Bools) -> Mesh:
    """The same for the border between some faces [F] and the others; the rims stay."""
    edges, sharing, on_side = _edges(mesh.faces, side)
    return _evened(mesh, edges[(sharing == 2) & (on_side == 1)])


def rim_edges(faces: npt.NDArray[np.int32]) -> Ints:
    """[E, 2] vertices of the edges that only one of the faces [F, 3] has."""
    edges, sharing, _ = _edges(faces, np.zeros(len(faces), bool))
    return edges[sharing == 1]


def _edges(faces: npt.NDArray[np.int32], side: Bools) -> tuple[Ints, Ints, Ints]:
    """Each edge of faces [F, 3]: its vertices [E, 2], how many faces have it, and how many of them
    are on the side [F]."""
    start, end = faces.ravel().astype(np.int64), faces[:, [1, 2, 0]].ravel().astype(np.int64)
    count = int(faces.max(initial=0)) + 1
    keys, place = np.unique(
        np.minimum(start, end) * count + np.maximum(start, end), return_inverse=True
    )
    on_side = np.bincount(place[np.repeat(side, 3)], minlength=len(keys))
    return np.stack([keys // count, keys % count], axis=1), np.bincount(place), on_side


def _evened(mesh: Mesh, curve: Ints) -> Mesh:
    """The mesh with the vertices along edges [E, 2] moved; those with other than two stay."""
    count = len(mesh.vertices)
    moves = np.bincount(curve.ravel(), minlength=count) == 2
    ends = np.concatenate([curve, curve[:, ::-1]])
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
