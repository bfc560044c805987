"""Open surfaces of known shape."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from stages.export.mesh.surface import Mesh


def sheet(across: int, down: int, shape: Callable, color: Callable) -> Mesh:  # type: ignore[type-arg]
    """A grid of triangles that faces -z, where `shape` (u, v) puts it; u, v are 0..1."""
    u, v = np.meshgrid(np.linspace(0, 1, across), np.linspace(0, 1, down))
    number = np.arange(across * down).reshape(down, across)
    a, b, c, d = number[:-1, :-1], number[:-1, 1:], number[1:, 1:], number[1:, :-1]
    faces = np.concatenate([np.stack([a, b, c], -1), np.stack([a, c, d], -1)]).reshape(-1, 3)
    vertices = np.stack(np.broadcast_arrays(*shape(u, v)), -1).reshape(-1, 3).astype(float)
    colors = np.stack(np.broadcast_arrays(*color(u, v)), -1).reshape(-1, 3).astype(float)
    mesh = Mesh(vertices, faces.astype(np.int32), colors)
    a, b, c = vertices[mesh.faces[0]]
    if np.cross(b - a, c - a)[2] > 0:
        mesh = replace(mesh, faces=np.ascontiguousarray(mesh.faces[:, [0, 2, 1]]))
    return mesh
