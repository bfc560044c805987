"""Cameras, photographs and points for other tools: a COLMAP model and nerfstudio's file."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from plyfile import PlyData, PlyElement

from pipeline.artifacts.cameras import Camera, reconstruction

#: A point is taken as seen by a camera if its depth is within this share of the rendered depth.
SEEN_WITHIN = 0.02


def observations(
    points: npt.NDArray[np.floating], cameras: Sequence[Camera], depths: Sequence[npt.NDArray]
) -> list[tuple[npt.NDArray[np.int64], npt.NDArray[np.float64]]]:
    """Which points each camera sees, by projection and the depth rendered there.

    Args:
        points: [N, 3] world.
        cameras: V cameras.
        depths: V depth maps [H, W] (z), of each camera's size; not finite or <= 0: nothing there.

    Returns:
        For each camera the indices of the points [K] and their pixels [K, 2].
    """
    found = []
    for camera, depth_map in zip(cameras, depths, strict=True):
        pixels, depth = camera.project(points)
        index = np.flatnonzero(camera.shows(pixels, depth))
        column, row = pixels[index].astype(np.int64).T
        surface = depth_map[row, column]
        with np.errstate(invalid="ignore"):
            seen = (surface > 0) & (np.abs(depth[index] - surface) < SEEN_WITHIN * surface)
        found.append((index[seen], pixels[index[seen]]))
    return found


def write_colmap(
    folder: Path,
    cameras: Sequence[Camera],
    points: npt.NDArray[np.floating],
    colors: npt.NDArray[np.uint8],
    depths: Sequence[npt.NDArray],
) -> int:
    """Write a binary COLMAP model whose images are named ``<camera name>.png``.

    Args:
        folder: existing folder for the `.bin` files.
        cameras: V placed cameras.
        points: [N, 3]; those that fewer than two cameras see are left out.
        colors: [N, 3] uint8.
        depths: V depth maps, see `observations`.

    Returns:
        The number of points written.
    """
    import pycolmap

    model = reconstruction(tuple(cameras))
    seen = observations(points, cameras, depths)
    views_of_point = np.zeros(len(points), np.int64)
    for index, _ in seen:
        views_of_point[index] += 1
    kept = views_of_point >= min(2, len(cameras))
    tracks: dict[int, Any] = {int(point): pycolmap.Track() for point in np.flatnonzero(kept)}
    for image_id, (index, pixels) in enumerate(seen, start=1):
        used = kept[index]
        # An image made from the pixels as one array makes the list without a loop in Python.
        model.image(image_id).points2D = pycolmap.Image(keypoints=pixels[used]).points2D
        for place, point in enumerate(index[used].tolist()):
            tracks[point].add_element(image_id, place)
    for point, track in tracks.items():
        model.add_point3D(points[point].astype(np.float64), track, colors[point])
    model.write_binary(str(folder))
    return len(tracks)


def nerfstudio_transforms(
    cameras: Sequence[Camera], masked: bool, notes: Mapping[str, Any]
) -> dict[str, Any]:
    """The content of nerfstudio's `transforms.json` (OpenGL camera axes: x right, y up, z back).

    Args:
        cameras: placed cameras, with images at ``colmap/images/<name>.png``.
        masked: whether there are masks at ``colmap/masks/<name>.png.png`` too.
        notes: further entries that readers ignore (frame, units).
    """
    flip = np.diag([1.0, -1.0, -1.0, 1.0])
    frames = []
    for index, camera in enumerate(cameras, start=1):
        frame: dict[str, Any] = {
            "file_path": f"colmap/images/{camera.name}.png",
            "colmap_im_id": index,
            "fl_x": camera.fx, "fl_y": camera.fy, "cx": camera.cx, "cy": camera.cy,
            "w": camera.width, "h": camera.height,
            "transform_matrix": (np.linalg.inv(camera.cam_from_world) @ flip).tolist(),
        }  # fmt: skip
        if masked:
            frame["mask_path"] = f"colmap/masks/{camera.name}.png.png"
        frames.append(frame)
    return {
        "camera_model": "OPENCV",
        "k1": 0.0, "k2": 0.0, "p1": 0.0, "p2": 0.0,
        "ply_file_path": "points.ply",
        **notes,
        "frames": frames,
    }  # fmt: skip


def write_json(path: Path, content: Mapping[str, Any]) -> None:
    """Write readable JSON that is the same for the same content."""
    path.write_text(json.dumps(content, indent=1, allow_nan=False) + "\n")


def write_cloud(
    path: Path, points: npt.NDArray[np.floating], colors: npt.NDArray[np.uint8]
) -> None:
    """Write points [N, 3] and colours [N, 3] as a binary PLY that Open3D and nerfstudio read."""
    rows = np.empty(
        len(points),
        [(name, "<f4") for name in "xyz"] + [(name, "u1") for name in ("red", "green", "blue")],
    )
    for axis, name in enumerate("xyz"):
        rows[name] = points[:, axis]
    for channel, name in enumerate(("red", "green", "blue")):
        rows[name] = colors[:, channel]
    PlyData([PlyElement.describe(rows, "vertex")], byte_order="<").write(str(path))
