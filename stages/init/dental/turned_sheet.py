"""Pictures of the coloured surface, turned: what people check at a glance."""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt

from pipeline.kernels import kernel
from stages.init.dental.surface.chart.raster import draw_triangle
from stages.init.dental.surface.dense import ArchSurface

_BACKGROUND = 0.94
#: The camera of the picture is this far off (mm): a little perspective, as a photograph has.
_DISTANCE = 160.0
#: Rendered so many times larger, then averaged.
_OVERSAMPLING = 2


@kernel(nogil=True)
def _paint(pixels, depths, colours, faces, depth, image):  # type: ignore[no-untyped-def]
    corners = np.zeros((3, 3))
    for f in range(faces.shape[0]):
        a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
        for k in range(3):
            corners[0, k], corners[1, k], corners[2, k] = (
                colours[a, k],
                colours[b, k],
                colours[c, k],
            )
        draw_triangle(
            pixels[a, 0], pixels[a, 1], depths[a], pixels[b, 0], pixels[b, 1], depths[b],
            pixels[c, 0], pixels[c, 1], depths[c], corners, depth, image,
        )  # fmt: skip


def render_turned(
    surface: ArchSurface, yaw: float, pitch: float, width: int, height: int, shaded: bool = False
) -> npt.NDArray[np.uint8]:
    """Picture [height, width, 3] uint8 of the surface from the front, turned.

    Args:
        surface: the surface.
        yaw: degrees to the patient's left.
        pitch: degrees upwards.
        width, height: pixels.
        shaded: grey, lit from the camera, instead of its own colour: shows the shape.
    """
    points = surface.positions.astype(np.float64)
    if not len(points):
        return np.full((height, width, 3), round(255 * _BACKGROUND), np.uint8)
    centre = (np.percentile(points, 2, axis=0) + np.percentile(points, 98, axis=0)) / 2
    extent = np.percentile(np.abs(points - centre), 99, axis=0)
    w, h = width * _OVERSAMPLING, height * _OVERSAMPLING
    # Wide enough for the front and, turned, for the sides.
    focal = _DISTANCE * min(w / (2.3 * np.hypot(extent[0], extent[2])), h / (2.7 * extent[1]))
    a, b = np.radians([yaw, pitch])
    toward = np.array([np.sin(a) * np.cos(b), np.sin(b), np.cos(a) * np.cos(b)])
    right = np.cross([0.0, 1.0, 0.0], toward)
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(right, toward), -toward])
    local = (points - centre) @ rotation.T + [0, 0, _DISTANCE]
    pixels = focal * local[:, :2] / local[:, 2:] + [w / 2, h / 2]
    colours = surface.colors.astype(np.float64)
    if shaded:
        light = np.clip((surface.normals * toward.astype(np.float32)).sum(-1), 0, 1)
        colours = np.repeat((0.1 + 0.8 * light.astype(np.float64))[:, None], 3, axis=1)
    depth = np.zeros((h, w))
    image = np.full((h, w, 3), _BACKGROUND)
    _paint(pixels, local[:, 2].copy(), colours, surface.faces, depth, image)
    small = cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)
    return np.clip(np.rint(small * 255), 0, 255).astype(np.uint8)


def turned_sheet(
    surface: ArchSurface,
    yaws: tuple[float, ...] = (-25.0, 0.0, 25.0),
    pitches: tuple[float, ...] = (4.0,),
    width: int = 640,
    height: int = 260,
) -> npt.NDArray[np.uint8]:
    """The coloured surface turned to several sides, and below it its shape in grey.

    Args:
        surface: the surface.
        yaws: degrees to the patient's left, one column each.
        pitches: degrees upwards, two rows each.
        width, height: pixels of one picture.

    Returns:
        [2 len(pitches) height, len(yaws) width, 3] uint8.
    """
    rows = []
    for pitch in pitches:
        for shaded in (False, True):
            rows.append(
                np.hstack(
                    [render_turned(surface, yaw, pitch, width, height, shaded) for yaw in yaws]
                )
            )
    return np.vstack(rows)
