"""Which photograph each triangle of a mesh is coloured from, in pieces that hang together."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
from scipy.sparse import coo_matrix, csr_matrix
from scipy.sparse.csgraph import connected_components

from stages.export.mesh.texture.sight import Sight

Array = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]
Numbers = npt.NDArray[np.int32]
Pixels = npt.NDArray[np.uint8]

#: A pixel none of whose channels is darker is a highlight, and counts this much of another.
CLIPPED, HIGHLIGHT = 244, 0.25
#: How often faces take over from their neighbours how well a photograph shows them.
EVENINGS = 12
#: Pieces with fewer faces go to another photograph that shows them.
SMALLEST_CHART, TRIES = 40, 3


def neighbours(faces: Numbers) -> Ints:
    """[E, 2] pairs of the faces [F, 3] that share an edge; where more than two do, in a row."""
    start, end = faces[:, [0, 1, 2]].ravel(), faces[:, [1, 2, 0]].ravel()
    low, high = np.minimum(start, end).astype(np.int64), np.maximum(start, end)
    key = low * (int(faces.max(initial=0)) + 1) + high
    order = np.argsort(key, kind="stable")
    same = key[order[1:]] == key[order[:-1]]
    return np.stack([order[:-1][same] // 3, order[1:][same] // 3], 1)


def best_photograph(
    faces: Numbers, seen: Sequence[Sight], photos: Sequence[Pixels]
) -> tuple[Ints, Ints]:
    """The photograph that shows each face best, if any, in large pieces.

    Best is the one with the most pixels for its area, where these are no highlights, in the mean of
    a face and those around it.

    Args:
        faces: [F, 3].
        seen: as each of K cameras sees the mesh. photos: what they took, [H, W, 3].

    Returns:
        The numbers of the photographs [F], -1 where none shows a face, and the pairs of faces that
        share an edge [E, 2].
    """
    pairs, count = neighbours(faces), len(faces)
    quality = np.stack([_quality(faces, s, p) for s, p in zip(seen, photos, strict=True)], 1)
    possible = quality > 0
    graph = _graph(pairs, count)
    shares = 1 / (1 + np.asarray(graph.sum(1)).reshape(-1, 1))
    even = quality
    for _ in range(EVENINGS):
        even = (even + graph @ even) * shares
    even = np.where(possible, even, 0)
    label = np.where(possible.any(1), even.argmax(1), -1)
    for _ in range(TRIES):
        chart = charts(label, pairs)
        small = (np.bincount(chart)[chart] < SMALLEST_CHART) & (label >= 0)
        # it goes where its neighbours outside are
        around = np.zeros_like(even)
        for one, other in ((pairs[:, 0], pairs[:, 1]), (pairs[:, 1], pairs[:, 0])):
            outside = small[one] & (chart[one] != chart[other]) & (label[other] >= 0)
            np.add.at(around, (chart[one[outside]], label[other[outside]]), 1)
        wanted = around[chart] * possible
        moved = small & (wanted.max(1) > 0)
        if not moved.any():
            break
        label = np.where(moved, wanted.argmax(1), label)
    return label, pairs


def charts(label: Ints, pairs: Ints) -> Ints:
    """[F] numbers of the connected pieces of faces with the same label [F]."""
    same = label[pairs[:, 0]] == label[pairs[:, 1]]
    _, chart = connected_components(_graph(pairs[same], len(label)), directed=False)
    return np.asarray(chart, np.int64)


def _graph(pairs: Ints, count: int) -> csr_matrix:
    """Symmetric [count, count]: 1 for each pair."""
    rows, columns = np.concatenate([pairs, pairs[:, ::-1]]).T
    return coo_matrix((np.ones(len(rows)), (rows, columns)), (count, count)).tocsr()


def _quality(faces: Numbers, sight: Sight, photo: Pixels) -> Array:
    """[F] how well a photograph shows each face; 0: not at all."""
    height, width = photo.shape[:2]
    column, row = np.clip(sight.pixels, 0, (width - 1, height - 1)).astype(np.int64).T
    bright = (photo[row, column].min(1) >= CLIPPED)[faces].any(1)
    return sight.facing * np.where(bright, HIGHLIGHT, 1.0)
