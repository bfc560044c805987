"""What the viewer knows of each place beside its colour: who saw it; the teeth; a small mesh."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from pipeline.artifacts.cameras import Camera
from stages.export.mesh.surface import Mesh
from stages.splatting.rendering import RenderedView
from stages.splatting.support import SeenSurface, seen_surface, supporting_views

Bytes = npt.NDArray[np.uint8]
Floats = npt.NDArray[np.floating]

#: As in `evaluate`: a relative difference of depth within which it is the same surface.
SAME_SURFACE = 0.02
#: Less opaque than this a pixel shows nothing.
LEAST_ALPHA = 0.5
#: Vertices of the mesh that lies over the scene, about.
OVERLAY_VERTICES = 7000


def seen_surfaces(
    cameras: Sequence[Camera],
    seen: Sequence[RenderedView],
    usable: Mapping[str, npt.NDArray[np.bool_]],
) -> list[SeenSurface]:
    """What the photographs show of the scene: rendered depth where it may be used."""
    return [
        seen_surface(
            camera, view.depth, view.alpha >= LEAST_ALPHA,
            usable.get(camera.name, np.ones(view.alpha.shape, np.bool_)),
        )
        for camera, view in zip(cameras, seen, strict=True)
    ]  # fmt: skip


def photographs_that_saw(points: Floats, surfaces: Sequence[SeenSurface]) -> Bytes:
    """[N] how many photographs saw each point [N, 3], at most 255."""
    counts = supporting_views(np.asarray(points, np.float64), surfaces, SAME_SURFACE)
    return np.minimum(counts, 255).astype(np.uint8)


def coarse(mesh: Mesh, count: int = OVERLAY_VERTICES) -> Mesh:
    """A mesh with about `count` vertices: those in a cell of a grid become one, their mean.

    (Vertex clustering, Rossignac & Borrel 1993: not the best triangles, but at once.)
    """
    vertices, faces = mesh.vertices, mesh.faces
    if len(vertices) <= count:
        return mesh
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    area = float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2)
    # A surface crosses about 1.5 cells for each square of a cell's edge.
    cell = np.sqrt(1.5 * area / count)
    keys = np.floor((vertices - vertices.min(0)) / cell).astype(np.int64)
    size = keys.max(0) + 1
    flat = (keys[:, 0] * size[1] + keys[:, 1]) * size[2] + keys[:, 2]
    _, member, number = np.unique(flat, return_inverse=True, return_counts=True)
    merged, colors = (
        np.stack([np.bincount(member, values[:, k], len(number)) for k in range(3)], 1)
        / number[:, None]
        for values in (vertices, mesh.colors)
    )
    corners = member[faces]
    whole = (corners != np.roll(corners, 1, axis=1)).all(1)
    corners = corners[whole]
    _, first = np.unique(np.sort(corners, axis=1), axis=0, return_index=True)
    return Mesh(merged, corners[np.sort(first)].astype(np.int32), colors)


def directions(
    teeth: Sequence[Mapping[str, Any]], cameras: Sequence[Camera]
) -> list[dict[str, Any]]:
    """The teeth that have a place, as the page takes them, and from where they were photographed.

    Args:
        teeth: entries of `teeth.json`.
        cameras: of the placed photographs.
    """
    eyes = {camera.name: camera.centre for camera in cameras}
    found = []
    for tooth in teeth:
        if tooth["centre"] is None:
            continue
        centre = np.array(tooth["centre"])
        rays = [eyes[s["photograph"]] - centre for s in tooth["seen_in"] if s["photograph"] in eyes]
        towards = np.sum([ray / np.linalg.norm(ray) for ray in rays], axis=0)
        towards = towards / max(float(np.linalg.norm(towards)), 1e-12)
        found.append(
            {key: tooth[key] for key in ("fdi", "universal", "jaw", "doubt", "centre")}
            | {"towards": np.round(towards, 4).tolist()}
        )
    return found
