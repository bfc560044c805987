"""The flow stage on a scene whose flow is known exactly."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
from pydantic import ValidationError

from pipeline.artifacts.cameras import Camera, Cameras
from pipeline.artifacts.flow import Flow, FlowPair
from pipeline.artifacts.views import View, Views
from pipeline.errors import RequestError
from pipeline.stage import LocalContext
from stages.flow import report
from stages.flow.geometry import occluded, predicted_flow
from stages.flow.stage import LEAST_WINDOW, FlowConfig, FlowStage
from tests.stages import flow_scene as scene

Shot = tuple[Camera, View, np.ndarray]


def shoot(*angles: float, **size: int) -> list[Shot]:
    """Photograph the scene from these angles: camera, view, exact depth."""
    cameras = [scene.camera(f"{k:03d}", angle, **size) for k, angle in enumerate(angles)]
    return [(camera, *scene.photograph(camera)) for camera in cameras]


def context(folder: Path, shots: list[Shot], kinds: str = "cp", **config: Any) -> LocalContext:
    """`kinds`: c for cameras, p for points."""
    inputs: dict[str, Any] = {"views": Views(tuple(view for _, view, _ in shots))}
    if "c" in kinds:
        inputs["cameras"] = Cameras(tuple(camera for camera, _, _ in shots))
    if "p" in kinds:
        inputs["points"] = scene.cloud()
    return LocalContext(FlowConfig(**config), folder, inputs, threads=2)


def run(context: LocalContext) -> Flow:
    FlowStage().run(context)
    flow = context.result("flow")
    assert isinstance(flow, Flow)
    return flow


def errors(a: Shot, b: Shot, flow: np.ndarray) -> np.ndarray:
    """Distance in pixels from the true flow; infinite where the point is hidden in b."""
    truth, depth_in_b = predicted_flow(a[2], a[0], b[0])
    error = np.linalg.norm(flow - truth, axis=-1)
    return np.where(occluded(truth, depth_in_b, b[2], 0.02), np.inf, error)


def both_ways(shots: list[Shot], pair: FlowPair) -> list[tuple[np.ndarray, np.ndarray]]:
    """(errors, mask) forward and backward."""
    by_name = {shot[1].name: shot for shot in shots}
    i, j = by_name[pair.name_i], by_name[pair.name_j]
    return [
        (errors(i, j, pair.forward), pair.mask_forward),
        (errors(j, i, pair.backward), pair.mask_backward),
    ]


@pytest.mark.parametrize("method", ["dis", "farneback"])
def test_flow_of_a_wide_pair_is_right_where_it_is_trusted(tmp_path: Path, method: str) -> None:
    shots = shoot(-10, 10)
    local = context(tmp_path, shots, method=method)
    (pair,) = run(local).pairs
    for error, mask in both_ways(shots, pair):
        assert mask.mean() > 0.4
        assert (error[mask] < 1).mean() > 0.97
        assert np.median(error[mask]) < 0.2
    assert local.figures["pairs"] == 1
    assert local.figures["prewarp"] == "true"
    assert 0.4 < local.figures["trusted_share"] < 1
    assert local.figures["median_px_from_geometry"] < 0.3
    assert not local.warnings


def test_flow_corrects_cameras_that_are_slightly_wrong(tmp_path: Path) -> None:
    shots = shoot(-10, 10)
    turned = scene.camera("001", 11.2)  # further along its circle
    wrong = replace(shots[1][0], cam_from_world=turned.cam_from_world)
    local = context(tmp_path, [shots[0], (wrong, *shots[1][1:])])
    (pair,) = run(local).pairs
    for error, mask in both_ways(shots, pair):
        assert mask.mean() > 0.4
        assert (error[mask] < 1).mean() > 0.95
    assert local.figures["median_px_from_geometry"] > 0.5  # tells of the wrong camera


def test_prewarp_is_what_makes_a_wide_pair_work(tmp_path: Path) -> None:
    shots = shoot(-10, 10)
    right = {}
    for prewarp in ("off", "on"):
        (pair,) = run(context(tmp_path / prewarp, shots, prewarp=prewarp)).pairs
        ways = both_ways(shots, pair)
        right[prewarp] = np.mean([(mask & (error < 1)).mean() for error, mask in ways])
    assert right["on"] > right["off"] + 0.2


def test_masks_bound_the_trust_on_both_sides(tmp_path: Path) -> None:
    shots = shoot(-4, 4)
    masks = [np.ones((120, 160), bool) for _ in shots]
    masks[0][:60] = False
    masks[1][:, :80] = False
    masked = [(c, replace(v, mask=m), z) for (c, v, z), m in zip(shots, masks, strict=True)]
    (pair,) = run(context(tmp_path, masked)).pairs
    assert not pair.mask_forward[:60].any()
    assert not pair.mask_backward[:, :80].any()
    assert pair.mask_forward.sum() > 1000
    rows, columns = np.nonzero(pair.mask_forward)
    landing = columns + pair.forward[rows, columns, 0]
    assert landing.min() >= 80
    rows, columns = np.nonzero(pair.mask_backward)
    assert (rows + pair.backward[rows, columns, 1]).min() >= 60


@pytest.mark.parametrize("kinds", ["", "cp"])
def test_views_of_different_sizes(tmp_path: Path, kinds: str) -> None:
    small, large = shoot(-2, width=120, height=90), shoot(2, width=200, height=150)
    camera, view, depth = large[0]
    shots = [*small, (replace(camera, name="001"), replace(view, name="001"), depth)]
    (pair,) = run(context(tmp_path, shots, kinds)).pairs
    assert pair.forward.shape == (90, 120, 2)
    assert pair.backward.shape == (150, 200, 2)
    for error, mask in both_ways(shots, pair):
        assert mask.mean() > 0.5
        assert (error[mask] < 1).mean() > 0.95


def test_pairs_follow_the_cameras_not_the_names(tmp_path: Path) -> None:
    shots = shoot(5, -5, 15, 0, width=64, height=48)
    flow = run(context(tmp_path / "a", shots))
    # In space: 1, 3, 0, 2.
    assert [(p.name_i, p.name_j) for p in flow.pairs] == [
        ("000", "002"), ("001", "003"), ("003", "000"),
    ]  # fmt: skip
    flow = run(context(tmp_path / "b", shots, kinds=""))
    assert [(p.name_i, p.name_j) for p in flow.pairs] == [
        ("000", "001"), ("001", "002"), ("002", "003"),
    ]  # fmt: skip


def test_unplaced_views_and_wide_pairs_are_left_out(tmp_path: Path) -> None:
    shots = shoot(0, 10, 20, 60, -10, width=64, height=48)
    local = context(tmp_path, shots, max_angle=30)
    local.inputs = {**local.inputs, "cameras": Cameras(tuple(shot[0] for shot in shots[:4]))}
    flow = run(local)
    assert [(p.name_i, p.name_j) for p in flow.pairs] == [("000", "001"), ("001", "002")]
    assert len(local.warnings) == 1
    assert "002 and 003" in local.warnings[0]
    assert local.figures["pairs_too_wide"] == 1


def test_a_single_view_gives_an_empty_flow_and_says_why(tmp_path: Path) -> None:
    local = context(tmp_path, shoot(0, width=64, height=48))
    assert len(run(local)) == 0
    assert len(local.warnings) == 1
    assert "two views" in local.warnings[0]


def test_of_photographs_far_apart_no_flow_is_expected(tmp_path: Path) -> None:
    local = context(tmp_path / "none", shoot(0, 20, 40, width=64, height=48), max_angle=15)
    assert len(run(local)) == 0
    assert local.warnings == []
    assert (local.figures["pairs"], local.figures["pairs_too_wide"]) == (0, 2)
    local = context(tmp_path / "poor", mostly_masked(shoot(-20, 20, width=64, height=48)))
    assert len(run(local)) == 1
    assert local.figures["trusted_share"] < 0.1
    assert local.warnings == []


def mostly_masked(shots: list[Shot]) -> list[Shot]:
    """Of the second photograph a small piece is left."""
    first, (camera, view, depth), *others = shots
    mask = np.zeros((view.height, view.width), bool)
    mask[20:28, 28:36] = True
    return [first, (camera, replace(view, mask=mask), depth), *others]


def test_flow_between_near_views_that_cannot_be_trusted_is_said(tmp_path: Path) -> None:
    """Once, however many pairs there are: films have dozens. By the names of the photographs."""
    shots = mostly_masked(shoot(-8, 0, 8, width=64, height=48))
    named = [
        (c, replace(v, source_name=f"film.mp4#{5 * k}"), d) for k, (c, v, d) in enumerate(shots)
    ]
    local = context(tmp_path, named)
    run(local)
    (said,) = local.warnings
    assert "film.mp4#0 and film.mp4#5 (" in said and "film.mp4#5 and film.mp4#10 (" in said


def test_prewarp_without_geometry_is_refused(tmp_path: Path) -> None:
    with pytest.raises(RequestError, match="needs cameras and points"):
        run(context(tmp_path, shoot(-2, 2, width=64, height=48), "c", prewarp="on"))


@pytest.mark.parametrize("method", ["dis", "farneback"])
def test_bytes_do_not_depend_on_threads(tmp_path: Path, method: str) -> None:
    shots = shoot(-4, 4)
    written = []
    before = cv2.getNumThreads()
    try:
        for threads in (1, 2, 2):
            cv2.setNumThreads(threads)
            local = context(tmp_path / str(len(written)), shots, method=method)
            local.threads = threads
            run(local)
            assert cv2.getNumThreads() == threads  # given back as found
            files = sorted((local.folder / "flow").iterdir())
            written.append({path.name: path.read_bytes() for path in files})
    finally:
        cv2.setNumThreads(before)
    assert len(written[0]) == 4
    assert written[0] == written[1] == written[2]


def test_a_window_that_leaves_nothing_of_a_photograph_is_refused():
    with pytest.raises(ValidationError, match="nothing is left of a photograph"):
        FlowConfig(contrast_window=LEAST_WINDOW / 2)
    for window in (0, LEAST_WINDOW):
        assert FlowConfig(contrast_window=window).contrast_window == window


def test_both_pictures_of_a_pair_have_the_scale_that_is_said(monkeypatch) -> None:
    """Wild flow that nobody trusts took the colour from the rest in one of them."""
    flow = np.zeros((8, 8, 2), np.float32)
    flow[:4, :, 0], flow[4:, :, 0] = 5, 400
    trusted = np.zeros((8, 8), bool)
    trusted[:4] = True
    pair = FlowPair("000", "001", flow, -flow, trusted, trusted)
    drawn: list[np.ndarray] = []
    monkeypatch.setattr(report, "picture", lambda image, *_: drawn.append(image))
    case = SimpleNamespace(latest={"flow": Flow((pair,))}.get, labels={})
    (section,) = report.pairs(case)
    _, full, shown = drawn
    assert np.array_equal(full[:4], shown[:4]) and not np.array_equal(full[4:], shown[4:])
    assert "full colour: 5 px" in str(section)
