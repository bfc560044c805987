"""The stage as a whole: what it says when photographs don't do, and what it gives when they do."""

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from pipeline.artifacts.cameras import Camera
from pipeline.artifacts.points import Points
from pipeline.artifacts.views import View, Views
from pipeline.errors import ReconstructionError
from pipeline.geometry import cloud
from pipeline.geometry.rigid import angle_between
from pipeline.stage import LocalContext
from stages.init.sfm.diagnosis import least_views
from stages.init.sfm.matching.two_view import Lens, TwoView
from stages.init.sfm.reconstruct import Evidence, group_lenses
from stages.init.stage import InitConfig, InitStage

REPOSITORY = Path(__file__).resolve().parents[2]
REAL_DATA = REPOSITORY.parent / "shared" / "data"


def texture(seed, size=(192, 256)):
    rng = np.random.default_rng(seed)
    layers = [cv2.GaussianBlur(rng.normal(0, 1, size), (0, 0), s) * s for s in (1, 2, 4)]
    gray = np.clip(0.5 + 0.15 * sum(layers) / sum(layers).std(), 0, 1)
    return np.repeat(gray[..., None], 3, 2).astype(np.float32)


def read(path, long_side=512):
    image = cv2.imread(str(path))[..., ::-1]
    factor = min(long_side / max(image.shape), 1)
    image = cv2.resize(image, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA)
    return image.astype(np.float32) / np.float32(255)


def run(tmp_path, images, names=None, threads=2, focal=None, **config):
    views = Views(
        tuple(
            View(f"{k:03d}", image, source_name=names[k] if names else f"photo{k}.jpg",
                 focal_px=focal)
            for k, image in enumerate(images)
        )
    )  # fmt: skip
    context = LocalContext(InitConfig(**config), tmp_path, inputs={"views": views}, threads=threads)
    InitStage().run(context)
    return context


def rotation_errors(cameras, poses):
    """Errors in degrees of all relative rotations, for [4, 4] poses in the cameras' order."""
    return [
        angle_between(a.rotation @ b.rotation.T, p[:3, :3] @ q[:3, :3].T)
        for a, p in zip(cameras, poses, strict=True)
        for b, q in zip(cameras, poses, strict=True)
        if a.name < b.name
    ]


def test_one_photograph_is_not_enough(tmp_path):
    with pytest.raises(ReconstructionError, match="One photograph"):
        run(tmp_path, [texture(0)])


def test_identical_photographs_show_no_depth(tmp_path, monkeypatch):
    monkeypatch.delattr("stages.init.sfm.solver.map_views")  # nobody looks for cameras
    with pytest.raises(ReconstructionError, match="did not move"):
        run(tmp_path, [texture(0)] * 3)


def test_blank_photographs_are_named(tmp_path):
    blank = np.full((192, 256, 3), 0.5, np.float32)
    with pytest.raises(ReconstructionError, match=r"'photo1.jpg' shows nothing to match"):
        run(tmp_path, [texture(0), blank, texture(1)])


def test_strangers_are_named_with_what_they_lack(tmp_path):
    with pytest.raises(ReconstructionError) as caught:
        run(tmp_path, [texture(0), texture(1), texture(2)], ["right.jpg", "front.jpg", "left.jpg"])
    message = str(caught.value)
    assert "share too little" in message
    assert "20 degrees" in message
    assert "init.focal" in message
    assert sum(name in message for name in ("right.jpg", "front.jpg", "left.jpg")) >= 2


def test_a_camera_that_only_turned_gives_no_scene(tmp_path, monkeypatch):
    monkeypatch.delattr("stages.init.sfm.solver.map_views")  # nobody looks for cameras
    base = texture(3, (300, 500))
    matrix = np.array([[400, 0, 128], [0, 400, 96], [0, 0, 1.0]])
    large = np.array([[400, 0, 250], [0, 400, 150], [0, 0, 1.0]])
    images = []
    for angle in (-0.08, 0.0, 0.08):
        turn = cv2.Rodrigues(np.array([0, angle, 0.0]))[0]
        images.append(cv2.warpPerspective(base, matrix @ turn @ np.linalg.inv(large), (256, 192)))
    with pytest.raises(ReconstructionError, match="turned on the spot"):
        run(tmp_path, images)


def test_views_needed():
    assert [least_views(n, 0.5) for n in (2, 3, 4, 5, 12)] == [2, 3, 2, 3, 6]
    assert least_views(12, 1.0) == 12


def test_standing_still_needs_all_views():
    edge = TwoView(30, np.arange(30), 1.0, np.eye(3, 4))
    one_pair = Evidence([100] * 3, {(0, 1): 9}, {(0, 1): 0.1}, {(0, 1): edge})
    assert not one_pair.is_still()
    both = replace(
        one_pair, displacement={(0, 1): 0.1, (1, 2): 0.2}, edges={(0, 1): edge, (1, 2): edge}
    )
    assert both.is_still()
    assert not replace(both, displacement={(0, 1): 0.1, (1, 2): 2.0}).is_still()


def test_views_of_one_size_and_focal_share_a_lens():
    lenses, of_view = group_lenses(
        [(384, 512), (384, 512), (512, 384), (256, 512)], [600.0, None, 600.0, None]
    )
    assert of_view == [0, 0, 0, 1]
    assert lenses == [Lens(512, 512, 600.0), Lens(512, 256, 600.0)]
    unknown, of_view = group_lenses([(384, 512), (384, 512)], [None, None])
    assert of_view == [0, 0]
    assert unknown[0].focal is None


