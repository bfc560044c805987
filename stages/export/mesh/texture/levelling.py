"""What is added to the colours of photographs so that no seam shows where two of them meet."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]
Numbers = npt.NDArray[np.int32]

#: How much what is added may change along an edge, against what a seam may leave; and as a whole.
EVENNESS, SMALLNESS = 0.3, 1e-3


def levelled(faces: Numbers, label: Ints, colors: Array, own: Array) -> Array:
    """What to add to the colours of each photograph at each vertex.

    The least squares of Lempitsky and Ivanov (2007), "Seamless mosaicing of image-based texture
    maps": at a vertex where faces of two labels meet both come to the same colour; elsewhere what
    is added changes little from vertex to vertex.

    Args:
        faces: [F, 3].
        label: [F] whose colours each face has: 0..K-1 a photograph, -1 the mesh's own.
        colors: [K, V, 3] of the vertices in the photographs.
        own: [V, 3] the mesh's own.

    Returns:
        [K + 1, V, 3], that of the mesh's own colours last; 0 where a label is not used.
    """
    from scipy.sparse import coo_matrix, diags
    from scipy.sparse.linalg import splu

    kinds, vertices = len(colors) + 1, len(own)
    said = np.concatenate([colors, own[None]]).reshape(-1, 3)
    # an unknown for each label at each vertex where it is used
    node = (label % kinds)[:, None] * vertices + faces
    used, corner = np.unique(node, return_inverse=True)
    corner = corner.reshape(-1, 3)
    added = np.zeros((kinds * vertices, 3))
    by_vertex = np.argsort(used % vertices, kind="stable")
    at = used[by_vertex] % vertices
    seam = np.flatnonzero(at[1:] == at[:-1])
    if not len(seam):
        return added.reshape(kinds, vertices, 3)
    one, other = by_vertex[seam], by_vertex[seam + 1]
    edges = np.concatenate([corner[:, [0, 1]], corner[:, [1, 2]], corner[:, [2, 0]]])
    rows = np.concatenate([one, edges[:, 0]])
    columns = np.concatenate([other, edges[:, 1]])
    weights = np.concatenate([np.ones(len(one)), np.full(len(edges), EVENNESS / 2)])
    count = len(used)
    ties = coo_matrix((weights, (rows, columns)), (count, count))
    ties = (ties + ties.T).tocsr()
    system = diags(np.asarray(ties.sum(1)).ravel() + SMALLNESS) - ties
    gap = said[used[other]] - said[used[one]]
    wanted = np.stack(
        [np.bincount(one, gap[:, k], count) - np.bincount(other, gap[:, k], count)
         for k in range(3)], 1,
    )  # fmt: skip
    # symmetric and far from singular: no pivots are needed
    solver = splu(
        system.tocsc(), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0,
        options={"SymmetricMode": True},
    )  # fmt: skip
    added[used] = solver.solve(wanted)
    return added.reshape(kinds, vertices, 3)
