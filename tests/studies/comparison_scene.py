"""A COLMAP model of the sample photographs, with points from their true depth."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pycolmap

from pipeline.artifacts.cameras import Camera

SAMPLES = Path(__file__).resolve().parents[2] / "data_samples" / "three_photos"
TRUTH = json.loads((SAMPLES / "transforms.json").read_text())


def true_cameras() -> list[Camera]:
    return [
        Camera(
            Path(frame["file_path"]).name, TRUTH["w"], TRUTH["h"], TRUTH["fl_x"], TRUTH["fl_x"],
            TRUTH["cx"], TRUTH["cy"], np.array(frame["w2c_opencv"], np.float64),
        )
        for frame in TRUTH["frames"]
    ]  # fmt: skip


def true_points(step: int = 6) -> np.ndarray:
    """[N, 3] surface points that the middle photograph sees, mm."""
    frame, camera = TRUTH["frames"][1], true_cameras()[1]
    raw = cv2.imread(str(SAMPLES / frame["depth_file_path"]), cv2.IMREAD_UNCHANGED)
    depth = raw.astype(np.float64) / TRUTH["depth_per_mm"]
    small = camera.resized(TRUTH["depth_w"], TRUTH["depth_h"])
    world = small.unproject(depth)[step // 2 :: step, step // 2 :: step].reshape(-1, 3)
    return world[depth[step // 2 :: step, step // 2 :: step].ravel() > 0]


def write_model(folder: Path, cameras: list[Camera], points: np.ndarray) -> Path:
    """A model in which every camera observes the points that project into it."""
    folder.mkdir(parents=True)
    model = pycolmap.Reconstruction()
    observed: list[list[tuple[int, int]]] = [[] for _ in points]
    for number, camera in enumerate(cameras, 1):
        parameters = [camera.fx, camera.cx, camera.cy, 0.0]
        lens = pycolmap.Camera(
            camera_id=number, model="SIMPLE_RADIAL", width=camera.width, height=camera.height,
            params=parameters,
        )  # fmt: skip
        model.add_camera_with_trivial_rig(lens)
        pixels, _ = camera.project(points)
        inside = ((pixels > 0) & (pixels < (camera.width, camera.height))).all(1)
        image = pycolmap.Image(
            name=camera.name, camera_id=number, image_id=number, keypoints=pixels[inside]
        )
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(camera.cam_from_world[:3]))
        for index, point in enumerate(np.flatnonzero(inside)):
            observed[point].append((number, index))
    for position, views in zip(points, observed, strict=True):
        if len(views) > 1:
            track = pycolmap.Track([pycolmap.TrackElement(*element) for element in views])
            model.add_point3D(position, track, np.array([200, 100, 50], np.uint8))
    model.write_binary(str(folder))
    return folder


def moved(camera: Camera, degrees: float, scale: float = 2.0) -> Camera:
    """The camera in a world twice as large, turned about its own vertical axis by an error."""
    angle = np.radians(degrees)
    turn = np.array(
        [[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]]
    )
    pose = np.eye(4)
    pose[:3, :3] = turn @ camera.rotation
    pose[:3, 3] = turn @ camera.translation * scale
    return Camera(
        camera.name, camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy, pose
    )