def test_rounding_by_a_pixel_makes_no_other_lens():
    lenses, of_view = group_lenses(
        [(341, 512), (342, 512), (342, 512), (343, 512)], [600.0, 600.1, 606.0, 600.0]
    )
    assert of_view == [0, 0, 1, 2]
    assert lenses[0] == Lens(512, 342, 600.0)
    _, of_view = group_lenses([(341, 512), (342, 512), (341, 512)], [None] * 3)
    assert of_view == [0, 0, 0]


def make_camera(name, shift):
    pose = np.eye(4)
    pose[0, 3] = -shift
    return Camera(name, 20, 16, 18.0, 18.0, 10.0, 8.0, pose)


def test_pointmaps_are_in_the_frame_of_the_first_view():
    first, second = make_camera("000", 0.0), make_camera("001", 0.5)
    depth = np.full((16, 20), 2, np.float32)
    holes = depth.copy()
    holes[:4] = 0
    confidence = np.full((16, 20), 5, np.float32)
    pair = cloud.pointmap_pair(first, second, depth, holes, confidence, confidence)
    np.testing.assert_allclose(pair.points_i[8, 10], [0.5 / 18 * 2, 0.5 / 18 * 2, 2], rtol=1e-5)
    np.testing.assert_allclose(
        (pair.points_j_in_i - pair.points_i)[4:],
        np.broadcast_to([0.5, 0, 0], (12, 20, 3)),
        atol=1e-5,
    )
    assert np.isfinite(pair.points_j_in_i).all()
    assert (pair.confidence_j[:4] == 1).all()
    assert (pair.confidence_j[4:] == 5).all()


def test_depth_becomes_points_with_their_colours():
    camera = make_camera("000", 0.0)
    depth = np.zeros((16, 20), np.float32)
    depth[2, 3] = 3
    image = np.random.default_rng(0).random((16, 20, 3)).astype(np.float32)
    normal = np.broadcast_to(np.float32([0, 0, -1]), (16, 20, 3))
    points = cloud.depth_points(image, depth, normal, depth + 1, camera)
    pixels, z = camera.project(points.positions)
    np.testing.assert_allclose(pixels, [[3.5, 2.5]], atol=1e-5)
    np.testing.assert_allclose(points.colors, image[2, 3][None])
    assert (len(points), z[0], points.confidence[0]) == (1, 3, 4)
    assert points.scale[0] == pytest.approx(3 / 18)


def test_thinning_keeps_the_order_and_grows_the_scale():
    values = np.arange(1000, dtype=np.float32)
    points = Points(*(np.repeat(values[:, None], 3, 1) for _ in range(3)), values, values * 0 + 1)
    thin = cloud.thinned(points, 250, 0)
    assert len(thin) == 250
    assert (np.diff(thin.positions[:, 0]) > 0).all()
    np.testing.assert_allclose(thin.scale, 2)
    assert cloud.thinned(points, 1000, 0) is points


def test_pointmap_edges_are_the_tree_and_the_next_best():
    weights = {(0, 1): 9.0, (1, 2): 8.0, (0, 2): 7.0, (2, 3): 1.0, (1, 3): 0.5}
    assert cloud.pointmap_edges(weights, [(0, 1), (1, 2), (2, 3)], 4) == [
        (0, 1), (0, 2), (1, 2), (2, 3),
    ]  # fmt: skip


def test_three_sample_photographs(tmp_path):
    folder = REPOSITORY / "data_samples" / "three_photos"
    truth = json.loads((folder / "transforms.json").read_text())
    images = [read(folder / frame["file_path"]) for frame in truth["frames"]]
    context = run(tmp_path, images, dense={"planes": 32, "max_planes": 48})
    cameras = context.result("cameras").cameras
    points = context.result("points")
    pairs = list(context.result("pointmaps"))
    poses = [np.array(frame["w2c_opencv"]) for frame in truth["frames"]]
    assert [camera.name for camera in cameras] == ["000", "001", "002"]
    assert max(rotation_errors(cameras, poses)) < 0.3
    assert cameras[0].fx == pytest.approx(truth["fl_x"], rel=0.02)
    assert context.warnings == []
    assert context.figures["views_registered"] == 3
    assert 50_000 < len(points) <= 400_000
    assert np.isfinite(points.positions).all()
    assert (points.scale > 0).all()
    assert {(pair.name_i, pair.name_j) for pair in pairs} >= {("000", "001"), ("001", "002")}
    for pair in pairs:  # both views of a pair see the same surface
        assert (pair.confidence_i > 1).mean() > 0.3
        assert np.median(pair.points_i[pair.confidence_i > 1][:, 2]) == pytest.approx(
            np.median(pair.points_j_in_i[pair.confidence_j > 1][:, 2]), rel=0.1
        )


@pytest.mark.real_data
def test_frames_of_a_scan_are_placed_exactly(tmp_path):
    folder = REAL_DATA / "scan_video_a"
    if not folder.exists():
        pytest.skip("the real photographs are not here")
    truth = json.loads((folder / "transforms.json").read_text())["frames"]
    chosen = [5, 11, 17]  # 26 degrees apart
    images = [read(folder / truth[k]["file_path"]) for k in chosen]
    cameras = (
        run(tmp_path, images, dense={"planes": 16, "max_planes": 16, "fill": False})
        .result("cameras")
        .cameras
    )
    poses = [np.array(truth[k]["w2c_opencv"]) for k in chosen]
    assert max(rotation_errors(cameras, poses)) < 0.7


@pytest.mark.real_data
def test_intra_oral_photographs_too_far_apart_are_refused(tmp_path):
    folder = REAL_DATA / "dental_photos_a" / "images"
    if not folder.exists():
        pytest.skip("the real photographs are not here")
    paths = sorted(folder.glob("*.jpg"))
    with pytest.raises(ReconstructionError, match="share too little"):
        run(
            tmp_path, [read(path) for path in paths], [path.name for path in paths],
            method="colmap",
        )  # fmt: skip
