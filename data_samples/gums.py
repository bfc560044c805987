"""The gums of our synthetic mouth: one sheet per jaw that follows the necks of the teeth."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import open3d as o3d
from anatomy import ArchLine, Jaw, Tooth, gum_margin
from scipy.ndimage import gaussian_filter, maximum_filter

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Sheet:
    """A grid of soft tissue.

    Attributes:
        vertices: [N, 3] in the world, mm.
        local: [N, 3] arc length along the arch, distance from the occlusal plane, distance from the
            gum's edge (negative under the teeth), mm.
        triangles: [M, 3].
    """

    vertices: Array
    local: Array
    triangles: npt.NDArray[np.int32]


def grid_sheet(vertices: Array, local: Array, flip: bool = False) -> Sheet:
    """Triangulate a grid [R, C, 3]; `flip` turns the faces over."""
    rows, columns = vertices.shape[:2]
    i, j = np.mgrid[: rows - 1, : columns - 1]
    a = i * columns + j
    b, c, d = a + 1, a + columns, a + columns + 1
    faces = np.concatenate([np.stack([a, b, c], -1), np.stack([b, d, c], -1)]).reshape(-1, 3)
    faces = faces[:, ::-1] if flip else faces
    return Sheet(vertices.reshape(-1, 3), local.reshape(-1, 3), faces.astype(np.int32))


def smoothstep(low: float, high: float, value: Array) -> Array:
    """0 at `low`, 1 at `high`, which may be less, smooth between."""
    t = np.clip((value - low) / (high - low), 0, 1)
    return np.asarray(t * t * (3 - 2 * t))


def tooth_relief(line: ArchLine, teeth: list[Tooth], along: Array, heights: Array) -> Array:
    """How far the teeth reach outwards from the arch line: [S, R] mm, -4 where there is none."""
    scene = o3d.t.geometry.RaycastingScene(nthreads=1)
    for tooth in teeth:
        scene.add_triangles(
            o3d.core.Tensor(tooth.vertices.astype(np.float32)),
            o3d.core.Tensor(tooth.triangles.astype(np.uint32)),
        )
    points, _, normals = line.at(along)
    start = points[:, None] + 9 * normals[:, None] + heights[None, :, None] * (0, 1, 0)
    rays = np.concatenate([start, np.broadcast_to(-normals[:, None], start.shape)], -1)
    hit = scene.cast_rays(o3d.core.Tensor(rays.astype(np.float32)), nthreads=1)["t_hit"].numpy()
    return np.maximum(np.where(np.isfinite(hit), 9 - hit, -4.0), -4.0)


def grow_gum(jaw: Jaw, teeth: list[Tooth], random: np.random.Generator, step: float) -> Sheet:
    """Drape a sheet over the roots: scalloped edge, papillae, root ridges, fold, lip."""
    line = ArchLine(jaw)
    along = np.arange(-line.reach, line.reach, step)
    reach = np.arange(0.0, 36.0, step)  # from the occlusal plane towards the root
    margin = gum_margin(teeth, along, jaw.up)
    # Behind the last molars the gum closes over the bite and runs into the cheek.
    last = max(teeth, key=lambda tooth: tooth.along)
    first = min(teeth, key=lambda tooth: tooth.along)
    behind = np.maximum(
        along - last.along - last.width / 2, first.along - first.width / 2 - along
    )  # [S]
    margin = margin - smoothstep(-0.3, 4.0, behind) * (margin + 2.0)
    depth = reach[None] - margin[:, None]  # [S, R]

    relief = tooth_relief(line, teeth, along, jaw.up * reach)
    # Between two teeth the gum bridges the gap rather than following it down.
    bridged = gaussian_filter(np.maximum(relief, -1.6), (0.55 / step, 0.35 / step))
    bridged = np.maximum(bridged, relief - 0.05)
    bridged = gaussian_filter(bridged, 0.22 / step)
    ridges = np.zeros_like(depth)
    for tooth in teeth:
        away = (along - tooth.along) / (0.36 * tooth.width)
        strength = 1.3 if tooth.kind == "canine" else 0.8
        ridges += strength * np.exp(-(away[:, None] ** 2)) * np.exp(-np.maximum(depth, 0) / 7)
    bone = -0.75 + ridges - 0.05 * np.maximum(depth, 0)
    outside = np.logaddexp(5 * (bridged + 0.28), 5 * bone) / 5
    far = smoothstep(2.5, 6.0, depth)
    outside = outside * (1 - far) + np.maximum(bone, bridged + 0.35) * far
    # No root may show, wherever the teeth stand out of line.
    roots = maximum_filter(relief, (int(1.2 / step) | 1, int(1.2 / step) | 1))
    buried = smoothstep(0.8, 1.6, depth) * np.maximum(roots + 0.35 - outside, 0)
    outside = outside + gaussian_filter(buried, 0.8 / step)
    rim = 0.16 * np.exp(-(((depth - 0.9) / 0.7) ** 2))  # the free gum is a little swollen
    under = np.minimum(relief, bridged) - 1.0
    covers = smoothstep(-0.3, 0.42, depth)
    offset = under * (1 - covers) + (outside + rim) * covers

    # The fold, and beyond it the lip held away by a retractor; the frenum in the middle.
    lift = np.maximum(reach[None] - 16.5, 0) / 6
    offset = offset + 3.6 * lift**2 / (0.35 + lift) - 0.7 * smoothstep(9, 16, reach[None])
    cheek = 0.16 * np.maximum(behind, 0)[:, None] ** 1.5
    offset = offset + cheek * smoothstep(0.0, 14.0, reach[None])
    frenum = np.exp(-((along[:, None] / 1.3) ** 2)) * smoothstep(12, 19, reach[None])
    offset = offset + 1.5 * frenum
    for size, height in ((2.2, 0.28), (0.8, 0.05)):
        waves = gaussian_filter(random.normal(size=depth.shape), size / step)
        offset = offset + height * waves / waves.std() * smoothstep(0.3, 6.0, depth)

    points, _, normals = line.at(along)
    vertices = points[:, None] + offset[..., None] * normals[:, None]
    vertices = vertices + jaw.up * reach[None, :, None] * (0, 1, 0)
    local = np.stack(np.broadcast_arrays(along[:, None], reach[None], depth), -1)
    return grid_sheet(vertices, local)
