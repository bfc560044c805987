"""From the dental path's result to the stage's outputs, and when that path is chosen."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from pipeline.artifacts.views import View, Views
from pipeline.errors import ReconstructionError, RequestError
from pipeline.stage import LocalContext
from stages.init import teeth
from stages.init.config import DentalConfig, InitConfig
from stages.init.dental.landmarks import Landmark
from stages.init.dental.reconstruct import Teeth
from stages.init.dental.scale import crown_width, scale_from_widths
from stages.init.dental.solution import ArchFit, PlacedView
from stages.init.dental.surface.dense import ArchSurface, SurfaceView
from stages.init.stage import InitStage

SIZE = (96, 128)
FOCAL = 240.0


def side_pose(yaw, distance=120.0):
    """A camera of the arch frame (y up, z to the front) that looks at its origin."""
    angle = np.radians(yaw)
    centre = distance * np.array([np.sin(angle), 0, np.cos(angle)])
    forward = -centre / distance
    down = np.array([0.0, -1, 0])
    pose = np.eye(4)
    pose[:3, :3] = np.stack([np.cross(down, forward), down, forward])
    pose[:3, 3] = -pose[:3, :3] @ centre
    return pose


def ball_depth(pose, radius=20.0):
    """z-depth [H, W] of a ball about the origin, 0 beside it."""
    v, u = np.mgrid[: SIZE[0], : SIZE[1]] + 0.5
    ray = np.stack([(u - SIZE[1] / 2) / FOCAL, (v - SIZE[0] / 2) / FOCAL, np.ones(SIZE)], -1)
    centre = pose[:3, 3]
    a, b = (ray**2).sum(-1), ray @ centre
    inside = b**2 - a * (centre @ centre - radius**2)
    depth = np.where(inside > 0, (b - np.sqrt(np.maximum(inside, 0))) / a, 0)
    return depth.astype(np.float32)


def found_teeth(yaws=(-40, 0, 40), widths=()):
    poses = [side_pose(yaw) for yaw in yaws]
    maps = [ball_depth(pose) for pose in poses]
    rng = np.random.default_rng(0)
    direction = rng.normal(size=(5000, 3))
    normals = (direction / np.linalg.norm(direction, axis=1, keepdims=True)).astype(np.float32)
    surface = ArchSurface(
        views=tuple(
            SurfaceView(depth, np.zeros((*SIZE, 3), np.float32), np.where(depth > 0, 5, 1).astype(
                np.float32)) for depth in maps
        ),
        positions=20 * normals, colors=np.full((5000, 3), 0.7, np.float32), normals=normals,
        confidence=np.full(5000, 4, np.float32), tooth=np.ones(5000, bool),
        faces=np.zeros((0, 3), np.int32), gains=np.ones((len(yaws), 3)),
    )  # fmt: skip
    landmarks = {
        Landmark("papilla", 12, 11): np.array([-8.0, 4, 0]),
        Landmark("papilla", 11, 21): np.array([0.0, 4, 0]),
        Landmark("embrasure", 12, 11): np.array([-9.0, 0, 0]),
        Landmark("embrasure", 11, 21): np.array([0.0, 0, 0]),
    }
    views = tuple(
        PlacedView(pose, FOCAL, role, (12, 11, 21), (41, 0, 31), 0.5)
        for pose, role in zip(poses, ("right", "frontal", "left"), strict=True)
    )
    fit = ArchFit(views, landmarks, landmarks, margin=40.0)
    picture = np.zeros((20, 30, 3), np.uint8)
    return Teeth([None] * len(yaws), fit, surface, {"teeth": picture, "turned": picture})


def photographs(count=3):
    image = np.full((*SIZE, 3), 0.5, np.float32)
    return Views(
        tuple(View(f"{k:03d}", image.copy(), source_name=f"p{k}.jpg") for k in range(count))
    )


def run(tmp_path, monkeypatch, found, **dental):
    monkeypatch.setattr(teeth, "reconstruct_teeth", lambda *args, **kwargs: found)
    config = InitConfig(method="dental", dental=dental)
    context = LocalContext(config, tmp_path, inputs={"views": photographs()}, threads=1)
    InitStage().run(context)
    return context


def test_outputs_agree_with_each_other_and_lead_back_to_millimetres(tmp_path, monkeypatch):
    context = run(tmp_path, monkeypatch, found_teeth())
    cameras = context.result("cameras")
    assert cameras.units == "mm" and not cameras.provisional
    for camera, yaw in zip(cameras.cameras, (-40, 0, 40), strict=True):
        mm_from_cam = cameras.input_from_world @ np.linalg.inv(camera.cam_from_world)
        np.testing.assert_allclose(
            mm_from_cam[:3, 3], np.linalg.inv(side_pose(yaw))[:3, 3], atol=1e-9
        )
    to_mm = cameras.input_from_world
    positions = context.result("points").positions @ to_mm[:3, :3].T + to_mm[:3, 3]
    np.testing.assert_allclose(np.linalg.norm(positions, axis=1), 20, atol=1e-3)
    normals = context.result("points").normals @ to_mm[:3, :3].T
    cosine = (normals * positions).sum(1) / np.linalg.norm(normals, axis=1) / 20
    np.testing.assert_allclose(cosine, 1, atol=1e-4)
    assert len(context.result("pointmaps")) == 2  # right - frontal, frontal - left
    for pair in context.result("pointmaps"):
        world = np.linalg.inv(cameras.by_name()[pair.name_i].cam_from_world)
        for points, confidence in (
            (pair.points_i, pair.confidence_i), (pair.points_j_in_i, pair.confidence_j)
        ):  # fmt: skip
            seen = points[confidence > 1] @ world[:3, :3].T + world[:3, 3]
            mm = seen @ to_mm[:3, :3].T + to_mm[:3, 3]
            np.testing.assert_allclose(np.linalg.norm(mm, axis=1), 20, atol=2e-3)
    assert sorted(context.result("pictures").images) == ["teeth", "turned"]
    assert any("textbook teeth" in warning for warning in context.warnings)


def test_what_is_not_teeth_is_masked(tmp_path, monkeypatch):
    found = found_teeth()
    context = run(tmp_path, monkeypatch, found)
    for view, shown in zip(context.result("views").views, found.surface.views, strict=True):
        np.testing.assert_array_equal(view.valid(), shown.depth > 0)
    context = run(tmp_path / "all", monkeypatch, found, mask_rest=False)
    assert not (tmp_path / "all" / "views").exists()


def test_known_tooth_width_gives_the_scale(tmp_path, monkeypatch):
    found = found_teeth()
    assert crown_width(found.fit, 11) == pytest.approx(8.5)
    assert crown_width(found.fit, 16) is None
    assert scale_from_widths(found.fit, {11: 10.2})[0] == pytest.approx(1.2)
    assert scale_from_widths(found.fit, {})[0] == 1
    with pytest.raises(RequestError, match="none was seen with both its neighbours"):
        scale_from_widths(found.fit, {16: 10.0})
    context = run(tmp_path, monkeypatch, found, tooth_widths={11: 10.2})
    cameras = context.result("cameras")
    scale = np.cbrt(np.linalg.det(cameras.input_from_world[:3, :3]))
    distance = scale * np.linalg.norm(cameras.cameras[0].centre - cameras.cameras[2].centre)
    truth = np.linalg.norm(
        np.linalg.inv(side_pose(-40))[:3, 3] - np.linalg.inv(side_pose(40))[:3, 3]
    )
    assert distance == pytest.approx(1.2 * truth)
    assert not any("textbook" in warning for warning in context.warnings)


def test_settings_reach_the_fit_in_working_pixels():
    views = photographs()
    large = View("000", views.views[0].image, source_name="p0.jpg", source_size=(1280, 960))
    views = Views((large, *views.views[1:]))
    config = DentalConfig(
        order="right, frontal,left",
        labels=[{"photo": "p0", "x": 500, "y": 200, "tooth": 14}],
        min_margin=21,
    )
    options = teeth.arch_options(config, views)
    assert options.order == ("right", "frontal", "left") and options.min_margin == 21
    hint = options.labels[0]
    assert (hint.photo, hint.x, hint.y, hint.tooth) == (0, 50, 20, 14)
    with pytest.raises(RequestError, match="names 2 photographs"):
        teeth.arch_options(DentalConfig(order="right,left"), views)
    with pytest.raises(RequestError, match="there is no tooth 18"):
        labels = [{"photo": "p0", "x": 1, "y": 1, "tooth": 18}]
        teeth.arch_options(DentalConfig(labels=labels), views)
    with pytest.raises(RequestError, match="no photograph 'q0'"):
        labels = [{"photo": "q0", "x": 1, "y": 1, "tooth": 11}]
        teeth.arch_options(DentalConfig(labels=labels), views)
    assert teeth.surface_options(DentalConfig(gum_height=2)).gum_height == 2


def unmatchable(count=3):
    """Photographs that share nothing."""
    images = []
    for seed in range(count):
        rng = np.random.default_rng(seed)
        gray = cv2.GaussianBlur(rng.uniform(size=(192, 256)), (0, 0), 2)
        gray = (gray - gray.min()) / np.ptp(gray)
        images.append(np.repeat(gray[..., None], 3, 2).astype(np.float32))
    return Views(tuple(View(f"{k:03d}", image) for k, image in enumerate(images)))


def auto(tmp_path, views, **config):
    context = LocalContext(InitConfig(**config), tmp_path, inputs={"views": views}, threads=2)
    InitStage().run(context)
    return context


def test_teeth_are_tried_where_features_fail_and_only_there(tmp_path, monkeypatch):
    tried = []
    monkeypatch.setattr("stages.init.teeth.from_teeth", lambda context, views: tried.append(1))
    with pytest.raises(ReconstructionError, match="could be placed"):
        auto(tmp_path / "landscape", unmatchable())  # no teeth to be seen
    assert not tried
    monkeypatch.setattr("stages.init.dental.photo.teeth_likely", lambda *a, **k: True)
    auto(tmp_path / "teeth", unmatchable())
    assert tried == [1]
    with pytest.raises(ReconstructionError):
        auto(tmp_path / "features", unmatchable(), method="colmap")
    with pytest.raises(ReconstructionError):
        auto(tmp_path / "pair", unmatchable(2))
    assert tried == [1]


def test_both_diagnoses_are_told_and_the_pictures_kept(tmp_path, monkeypatch):
    picture = {"teeth": np.zeros((4, 4, 3), np.uint8)}

    def doubtful(context, views):
        raise ReconstructionError("Photo 1 and 2 hardly agree.", picture)

    monkeypatch.setattr("stages.init.teeth.from_teeth", doubtful)
    monkeypatch.setattr("stages.init.dental.photo.teeth_likely", lambda *a, **k: True)
    with pytest.raises(ReconstructionError, match=r"could be placed.*hardly agree") as caught:
        auto(tmp_path, unmatchable())
    assert caught.value.pictures == picture


REAL_DATA = Path(__file__).resolve().parents[3] / "shared" / "data"


@pytest.mark.real_data
@pytest.mark.parametrize("folder", ["castle", "berlin"])
def test_other_photographs_are_never_taken_for_teeth(folder):
    from stages.init.dental.photo import teeth_likely

    if not REAL_DATA.exists():
        pytest.skip("the real photographs are not here")
    images = []
    for path in sorted((REAL_DATA / folder / "images").iterdir())[:4]:
        image = cv2.resize(cv2.imread(str(path)), (512, 384), interpolation=cv2.INTER_AREA)
        images.append(image[..., ::-1].astype(np.float32) / np.float32(255))
    assert not teeth_likely(images, [np.ones((384, 512), bool)] * len(images))
