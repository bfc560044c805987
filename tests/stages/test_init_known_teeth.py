"""Known cameras and wide photographs of teeth: when their surface is made, what comes out."""

import json

import numpy as np
import pytest

from pipeline.artifacts.views import View, Views
from pipeline.errors import ReconstructionError, RequestError
from pipeline.stage import LocalContext
from stages.init.config import InitConfig
from stages.init.dental import place_known
from stages.init.stage import InitStage
from tests.stages.init_teeth_case import FOCAL, SIZE, found_teeth, read_teeth, side_pose
from tests.teeth_case import write

UNIT = 0.02  # of the cameras' world per mm of the arch
OPENGL = np.diag([1.0, -1, -1, 1])


def world_pose(yaw):
    """The camera of the arch frame in a world that is turned, shifted and in another unit."""
    pose = side_pose(yaw)
    turn = np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]])
    moved = np.eye(4)
    moved[:3, :3] = pose[:3, :3] @ turn.T
    moved[:3, 3] = UNIT * pose[:3, 3] - moved[:3, :3] @ [0.5, 2, -1]
    return moved


def transforms(folder, yaws=(-40, 0, 40), cx=SIZE[1] / 2):
    frames = [
        {
            "file_path": f"{number}.png",
            "transform_matrix": (np.linalg.inv(world_pose(yaw)) @ OPENGL).tolist(),
        }
        for number, yaw in enumerate(yaws)
    ]
    lens = {"w": SIZE[1], "h": SIZE[0], "fl_x": FOCAL, "fl_y": FOCAL, "cx": cx, "cy": SIZE[0] / 2}
    path = folder / "transforms.json"
    path.write_text(json.dumps({**lens, "frames": frames}))
    return path


def photographs(count=3):
    image = np.random.default_rng(0).random((*SIZE, 3)).astype(np.float32)
    return Views(
        tuple(
            View(f"{k:03d}", image, source_name=f"{k}.png", source_size=SIZE[::-1])
            for k in range(count)
        )
    )


def run(tmp_path, monkeypatch, path, found, likely=True, **settings):
    """The stage with the teeth as given (an exception is raised), and what it was asked."""
    asked = {}

    def reconstruct(views, names, dentitions, focals, *_, cameras, **__):
        asked.update(views=views, dentitions=dentitions, focals=focals, cameras=cameras)
        if isinstance(found, Exception):
            raise found
        return found

    def sweep(*_, **__):
        raise ReconstructionError("the sweep was asked")

    monkeypatch.setattr(place_known, "place_teeth", reconstruct)
    monkeypatch.setattr(place_known, "with_surface", lambda teeth, *_: teeth)
    monkeypatch.setattr("stages.init.place.place_known", sweep)
    config = InitConfig(cameras=str(path), **settings)
    inputs = {"views": photographs()} | ({"teeth": read_teeth()} if likely else {})
    context = LocalContext(
        config, tmp_path, inputs=inputs,
        sources=InitStage().sources(config, {}), threads=1,
    )  # fmt: skip
    return context, asked


