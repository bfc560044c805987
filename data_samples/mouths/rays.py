"""Rays against triangles, by Open3D on one thread (so that the same input gives the same bytes)."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
import numpy.typing as npt
import open3d as o3d

Array = npt.NDArray[np.float64]


def tensor(values: npt.NDArray[Any]) -> Any:
    """An Open3D tensor of an array."""
    return o3d.core.Tensor(values)  # type: ignore[call-overload]


def ray_scene(*meshes: tuple[Array, npt.NDArray[np.int32]]) -> Any:
    """A scene of meshes: vertices [N, 3], mm, and triangles [M, 3] each."""
    scene = o3d.t.geometry.RaycastingScene(nthreads=1)
    for vertices, triangles in meshes:
        scene.add_triangles(
            tensor(vertices.astype(np.float32)), tensor(triangles.astype(np.uint32))
        )
    return scene


def teeth_scene(teeth: Iterable[Any]) -> Any:
    """A scene of teeth (`arrange.Tooth`)."""
    return ray_scene(*((tooth.vertices, tooth.triangles) for tooth in teeth))


def cast(scene: Any, rays: npt.NDArray[Any]) -> dict[str, npt.NDArray[Any]]:
    """What rays [..., 6] meet: `t_hit`, `primitive_ids` [...], and `primitive_uvs` [..., 2]."""
    hit = scene.cast_rays(tensor(rays.astype(np.float32)), nthreads=1)
    return {key: hit[key].numpy() for key in ("t_hit", "primitive_ids", "primitive_uvs")}
