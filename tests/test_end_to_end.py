"""The whole job on the three sample photographs, with a short fit."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

import pipeline
from pipeline.artifacts.cameras import Cameras
from pipeline.running.outcomes import RunSummary
from pipeline.store import Store

SAMPLES = Path(__file__).resolve().parents[1] / "data_samples" / "three_photos"


@pytest.fixture(scope="module")
def done(sample_run: RunSummary) -> RunSummary:
    return sample_run


def test_every_stage_ran_and_told_its_figures(done: RunSummary) -> None:
    assert [stage.name for stage in done.stages] == [
        "views", "teeth", "init", "align", "sap", "flow", "fit", "export", "evaluate"
    ]  # fmt: skip
    figures = {stage.name: stage.figures["summary"] for stage in done.stages}
    assert figures["init"]["views_registered"] == figures["init"]["views_total"] == 3
    assert figures["init"]["completed_by_teeth"]
    assert figures["sap"]["points_after_pruning"] < figures["sap"]["points_before"]
    assert figures["fit"]["gaussians"] > 5000
    assert figures["evaluate"]["psnr"] > 25
    assert figures["evaluate"]["coverage"] > 0.85


def test_refined_cameras_are_where_the_scene_was_rendered_from(done: RunSummary) -> None:
    cameras: Cameras = load(done, "fit", "cameras")
    truth = json.loads((SAMPLES / "transforms.json").read_text())
    true_poses = {
        f"Prognath_Anna_{Path(f['file_path']).name}": np.array(f["w2c_opencv"])
        for f in truth["frames"]
    }
    names = {v.name: v.source_name for v in load(done, "views", "views").views}
    found = [camera.rotation for camera in cameras.cameras]
    wanted = [true_poses[names[camera.name]][:3, :3] for camera in cameras.cameras]
    for i in range(3):
        for j in range(i):
            difference = found[i] @ found[j].T @ wanted[j] @ wanted[i].T
            angle = np.degrees(np.arccos(np.clip((np.trace(difference) - 1) / 2, -1, 1)))
            assert angle < 1.0


def test_results_hold_every_output(done: RunSummary) -> None:
    assert done.results is not None
    names = {path.name for path in done.results.iterdir()}
    assert {
        "viewer.html", "orbit.mp4", "splats.ply", "splats.spz", "mesh.ply",
        "mesh.stl", "colmap", "transforms.json", "scene.json", "preview.png",
    } <= names  # fmt: skip


def test_second_run_is_cached_and_a_setting_reruns_only_what_depends_on_it(
    done: RunSummary, named_samples: Path, short_settings: dict[str, int], tmp_path: Path
) -> None:
    workspace = shutil.copytree(done.workspace, tmp_path / "w", symlinks=True)

    def actions(*overrides: str, **options: object) -> dict[str, str]:
        settings = [f"{key}={value}" for key, value in short_settings.items()] + ["report=false"]
        summary = pipeline.run(
            named_samples, workspace=workspace, overrides=[*settings, *overrides], **options
        )  # type: ignore[arg-type]
        return {stage.name: stage.action for stage in summary.stages}

    assert set(actions().values()) == {"cached"}
    chain = {"stages": ["init", "sap", "fit"]}
    short = ("fit.iterations=5", "fit.light=none", "sap.target_points=3000")
    assert actions(*short, **chain)["fit"] == "ran"
    changed = actions(*short, "sap.quantile=0.99", **chain)
    assert changed == {
        "views": "cached", "teeth": "cached", "init": "cached", "sap": "ran", "fit": "ran",
    }  # fmt: skip
    states = {s.name: s for s in pipeline.status(workspace=workspace)}
    assert states["sap"].reasons == ["sap.quantile 0.999 → 0.99"]
    assert states["fit"].reasons == ["input points (from sap) changed"]
    assert set(actions(*short, **chain).values()) == {"cached"}
    assert set(actions().values()) == {"cached"}


def load(done: RunSummary, stage: str, kind: str):  # type: ignore[no-untyped-def]
    outcome = next(entry for entry in done.stages if entry.name == stage)
    store = Store(done.workspace)
    result = store.find(stage, outcome.key or "")
    assert result is not None
    return store.load(result, kind)
