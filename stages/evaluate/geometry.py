"""The reconstruction's surface before the true mesh: which parts of both are compared."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from pipeline.artifacts.cameras import Camera
from pipeline.geometry.mesh import Mesh
from stages.evaluate.held_out import ALIGNMENT, Registration
from stages.evaluate.surface import icp, surface_figures
from stages.splatting.support import SeenSurface, supporting_views

Array = npt.NDArray[np.float64]
Bools = npt.NDArray[np.bool_]

#: What the figures are of, for whoever reads them.
SURFACE = (
    "the surface that the finished scene renders in the input views, at their pixels where the "
    "true camera sees the mesh (and inside evaluate.masks, where given); completeness of the part "
    "of the mesh at these pixels"
)
CLOUD = "the points that the fit started from, where input views see them at such pixels"
#: A cloud point is seen where its depth differs from the rendered one by less than this, relative.
_SAME_SURFACE = 0.05


@dataclass(frozen=True)
class Compared:
    """Attributes:
    points: [N, 3] rendered surface at pixels of the mesh.
    surface: [P, 3] rendered surface at all pixels.
    seen: [M, 3] the mesh at its pixels. All in the world of the mesh.
    """

    points: Array
    surface: Array
    seen: Array


def compared_parts(
    mesh: Mesh,
    surfaces: Sequence[SeenSurface],
    truth: Mapping[str, Camera],
    registration: Registration,
    regions: Mapping[str, Bools],
) -> tuple[Compared, list[SeenSurface]]:
    """What of the reconstruction and of the mesh is compared.

    Args:
        mesh: the truth.
        surfaces: what the input views show; those without a true camera are left out.
        truth: true cameras by name of view.
        registration: of the reconstruction in the world of the truth.
        regions: by name of view, [H, W] pixels to use; all of views that are not in it.

    Returns:
        The parts, and the surfaces at pixels of the mesh alone.
    """
    points, everything, seen, there = [], [], [], []
    for surface in surfaces:
        name = surface.camera.name
        if name not in truth:
            continue
        depth = mesh.depth(truth[name])
        counted = (depth > 0) & regions.get(name, np.ones(depth.shape, bool))
        world = registration.to_truth(surface.camera.unproject(surface.depth))
        rendered = surface.depth > 0
        everything.append(world[rendered])
        points.append(world[rendered & counted])
        seen.append(truth[name].unproject(depth)[counted])
        there.append(SeenSurface(surface.camera, np.where(counted, surface.depth, 0)))
    parts = [np.concatenate(part or [np.zeros((0, 3))]) for part in (points, everything, seen)]
    return Compared(*parts), there


def geometry_figures(
    mesh: Mesh,
    surfaces: Sequence[SeenSurface],
    truth: Mapping[str, Camera],
    registration: Registration,
    regions: Mapping[str, Bools],
    cloud: npt.NDArray[np.floating] | None,
    align: str,
    distances: Sequence[float],
    unit: str,
) -> dict[str, Any] | None:
    """Figures of the geometry; None where no input view has both the mesh and the scene in it.

    Args:
        mesh, surfaces, truth, registration, regions: see `compared_parts`.
        cloud: [N, 3] points that the fit started from, in the reconstruction's world, or None.
        align: ``"cameras"``, or ``"icp"`` to lay the surface onto the mesh after that.
        distances, unit: see `surface_figures`.
    """
    parts, there = compared_parts(mesh, surfaces, truth, registration, regions)
    if not len(parts.points) or not len(parts.seen):
        return None
    chosen = np.zeros((0, 3))
    if cloud is not None:
        positions = np.asarray(cloud, np.float64)
        views = supporting_views(positions, surfaces, _SAME_SURFACE)
        at_mesh = supporting_views(positions, there, _SAME_SURFACE)
        # gum beside a tooth is at a pixel of the mesh in the odd view
        chosen = registration.to_truth(positions[(at_mesh > 0) & (2 * at_mesh > views)])
    points, surface = parts.points, parts.surface
    alignment = ALIGNMENT
    if align == "icp":
        scale, rotation, shift = icp(mesh, points)
        points, surface, chosen = (
            scale * part @ rotation.T + shift for part in (points, surface, chosen)
        )
        alignment = f"{ALIGNMENT}; then trimmed ICP with scale onto the mesh"
    block = {
        **surface_figures(mesh, points, surface, parts.seen, distances, unit),
        "alignment": alignment,
        "of": SURFACE,
    }
    if len(chosen):
        figures = surface_figures(mesh, chosen, chosen, parts.seen, distances, unit)
        block["points"] = {**figures, "of": CLOUD}
    return block
