"""Braces: a bracket on every crown, a wire along them."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy.interpolate import CubicSpline

from .arrange import Row
from .rays import cast, teeth_scene

Array = npt.NDArray[np.float64]
Mesh = tuple[Array, npt.NDArray[np.int32]]  # vertices [N, 3] mm, triangles [M, 3]


def _box(size: Array) -> Mesh:
    """A box [-size, size] with its own corners on each face, so that the edges are sharp."""
    vertices: list[Array] = []
    faces: list[tuple[int, int, int]] = []
    for axis in range(3):
        for sign in (-1.0, 1.0):
            a, b = [k for k in range(3) if k != axis]
            corners = np.zeros((4, 3))
            corners[:, axis] = sign
            corners[:, a] = (-1, 1, 1, -1)
            corners[:, b] = (-1, -1, 1, 1)
            n = 4 * len(vertices)
            vertices.append(corners * size)
            faces += [(n, n + 1, n + 2), (n, n + 2, n + 3)]
    return np.concatenate(vertices), np.array(faces, np.int32)


def _join(meshes: list[Mesh]) -> Mesh:
    starts = np.cumsum([0] + [len(v) for v, _ in meshes[:-1]])
    return (
        np.concatenate([v for v, _ in meshes]),
        np.concatenate([f + n for (_, f), n in zip(meshes, starts, strict=True)]).astype(np.int32),
    )


def brackets(row: Row, rng: np.random.Generator) -> tuple[dict[int, Mesh], Mesh]:
    """Brackets by FDI number, and the wire that runs through them.

    Molars from the second one back stay bare.
    """
    scene = teeth_scene(row.teeth)
    width = rng.uniform(1.3, 1.8)
    made: dict[int, Mesh] = {}
    slots, places = [], []
    for tooth in row.teeth:
        if tooth.plan.number > 6:
            continue
        _, tangent, normal = row.arch.at(tooth.along)
        start = tooth.labial + 7 * normal
        hit = float(cast(scene, np.concatenate([start, -normal])[None])["t_hit"][0])
        if not np.isfinite(hit) or hit > 12:
            continue
        base = start - normal * hit
        up = np.cross(normal, tangent)
        lean = np.radians(rng.normal() * 5)
        a = np.cos(lean) * tangent + np.sin(lean) * up
        b = np.cross(normal, a)
        axes = np.stack([a, b, normal])
        parts = []
        for x, y, size in (
            (0.0, 0.0, (1.0, 1.0, 0.35)),  # the base
            (-0.55, 0.6, (0.3, 0.35, 0.9)),  # four wings
            (0.55, 0.6, (0.3, 0.35, 0.9)),
            (-0.55, -0.6, (0.3, 0.35, 0.9)),
            (0.55, -0.6, (0.3, 0.35, 0.9)),
        ):
            v, f = _box(np.array(size) * (width, width, 1.0))
            parts.append((v + np.array([x * width, y * width, size[2] - 0.3]), f))
        vertices, faces = _join(parts)
        made[tooth.plan.fdi] = (base + vertices @ axes, faces)
        slots.append(base + 0.95 * normal)
        places.append(tooth.along)
    if len(slots) < 3:
        return made, (np.zeros((0, 3)), np.zeros((0, 3), np.int32))
    t = np.linspace(places[0] - 2.5, places[-1] + 2.5, 400)
    path = CubicSpline(places, np.array(slots), bc_type="natural")(t)
    return made, _tube(path, rng.uniform(0.2, 0.28))


def _tube(path: Array, radius: float) -> Mesh:
    """A round wire along a path [N, 3]."""
    forward = np.gradient(path, axis=0)
    forward /= np.linalg.norm(forward, axis=1, keepdims=True)
    side = np.cross(forward, (0.0, 1.0, 0.0))
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    other = np.cross(forward, side)
    angle = np.linspace(0, 2 * np.pi, 6, endpoint=False)[None, :, None]
    rings = path[:, None] + radius * (
        np.cos(angle) * side[:, None] + np.sin(angle) * other[:, None]
    )
    rows = len(path)
    i, j = np.mgrid[: rows - 1, :6]
    a, b = i * 6 + j, i * 6 + (j + 1) % 6
    faces = np.concatenate([np.stack([a, a + 6, b], -1), np.stack([b, a + 6, b + 6], -1)])
    return rings.reshape(-1, 3), faces.reshape(-1, 3).astype(np.int32)
