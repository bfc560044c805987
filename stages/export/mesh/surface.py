"""Triangle meshes: from points (screened Poisson), repaired, simplified, cut to what is known."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt
from scipy.sparse import coo_matrix, csr_matrix
from scipy.spatial import cKDTree

from pipeline.errors import RequestError

Array = npt.NDArray[np.float64]

#: Depth maps are trusted where at least this much of the light is accounted for ...
LEAST_ALPHA = 0.6
#: ... and away from steps: depth changes by less than this share across 3 x 3 pixels.
STEEPEST_STEP = 0.03
#: Poisson takes minutes beyond this depth.
DEEPEST_OCTREE = 10


@dataclass(frozen=True)
class Mesh:
    """A coloured triangle mesh.

    Attributes:
        vertices: [V, 3] float64, world.
        faces: [F, 3] int32, counter-clockwise as seen from outside.
        colors: [V, 3] float64 sRGB in 0..1.
    """

    vertices: Array
    faces: npt.NDArray[np.int32]
    colors: Array

    def __len__(self) -> int:
        return len(self.faces)


def trusted_depth(
    depth: npt.NDArray[np.floating], alpha: npt.NDArray[np.floating], farthest: float
) -> npt.NDArray[np.float32]:
    """A depth map [H, W] with 0 where it is transparent, at a step, or too far.

    A median over 5 x 5 pixels takes out single Gaussians that stick out of the surface.
    """
    clean = np.where(np.isfinite(depth) & (depth > 0), depth, 0).astype(np.float32)
    kernel = np.ones((3, 3), np.uint8)
    step = cv2.dilate(clean, kernel) - cv2.erode(clean, kernel)
    good = (alpha >= LEAST_ALPHA) & (clean < farthest) & (step < STEEPEST_STEP * clean)
    even = cv2.medianBlur(np.where(good, clean, np.float32(0)), 5)
    return np.where(good & (even > 0), even, np.float32(0))


def poisson(
    points: npt.NDArray[np.floating],
    normals: npt.NDArray[np.floating],
    colors: npt.NDArray[np.floating],
    depth: int,
) -> Mesh:
    """Screened Poisson reconstruction (Kazhdan and Hoppe 2013), on one thread: it isn't
    deterministic on more.

    Args:
        points, normals, colors: [N, 3] each; points without a normal (0) are left out.
        depth: of the octree.

    Returns:
        The (closed) mesh.
    """
    import open3d

    oriented = np.linalg.norm(normals, axis=1) > 0.5
    cloud = open3d.geometry.PointCloud()
    for name, values in (("points", points), ("normals", normals), ("colors", colors)):
        vectors = open3d.utility.Vector3dVector(np.asarray(values, np.float64)[oriented])
        setattr(cloud, name, vectors)
    mesh, _ = open3d.geometry.TriangleMesh.create_from_point_cloud_poisson(
        cloud, depth=depth, n_threads=1
    )
    return _from_open3d(mesh)


def keep_near(mesh: Mesh, support: npt.NDArray[np.floating], reach: float) -> Mesh:
    """The part of a mesh with a point of `support` [N, 3] within `reach` of each vertex."""
    tree = few_queries(np.asarray(support, np.float64))
    distance, _ = tree.query(mesh.vertices, distance_upper_bound=np.nextafter(reach, np.inf))
    return keep_vertices(mesh, distance <= reach)


def few_queries(points: npt.NDArray[np.floating]) -> cKDTree:
    """For a few queries: what makes many fast takes longer than they do."""
    return cKDTree(points, balanced_tree=False, compact_nodes=False)


def keep_vertices(mesh: Mesh, kept: npt.NDArray[np.bool_]) -> Mesh:
    """The faces all of whose vertices are kept, without loose vertices."""
    faces = mesh.faces[kept[mesh.faces].all(1)]
    used = np.zeros(len(mesh.vertices), bool)
    used[faces] = True
    number = np.cumsum(used) - 1
    return Mesh(mesh.vertices[used], number[faces].astype(np.int32), mesh.colors[used])


def drop_small_parts(mesh: Mesh, least_share: float) -> Mesh:
    """Drop connected parts with fewer than `least_share` of the largest part's faces."""
    from scipy.sparse.csgraph import connected_components

    if len(mesh) == 0:
        return mesh
    start, end = mesh.faces[:, [0, 1, 2]].ravel(), mesh.faces[:, [1, 2, 0]].ravel()
    count = len(mesh.vertices)
    graph = coo_matrix((np.ones(len(start), np.int8), (start, end)), shape=(count, count))
    _, part = connected_components(graph, directed=False)
    faces = np.bincount(part[mesh.faces[:, 0]], minlength=part.max() + 1)
    return keep_vertices(mesh, faces[part] >= least_share * faces.max())


