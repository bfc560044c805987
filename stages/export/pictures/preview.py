"""One picture that shows what came out: photograph, splats, a new viewpoint, the mesh."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np
import numpy.typing as npt

from pipeline.artifacts.cameras import Camera
from stages.export.mesh.surface import Mesh, vertex_normals

Pixels = npt.NDArray[np.uint8]

GAP = 8
CAPTION = 30
PAPER = 250
INK = (60, 60, 60)


def shade_mesh(mesh: Mesh, camera: Camera) -> Pixels:
    """Picture of a mesh, lit from the camera: [H, W, 3] uint8, white where there is nothing."""
    import open3d

    scene = open3d.t.geometry.RaycastingScene()
    scene.add_triangles(
        open3d.core.Tensor.from_numpy(mesh.vertices.astype(np.float32)),
        open3d.core.Tensor.from_numpy(mesh.faces.astype(np.uint32)),
    )
    # Each pixel is the mean of 2 x 2 rays.
    fine = camera.resized(2 * camera.width, 2 * camera.height)
    rays = open3d.t.geometry.RaycastingScene.create_rays_pinhole(
        open3d.core.Tensor.from_numpy(fine.matrix),
        open3d.core.Tensor.from_numpy(np.ascontiguousarray(fine.cam_from_world)),
        fine.width, fine.height,
    )  # fmt: skip
    answer = scene.cast_rays(rays, nthreads=1)
    hit = np.isfinite(answer["t_hit"].numpy())
    corners = mesh.faces[np.where(hit, answer["primitive_ids"].numpy(), 0)]  # [H, W, 3]
    uv = answer["primitive_uvs"].numpy()
    weights = np.stack([1 - uv.sum(-1), uv[..., 0], uv[..., 1]], -1)[..., None]
    normals = (vertex_normals(mesh)[corners] * weights).sum(2)
    normals /= np.maximum(np.linalg.norm(normals, axis=-1, keepdims=True), 1e-9)
    directions = rays.numpy()[..., 3:]
    directions = directions / np.linalg.norm(directions, axis=-1, keepdims=True)
    facing = np.abs((normals * directions).sum(-1, keepdims=True))
    shaded = (0.25 + 0.75 * facing) * np.array([0.93, 0.91, 0.87])
    picture = np.where(hit[..., None], shaded, PAPER / 255)
    picture = picture.reshape(camera.height, 2, camera.width, 2, 3).mean((1, 3))
    return np.asarray(np.rint(picture * 255), np.uint8)


def contact_sheet(panels: Sequence[tuple[str, Pixels]], width: int, height: int) -> Pixels:
    """Put captioned pictures into a grid of two columns (one row if there are at most three).

    Args:
        panels: caption and RGB picture each, of any size.
        width, height: of one panel in pixels.
    """
    columns = len(panels) if len(panels) <= 3 else 2
    rows = -(-len(panels) // columns)
    sheet = np.full(
        (rows * (height + CAPTION + GAP) + GAP, columns * (width + GAP) + GAP, 3), PAPER, np.uint8
    )
    for index, (caption, picture) in enumerate(panels):
        top = GAP + index // columns * (height + CAPTION + GAP)
        left = GAP + index % columns * (width + GAP)
        scale = min(width / picture.shape[1], height / picture.shape[0])
        size = (round(picture.shape[1] * scale), round(picture.shape[0] * scale))
        fitted = cv2.resize(picture, size, interpolation=cv2.INTER_AREA)
        y, x = top + (height - size[1]) // 2, left + (width - size[0]) // 2
        sheet[y : y + size[1], x : x + size[0]] = fitted
        _write(sheet, caption, (left, top + height))
    return sheet


def _write(sheet: Pixels, text: str, corner: tuple[int, int]) -> None:
    """Write a caption below a panel, whose lower left corner is given."""
    from PIL import Image, ImageDraw, ImageFont

    left, top = corner
    strip = Image.fromarray(sheet[top : top + CAPTION])
    ImageDraw.Draw(strip).text((left + 2, 6), text, INK, ImageFont.load_default(16))
    sheet[top : top + CAPTION] = np.asarray(strip)


def panel_size(camera: Camera, longest: int = 512) -> Camera:
    """The camera at the size of a panel."""
    scale = longest / max(camera.width, camera.height)
    return camera.resized(round(camera.width * scale), round(camera.height * scale))


def beside(camera: Camera, other: Camera) -> Camera:
    """`other`'s pose seen through `camera`'s lens."""
    return replace(camera, cam_from_world=other.cam_from_world)