@pytest.mark.parametrize("cx", [SIZE[1] / 2, SIZE[1] / 2 + 3])
def test_cameras_stay_as_given_and_the_surface_lies_before_them(tmp_path, monkeypatch, cx):
    teeth = found_teeth()
    if cx != SIZE[1] / 2:  # what was found is of photographs that are 6 pixels wider
        widen = lambda a: np.pad(a, [(0, 0), (0, 6)] + [(0, 0)] * (a.ndim - 2))  # noqa: E731
        for view in teeth.surface.views:
            for name in ("depth", "normal", "confidence"):
                shifted = np.roll(widen(getattr(view, name)), 3, axis=1)
                object.__setattr__(view, name, shifted)
    context, asked = run(tmp_path, monkeypatch, transforms(tmp_path, cx=cx), teeth)
    InitStage().run(context)
    assert asked["focals"] == [FOCAL] * 3
    for before, after in zip(read_teeth().views, asked["dentitions"], strict=True):
        # The crowns lie where the picture has them that has its principal point in the middle.
        shift = np.array([after.size[0] / 2 - cx, 0])
        assert after.name == before.name
        for crown, centred in zip(before.all_crowns, after.all_crowns, strict=True):
            np.testing.assert_allclose(centred.outline, crown.outline + shift, atol=1e-9)
            assert (centred.number, centred.doubt) == (crown.number, crown.doubt)
    cameras = context.result("cameras")
    scale = np.cbrt(np.linalg.det(cameras.input_from_world[:3, :3]))
    for camera, yaw, given in zip(cameras.cameras, (-40, 0, 40), asked["cameras"], strict=True):
        assert (camera.fx, camera.cx, camera.cy) == (FOCAL, cx, SIZE[0] / 2)
        truth = np.linalg.inv(world_pose(yaw))
        found = cameras.input_from_world @ np.linalg.inv(camera.cam_from_world)
        np.testing.assert_allclose(found[:3, :3] / scale, truth[:3, :3], atol=1e-9)
        np.testing.assert_allclose(found[:3, 3], truth[:3, 3], atol=1e-9)
        np.testing.assert_allclose(given, world_pose(yaw), atol=1e-12)
    points = context.result("points")
    sure = points.confidence > 2
    assert 0 < sure.sum() < len(sure)  # the rest is filled in around the teeth
    centre = cameras.input_from_world[:3, :3] @ points.positions[sure].astype(np.float64).T
    centre = centre.T + cameras.input_from_world[:3, 3] - [0.5, 2, -1]
    np.testing.assert_allclose(np.linalg.norm(centre, axis=1), 20 * UNIT, rtol=1e-4)
    own = (points.positions[sure] - points.positions[sure].mean(0)).astype(np.float64)
    assert np.median((own * points.normals[sure]).sum(1)) > 0  # normals point outwards
    for pair in context.result("pointmaps"):
        camera = cameras.by_name()[pair.name_i]
        known = pair.confidence_i > 2
        assert known.sum() > 500
        v, u = np.nonzero(known)
        depth = pair.points_i[..., 2][known]
        np.testing.assert_allclose(
            pair.points_i[known][:, 0], (u + 0.5 - camera.cx) / camera.fx * depth, atol=1e-6
        )
        np.testing.assert_allclose(
            pair.points_i[known][:, 1], (v + 0.5 - camera.cy) / camera.fy * depth, atol=1e-6
        )


def test_doubtful_teeth_fall_back_to_the_sweep_with_a_word(tmp_path, monkeypatch):
    doubt = ReconstructionError("The teeth are odd.")
    context, _ = run(tmp_path, monkeypatch, transforms(tmp_path), doubt)
    with pytest.raises(ReconstructionError, match="the sweep was asked"):
        InitStage().run(context)
    assert any("The teeth are odd." in text for text in context.warnings)
    context, _ = run(tmp_path, monkeypatch, transforms(tmp_path), doubt, method="dental")
    with pytest.raises(ReconstructionError, match="The teeth are odd"):
        InitStage().run(context)


@pytest.mark.parametrize(
    ("yaws", "likely", "settings"),
    [
        ((-12, 0, 12), True, {}),
        ((-40, 0, 40), False, {}),
        ((-40, 0, 40), True, {"dense": {"method": "sweep"}}),
        ((-40, 0, 40), True, {"dental": {"wide_angle": 60.0}}),
    ],
)
def test_the_sweep_is_taken_for_near_views_other_things_and_by_name(
    tmp_path, monkeypatch, yaws, likely, settings
):
    context, asked = run(
        tmp_path, monkeypatch, transforms(tmp_path, yaws), found_teeth(), likely, **settings
    )
    with pytest.raises(ReconstructionError, match="the sweep was asked"):
        InitStage().run(context)
    assert not asked


def test_a_known_camera_is_of_the_picture_as_it_is(tmp_path, monkeypatch):
    def said(text):
        labels = str(write(tmp_path / "said.yaml", text))
        return run(
            tmp_path, monkeypatch, transforms(tmp_path), found_teeth(), dental={"labels": labels}
        )

    context, asked = said("photographs: {1.png: {mirrored: true}}")
    with pytest.raises(RequestError, match=r"^1\.png is said to be mirrored, but init.cameras"):
        InitStage().run(context)
    assert not asked
    context, _ = said("photographs: {0.png: {mirrored: true}, 2.png: {mirrored: true}}")
    with pytest.raises(RequestError, match=r"^0\.png, 2\.png are said to be mirrored"):
        InitStage().run(context)
    context, asked = said("photographs: {1.png: {mirrored: false}}")
    InitStage().run(context)
    assert len(asked["dentitions"]) == 3


def test_a_photograph_without_teeth_is_named(tmp_path, monkeypatch):
    teeth = found_teeth()
    views = (None, *teeth.fit.views[1:])
    object.__setattr__(teeth.fit, "views", views)
    context, _ = run(tmp_path, monkeypatch, transforms(tmp_path), teeth, method="dental")
    with pytest.raises(ReconstructionError, match=r"0\.png"):
        InitStage().run(context)
