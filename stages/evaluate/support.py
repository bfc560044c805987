"""Which part of a picture was photographed: input views that saw the surface of each pixel."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
import numpy.typing as npt

from pipeline.artifacts.cameras import Camera
from pipeline.geometry.rigid import exponential
from pipeline.kernels import each, kernel

Array = npt.NDArray[np.float64]
Image = npt.NDArray[np.uint8]
Bools = npt.NDArray[np.bool_]

#: Colour, RGB, over what no photograph saw, and how much of it is mixed in.
TINT = (230, 0, 200)
_MIX = 0.6
#: Points that are looked up at a time.
_CHUNK = 16384
#: What the tint means, for the manifest.
LEGEND = "magenta: rendered, but seen by no input photograph; grey hatching: nothing rendered"


@dataclass(frozen=True)
class SeenSurface:
    """What one input view shows of the scene.

    Attributes:
        camera: of the view.
        depth: [H, W] rendered z; 0 where nothing is rendered or the pixel may not be used.
    """

    camera: Camera
    depth: npt.NDArray[np.float32]


def supporting_views(
    points: Array, surfaces: Sequence[SeenSurface], tolerance: float
) -> npt.NDArray[np.int64]:
    """How many input views saw each point: it is in their picture, and nothing is before it.

    Args:
        points: [N, 3] world.
        surfaces: of the input views.
        tolerance: relative difference of depth within which it is the same surface. The nearest of
            the four pixels around counts, so that edges do not.

    Returns:
        [N] counts.
    """
    count = np.zeros(len(points), np.int64)
    places = np.ascontiguousarray(points, np.float64)
    for surface in surfaces:
        camera = surface.camera
        each(
            _count_chunk, -(-len(places) // _CHUNK), places,
            np.ascontiguousarray(camera.cam_from_world, np.float64),
            np.array([camera.fx, camera.fy, camera.cx, camera.cy]),
            np.ascontiguousarray(surface.depth, np.float32), float(tolerance), count,
        )  # fmt: skip
    return count


@kernel(nogil=True)
def _count_chunk(  # type: ignore[no-untyped-def]
    chunk, points, pose, lens, depth, tolerance, count
):  # fmt: skip
    """Add one to `count` of those of some points that a view sees; see `supporting_views`."""
    height, width = depth.shape
    for i in range(chunk * _CHUNK, min(len(points), (chunk + 1) * _CHUNK)):
        x, y, z = points[i]
        ahead = pose[2, 0] * x + pose[2, 1] * y + pose[2, 2] * z + pose[2, 3]
        if not ahead > 0:
            continue
        across = pose[0, 0] * x + pose[0, 1] * y + pose[0, 2] * z + pose[0, 3]
        down = pose[1, 0] * x + pose[1, 1] * y + pose[1, 2] * z + pose[1, 3]
        u, v = lens[0] * across / ahead + lens[2], lens[1] * down / ahead + lens[3]
        if not (0 <= u < width and 0 <= v < height):
            continue
        left, top = int(np.floor(u - 0.5)), int(np.floor(v - 0.5))
        for column in (max(left, 0), min(left + 1, width - 1)):
            for row in (max(top, 0), min(top + 1, height - 1)):
                seen = np.float64(depth[row, column])
                if seen > 0 and abs(seen - ahead) < tolerance * ahead:
                    count[i] += 1
                    break
            else:
                continue
            break


def support_map(
    camera: Camera,
    depth: npt.NDArray[np.floating],
    rendered: Bools,
    surfaces: Sequence[SeenSurface],
    tolerance: float,
) -> npt.NDArray[np.int64]:
    """[H, W] how many input views saw what each pixel of a render shows; 0 where nothing is.

    Args:
        camera: of the render.
        depth: [H, W] z of the render.
        rendered: [H, W] pixels that show something.
        surfaces, tolerance: see `supporting_views`.
    """
    count = np.zeros(depth.shape, np.int64)
    points = camera.unproject(depth)[rendered]
    count[rendered] = supporting_views(points, surfaces, tolerance)
    return count


def unsupported_share(count: npt.NDArray[np.int64], rendered: Bools) -> float:
    """Share of the rendered pixels that no input view saw; 0 where nothing is rendered."""
    total = int(rendered.sum())
    return float((count[rendered] == 0).sum() / total) if total else 0.0


def overlay(image: Image, count: npt.NDArray[np.int64], rendered: Bools) -> Image:
    """The render, tinted where no photograph saw it, hatched where nothing is rendered.

    Args:
        image: [H, W, 3] uint8; count: [H, W] of `support_map`; rendered: [H, W].
    """
    unseen = rendered & (count == 0)
    tinted = (1 - _MIX) * image + _MIX * np.array(TINT)
    picture = np.where(unseen[..., None], tinted, image)
    row, column = np.indices(rendered.shape)
    hatched = np.where((row + column) % 8 < 2, 130, 70)[..., None]
    picture = np.where(rendered[..., None], picture, hatched)
    return np.ascontiguousarray(np.rint(picture), np.uint8)


def beyond(cameras: Sequence[Camera], pivot: Array, degrees: float) -> list[Camera]:
    """Two novel cameras: the two that are farthest apart around the pivot, turned further out.

    Args:
        cameras: of the input views.
        pivot: [3] the middle of the scene.
        degrees: how much further.

    Returns:
        Cameras named ``first`` and ``last`` (by the order of the input); none where all cameras
        look from one side.
    """
    rays = np.array([camera.centre - pivot for camera in cameras])
    rays /= np.maximum(np.linalg.norm(rays, axis=1, keepdims=True), 1e-12)
    cosines = np.triu(2 - rays @ rays.T, 1)  # larger is farther apart
    i, j = divmod(int(cosines.argmax()), len(cameras))
    axis = np.cross(rays[i], rays[j])
    if len(cameras) < 2 or np.linalg.norm(axis) < 1e-6:
        return []
    axis /= np.linalg.norm(axis)
    novel = []
    for name, index, sign in (("first", i, -1.0), ("last", j, 1.0)):
        turn, _ = exponential(np.concatenate([np.zeros(3), sign * np.radians(degrees) * axis]))
        camera = cameras[index]
        pose = np.eye(4)
        pose[:3, :3] = camera.rotation @ turn.T
        pose[:3, 3] = camera.translation + camera.rotation @ (pivot - turn.T @ pivot)
        novel.append(replace(camera, name=name, cam_from_world=pose))
    return novel


def seen_surface(
    camera: Camera,
    depth: npt.NDArray[np.floating],
    rendered: Bools,
    valid: Bools,
) -> SeenSurface:
    """What an input view shows: its rendered depth [H, W], where it may be used.

    A pixel at the edge of a hole in the render has no sure depth: one pixel around is left out.
    """
    sure = cv2.erode((rendered & valid).astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    return SeenSurface(camera, np.where(sure, depth, 0).astype(np.float32))
