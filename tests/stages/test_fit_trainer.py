"""The fit on a small textured surface with known cameras."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest

from pipeline.artifacts.cameras import Camera, Cameras
from pipeline.artifacts.flow import Flow, FlowPair
from pipeline.artifacts.views import View, Views
from pipeline.errors import ReconstructionError
from pipeline.geometry.rigid import exponential
from stages.fit.stage import FitStage
from stages.splatting.rendering import render
from tests.stages.fit_case import HEIGHT, WIDTH, StoppedError, case, context, outputs


def test_fit_improves_on_its_start_and_reports(tmp_path) -> None:
    views, cameras, points = case()
    here = context(tmp_path, views, cameras, points, iterations=150)
    seen: list[tuple[int, int, dict]] = []
    here.on_progress = lambda step, done, total, **figures: seen.append((done, total, figures))
    FitStage().run(here)
    assert seen[-1][:2] == (150, 150) and {"loss", "psnr", "gaussians"} <= set(seen[-1][2])
    first = next(figures["psnr"] for done, _, figures in seen if done == 10)
    assert here.figures["train_psnr"] > max(26.0, first + 4)
    assert here.figures["gaussians"] == len(here.result("gaussians"))
    # the written Gaussians, through the written cameras, are what was scored
    refined = here.result("cameras").by_name()
    scores = []
    for view in views.views:
        image = render(here.result("gaussians"), refined[view.name], threads=1).image
        scores.append(-10 * np.log10(((np.clip(image, 0, 1) - view.image) ** 2).mean()))
    assert np.mean(scores) == pytest.approx(here.figures["train_psnr"], abs=0.05)


@pytest.mark.parametrize("light", ["auto", "none"])
def test_a_view_that_is_masked_wholly_has_no_part_in_the_scores(tmp_path, light) -> None:
    views, cameras, points = case()
    hidden = dataclasses.replace(views.views[0], mask=np.zeros((HEIGHT, WIDTH), bool))
    masked = Views((hidden, *views.views[1:]))
    here = context(tmp_path, masked, cameras, points, light=light, hold_surface=False)
    last: dict[str, Any] = {}
    here.on_progress = lambda step, done, total, **figures: last.update(figures)
    FitStage().run(here)
    assert 20 < here.figures["train_psnr"] < 40 and last["psnr"] < 40
    assert all(value < 40 for name, value in here.figures.items() if "light_trial" in name)


def test_harmonics_that_a_fit_does_not_come_to_are_not_in_the_scene(tmp_path) -> None:
    views, cameras, points = case()
    config = {"light": "none", "hold_surface": False, "headlight": 0.6}
    scenes, scores = {}, {}
    for name, changes in (
        ("none", {"sh_degree": 0}),
        ("later", {"sh_degree": 1, "sh_degree_interval": 1000}),
        ("soon", {"sh_degree": 1, "sh_degree_interval": 20}),
    ):
        here = context(tmp_path / name, views, cameras, points, **config, **changes)
        FitStage().run(here)
        scenes[name], scores[name] = here.result("gaussians").sh, here.figures["train_psnr"]
    np.testing.assert_array_equal(scenes["later"], scenes["none"])
    assert np.any(scenes["soon"][:, 1:4])
    assert scores["soon"] > scores["none"]


def test_opacities_that_start_anew_are_no_divergence_and_have_time_to_come_back(tmp_path) -> None:
    views, cameras, points = case()
    config = {"densify": True, "light": "none", "hold_surface": False}
    here = context(
        tmp_path, views, cameras, points, iterations=320, opacity_reset_interval=160, **config
    )
    losses: list[float] = []
    here.on_progress = lambda step, done, total, **figures: losses.append(figures.get("loss", 0))
    FitStage().run(here)
    grown = np.diff(losses) > 0.1
    assert grown.sum() == 1 and grown[16]  # at 160, and not at the end
    assert here.figures["train_psnr"] > 30  # 33.3; 36.1 without


def test_densification_that_comes_to_nothing_is_said(tmp_path) -> None:
    views, cameras, points = case()
    said = {}
    for densify in (True, "auto"):
        here = context(
            tmp_path / str(densify), views, cameras, points, iterations=2, densify=densify
        )
        FitStage().run(here)
        said[densify] = " ".join(here.warnings)
    assert "begin at iteration 150 (fit.densify_from_iter) and end at 0" in said[True]
    assert "densify" not in said["auto"]


def test_a_stopped_fit_resumes_to_the_same_bytes_with_any_number_of_threads(tmp_path) -> None:
    views, cameras, points = case()
    config = {"densify": True, "densify_from_iter": 20, "densification_interval": 10,
              "max_gaussians": 3000, "densify_grad_threshold": 1e-7, "exposure": True,
              "densify_abs_grad_threshold": 1e-7, "densify_until_iter": 60}  # fmt: skip
    whole = context(tmp_path / "a", views, cameras, points, threads=1, **config)
    FitStage().run(whole)
    assert whole.figures["gaussians"] > 1700  # it did densify
    for folder, threads, moments in (("b", 2, (13, 37)), ("c", 1, (50,))):
        for moment in moments:
            stopped = context(
                tmp_path / folder, views, cameras, points, threads=threads, checkpoint_every=7,
                **config,
            )  # fmt: skip

            def stop(step, done, total, moment=moment, **figures):
                if done >= moment:
                    raise StoppedError

            stopped.on_progress = stop
            with pytest.raises(StoppedError):
                FitStage().run(stopped)
        resumed = context(tmp_path / folder, views, cameras, points, threads=3 - threads, **config)
        seen: list[int] = []
        resumed.on_progress = lambda step, done, total, seen=seen, **figures: seen.append(done)
        FitStage().run(resumed)
        assert min(done for done in seen if done) >= moments[-1] - 10  # it did resume
        assert outputs(tmp_path / folder) == outputs(tmp_path / "a")
        assert resumed.figures == whole.figures


@pytest.mark.parametrize("damage", ["truncate", "garbage", "other"])
def test_a_checkpoint_that_cannot_be_used_is_ignored(tmp_path, damage: str) -> None:
    views, cameras, points = case()
    whole = context(tmp_path / "a", views, cameras, points, iterations=20, checkpoint_every=7)
    FitStage().run(whole)
    other = context(tmp_path / "b", views, cameras, points, iterations=30, checkpoint_every=7)
    if damage == "other":
        FitStage().run(other)  # leaves a checkpoint of another fit
    else:
        data = (tmp_path / "a" / "scratch" / "fit.npz").read_bytes()
        bad = data[: len(data) // 2] if damage == "truncate" else b"\0" * 1000
        (tmp_path / "b" / "scratch" / "fit.npz").write_bytes(bad)
    again = context(tmp_path / "b", views, cameras, points, iterations=20)
    FitStage().run(again)
    assert outputs(tmp_path / "b") == outputs(tmp_path / "a")


def test_pose_refinement_recovers_a_disturbed_camera(tmp_path) -> None:
    views, cameras, points = case()
    rotation, _ = exponential(np.array([0, 0, 0, 0.004, 0.006, -0.003]))
    wrong = np.eye(4)
    wrong[:3, :3] = rotation
    disturbed = list(cameras.cameras)
    truth = disturbed[2]
    disturbed[2] = dataclasses.replace(truth, cam_from_world=wrong @ truth.cam_from_world)
    here = context(
        tmp_path, views, Cameras(tuple(disturbed)), points, iterations=200, pose_lr_init=2e-3,
        pose_lr_final=2e-5,
    )  # fmt: skip
    FitStage().run(here)
    refined = here.result("cameras").by_name()

    def shift(camera: Camera) -> float:
        """Mean distance on the screen, px, of where the surface is seen."""
        a, _ = camera.project(points.positions)
        b, _ = truth.project(points.positions)
        return float(np.linalg.norm(a - b, axis=1).mean())

    assert shift(disturbed[2]) > 0.4
    assert shift(refined["002"]) < 0.5 * shift(disturbed[2])
    assert np.allclose(refined["001"].cam_from_world, cameras.cameras[1].cam_from_world)


def test_views_of_other_sizes_masks_unplaced_views_and_flow(tmp_path) -> None:
    views, cameras, points = case(v001=(51, 37))
    masked = list(views.views)
    mask = np.ones((HEIGHT, WIDTH), bool)
    mask[:, :20] = False
    image = masked[0].image.copy()
    image[:, :20] = (1.0, 0.0, 1.0)  # a glove that is masked away
    masked[0] = dataclasses.replace(masked[0], image=image, mask=mask)
    masked.append(View("003", np.zeros((10, 10, 3), np.float32)))
    still = np.zeros((HEIGHT, WIDTH, 2), np.float32)
    good = np.ones((HEIGHT, WIDTH), bool)
    pair = FlowPair("000", "002", still, still, good, good)
    lost = FlowPair("002", "003", still, still, good, good)
    flow = Flow((pair, lost))
    here = context(
        tmp_path, Views(tuple(masked)), cameras, points, flow, iterations=120, lambda_flow=1e-4
    )
    FitStage().run(here)
    assert here.figures["flow_pairs"] == 1
    assert here.figures["train_psnr"] > 24
    result = render(here.result("gaussians"), here.result("cameras").by_name()["000"], threads=1)
    magenta = np.abs(result.image[:, 4:16] - (1.0, 0.0, 1.0)).max(-1)
    assert (magenta > 0.25).mean() > 0.95  # the glove was not learnt
    assert [c.name for c in here.result("cameras").cameras] == ["000", "001", "002"]


def test_flow_to_several_views_counts_all_of_it(tmp_path) -> None:
    """As flow.window makes it: what leads from a view to its second neighbour has a say too."""
    views, cameras, points = case()
    still, good = np.zeros((HEIGHT, WIDTH, 2), np.float32), np.ones((HEIGHT, WIDTH), bool)
    pairs = [FlowPair("000", name, still, still, good, good) for name in ("001", "002")]
    made = []
    for number in (1, 2):
        here = context(
            tmp_path / str(number), views, cameras, points, Flow(tuple(pairs[:number])),
            iterations=24, light="none", lambda_flow=0.1,
        )  # fmt: skip
        FitStage().run(here)
        assert here.figures["flow_pairs"] == number
        made.append(here.result("gaussians").means)
    assert not np.array_equal(*made)


def test_too_little_to_start_from_is_explained(tmp_path) -> None:
    views, cameras, points = case()
    with pytest.raises(ReconstructionError, match="Only 1 of 3 photographs"):
        FitStage().run(context(tmp_path, views, Cameras(cameras.cameras[:1]), points))
    few = points[np.arange(50)]
    with pytest.raises(ReconstructionError, match="only 50 points"):
        FitStage().run(context(tmp_path, views, cameras, few))


def test_divergence_stops_with_a_diagnosis_and_keeps_the_checkpoint(tmp_path) -> None:
    views, cameras, points = case()
    broken = context(
        tmp_path, views, cameras, points, feature_lr=1e38, light="none", checkpoint_every=1
    )
    with pytest.raises(ReconstructionError, match="diverged at iteration"):
        FitStage().run(broken)
    assert (broken.scratch / "fit.npz").exists()
