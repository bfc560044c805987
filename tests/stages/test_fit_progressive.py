"""Views that are placed one after another, on a small textured surface."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from pydantic import ValidationError

from pipeline.artifacts.cameras import Camera, Cameras
from pipeline.artifacts.views import View, Views
from pipeline.errors import ReconstructionError
from pipeline.geometry.rigid import exponential
from stages.fit.config import FitConfig
from stages.fit.inputs.initial import Cloud, initial_gaussians
from stages.fit.parts.camera import PoseOptimizer
from stages.fit.parts.progressive import next_pose
from stages.fit.stage import FitStage
from stages.splatting.rasterizer import unpack
from stages.splatting.rendering import render
from tests.stages.fit_case import StoppedError, case, context, looking, outputs, surface

PLAIN = {
    "light": "none", "hold_surface": False, "lambda_flow": 0.0, "lambda_depth": 0.0,
    "headlight": 0.0, "sh_degree": 0, "coarse_fraction": 0.0, "trusted_confidence": 1.0,
    "optimize_poses": False, "densify": False, "initial_opacity": 0.9,
}  # fmt: skip
PROGRESSIVE = {
    **PLAIN, "progressive": True, "progressive_iterations": 30, "progressive_pose_iterations": 150,
}  # fmt: skip


def degrees_between(a: Camera, b: Camera) -> float:
    cosine = (np.trace(a.rotation @ b.rotation.T) - 1) / 2
    return float(np.degrees(np.arccos(np.clip(cosine, -1, 1))))


def painted(cameras: list[Camera]) -> Views:
    """What cameras see of a dense version of the surface."""
    dense = surface(8000, 1)
    arrays = (np.asarray(a, np.float64) for a in (dense.positions, dense.colors, dense.normals))
    packed = initial_gaussians(
        Cloud(*arrays, np.ones(len(dense))), cameras, opacity=0.95, scale=1.0, scale_max_px=6,
        degree=0, headlight=0, shoulder=0,
    )  # fmt: skip
    images = [np.clip(render(unpack(packed), c, threads=1).image, 0, 1) for c in cameras]
    return Views(tuple(View(c.name, i) for c, i in zip(cameras, images, strict=True)))


def around() -> list[Camera]:
    """Four cameras, 4 degrees from one to the next."""
    return [looking(0.07 * step, f"{step:03d}") for step in range(4)]


def test_poses_are_found_though_only_the_first_one_is_given(tmp_path) -> None:
    truth = around()
    here = context(
        tmp_path, painted(truth), Cameras(tuple(truth)), surface(), iterations=160, **PROGRESSIVE
    )
    FitStage().run(here)
    found = here.result("cameras").by_name()
    assert np.array_equal(found["000"].cam_from_world, truth[0].cam_from_world)
    for camera in truth[1:]:
        assert degrees_between(found[camera.name], camera) < 0.4
        way = np.linalg.norm(camera.centre - truth[0].centre)
        assert np.linalg.norm(found[camera.name].centre - camera.centre) < 0.1 * way
    assert here.figures["train_psnr"] > 26


def test_the_other_poses_of_the_init_are_not_used(tmp_path) -> None:
    truth = around()
    motion = np.eye(4)
    motion[:3, :3], motion[:3, 3] = exponential(np.array([0.5, 0, 0, 0.0, 0.02, 0.0]))
    moved = dataclasses.replace(truth[2], cam_from_world=motion @ truth[2].cam_from_world)
    assert degrees_between(moved, truth[2]) > 1
    given = Cameras((*truth[:2], moved, truth[3]))
    here = context(tmp_path, painted(truth), given, surface(), iterations=120, **PROGRESSIVE)
    FitStage().run(here)
    assert degrees_between(here.result("cameras").by_name()["002"], truth[2]) < 0.5


def sideways(offset: float, name: str) -> Camera:
    camera = looking(0.0, name)
    camera.cam_from_world[0, 3] = -offset
    return camera


def test_a_view_adds_gaussians_where_it_shows_something_new(tmp_path) -> None:
    cameras = [sideways(-25.0, "000"), sideways(-20.0, "001"), sideways(-5.0, "002")]
    here = context(
        tmp_path, painted(cameras), Cameras(tuple(cameras)), surface(), iterations=90,
        **PROGRESSIVE,
    )  # fmt: skip
    FitStage().run(here)
    pixels, _ = cameras[0].project(here.result("gaussians").means)
    beyond = pixels[:, 0] > cameras[0].width + 4
    assert beyond.sum() > 50
    pixels, _ = cameras[2].project(here.result("gaussians").means[beyond])
    assert (pixels[:, 0] < cameras[2].width + 4).all()  # nothing that no view sees


@pytest.mark.parametrize("blind", ["000", "002"])
def test_a_view_that_sees_no_point_stays_where_it_is(tmp_path, blind: str) -> None:
    truth = around()
    shown = [
        dataclasses.replace(view, mask=np.zeros(view.image.shape[:2], bool))
        if view.name == blind else view
        for view in painted(truth).views
    ]  # fmt: skip
    here = context(
        tmp_path, Views(tuple(shown)), Cameras(tuple(truth)), surface(), iterations=120,
        **PROGRESSIVE,
    )  # fmt: skip
    FitStage().run(here)
    for camera in truth:
        found = here.result("cameras").by_name()[camera.name]
        assert degrees_between(found, camera) < (1e-4 if camera.name == blind else 0.8)
    with pytest.raises(ReconstructionError, match="shows any of the points"):
        none = [dataclasses.replace(v, mask=np.zeros(v.image.shape[:2], bool)) for v in shown]
        FitStage().run(
            context(
                tmp_path / "none", Views(tuple(none)), Cameras(tuple(truth)), surface(),
                iterations=3, **PROGRESSIVE,
            )
        )  # fmt: skip


def test_views_that_are_still_to_be_placed_say_nothing_of_how_right_a_fit_is(tmp_path) -> None:
    truth = [looking(0.15 * step, f"{step:03d}") for step in range(4)]
    here = context(
        tmp_path, painted(truth), Cameras(tuple(truth)), surface(), iterations=120, extension=0.5,
        **PROGRESSIVE,
    )  # fmt: skip
    FitStage().run(here)
    assert here.figures["extension"] == 0


def test_a_stopped_progressive_fit_resumes_to_the_same_bytes(tmp_path) -> None:
    views, cameras, points = case()
    config = {**PROGRESSIVE, "progressive_pose_iterations": 10, "densify": True,
              "densify_from_iter": 20, "densification_interval": 10, "max_gaussians": 3000,
              "densify_grad_threshold": 1e-7, "densify_abs_grad_threshold": 1e-7,
              "densify_until_iter": 60, "optimize_poses": True}  # fmt: skip
    whole = context(tmp_path / "a", views, cameras, points, threads=1, **config)
    FitStage().run(whole)
    # 20, 40: a view joins in the next iteration; 27 and 53 are between
    for moment in (20, 27, 40, 53):
        stopped = context(
            tmp_path / "b", views, cameras, points, threads=2, checkpoint_every=5, **config
        )

        def stop(step, done, total, moment=moment, **figures):
            if done >= moment:
                raise StoppedError

        stopped.on_progress = stop
        with pytest.raises(StoppedError):
            FitStage().run(stopped)
    resumed = context(tmp_path / "b", views, cameras, points, threads=2, **config)
    seen: list[int] = []
    resumed.on_progress = lambda step, done, total, **figures: seen.append(done)
    FitStage().run(resumed)
    assert min(done for done in seen if done) >= 50  # it did resume
    assert outputs(tmp_path / "b") == outputs(tmp_path / "a")
    assert resumed.figures == whole.figures


def test_a_camera_goes_on_moving_as_before() -> None:
    poses = np.array([looking(angle, "a").cam_from_world[:3] for angle in (0.1, 0.2, 0.3)])
    assert np.allclose(next_pose(poses[:2]), poses[2])
    assert np.array_equal(next_pose(poses[:1]), poses[0])


def test_turning_about_a_pivot_keeps_it_in_place() -> None:
    pose = looking(0.2, "a").cam_from_world[:3]
    pivot = pose @ [3.0, -2.0, 90.0, 1.0]
    poses = PoseOptimizer(pose[None], held=-1)
    # a gradient about the camera that is a pure turn about the pivot
    turn = np.array([0.0, 1.0, 0.0])
    shift = np.cross(pivot, turn)
    gradient = np.concatenate([np.zeros(3), turn])
    poses.step(0, gradient, 0.01, pivot=pivot)
    assert shift.any() and not np.allclose(poses.poses[0], pose, atol=1e-3)
    assert np.allclose(poses.poses[0] @ [3.0, -2.0, 90.0, 1.0], pivot, atol=1e-6)


@pytest.mark.parametrize(
    "other", [{"light": "camera"}, {"hold_surface": "auto"}, {"lambda_flow": 0.1}]
)
def test_what_progressive_does_not_go_with_is_refused(other: dict) -> None:
    with pytest.raises(ValidationError, match="progressive works with"):
        FitConfig(**{**PROGRESSIVE, **other})
