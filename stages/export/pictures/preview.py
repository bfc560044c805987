"""One picture that shows what came out: photograph, splats, a new viewpoint, the mesh."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
import numpy.typing as npt

from pipeline.artifacts.cameras import Camera
from pipeline.kernels import kernel
from stages.export.mesh.surface import Mesh, vertex_normals

Pixels = npt.NDArray[np.uint8]
Array = npt.NDArray[np.float64]
Floats = npt.NDArray[np.float32]
Ints = npt.NDArray[np.int32]

GAP = 8
CAPTION = 30
PAPER = 250
INK = (60, 60, 60)


def shade_mesh(mesh: Mesh, camera: Camera) -> Pixels:
    """Picture of a mesh, lit from the camera: [H, W, 3] uint8, white where there is nothing."""
    # Each pixel is the mean of 2 x 2.
    fine = camera.resized(2 * camera.width, 2 * camera.height)
    points, depths = fine.project(mesh.vertices)
    towards = fine.centre - mesh.vertices
    towards /= np.maximum(np.linalg.norm(towards, axis=1, keepdims=True), 1e-12)
    facing = np.abs((vertex_normals(mesh) * towards).sum(1))
    shown = np.full((fine.height, fine.width), -1.0, np.float32)
    nearest = np.zeros_like(shown)
    draw(points, depths, facing, mesh.faces, nearest, shown)
    shaded = (0.25 + 0.75 * shown[..., None]) * np.array([0.93, 0.91, 0.87])
    picture = np.where(shown[..., None] >= 0, shaded, PAPER / 255)
    picture = picture.reshape(camera.height, 2, camera.width, 2, 3).mean((1, 3))
    return np.asarray(np.rint(picture * 255), np.uint8)


def draw(
    points: Array, depths: Array, values: Array, faces: Ints, nearest: Floats, shown: Floats
) -> None:
    """Draw triangles with a value at each vertex, the nearest before the others.

    Args:
        points, depths, values: [V, 2] pixels, [V] z (triangles that reach behind the camera are
            left out), [V].
        faces: [F, 3].
        nearest: [H, W] 1 / z of what is drawn, 0: nothing. shown: [H, W] the value there.
    """
    # contiguous, all of them: one kernel instead of one for each mixture
    given = (np.ascontiguousarray(array) for array in (points, depths, values, faces))
    _draw(*given, nearest, shown)


@kernel(nogil=True)
def _draw(points, depths, values, faces, nearest, shown):  # type: ignore[no-untyped-def]
    """See `draw`."""
    height, width = shown.shape
    for face in range(len(faces)):
        i, j, k = faces[face]
        if depths[i] <= 0 or depths[j] <= 0 or depths[k] <= 0:
            continue
        ax, ay = points[i]
        bx, by = points[j] - points[i]
        cx, cy = points[k] - points[i]
        area = bx * cy - by * cx
        if not abs(area) > 1e-9:
            continue
        left = max(0, int(np.ceil(ax + min(0.0, bx, cx) - 0.5)))
        right = min(width - 1, int(np.floor(ax + max(0.0, bx, cx) - 0.5)))
        top = max(0, int(np.ceil(ay + min(0.0, by, cy) - 0.5)))
        bottom = min(height - 1, int(np.floor(ay + max(0.0, by, cy) - 0.5)))
        for y in range(top, bottom + 1):
            for x in range(left, right + 1):
                dx, dy = x + 0.5 - ax, y + 0.5 - ay
                q = (dx * cy - dy * cx) / area
                r = (bx * dy - by * dx) / area
                if q < 0 or r < 0 or q + r > 1:
                    continue
                # what is linear in the world is so on the screen after division by z
                p, q, r = (1 - q - r) / depths[i], q / depths[j], r / depths[k]
                near = p + q + r
                if near > nearest[y, x]:
                    nearest[y, x] = near
                    shown[y, x] = (p * values[i] + q * values[j] + r * values[k]) / near


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
