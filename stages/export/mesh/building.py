"""From a scene to its mesh: what it is made of, and the steps from there."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from pipeline.artifacts.cameras import Camera
from pipeline.artifacts.points import Points
from pipeline.artifacts.views import to_uint8
from pipeline.geometry.cloud import median_spacing
from stages.export.mesh.bend import bent
from stages.export.mesh.field import TRUNCATION, colors_of, fuse
from stages.export.mesh.nets import zero_surface
from stages.export.mesh.rims import even_rims, rim_edges, without_fringes
from stages.export.mesh.surface import (
    DEEPEST_OCTREE,
    Mesh,
    drop_small_parts,
    few_queries,
    keep_near,
    keep_vertices,
    poisson,
    repair,
    trusted_depth,
)

if TYPE_CHECKING:
    from stages.export.scene import Scene

Array = npt.NDArray[np.float64]
Floats = npt.NDArray[np.float32]
Bools = npt.NDArray[np.bool_]
Progress = Callable[..., None]

#: A mesh with fewer triangles than this is no mesh of anything.
FEWEST_FACES = 100
#: The mesh needs a trusted point within this many of their spacings, or this many voxels.
SUPPORT_REACH = 4.0
SUPPORT_VOXELS = 6.0
#: Where a point that is not trusted is nearer, the mesh may be so many voxels off the planes of
#: trusted points around, of so many of them off the nearest.
OFF_PLANE, PLANES = 2.0, 8
#: What is narrower at the rims than twice so many voxels is cut off: tatters of where points end.
FRINGE = 4.0
#: Connected parts of the mesh smaller than this share of the largest are dropped.
SMALLEST_PART = 0.02
#: Holes of up to this many edges are closed.
LARGEST_HOLE = 40


def raw_surface(
    scene: Scene,
    method: str,
    resolution: int,
    cell: int,
    between_views: int,
    reach_behind: float,
    confidence: float,
    progress: Progress,
) -> Mesh | None:
    """Reconstruct the surface near what is trusted, as it comes.

    Args:
        scene: what to mesh.
        method: ``tsdf`` from rendered depth, or ``poisson`` through the points.
        resolution: voxels across what a photograph shows.
        cell: edge of the cells of a ``tsdf`` mesh in voxels: 1, 2, 4 or 8.
        between_views: further viewpoints to fuse.
        reach_behind: how far behind the scene's centre, in half widths of a photograph.
        confidence: points above it support the mesh.
        progress: called with (step, done, total).

    Returns:
        The surface, or None if too little is trusted.
    """
    voxel = scene.voxel(resolution)
    start: Points = scene.points[scene.points.confidence > confidence]
    if len(start) < FEWEST_FACES:
        return None
    trusted = bent(
        start, scene.cameras, [_trusted(scene, k, np.inf) for k in range(len(scene.seen))]
    )
    reach = max(SUPPORT_VOXELS * voxel, SUPPORT_REACH * median_spacing(trusted.positions))
    if method == "tsdf":
        surface = fused(scene, trusted, voxel, cell, between_views, reach_behind, reach, progress)
    else:
        oriented = trusted[np.linalg.norm(trusted.normals, axis=1) > 0.5]
        if len(oriented) < FEWEST_FACES:
            return None
        octree = int(np.clip(np.ceil(np.log2(resolution)), 5, DEEPEST_OCTREE))
        surface = poisson(oriented.positions, oriented.normals, oriented.colors, octree)
    surface = keep_near(surface, trusted.positions, reach)
    guessed = scene.points[scene.points.confidence <= confidence].positions
    return keep_vertices(surface, ~made_of(guessed, surface.vertices, start, voxel))


def made_of(guessed: Floats, vertices: Array, trusted: Points, voxel: float) -> Bools:
    """[V] which vertices of a surface points have made that are not trusted: such a one is nearer,
    and what is trusted around lies elsewhere.

    Args:
        guessed: [N, 3] points that are not trusted.
        vertices: [V, 3].
        trusted: points as the fit found them; bent, those that guessed ones hide are on these.
        voxel: world units.
    """
    made = np.zeros(len(vertices), bool)
    if not len(guessed):
        return made
    tree = few_queries(trusted.positions)
    nearest, _ = tree.query(vertices)
    guess, _ = few_queries(guessed).query(vertices)
    asked = guess < nearest
    _, places = tree.query(vertices[asked], PLANES)
    away = vertices[asked, None] - trusted.positions[places]
    off = np.abs((away * trusted.normals[places]).sum(-1)).min(1)
    made[asked] = off > OFF_PLANE * voxel
    return made


def clean_mesh(surface: Mesh, most_faces: int, voxel: float) -> Mesh | None:
    """A surface without loose parts and holes, of at most so many triangles, with even rims; None
    if too little is left.

    Rims that would take most of the triangles are simplified with the rest, and have no steps then.

    Args:
        surface: see `raw_surface`.
        most_faces: triangles, at most.
        voxel: in which it was made, world units.
    """
    surface = drop_small_parts(surface, SMALLEST_PART)
    if len(surface) < FEWEST_FACES:
        return None
    rims_stay = 2 * len(rim_edges(surface.faces)) <= most_faces
    surface = repair(surface, most_faces, LARGEST_HOLE, rims_stay)
    surface = drop_small_parts(without_fringes(surface, FRINGE * voxel), SMALLEST_PART)
    if len(surface) < min(FEWEST_FACES, most_faces / 2):
        return None
    return even_rims(surface) if rims_stay else surface


def fused(
    scene: Scene,
    trusted: Points,
    voxel: float,
    cell: int,
    between_views: int,
    reach_behind: float,
    reach: float,
    progress: Progress,
) -> Mesh:
    """The surface that the depth rendered from the photographs' places and between them shows.

    Args:
        trusted: the surface is sought within `reach` of these.
        voxel, reach: world units.
        scene, cell, between_views, reach_behind, progress: see `raw_surface`.
    """
    from stages.export.pictures.orbits import between

    extra = between(scene.orbit, scene.cameras, between_views) if between_views else []
    cameras: list[Camera] = [*scene.cameras, *extra]
    images, depths = [], []
    for index, camera in enumerate(cameras):
        progress("mesh", index, len(cameras))
        seen = scene.seen[index] if index < len(scene.seen) else scene.painter(camera)
        eye_to_centre = float(np.linalg.norm(camera.centre - scene.orbit.centre))
        farthest = eye_to_centre + reach_behind * scene.orbit.radius
        if index < len(scene.seen):
            depths.append(_trusted(scene, index, farthest))
        else:
            depths.append(trusted_depth(seen.depth, seen.alpha, farthest))
        images.append(to_uint8(seen.image))
    field, maps = fuse(cameras, images, depths, voxel, trusted.positions, reach)
    vertices, faces = zero_surface(field.smoothed(), cell)
    return Mesh(vertices, faces, colors_of(vertices, maps, TRUNCATION * voxel))


def _trusted(scene: Scene, index: int, farthest: float) -> npt.NDArray[np.float32]:
    """Depth that the camera of a photograph sees, where the photograph may be used."""
    seen, mask = scene.seen[index], scene.masks[scene.cameras[index].name]
    depth = trusted_depth(seen.depth, seen.alpha, farthest)
    return np.where(mask, depth, np.float32(0))
