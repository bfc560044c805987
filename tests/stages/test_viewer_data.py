"""What the viewer page carries beside the colours: jaws, who saw what, the mesh, small arrays."""

from __future__ import annotations

import base64
import zlib
from dataclasses import replace

import numpy as np
import pytest

from stages.export.mesh.surface import Mesh
from stages.export.viewer.compact import Pack, octahedral
from stages.export.viewer.knowledge import (
    coarse,
    photographs_that_saw,
    seen_surfaces,
)
from stages.splatting.rendering import render
from tests.stages import export_scene as scene


def test_who_saw_what() -> None:
    ball = scene.ball_gaussians()
    opaque = np.full_like(ball.logit_opacities, 6.0)
    ball = replace(ball, logit_opacities=opaque, log_scales=ball.log_scales + 0.2)
    cameras = scene.ball_cameras()
    surfaces = seen_surfaces(cameras, [render(ball, camera) for camera in cameras], {})
    points = np.array([[0.1, -0.25, -1.0], [-0.3, 0.3, -1.0], [0.75, 0.2, -0.63], [0, 0, 1]])
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    seen = photographs_that_saw(points, surfaces)
    assert seen[[0, 1, 3]].tolist() == [3, 3, 0]
    assert 1 <= seen[2] <= 3


@pytest.mark.parametrize("delta", [False, True])
@pytest.mark.parametrize("bits", [8, 10, 16])
def test_columns_come_back(bits: int, delta: bool) -> None:
    values = np.random.default_rng(bits).normal(size=(300, 2)).cumsum(0)
    pack = Pack()
    pack.add("values", values, bits, delta)
    told = pack.described["values"]
    planes = np.frombuffer(zlib.decompress(base64.b64decode(pack.text()), -15), np.uint8)
    planes = planes.reshape(2, -1, 300).astype(np.int64)
    levels = planes[:, 0] if bits == 8 else planes[:, 0] + 256 * planes[:, 1]
    if delta:
        steps = np.where(levels % 2, -(levels + 1) // 2, levels // 2)
        levels = np.cumsum(steps, axis=1) % 2**bits
    back = np.array(told["low"]) + np.array(told["step"]) * levels.T
    assert np.abs(back - values).max() <= 0.51 * np.ptp(values, axis=0).max() / (2**bits - 1)


def test_directions_survive_the_octahedron() -> None:
    directions = np.random.default_rng(1).normal(size=(500, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    xy = octahedral(directions)
    z = 1 - np.abs(xy).sum(1)
    folded = (1 - np.abs(xy[:, ::-1])) * np.where(xy >= 0, 1, -1)
    back = np.column_stack([np.where(z[:, None] >= 0, xy, folded), z])
    back /= np.linalg.norm(back, axis=1, keepdims=True)
    np.testing.assert_allclose(back, directions, atol=1e-9)


def test_a_coarse_mesh_keeps_its_shape() -> None:
    grid = np.stack(np.meshgrid(np.linspace(0, 1, 80), np.linspace(0, 1, 80)), -1).reshape(-1, 2)
    vertices = np.column_stack([grid, 0.1 * np.sin(6 * grid[:, 0])])
    corner = (np.arange(79)[:, None] * 80 + np.arange(79)).ravel()
    faces = np.concatenate(
        [
            np.column_stack([corner, corner + 1, corner + 80]),
            np.column_stack([corner + 1, corner + 81, corner + 80]),
        ]
    )
    mesh = coarse(Mesh(vertices, faces.astype(np.int32), np.column_stack([grid, grid[:, 0]])), 600)
    small, triangles = mesh.vertices, mesh.faces
    np.testing.assert_allclose(mesh.colors[:, :2], small[:, :2])
    assert 200 < len(small) < 1000
    assert triangles.max() < len(small)
    assert np.abs(small[:, 2] - 0.1 * np.sin(6 * small[:, 0])).max() < 0.01
    a, b, c = (small[triangles[:, k]] for k in range(3))
    normals = np.cross(b - a, c - a)
    assert (normals[:, 2] > -1e-9).all(), "the same side is outside"
