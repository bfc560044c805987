"""Cameras and lengths that the user knows: read, matched to photographs, undistorted, used."""

import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest
from scipy.spatial.transform import Rotation

from pipeline.artifacts.cameras import Camera
from pipeline.artifacts.space.scale import NO_SCALE, Scale
from pipeline.artifacts.views import View, Views
from pipeline.errors import ReconstructionError, RequestError
from pipeline.geometry.models.known_cameras import (
    KnownCamera,
    as_pinhole,
    matching_cameras,
    model_files,
    read_cameras,
)
from pipeline.geometry.world import move_camera
from pipeline.stage import LocalContext
from stages.init.place import place_known
from stages.init.sfm.matching.epipolar import fundamental_between, sampson_distance
from stages.init.sfm.matching.features import describe
from stages.init.sfm.matching.two_view import Correspondences
from stages.init.sfm.options import ClassicalOptions
from stages.init.sfm.triangulate import agreeing_matches, link_tracks, triangulate
from stages.init.stage import InitConfig, InitStage

SAMPLES = Path(__file__).resolve().parents[2] / "data_samples" / "three_photos"
TRUTH = json.loads((SAMPLES / "transforms.json").read_text())
#: Depth for who doesn't look at it.
COARSE = {"planes": 16, "max_planes": 16, "fill": False}


@pytest.fixture(scope="module", autouse=True)
def described_once() -> Iterator[None]:
    """Features of the same pictures are found once: most tests here are of the same photographs."""
    kept = {}

    def once(images, *options):
        *said, _threads, _scratch = options
        key = (*((image.shape, image.tobytes()) for image in images), *said)
        if key not in kept:
            kept[key] = describe(images, *options)
        return kept[key]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("stages.init.sfm.reconstruct.describe", once)
        yield


def look_at(yaw, distance=4.0):
    angle = np.radians(yaw)
    centre = distance * np.array([np.sin(angle), 0, -np.cos(angle)])
    forward = -centre / distance
    right = np.cross([0, 1, 0], forward)
    rotation = np.stack([right, [0, 1, 0], forward])
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, -rotation @ centre
    return pose


def sample_views():
    views = []
    for number, frame in enumerate(TRUTH["frames"]):
        image = cv2.imread(str(SAMPLES / frame["file_path"]))[..., ::-1]
        image = image.astype(np.float32) / np.float32(255)
        name = Path(frame["file_path"]).name
        size = image.shape[1::-1]
        views.append(View(f"{number:03d}", image, source_name=name, source_size=size))
    return Views(tuple(views))


def run(tmp_path, cameras, **settings):
    config = InitConfig(cameras=str(cameras), **settings)
    context = LocalContext(
        config, tmp_path, inputs={"views": sample_views()},
        sources=InitStage().sources(config, {}), threads=2,
    )  # fmt: skip
    InitStage().run(context)
    return context


def colmap_model(folder, model="PINHOLE", extra=(), names=None):
    """The sample's cameras as a COLMAP model."""
    folder.mkdir(parents=True, exist_ok=True)
    written = pycolmap.Reconstruction()
    parameters = {
        "PINHOLE": [TRUTH["fl_x"], TRUTH["fl_x"], 256, 192],
        "SIMPLE_RADIAL": [TRUTH["fl_x"], 256, 192, *extra],
    }[model]
    for number, frame in enumerate(TRUTH["frames"], 1):
        lens = pycolmap.Camera(
            camera_id=number, model=model, width=512, height=384, params=parameters
        )
        written.add_camera_with_trivial_rig(lens)
        name = names[number - 1] if names else Path(frame["file_path"]).name
        image = pycolmap.Image(name=name, camera_id=number, image_id=number)
        pose = pycolmap.Rigid3d(np.array(frame["w2c_opencv"])[:3])
        written.add_image_with_trivial_frame(image, pose)
    written.write_text(str(folder))
    return folder


