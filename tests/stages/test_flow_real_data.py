"""Flow of the scan video against its exact geometry, from cameras and points that are a bit off."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.ndimage import gaussian_filter
from scipy.spatial.transform import Rotation

from pipeline.artifacts.cameras import Camera, Cameras
from pipeline.artifacts.points import Points
from pipeline.artifacts.views import View, Views, read_png
from pipeline.stage import LocalContext
from stages.flow.geometry import occluded, predicted_flow
from stages.flow.stage import FlowConfig, FlowStage

DATA = Path(__file__).resolve().parents[3] / "shared" / "data" / "scan_video_a"

pytestmark = [
    pytest.mark.real_data,
    pytest.mark.skipif(not DATA.exists(), reason="the scan video is not part of the project"),
]

#: Frames of the paper's protocol for six views.
SIX_VIEWS = (0, 5, 9, 14, 18, 23)


def load(index: int) -> tuple[Camera, View, np.ndarray]:
    meta = json.loads((DATA / "transforms.json").read_text())
    frame = meta["frames"][index]
    camera = Camera(
        f"{index:03d}", meta["w"], meta["h"], meta["fl_x"], meta["fl_y"], meta["cx"], meta["cy"],
        np.array(frame["w2c_opencv"]),
    )  # fmt: skip
    image = read_png(DATA / frame["file_path"]).astype(np.float32) / np.float32(255)
    depth = cv2.imread(str(DATA / frame["depth_file_path"]), cv2.IMREAD_UNCHANGED) / 200.0
    return camera, View(camera.name, image), depth.astype(np.float32)


def estimated(camera: Camera, depth: np.ndarray, rng: np.random.Generator) -> tuple[Camera, Points]:
    """What a reconstruction gives: a camera off by about .25 degrees and .25 mm, noisy points."""
    pose = camera.cam_from_world.copy()
    turn = Rotation.from_rotvec(np.radians(0.25) / np.sqrt(3) * rng.normal(size=3))
    pose[:3, :3] = turn.as_matrix() @ pose[:3, :3]
    pose[:3, 3] += 0.25 / np.sqrt(3) * rng.normal(size=3)
    camera = replace(camera, cam_from_world=pose)
    noise = gaussian_filter(rng.normal(size=depth.shape), 8)
    noisy = depth + 0.15 * noise / noise.std()
    known = np.zeros(depth.shape, bool)
    known[::2, ::2] = depth[::2, ::2] > 0
    positions = camera.unproject(noisy)[known].astype(np.float32)
    empty, ones = np.zeros_like(positions), np.ones(len(positions), np.float32)
    spacing = (2 * depth[known] / camera.fx).astype(np.float32)
    return camera, Points(positions, empty, empty, ones, spacing)


def test_trusted_flow_is_right(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    shots = {f"{k:03d}": load(k) for k in SIX_VIEWS}
    guesses = [estimated(camera, depth, rng) for camera, _, depth in shots.values()]
    fields = ("positions", "colors", "normals", "confidence", "scale")
    points = Points(*(np.concatenate([getattr(p, name) for _, p in guesses]) for name in fields))
    inputs = {
        "views": Views(tuple(view for _, view, _ in shots.values())),
        "cameras": Cameras(tuple(camera for camera, _ in guesses)),
        "points": points,
    }
    local = LocalContext(FlowConfig(), tmp_path, inputs)
    FlowStage().run(local)
    pairs = local.result("flow").pairs
    assert len(pairs) == 5
    right, trusted = [], []
    for pair in pairs:
        i, j = shots[pair.name_i], shots[pair.name_j]
        for a, b, flow, mask in (
            (i, j, pair.forward, pair.mask_forward),
            (j, i, pair.backward, pair.mask_backward),
        ):
            truth, depth_in_b = predicted_flow(a[2], a[0], b[0])
            wrong = occluded(truth, depth_in_b, b[2], 0.01)
            wrong |= np.linalg.norm(flow - truth, axis=-1) >= 1
            graded = mask & (depth_in_b > 0)
            right.append((~wrong[graded]).mean())
            trusted.append(mask.mean())
    assert np.mean(right) > 0.9
    assert np.mean(trusted) > 0.45
    # The cameras are off by 3 px or so: the flow is nearer to the truth than to the geometry.
    assert local.figures["median_px_from_geometry"] > 1.5
