"""Which jaw everything belongs to, by the crowns in the photographs and the surface between."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import cv2
import numpy as np
import numpy.typing as npt
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import dijkstra
from scipy.spatial import cKDTree

from pipeline.artifacts.cameras import Camera
from pipeline.artifacts.dental.fdi import JAWS, Jaw
from pipeline.artifacts.teeth import Dentition, filled
from stages.export.mesh.surface import Mesh, edge_lengths, face_normals
from stages.export.mesh.texture.charts import charts, neighbours
from stages.export.mesh.texture.sight import Sight

Bools = npt.NDArray[np.bool_]
Signs = npt.NDArray[np.int8]

#: A jaw is known if its crowns are seen at this many vertices; it has this many faces, and this
#: share of the mesh's area: less is scraps of crowns at the border of photographs of the other jaw.
FEWEST_VERTICES, FEWEST_FACES, LEAST_SHARE = 30, 100, 0.04
#: Pixels by which crowns are taken smaller: their outlines are no better.
BORDER = 1
#: How often the border between the jaws is evened out.
EVENINGS = 6
#: What lies farther from the mesh than this share of its diagonal is of no jaw.
OFF = 0.04
NEITHER, UPPER, LOWER = 0, 1, 2
#: Faces that look so far down (cosine) at the upper border of the lower jaw are the underside of
#: upper crowns, which bite in front; no crown leans out by 49 degrees. The upper jaw's alike.
LEDGE = 0.75
#: A piece smaller than this share of its jaw's largest that touches the other jaw belongs to that.
SMALLEST_PIECE = 0.02


def crown_maps(
    dentitions: Mapping[str, Dentition], cameras: Sequence[Camera]
) -> list[Signs | None]:
    """Where each camera sees crowns: [H, W], 1 the upper jaw's, -1 the lower jaw's, 0 none.

    Args:
        dentitions: by camera name, in pixels of the exported images; one without a name shows none
            (see `stages.export.measuring.mouth.Mouth`).
        cameras: K of them.
    """
    kernel = np.ones((2 * BORDER + 1, 2 * BORDER + 1), np.uint8)
    maps: list[Signs | None] = []
    for camera in cameras:
        dentition = dentitions.get(camera.name)
        if dentition is None or not dentition.all_crowns:
            maps.append(None)
            continue
        found = np.zeros((camera.height, camera.width), np.int8)
        for jaw, sign in zip(JAWS, (1, -1), strict=True):
            mask = filled(dentition.crowns(jaw), (camera.width, camera.height)).astype(np.uint8)
            found += np.int8(sign) * cv2.erode(mask, kernel).astype(np.int8)
        maps.append(found)
    return maps


def jaws_of(
    mesh: Mesh,
    seen: Sequence[Sight],
    maps: Sequence[Signs | None],
    up: npt.NDArray[np.floating] | None = None,
) -> Mapping[Jaw, Bools]:
    """The faces of each jaw.

    The photographs vote on the vertices that they show inside crowns. Gums and all else go with the
    crown that is nearest along the surface, and undersides of crowns with these.

    Args:
        mesh: to divide.
        seen: as each of K cameras sees it.
        maps: K times where crowns are, see `crown_maps`.
        up: [3] unit, from the lower jaw to the upper one; None: not known.

    Returns:
        Jaw -> [F] bool, both jaws; nothing, if hardly anything of a jaw is seen.
    """
    votes = np.zeros(len(mesh.vertices), np.int64)
    for sight, crowns in zip(seen, maps, strict=True):
        if crowns is not None:
            column, row = sight.pixels[sight.seen].astype(np.int64).T
            votes[sight.seen] += crowns[row, column]
    if min((votes > 0).sum(), (votes < 0).sum()) < FEWEST_VERTICES:
        return {}
    graph = edge_lengths(mesh)
    sign = _carried_on(mesh, graph, np.sign(votes))
    shares = 1 / (1 + np.diff(graph.indptr))
    ties = graph.copy()
    ties.data[:] = 1
    for _ in range(EVENINGS):
        sign = (sign + ties @ sign) * shares
    upper = sign[mesh.faces].sum(1) > 0
    pairs = neighbours(mesh.faces)
    if up is not None:
        upper = upper ^ _ledges(mesh, upper, pairs, np.asarray(up, np.float64))
    piece = charts(upper.astype(np.int64), pairs)
    sizes = np.bincount(piece)
    largest = {side: sizes[piece[upper == side]].max(initial=0) for side in (True, False)}
    border = upper[pairs[:, 0]] != upper[pairs[:, 1]]
    touching = np.zeros(len(sizes), bool)
    touching[piece[pairs[border].ravel()]] = True
    small = sizes[piece] < SMALLEST_PIECE * np.where(upper, largest[True], largest[False])
    upper = upper ^ (small & touching[piece])
    area = np.linalg.norm(face_normals(mesh), axis=1)
    share = area[upper].sum() / area.sum()
    if min(upper.sum(), (~upper).sum()) < FEWEST_FACES or min(share, 1 - share) < LEAST_SHARE:
        return {}
    return {"upper": upper, "lower": ~upper}


def jaws_at(
    points: npt.NDArray[np.floating], mesh: Mesh, jaws: Mapping[Jaw, Bools]
) -> npt.NDArray[np.uint8]:
    """[N] the jaw of the mesh beside each point [N, 3]: `NEITHER`, `UPPER` or `LOWER`.

    Args:
        points: in the world of the mesh.
        mesh: that was divided.
        jaws: what `jaws_of` says of it.
    """
    found = np.full(len(points), NEITHER, np.uint8)
    if not jaws:
        return found
    votes = np.zeros(len(mesh.vertices), np.int64)
    for jaw, sign in zip(JAWS, (1, -1), strict=True):
        np.add.at(votes, mesh.faces[jaws[jaw]].ravel(), sign)
    known = np.flatnonzero(votes)
    within = OFF * float(np.linalg.norm(np.ptp(mesh.vertices, axis=0)))
    finite = np.flatnonzero(np.isfinite(points).all(1))
    tree = cKDTree(mesh.vertices[known])
    away, nearest = tree.query(points[finite], distance_upper_bound=within)
    near = np.isfinite(away)
    found[finite[near]] = np.where(votes[known[nearest[near]]] > 0, UPPER, LOWER)
    return found


def _ledges(
    mesh: Mesh, upper: Bools, pairs: npt.NDArray[np.int64], up: npt.NDArray[np.float64]
) -> Bools:
    """[F] faces that join a crown to what the other jaw has in front of it, and look away from it.

    Args:
        upper: [F] whose jaw each is so far.
        pairs: [E, 2] neighbouring faces.
    """
    normals = face_normals(mesh)
    away = np.where(upper, 1, -1) * (normals @ up) > LEDGE * np.linalg.norm(normals, axis=1)
    piece = charts(np.where(away, 1 + upper, 0), pairs)
    meeting = pairs[upper[pairs[:, 0]] != upper[pairs[:, 1]]]
    touching = np.zeros(piece.max(initial=0) + 1, bool)
    touching[piece[meeting.ravel()]] = True
    return np.asarray(away & touching[piece])


def _carried_on(
    mesh: Mesh, graph: csr_matrix, sign: npt.NDArray[np.integer]
) -> npt.NDArray[np.float64]:
    """[V] +-1: that of the nearest vertex that has one, along the edges if they lead to one."""
    known = np.flatnonzero(sign)
    _, _, source = dijkstra(graph, indices=known, min_only=True, return_predecessors=True)
    reached = source >= 0
    result = np.zeros(len(sign))
    result[reached] = sign[source[reached]]
    if not reached.all():
        near = cKDTree(mesh.vertices[known]).query(mesh.vertices[~reached])[1]
        result[~reached] = sign[known[near]]
    return result