def test_known_cameras_are_kept_and_the_depth_is_true(tmp_path):
    context = run(tmp_path, SAMPLES / "transforms.json")
    cameras = context.result("cameras")
    assert cameras.units == "mm"
    scale = np.cbrt(np.linalg.det(cameras.input_from_world[:3, :3]))
    for camera, frame in zip(cameras.cameras, TRUTH["frames"], strict=True):
        truth = np.array(frame["w2c_opencv"])
        world_from_cam = cameras.input_from_world @ np.linalg.inv(camera.cam_from_world)
        np.testing.assert_allclose(
            world_from_cam[:3, :3] / scale, np.linalg.inv(truth)[:3, :3], atol=1e-9
        )
        np.testing.assert_allclose(world_from_cam[:3, 3], np.linalg.inv(truth)[:3, 3], atol=1e-6)
        assert (camera.fx, camera.cx, camera.cy) == (TRUTH["fl_x"], 256, 192)
    errors = []
    for pair in context.result("pointmaps"):
        frame = next(f for f in TRUTH["frames"] if sample_name(f) == pair.name_i)
        stored = cv2.imread(str(SAMPLES / frame["depth_file_path"]), cv2.IMREAD_UNCHANGED) / 200
        truth = cv2.resize(stored, (512, 384), interpolation=cv2.INTER_NEAREST)
        sure = (pair.confidence_i > 5) & (truth > 0)
        errors.append(np.abs(pair.points_i[..., 2] * scale - truth)[sure])
    assert np.median(np.concatenate(errors)) < 0.25  # mm


def test_the_scale_of_an_earlier_run_is_taken_over_as_it_was(tmp_path):
    """With its source and its uncertainty; `init.units` may still say otherwise."""
    scale = Scale("mm", "textbook_teeth", 10.57)
    file = tmp_path / "transforms.json"

    def said(**notes):
        file.write_text(json.dumps({**TRUTH, "units": "mm", **notes}))
        return read_cameras([file])[1]

    assert said() == said(dentalsplat_scale=NO_SCALE.as_dict()) == Scale("mm", "cameras")
    assert said(dentalsplat_scale=scale.as_dict(), units="") == NO_SCALE
    assert said(dentalsplat_scale=scale.as_dict()) == scale
    for units, kept in (("mm", scale), ("arbitrary", NO_SCALE)):
        context = run(tmp_path / units, file, units=units, dense=COARSE)
        assert context.result("cameras").scale == kept


def sample_name(frame):
    return f"{TRUTH['frames'].index(frame):03d}"


def test_colmap_model_is_found_in_the_usual_folders_and_reads_like_transforms(tmp_path):
    colmap_model(tmp_path / "scene" / "sparse" / "0")
    found, scale = read_cameras(model_files(tmp_path / "scene").values())
    reference, _ = read_cameras(model_files(SAMPLES).values())
    assert scale == NO_SCALE
    assert [c.name for c in found] == [c.name for c in reference]
    for a, b in zip(found, reference, strict=True):
        np.testing.assert_allclose(a.cam_from_world, b.cam_from_world, atol=1e-6)