def repair(mesh: Mesh, target_faces: int, largest_hole: int, rims_stay: bool = True) -> Mesh:
    """Repair a mesh and simplify it to at most about `target_faces` (quadric edge collapse).

    Removes duplicate and null faces and non-manifold edges and vertices, and closes holes of up to
    `largest_hole` edges (0: none, and faces stay turned as they are). Colours are taken over from
    the nearest original vertices. Where `rims_stay` there are at least as many faces as edges of
    rims, whatever is asked for.
    """
    import pymeshlab

    work = pymeshlab.MeshSet(verbose=False)
    if not hasattr(work, "meshing_close_holes"):
        raise RequestError(
            "PyMeshLab is installed but could not load its filters: a library of the system is "
            "missing, mostly libOpenGL.so.0 (Debian, Ubuntu: libopengl0). 'pipeline doctor' says "
            "which. Run the same command again then, or without a mesh: --set export.mesh=false."
        )
    work.add_mesh(pymeshlab.Mesh(mesh.vertices, mesh.faces))
    work.meshing_remove_duplicate_vertices()
    work.meshing_remove_duplicate_faces()
    work.meshing_remove_null_faces()
    _make_manifold(work)
    work.meshing_close_holes(maxholesize=largest_hole, newfaceselected=False)
    if work.current_mesh().face_number() > target_faces:
        work.meshing_decimation_quadric_edge_collapse(
            targetfacenum=target_faces, preserveboundary=rims_stay, boundaryweight=2.0,
            preservenormal=True, preservetopology=True, planarquadric=True, qualitythr=0.5,
        )  # fmt: skip
        _make_manifold(work)
    if largest_hole:
        # around simpler rims, gaps that are meant have as few edges as holes
        _turn_one_way(work, largest_hole if rims_stay else 0)
    work.meshing_remove_unreferenced_vertices()
    result = work.current_mesh()
    vertices = np.array(result.vertex_matrix(), np.float64)
    faces = np.array(result.face_matrix(), np.int32)
    return Mesh(vertices, faces, _transfer_colors(mesh, vertices))


def _make_manifold(work):  # type: ignore[no-untyped-def]  # pymeshlab has no types
    work.meshing_repair_non_manifold_edges()
    work.meshing_repair_non_manifold_vertices()


def _turn_one_way(work, largest_hole):  # type: ignore[no-untyped-def]
    """Put others in the place of faces that look inward where their neighbours look outward.

    Closing holes and simplifying leave some, slivers mostly, and with them a surface has no sides.
    """
    import pymeshlab

    for last in (False, False, True):
        now = work.current_mesh()
        vertices, faces = np.array(now.vertex_matrix()), np.array(now.face_matrix())
        wrong = turned_faces(Mesh(vertices, faces, vertices))
        if not wrong.any():
            return
        work.add_mesh(pymeshlab.Mesh(vertices, faces[~wrong]))
        _make_manifold(work)
        if not last:
            work.meshing_close_holes(maxholesize=largest_hole, newfaceselected=False)


def turned_faces(mesh: Mesh) -> npt.NDArray[np.bool_]:
    """[F] bool: of two faces that pass their common edge in the same direction, the one that looks
    less where the surface does (weighted by area: a sliver hardly looks anywhere)."""
    faces = mesh.faces.astype(np.int64)
    edges = faces.ravel() * len(mesh.vertices) + faces[:, [1, 2, 0]].ravel()
    order = np.argsort(edges, kind="stable")
    twice = np.flatnonzero(edges[order][1:] == edges[order][:-1])
    pairs = np.stack([order[twice], order[twice + 1]], 1) // 3
    agrees = (face_normals(mesh) * vertex_normals(mesh)[faces].sum(1)).sum(1)
    wrong = np.zeros(len(faces), bool)
    wrong[np.where(agrees[pairs[:, 0]] < agrees[pairs[:, 1]], pairs[:, 0], pairs[:, 1])] = True
    return wrong


def _transfer_colors(source: Mesh, vertices: Array) -> Array:
    """Colours of the nearest source vertices, weighted by closeness."""
    number = min(4, len(source.vertices))
    distance, index = cKDTree(source.vertices).query(vertices, number)
    distance, index = distance.reshape(-1, number), index.reshape(-1, number)
    weight = 1.0 / (distance + 0.1 * distance.mean() + 1e-12)
    weight /= weight.sum(1, keepdims=True)
    return np.asarray((weight[..., None] * source.colors[index]).sum(1))


def edge_lengths(mesh: Mesh) -> csr_matrix:
    """[V, V] symmetric: the lengths of the edges."""
    start = mesh.faces[:, [0, 1, 2, 1, 2, 0]].ravel().astype(np.int64)
    end = mesh.faces[:, [1, 2, 0, 0, 1, 2]].ravel().astype(np.int64)
    count = len(mesh.vertices)
    once = np.unique(start * count + end)
    start, end = once // count, once % count
    lengths = np.linalg.norm(mesh.vertices[start] - mesh.vertices[end], axis=1)
    lengths = np.maximum(lengths, 1e-12)  # 0 would be no edge
    return coo_matrix((lengths, (start, end)), (count, count)).tocsr()


def face_normals(mesh: Mesh) -> Array:
    """[F, 3], length twice the area."""
    a, b, c = (mesh.vertices[mesh.faces[:, k]] for k in range(3))
    return np.cross(b - a, c - a)


def vertex_normals(mesh: Mesh) -> Array:
    """[V, 3] unit, area-weighted."""
    flat = face_normals(mesh)
    normals = np.stack(
        [
            sum(
                np.bincount(mesh.faces[:, k], flat[:, axis], minlength=len(mesh.vertices))
                for k in range(3)
            )
            for axis in range(3)
        ],
        axis=1,
    )
    return normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)


def _from_open3d(mesh) -> Mesh:  # type: ignore[no-untyped-def]
    """Arrays of an Open3D mesh, in an order that depends on the geometry alone."""
    vertices = np.asarray(mesh.vertices, np.float64)
    faces = np.asarray(mesh.triangles, np.int32)
    order = np.lexsort(vertices.T)
    number = np.empty(len(order), np.int64)
    number[order] = np.arange(len(order))
    faces = number[faces].astype(np.int32)
    first = faces.argmin(1)  # turn each face so that its smallest index leads
    faces = faces[np.arange(len(faces))[:, None], (first[:, None] + np.arange(3)) % 3]
    faces = faces[np.lexsort(faces.T[::-1])]
    colors = np.asarray(mesh.vertex_colors, np.float64).reshape(-1, 3)
    return Mesh(vertices[order], faces, colors[order])
