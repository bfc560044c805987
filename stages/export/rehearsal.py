"""A few pixels of everything, so that the kernels of the export are compiled."""

from __future__ import annotations

import numpy as np

from pipeline.artifacts.cameras import Camera
from pipeline.artifacts.gaussians import Gaussians, Light
from stages.export.mesh.field import colors_of, fuse
from stages.export.mesh.nets import zero_surface
from stages.export.mesh.surface import Mesh
from stages.export.pictures.frames import film_frame
from stages.export.pictures.preview import shade_mesh
from stages.splatting.rendering import Painter

SIZE = 32


def _camera() -> Camera:
    return Camera("000", SIZE, SIZE, SIZE, SIZE, SIZE / 2, SIZE / 2, np.eye(4))


def surface() -> None:
    """A slanted plane, fused, meshed and drawn."""
    depth = np.tile(np.linspace(1.9, 2.1, SIZE, dtype=np.float32), (SIZE, 1))
    image = np.full((SIZE, SIZE, 3), 128, np.uint8)
    cameras = [_camera()] * 2
    points = _camera().unproject(depth).reshape(-1, 3).astype(np.float32)
    field, maps = fuse(cameras, [image] * 2, [depth] * 2, 0.1, points, 0.3)
    vertices, faces = zero_surface(field.smoothed(), 2)
    shade_mesh(Mesh(vertices, faces, colors_of(vertices, maps, 0.5)), _camera())


def film() -> None:
    """A frame of Gaussians with a light, and of some without."""
    place = np.array([[0, 0, 2]], np.float32)
    one = np.ones((1, 3), np.float32)
    light = Light(one, -place, 0.5, 1.0, 2.0, (60.0, 12.0), (0.5, 0.05))
    for lamp in (light, None):
        gaussians = Gaussians(
            place, np.array([[1, 0, 0, 0]], np.float32), -2 * one, np.ones(1, np.float32),
            np.ones((1, 16, 3), np.float32), lamp,
        )  # fmt: skip
        film_frame(Painter(gaussians, threads=1), _camera(), 0.1)