@pytest.mark.parametrize(
    ("model", "parameters"),
    [("SIMPLE_RADIAL", [500, 256, 192, -0.2]), ("SIMPLE_FISHEYE", [400, 256, 192])],
)
def test_distortion_is_taken_out_of_the_image(model, parameters):
    """A picture of straight lines, bent by the lens, is straight again."""
    lens = pycolmap.Camera(model=model, width=512, height=384, params=parameters)
    v, u = np.mgrid[:384, :512] + 0.5
    rays = lens.cam_from_img(np.stack([u.ravel(), v.ravel()], 1))
    # Each pixel shows a chequered plane in front of the camera.
    plane = np.asarray(rays)[:, :2].reshape(384, 512, 2)
    sharp = 0.5 + 0.5 * np.tanh(20 * np.sin(40 * plane[..., 0]) * np.sin(40 * plane[..., 1]))
    view = View("000", np.repeat(sharp[..., None], 3, 2).astype(np.float32), source_size=(512, 384))
    flat, camera = as_pinhole(view, KnownCamera("a.jpg", lens, np.eye(4)))
    x, y = (u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy
    expected = 0.5 + 0.5 * np.tanh(20 * np.sin(40 * x) * np.sin(40 * y))
    inside = flat.valid()
    assert inside.mean() > 0.9
    assert np.abs(flat.image[..., 0] - expected)[inside].mean() < 0.03
    assert np.abs(view.image[..., 0] - expected)[inside].mean() > 0.1  # it was bent before


def test_distorted_model_gives_undistorted_views(tmp_path):
    folder = colmap_model(tmp_path / "model", "SIMPLE_RADIAL", (-0.05,))
    context = run(tmp_path / "out", folder, dense=COARSE)
    views = context.result("views")
    assert len(views) == 3 and context.figures["undistorted"] == 3
    assert any(
        np.abs(new.image - old.image).max() > 0.05
        for new, old in zip(views.views, sample_views().views, strict=True)
    )


@pytest.mark.parametrize("lens_size", [(384, 512), (512, 384)])
def test_lens_of_a_photograph_stored_on_its_side(lens_size):
    """The same ray meets the same pixel, whether the model was made of the stored or upright one.

    Stored 512 x 384, shown turned by 90 degrees clockwise.
    """
    working_from_stored = np.array([[0.0, -1, 384], [1, 0, 0], [0, 0, 1]])
    view = View(
        "000", np.zeros((512, 384, 3), np.float32),
        working_from_source=working_from_stored, source_size=(512, 384),
    )  # fmt: skip
    width, height = lens_size
    lens = pycolmap.Camera(
        model="PINHOLE", width=width, height=height, params=[500, 520, width / 2 + 7, height / 2]
    )
    _, camera = as_pinhole(view, KnownCamera("a.jpg", lens, look_at(20)))
    points = np.random.default_rng(0).uniform(-0.5, 0.5, (20, 3))
    pixels, _ = camera.project(points)
    local = points @ look_at(20)[:3, :3].T + look_at(20)[:3, 3]
    expected = np.asarray(lens.img_from_cam(local))
    if lens_size == (512, 384):
        expected = expected @ working_from_stored[:2, :2].T + working_from_stored[:2, 2]
    np.testing.assert_allclose(pixels, expected, atol=1e-9)


@pytest.mark.parametrize("parent", [".", "sparse"])
def test_of_several_models_the_largest_is_taken(tmp_path, parent):
    from tests.studies.comparison_scene import true_cameras, true_points, write_model

    cameras = true_cameras()
    for number, count in ((0, 2), (2, 3), (10, 2)):
        write_model(tmp_path / parent / str(number), cameras[:count], true_points(30))
    found, _ = read_cameras(model_files(tmp_path).values())
    assert len(found) == 3


def test_wrong_cameras_are_refused_in_words(tmp_path):
    with pytest.raises(RequestError, match=r"holds no cameras"):
        model_files(tmp_path)
    (tmp_path / "transforms.json").write_text('{"frames": [{"file_path": "a.png"')
    with pytest.raises(RequestError, match="can't be read"):
        read_cameras(model_files(tmp_path).values())
    (tmp_path / "transforms.json").write_text(
        json.dumps({"frames": [{"file_path": "a.png", "transform_matrix": np.eye(4).tolist()}]})
    )
    with pytest.raises(RequestError, match=r"gives no 'w' for a\.png"):
        read_cameras(model_files(tmp_path).values())
    cameras, _ = read_cameras(model_files(SAMPLES).values())
    strangers = [View("a", np.zeros((3, 4, 3), np.float32), source_name="x.jpg")]
    with pytest.raises(RequestError, match=r"none of .* like frontal\.jpg.* like x\.jpg"):
        matching_cameras(cameras, strangers)
    with pytest.raises(RequestError, match=r"frontal\.jpg alone has a camera.* two at least"):
        matching_cameras(cameras[:1], sample_views().views)
    view = View("a", np.zeros((300, 300, 3), np.float32), source_size=(300, 300))
    with pytest.raises(RequestError, match="512 x 384"):
        as_pinhole(view, cameras[0])
    with pytest.raises(RequestError, match="no cameras are given"):
        InitStage().sources(InitConfig(method="known"), {})


@pytest.mark.parametrize(
    ("yaws", "words"),
    [((50, 170, 290), "do not fit the photographs"), ((50, 50, 50), "tell no depth: .* one place")],
)
def test_cameras_of_other_photographs_are_noticed(tmp_path, yaws, words):
    """The names fit, but the poses are another scene's, or are all the same."""
    folder = colmap_model(tmp_path / "model")
    shuffled = pycolmap.Reconstruction(str(folder))
    for number, yaw in enumerate(yaws):
        shuffled.images[number + 1].frame.rig_from_world = pycolmap.Rigid3d(look_at(yaw, 60)[:3])
    shuffled.write_text(str(folder))
    with pytest.raises(ReconstructionError, match=words):
        run(tmp_path / "out", folder)


@pytest.mark.parametrize("quarters", [1, 2])
def test_cameras_of_rolled_photographs_fit(tmp_path, quarters):
    """A phone held upside down or on its side; the cameras say so."""
    views = list(sample_views().views)
    frames = [dict(frame) for frame in TRUTH["frames"]]
    image = np.ascontiguousarray(np.rot90(views[1].image, -quarters))
    size = image.shape[1::-1]
    views[1] = replace(
        views[1], image=image, source_size=size, mask=None, working_from_source=np.eye(3)
    )
    turned = np.eye(4)
    turned[:3, :3] = Rotation.from_euler("z", 90 * quarters, degrees=True).as_matrix()
    pose = np.linalg.inv(turned @ np.array(frames[1]["w2c_opencv"])) @ np.diag([1, -1, -1, 1])
    frames[1] |= {"transform_matrix": pose.tolist(), "w": size[0], "h": size[1]}
    frames[1] |= {"cx": size[0] / 2, "cy": size[1] / 2}
    path = tmp_path / "transforms.json"
    path.write_text(json.dumps({**TRUTH, "frames": frames}))
    known = matching_cameras(read_cameras([path])[0], views)
    warned = []
    placement = place_known(
        views, known, NO_SCALE, False, ClassicalOptions(), threads=2, progress=lambda *_: None,
        warn=warned.append,
    )  # fmt: skip
    assert warned == []
    assert min(len(seen) for seen in placement.seen) > 100


def test_photographs_without_camera_are_named(tmp_path):
    folder = colmap_model(tmp_path / "m", names=["frontal.jpg", "left_buccal.jpg", "other.jpg"])
    names = [Path(frame["file_path"]).name for frame in TRUTH["frames"]]
    assert names == ["right_buccal.jpg", "frontal.jpg", "left_buccal.jpg"]
    found = matching_cameras(read_cameras(model_files(folder).values())[0], sample_views().views)
    assert sorted(found) == ["001", "002"]


@pytest.mark.parametrize(("size", "away"), [(1.0, 0.0), (50.0, 5e6), (1e-6, 0.0)])
def test_tracks_are_triangulated_and_wrong_matches_dropped(size, away):
    """Around the origin, in metres of a map, and in units of which the scene is a millionth."""
    rng = np.random.default_rng(1)
    motion = size, np.eye(3), np.array([away, -away, 0])
    cameras = [
        move_camera(Camera(str(k), 400, 400, 500, 500, 200, 200, look_at(15 * k)), motion)
        for k in range(3)
    ]
    truth = size * rng.uniform(-0.6, 0.6, (60, 3)) + motion[2]
    pixels = [camera.project(truth)[0] for camera in cameras]
    matches = {}
    for i, j in ((0, 1), (1, 2), (0, 2)):
        features = np.stack([np.arange(60), np.arange(60)], 1)
        features[:10, 1] = rng.permutation(10) + 20  # ten wrong matches
        matches[i, j] = Correspondences(
            features, pixels[i][features[:, 0]], pixels[j][features[:, 1]], np.ones(60, bool)
        )
    fundamental = fundamental_between(cameras[0], cameras[1])
    found = matches[0, 1]
    distance = sampson_distance(fundamental, found.positions_i, found.positions_j)
    assert distance[10:].max() < 1e-6 and np.median(distance[:10]) > 3
    chosen = agreeing_matches(cameras, matches, 1.0)
    tracks = link_tracks(pixels, [np.arange(60)] * 3, matches, chosen)
    points, kept = triangulate(cameras, tracks, 1.0, 1.0)
    assert len(points) >= 50
    nearest = np.linalg.norm(points[:, None] - truth[None], axis=-1).min(1)
    assert np.mean(nearest < 1e-6 * size + 1e-14 * away) > 0.9
    for number, camera in enumerate(cameras):
        mine = kept.view == number
        assert np.abs(camera.project(points[kept.point[mine]])[0] - kept.pixel[mine]).max() < 1


def test_known_length_gives_millimetres(tmp_path):
    """Two corners of a tooth, measured in a photograph; the truth is in millimetres."""
    frame = TRUTH["frames"][1]
    stored = cv2.imread(str(SAMPLES / frame["depth_file_path"]), cv2.IMREAD_UNCHANGED) / 200
    start, end = np.array([236.0, 172.0]), np.array([282.0, 174.0])
    places = []
    for pixel in (start, end):
        z = stored[int(pixel[1] / 2), int(pixel[0] / 2)]
        assert z > 0
        places.append(np.array([*(pixel - (256, 192)) / TRUTH["fl_x"], 1]) * z)
    mm = float(np.linalg.norm(places[0] - places[1]))
    folder = colmap_model(tmp_path / "model")
    length = {"mm": mm, "photo": "frontal", "start": tuple(start), "end": tuple(end)}
    context = run(tmp_path / "out", folder, length=length, dense={"planes": 32, "max_planes": 48})
    cameras = context.result("cameras")
    assert cameras.units == "mm"
    scale = np.cbrt(np.linalg.det(cameras.input_from_world[:3, :3]))
    truth = np.linalg.norm(
        np.linalg.inv(TRUTH["frames"][0]["w2c_opencv"])[:3, 3]
        - np.linalg.inv(TRUTH["frames"][2]["w2c_opencv"])[:3, 3]
    )
    ours = scale * np.linalg.norm(cameras.cameras[0].centre - cameras.cameras[2].centre)
    assert abs(ours / truth - 1) < 0.02
    with pytest.raises(RequestError, match=r"no photograph 'frontel'.*frontal"):
        run(tmp_path / "wrong", folder, length={**length, "photo": "frontel"})


def test_what_was_put_right_beside_the_photographs_is_said_not_to_be_used(tmp_path):
    photographs, workspace = tmp_path / "photographs", tmp_path / "w"
    photographs.mkdir()
    workspace.mkdir()
    (photographs / "teeth.yaml").write_text("photographs: {}")
    for images in ([photographs], [photographs / "left.jpg"]):
        told = []
        request = {"images": images, "workspace": workspace, "tell": told.append}
        assert InitStage().sources(InitConfig(), request) == {}
        assert len(told) == 1 and f"{photographs / 'teeth.yaml'} is not used" in told[0]
    (workspace / "teeth.yaml").write_text("photographs: {}")
    told.clear()
    assert "teeth.yaml" in InitStage().sources(InitConfig(), request)
    assert not told
