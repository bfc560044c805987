"""Which part of a picture was photographed: input views that saw the surface of each pixel."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from pipeline.artifacts.cameras import Camera
from pipeline.geometry.rigid import exponential
from stages.splatting.support import SeenSurface, supporting_views

Array = npt.NDArray[np.float64]
Image = npt.NDArray[np.uint8]
Bools = npt.NDArray[np.bool_]

#: Colour, RGB, over what no photograph saw, and how much of it is mixed in.
TINT = (230, 0, 200)
_MIX = 0.6
#: What the tint means, for the manifest.
LEGEND = "magenta: rendered, but seen by no input photograph; grey hatching: nothing rendered"


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
