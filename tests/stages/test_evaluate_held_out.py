"""The evaluate stage on a scene whose truth is known: held-out views, poses, support, geometry."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from pipeline.artifacts.cameras import Camera, Cameras
from pipeline.artifacts.gaussians import Gaussians
from pipeline.artifacts.metrics import Metrics
from pipeline.artifacts.views import HeldOut, View, Views, to_uint8, write_png
from pipeline.errors import RequestError
from pipeline.stage import LocalContext
from pipeline.untrusted.scenes.transforms import OPENCV_FROM_OPENGL
from stages.evaluate.config import EvaluateConfig
from stages.evaluate.report import PARTS
from stages.evaluate.stage import EvaluateStage
from stages.evaluate.truth import scoring_mask
from stages.splatting.rendering import render
from stages.views.orientation import make_stored
from stages.views.working import prepare
from tests.stages.evaluate_scene import arc, moved_world, rotation, textured_scene

ANGLES = [-24.0, -16, -8, 0, 8, 16, 24]
HELD = (1, 4)
TURN, SHIFT, SCALE = rotation((1, 2, 3), 50), np.array([1.0, -2, 3]), 2.0


def case(folder: Path) -> dict[str, Any]:
    """Photographs rendered from a scene, which is reconstructed exactly, in a world of its own."""
    scene = textured_scene()
    poses = arc(ANGLES, 3.0)
    cameras = [Camera("", 96, 72, 120.0, 120.0, 48, 36, pose) for pose in poses]
    photos = [to_uint8(np.clip(render(scene, camera).image, 0, 1)) for camera in cameras]
    frames = [
        {"file_path": f"p{k}.png",
         "transform_matrix": (np.linalg.inv(pose) @ OPENCV_FROM_OPENGL).tolist()}
        for k, pose in enumerate(poses)
    ]  # fmt: skip
    truth = {"w": 96, "h": 72, "fl_x": 120.0, "units": "mm", "frames": frames}
    (folder / "transforms.json").write_text(json.dumps(truth))
    inputs = [k for k in range(len(ANGLES)) if k not in HELD]

    def view(name: str, k: int) -> View:
        image = photos[k].astype(np.float32) / np.float32(255)
        return View(name, image, source_size=(96, 72), source_name=f"p{k}.png")

    moved = moved_world(poses, SCALE, TURN, SHIFT)
    placed = [replace(cameras[k], name=f"{n:03d}", cam_from_world=moved[k])
              for n, k in enumerate(inputs)]  # fmt: skip
    world = Gaussians(
        (SCALE * scene.means @ TURN.T + SHIFT).astype(np.float32), scene.quats_wxyz,
        scene.log_scales + np.float32(np.log(SCALE)), scene.logit_opacities, scene.sh,
    )  # fmt: skip
    return {
        "views": Views(tuple(view(f"{n:03d}", k) for n, k in enumerate(inputs))),
        "held_out": HeldOut(tuple(view(f"h{n:03d}", k) for n, k in enumerate(HELD))),
        "cameras": Cameras(tuple(placed)),
        "gaussians": world,
    }


def run(folder: Path, inputs: dict[str, Any], **settings: Any) -> LocalContext:
    config = EvaluateConfig(**settings)
    stage = EvaluateStage()
    sources = stage.sources(config, {"images": []})
    context = LocalContext(config, folder, inputs, sources, threads=1)
    stage.run(context)
    return context


def test_everything_where_the_reconstruction_is_exact(tmp_path: Path) -> None:
    inputs = case(tmp_path)
    (tmp_path / "masks").mkdir()
    mask = np.zeros((72, 96), np.uint8)
    mask[20:50, 30:60] = 255
    mask[:20] = 128  # something else
    write_png(tmp_path / "masks" / "p1.png", mask)
    context = run(
        tmp_path / "out", inputs, ground_truth=str(tmp_path / "transforms.json"),
        masks=str(tmp_path / "masks"), flip=False,
    )  # fmt: skip
    figures = context.result("metrics").figures
    assert context.warnings == []
    assert sorted(figures["views"]) == ["000", "001", "002", "003", "004"]
    poses = figures["poses"]
    assert poses["rotation_deg"]["max"] < 1e-4
    assert poses["ate_rmse"] < 1e-5
    assert (poses["ate_unit"], poses["placed"], poses["auc_5"]) == ("mm", 5, pytest.approx(1))
    held = figures["held_out"]
    assert held.pop("sources") == {"h000": "p1.png", "h001": "p4.png"}
    assert held.pop("pictures") == "refined"
    assert sorted(held) == ["refined", "registered"]
    assert "registered only" in held["registered"]["protocol"]
    assert "then refined" in held["refined"]["protocol"]
    for block in held.values():
        assert sorted(block["views"]) == ["h000", "h001"]
        assert block["mean"]["psnr"] > 45
        assert block["mean"]["lpips"] is None
        assert block["views"]["h000"]["psnr_mask"] > 45
        assert "psnr_mask" not in block["views"]["h001"]
        assert block["views"]["h000"]["unsupported"] < 0.05
    written = {path.name for path in (tmp_path / "out" / "metrics").iterdir()}
    assert {"heldout_comparison_h000.png", "support_h001.png", "support_novel_first.png"} <= written
    novel = figures["novel"]["views"]
    assert novel["first"]["unsupported"] >= held["registered"]["mean"]["unsupported"]


def test_whole_photographs_held_out_beside_masked_ones_are_said(tmp_path: Path) -> None:
    """As after `init.dental.mask_rest`: 9 dB on lips that the scene was never to show."""
    inputs = case(tmp_path)
    mask = np.zeros((72, 96), bool)
    mask[18:54] = True
    shown = tuple(replace(view, mask=mask) for view in inputs["views"].views)
    masked = inputs | {"views": Views(shown)}
    truth: dict[str, Any] = {"ground_truth": str(tmp_path / "transforms.json"), "flip": False}
    context = run(tmp_path / "out", masked, test_poses="registered", novel_angle=0, **truth)
    (said,) = context.warnings
    assert "from 50% of the input" in said and "of held-out ones 100% count" in said
    metrics = context.result("metrics")
    facts = [
        fact.text
        for fact in PARTS["findings"](SimpleNamespace(latest={"metrics": metrics}.get, labels={}))
    ]
    assert any("repeats the 50 % of them that masks leave" in text for text in facts)
    assert any("pixels that masks leave" in text for text in facts)
    assert not any("counts as well" in text for text in facts)
    metrics.figures["held_out"]["registered"]["mean"]["coverage"] = 0.35
    again = PARTS["findings"](SimpleNamespace(latest={"metrics": metrics}.get, labels={}))
    assert any("covers 35 % of their pixels" in fact.text for fact in again)
    both = masked | {
        "held_out": HeldOut(tuple(replace(v, mask=mask) for v in inputs["held_out"].views))
    }
    assert not run(tmp_path / "b", both, test_poses="registered", novel_angle=0, **truth).warnings


def test_masks_that_mark_nothing_are_said(tmp_path: Path) -> None:
    inputs = case(tmp_path)
    masks = tmp_path / "masks"
    masks.mkdir()
    write_png(masks / "p1_mask.png", np.full((72, 96), 255, np.uint8))
    with pytest.raises(RequestError, match=r"like p1_mask\.png, the photographs like p0\.png"):
        run(tmp_path / "other", inputs, masks=str(masks), flip=False)
    write_png(masks / "p0.png", np.ones((72, 96), np.uint8))  # 1 for a tooth, not 255
    context = run(tmp_path / "ones", inputs, masks=str(masks), flip=False, novel_angle=0)
    assert any("masks of p0.png is 255" in text for text in context.warnings)


@pytest.mark.parametrize("orientation", range(1, 9))
def test_masks_lie_as_they_do_for_the_stage_views(tmp_path: Path, orientation: int) -> None:
    """Upright, or stored where only that has their shape; of a mirror image turned back, too."""
    mask = np.zeros((60, 80), np.uint8)
    mask[:20, :30] = mask[40:, 20:30] = 255
    photo = make_stored(np.zeros((60, 80, 3), np.uint8), orientation)
    picture = prepare(photo, None, orientation, None, 40, mask > 0)
    assert picture.mask is not None
    view = View(
        "000", picture.rgb.astype(np.float32), source_name="p.jpg", source_size=picture.source_size,
        working_from_source=picture.working_from_source,
    )  # fmt: skip
    path = tmp_path / "p.png"
    shapes = [mask, mask[::2, ::2]]
    if orientation >= 5:
        shapes += [make_stored(shape, orientation) for shape in shapes]
    for shape in shapes:
        write_png(path, np.ascontiguousarray(shape))
        found = scoring_mask({path.name: path}, view)
        np.testing.assert_array_equal(found, picture.mask)
        turned = scoring_mask({path.name: path}, view.mirrored())
        np.testing.assert_array_equal(turned, picture.mask[:, ::-1])
    write_png(path, np.zeros((60, 60), np.uint8))
    with pytest.raises(RequestError, match=r"60 x 60 pixels, but the photograph p\.jpg"):
        scoring_mask({path.name: path}, view)


def test_refinement_mends_wrong_true_cameras_only_in_its_own_protocol(tmp_path: Path) -> None:
    inputs = case(tmp_path)
    text = json.loads((tmp_path / "transforms.json").read_text())
    pose = np.array(text["frames"][1]["transform_matrix"])
    pose[:3, :3] = rotation((0, 1, 0), 1.0) @ pose[:3, :3]  # two pixels
    text["frames"][1]["transform_matrix"] = pose.tolist()
    (tmp_path / "transforms.json").write_text(json.dumps(text))
    truth = {"ground_truth": str(tmp_path), "flip": False, "novel_angle": 0}
    both = run(tmp_path / "a", inputs, **truth).result("metrics").figures["held_out"]
    registered, refined = (both[p]["views"]["h000"]["psnr"] for p in ("registered", "refined"))
    assert registered < 35
    assert refined > registered + 8
    one = run(tmp_path / "b", inputs, **truth, test_poses="registered")
    alone = one.result("metrics").figures["held_out"]
    assert alone["registered"] == both["registered"]
    assert (alone["pictures"], "refined" in alone) == ("registered", False)


def test_the_geometry_of_the_exact_reconstruction(tmp_path: Path) -> None:
    import open3d as o3d

    inputs = case(tmp_path)
    means = textured_scene().means.reshape(54, 70, 3).astype(np.float64)
    index = np.arange(54 * 70).reshape(54, 70)
    corners = [index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]]
    a, b, c, d = (part.ravel() for part in corners)
    triangles = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
    made = o3d.geometry.TriangleMesh(
        o3d.utility.Vector3dVector(means.reshape(-1, 3)), o3d.utility.Vector3iVector(triangles)
    )
    o3d.io.write_triangle_mesh(str(tmp_path / "wall.ply"), made)
    truth = {"ground_truth": str(tmp_path), "mesh": str(tmp_path / "wall.ply")}
    context = run(
        tmp_path / "a", inputs, **truth, flip=False, novel_angle=0, test_poses="registered",
        geometry_distances=(0.1,),
    )  # fmt: skip
    figures = context.result("metrics").figures["geometry"]
    assert figures["unit"] == "mm"
    assert figures["accuracy_mm"]["median"] < 0.03  # a Gaussian's sigma
    assert figures["completeness_mm"]["median"] < 0.03
    assert figures["fscore"]["0.1"] > 0.95
    assert "similarity" in figures["alignment"]
    assert "points" not in figures  # there were none


def test_held_out_without_truth_is_said(tmp_path: Path) -> None:
    context = run(tmp_path / "out", case(tmp_path), flip=False, novel_angle=0)
    assert "held_out" not in context.result("metrics").figures
    assert "held out are not scored (2)" in context.warnings[0]


def test_what_is_missing_is_named(tmp_path: Path) -> None:
    stage = EvaluateStage()
    for settings, words in (
        ({"ground_truth": str(tmp_path)}, "evaluate.ground_truth: .* holds no cameras"),
        ({"mesh": str(tmp_path / "no.ply")}, r"mesh: there is no file .* \.ply, \.stl or \.obj"),
        ({"masks": str(tmp_path / "no")}, "evaluate.masks: there is no folder"),
        ({"masks": str(tmp_path)}, "evaluate.masks: there is no picture"),
    ):
        with pytest.raises(RequestError, match=words):
            stage.sources(EvaluateConfig(**settings), {})
    (tmp_path / "m.ply").write_text("ply")
    with pytest.raises(RequestError, match="without true cameras"):
        stage.sources(EvaluateConfig(mesh=str(tmp_path / "m.ply")), {})
    (tmp_path / "000.webp").write_bytes(b"")
    found = stage.sources(EvaluateConfig(masks=str(tmp_path)), {})
    assert found["masks/000.webp"] == tmp_path / "000.webp"


def test_the_place_of_the_truth_is_not_part_of_the_key() -> None:
    for name in ("ground_truth", "mesh", "masks", "lpips_weights"):
        extra = EvaluateConfig.model_fields[name].json_schema_extra
        assert extra == {"affects_result": False}, name


@pytest.mark.parametrize(
    ("kept_back", "said"), [(True, "true cameras of the photographs held out"), (False, "no photo")]
)
def test_the_page_says_why_no_other_direction_was_measured(kept_back: bool, said: str) -> None:
    view = View("h000", np.zeros((4, 4, 3), np.float32))
    found = {"metrics": Metrics({"mean": {}}), "held_out": HeldOut((view,)) if kept_back else None}
    (fact,) = PARTS["findings"](SimpleNamespace(latest=found.get, labels={}))
    assert said in fact.text and "not measured" in fact.text
