"""A fit that is far from right on its way gets more steps; one that is right does not."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from pipeline.artifacts.views import Views
from stages.fit.config import FitConfig, resolve
from stages.fit.parts.extension import MORE
from stages.fit.stage import FitStage
from tests.stages.fit_case import StoppedError, case, context, outputs

ALWAYS = {"extension": 0.5, "extension_psnr": (60.0, 70.0)}


def test_what_is_far_from_right_gets_more_steps_and_what_is_right_none(tmp_path) -> None:
    views, cameras, points = case()
    half = points[points.positions[:, 0] < 0]  # as where stereo saw nothing
    steps = []
    for name, cloud in (("right", points), ("half", half)):
        here = context(tmp_path / name, views, cameras, cloud, iterations=60, extension=0.5)
        seen: list[tuple[int, int]] = []
        here.on_progress = lambda _, done, of, seen=seen, **figures: seen.append((done, of))
        FitStage().run(here)
        assert seen[-1][0] == seen[-1][1] == here.figures["iterations"]
        steps.append((here.figures["iterations"], here.figures["extension"]))
    assert steps[0] == (60, 0)
    longer, share = steps[1]
    assert share > 0 and longer == pytest.approx(60 * (1 + 0.5 * share), abs=1)


def test_noise_and_exposure_are_no_reason_for_more_steps(tmp_path) -> None:
    views, cameras, points = case()
    rng = np.random.default_rng(5)
    worse = tuple(
        dataclasses.replace(
            view,
            image=np.clip(
                view.image * gain + rng.normal(0, 0.1, view.image.shape), 0, 1
            ).astype(np.float32),
        )
        for view, gain in zip(views.views, (0.75, 1.0, 0.85), strict=True)
    )  # fmt: skip
    here = context(tmp_path, Views(worse), cameras, points, iterations=60, extension=0.5)
    FitStage().run(here)
    assert here.figures["train_psnr"] < 20.5  # as it is, it would have had the whole extension
    assert here.figures["extension"] == 0


def test_an_extended_fit_resumes_to_the_same_bytes(tmp_path) -> None:
    views, cameras, points = case()
    whole = context(tmp_path / "a", views, cameras, points, threads=1, **ALWAYS)
    FitStage().run(whole)
    assert whole.figures["iterations"] == 90
    stopped = context(tmp_path / "b", views, cameras, points, checkpoint_every=7, **ALWAYS)

    def stop(step: str, done: int, of: int, **figures: float) -> None:
        if done >= 70:
            raise StoppedError

    stopped.on_progress = stop
    with pytest.raises(StoppedError):
        FitStage().run(stopped)
    resumed = context(tmp_path / "b", views, cameras, points, **ALWAYS)
    seen: list[int] = []
    resumed.on_progress = lambda step, done, of, **figures: seen.append(done)
    FitStage().run(resumed)
    assert min(done for done in seen if done) > 60  # it did resume, after it was decided
    assert outputs(tmp_path / "b") == outputs(tmp_path / "a")
    assert resumed.figures == whole.figures


def test_only_automatic_iterations_of_a_free_scene_are_extended() -> None:
    assert resolve(FitConfig(), 12, 0).extension == MORE
    assert resolve(FitConfig(iterations=300), 12, 0).extension == 0
    assert resolve(FitConfig(), 3, 0, held=True).extension == 0
    assert resolve(FitConfig(iterations=300, extension=0.2), 12, 0).extension == 0.2
