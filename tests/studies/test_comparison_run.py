"""`pipeline compare` on the sample photographs, and runs on a COLMAP model's cameras and points."""

import json
import shutil
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest

import pipeline
from pipeline.artifacts.cameras import Cameras
from pipeline.artifacts.pointmaps import Pointmaps
from pipeline.artifacts.points import Points
from pipeline.artifacts.space.scale import Scale
from pipeline.artifacts.views import View, Views
from pipeline.errors import ReconstructionError, RequestError
from pipeline.running.reporter import Reporter
from pipeline.stage import LocalContext
from pipeline.store import Store
from pipeline.studies.compare.compare import compare
from pipeline.studies.compare.fits import settings_of, take_corrections
from pipeline.studies.compare.tables import markdown, tables_of
from stages.align.stage import AlignStage
from stages.init.config import InitConfig
from stages.init.stage import InitStage
from stages.swap.stage import SwapConfig, SwapStage
from tests.studies import report_case as case
from tests.studies.comparison_scene import SAMPLES, moved, true_cameras, true_points, write_model
from tests.studies.report_page import text_of

SETTINGS = {
    "views.long_side": 192, "init.cameras": str(SAMPLES / "transforms.json"), "fit.iterations": 20,
    "fit.light": "none", "threads": 2, "report": False, "init.dense.method": "sweep",
    "teeth.method": "none",
}  # fmt: skip
PHOTOS = [SAMPLES / f"{name}.jpg" for name in ("right_buccal", "frontal", "left_buccal")]


@pytest.fixture(scope="module")
def workspace(tmp_path_factory):
    home = tmp_path_factory.mktemp("compare") / "w"
    stages = ["views", "init", "align", "sap", "fit", "evaluate"]
    home.mkdir()
    (home / "teeth.yaml").write_text("photographs: {frontal: {kind: front}}")
    pipeline.run(PHOTOS, workspace=home, overrides=SETTINGS, stages=stages)
    return home


@pytest.fixture(scope="module")
def model(tmp_path_factory):
    """The true cameras, but for the first, which is turned by a degree; in a world twice as big."""
    cameras = true_cameras()
    wrong = [moved(camera, 1.0 if k == 0 else 0.0) for k, camera in enumerate(cameras)]
    return write_model(tmp_path_factory.mktemp("model") / "0", wrong, 2 * true_points(8))


def test_the_whole_comparison(workspace, model):
    (workspace / "report.html").write_text("to be renewed")
    found = compare(workspace, colmap=model, ground_truth=SAMPLES / "transforms.json", threads=2)
    rows = {row["name"]: row for row in found.figures["cameras"]}
    assert list(rows) == ["init (ours)", "align (ours)", "fit (ours)", "COLMAP, given model"]
    assert rows["init (ours)"]["errors"]["rotation_deg"]["max"] < 1e-3
    colmap = rows["COLMAP, given model"]
    assert colmap["errors"]["relative_rotation_deg"]["max"] == pytest.approx(1, abs=0.01)
    assert (colmap["registered"], colmap["models"]) == (3, 1)
    points = {row["name"]: row for row in found.figures["points"]}
    assert set(points) == {"init (ours)", "align (ours)", "sap (ours)", "COLMAP, given model"}
    assert points["init (ours)"]["cloud"]["from_other_percent"]["median"] < 3
    fits = {row["start"]: row for row in found.figures["fits"]}
    assert len(fits) == 3 and not any("failure" in row for row in fits.values())
    assert {row["iterations"] for row in fits.values()} == {20}
    manifests = found.folder.rglob("teeth/*/manifest.json")
    assert [json.loads(path.read_text())["config"]["method"] for path in manifests] == ["none"]
    manifests = [json.loads(k.read_text()) for k in found.folder.rglob("init/*/manifest.json")]
    assert len(manifests) == 2
    assert all("teeth.yaml" in dict(made["key_material"]["sources"]) for made in manifests)
    # 21.9, 22.0 and 17.9 when this was written; COLMAP's few points start a fit worst
    assert all(row["psnr"] > 13.5 for row in fits.values())
    assert min(fits, key=lambda start: fits[start]["psnr"]) == "COLMAP's cameras and points"
    ours = json.loads(next(workspace.glob("evaluate/*/metrics/metrics.json")).read_text())
    assert fits["this pipeline"]["psnr"] == ours["mean"]["psnr"]
    assert json.loads((found.folder / "comparison.json").read_text()) == found.figures
    text = (found.folder / "comparison.md").read_text()
    assert "| COLMAP, given model | 3/3 | 1 (3) |" in text
    assert "| COLMAP's cameras and points | 3 | 20 |" in text
    page = (found.folder / "report.html").read_text()
    assert page.count("<table") == 3
    assert all(f">{photo.stem}<" in page for photo in PHOTOS), (
        "the chart says which camera is whose"
    )
    report = text_of((workspace / "report.html").read_text())
    assert "Comparison with COLMAP measured against ground truth" in report
    assert "COLMAP, given model 3/3 1 (3)" in report
    assert "COLMAP's cameras and points 3 20" in report
    assert "it tells of earlier results" not in report


def test_what_was_put_right_about_the_teeth_holds_in_its_fits_too(workspace, tmp_path):
    settings = settings_of({name: Store(workspace).current(name) for name in ("init", "fit")})
    assert (settings["init.dental"]["labels"], settings["fit.iterations"]) == ([], 20)
    (tmp_path / "teeth.yaml").write_text("photographs: {frontal: {kind: front}}")
    fits = tmp_path / "compare" / "colmap"
    take_corrections(tmp_path, fits)
    # a list of teeth in the settings does not go before it
    listed = [{"photo": "frontal.jpg", "x": 96, "y": 60, "tooth": 11}]
    config = InitConfig.model_validate({"dental": {"labels": listed}})
    found = InitStage().sources(config, {"workspace": str(fits)})["teeth.yaml"]
    assert found.read_bytes() == (tmp_path / "teeth.yaml").read_bytes()
    (tmp_path / "teeth.yaml").write_text("photographs: {frontal: {kind: above}}")
    with pytest.raises(RequestError, match=r"kind must be front, right or left"):
        take_corrections(tmp_path, fits)
    (tmp_path / "teeth.yaml").unlink()
    take_corrections(tmp_path, fits)
    assert not (fits / "teeth.yaml").exists()


def test_the_truth_of_the_run_is_that_of_its_comparison(workspace, model, tmp_path, monkeypatch):
    monkeypatch.setenv("HOME", str(tmp_path))
    home = tmp_path / "w"
    shutil.copytree(workspace, home, symlinks=True)
    truth = tmp_path / "transforms.json"
    shutil.copy(SAMPLES / "transforms.json", truth)
    changes = {**SETTINGS, "evaluate.ground_truth": f"~/{truth.name}"}
    pipeline.run(PHOTOS, workspace=home, overrides=changes, stages=["evaluate"])
    found = compare(home, colmap=model, fit=False)
    assert found.figures["reference"] == "ground truth"
    elsewhere = truth.rename(tmp_path / "elsewhere.json")
    found = compare(home, colmap=model, ground_truth=elsewhere)
    fits = found.figures["fits"]
    assert len(fits) == 3 and not any("failure" in row for row in fits)
    told = Told()
    found = compare(home, colmap=model, fit=False, reporter=told)
    assert found.figures["reference"] == "COLMAP, given model"
    assert any("--ground-truth names it where it is now" in message for message in told.messages)


class Told(Reporter):
    def __init__(self):
        self.messages = []

    def message(self, text):
        self.messages.append(text)


def test_the_report_says_when_a_comparison_is_of_earlier_results(tmp_path):
    home = case.write_case(tmp_path / "w", ("views", "init", "sap", "fit"))
    used = Store(home).current("init")
    table = {
        "title": "Cameras", "explanation": "Errors.", "head": ["cameras", "s"],
        "rows": [["<b>ours", "1.5"]], "notes": [["<b>ours", "why & how"]],
    }  # fmt: skip
    figures = {"reference": None, "results": {"init": used.key, "fit": "0" * 64}, "tables": [table]}
    (home / "compare").mkdir()
    (home / "compare" / "comparison.json").write_text(json.dumps(figures))
    page = pipeline.run_report(home).read_text()
    text = text_of(page)
    assert "Made before fit was computed anew: it tells of earlier results." in text
    assert "Errors. cameras s <b>ours 1.5 <b>ours why & how" in text
    assert "<b>ours" not in page
    assert "could not be drawn" not in text


def test_a_rival_that_fails_says_why_and_the_rest_goes_on(workspace, tmp_path):
    cameras = true_cameras()[:2]
    model = write_model(tmp_path / "sparse" / "0", cameras, true_points(30)[:40])
    found = compare(workspace, colmap=tmp_path / "sparse", threads=2)
    assert found.figures["reference"] == "COLMAP, given model"
    row = found.figures["cameras"][-1]
    assert row["registered"] == 2 and "no database.db" in row["why_not_all"]
    assert "errors" not in row and found.figures["cameras"][0]["errors"]["placed"] == 2
    failed = found.figures["fits"][-1]
    assert failed["start"] == "COLMAP's cameras and points"
    assert "points to start from; a fit needs 100" in failed["failure"]
    text = markdown(tables_of(found.figures))
    assert "agreement, not errors (of the 2 of 3 views that have a camera there)" in text
    assert failed["failure"] in text
    assert model.exists()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((), "Say what to compare with"),
        (("--run-colmap", "--colmap", "x"), "not both"),
        (("--colmap", "nowhere"), "--colmap: nowhere holds no COLMAP model"),
        (("--run-colmap", "--ground-truth", "nowhere"), "--ground-truth: there is no "),
        (("--run-colmap", "--mesh", "teeth.ply"), "--mesh needs --ground-truth"),
    ],
)
def test_wrong_requests_are_refused(workspace, monkeypatch, capsys, arguments, message):
    from pipeline import cli

    monkeypatch.setattr(sys, "argv", ["pipeline", "compare", "-w", str(workspace), *arguments])
    with pytest.raises(SystemExit) as ended:
        cli.main()
    assert ended.value.code == 2
    assert message in capsys.readouterr().err


def test_a_bad_model_ends_with_status_2_in_a_process_of_its_own(workspace):
    command = [sys.executable, "-m", "pipeline.cli", "compare", "-w", str(workspace)]
    ended = subprocess.run(
        [*command, "--colmap", str(workspace)], capture_output=True, text=True, check=False
    )
    assert ended.returncode == 2 and "holds no COLMAP model" in ended.stderr


def test_a_folder_without_a_run_is_refused(tmp_path):
    with pytest.raises(RequestError, match="is not a workspace"):
        compare(tmp_path, run_colmap=True)


# -- the settings that take the results of COLMAP into a run ------------------------------------


def small_views():
    import cv2

    views = []
    for number, path in enumerate(PHOTOS):
        image = cv2.imread(str(path))[..., ::-1].astype(np.float32) / np.float32(255)
        name, size = path.name, image.shape[1::-1]
        views.append(View(f"{number:03d}", image, source_name=name, source_size=size))
    return Views(tuple(views))


def start_from(model, folder, **settings):
    config = InitConfig(cameras=str(model) if model else None, points="model", **settings)
    context = LocalContext(
        config, folder, {"views": small_views()}, InitStage().sources(config, {}), threads=2
    )
    InitStage().run(context)
    return context


def test_a_models_own_points_replace_dense_stereo(tmp_path):
    cameras, points = true_cameras(), true_points(8)
    context = start_from(write_model(tmp_path / "m", cameras, points), tmp_path / "init")
    placed, cloud = context.result("cameras"), context.result("points")
    assert len(context.result("pointmaps")) == 0
    assert context.figures["sparse_points"] == len(cloud) > 300
    back = placed.input_from_world
    world = cloud.positions.astype(np.float64) @ back[:3, :3].T + back[:3, 3]
    distance = np.linalg.norm(world[:, None] - points[None], axis=-1).min(1)
    assert distance.max() < 1e-2  # mm
    pixels, depth = placed.cameras[1].project(cloud.positions)
    expected, _ = cameras[1].project(world)
    assert np.allclose(pixels, expected, atol=1e-2) and (depth > 0).all()
    assert np.allclose(cloud.colors, np.array([200, 100, 50]) / 255, atol=1e-6)


def test_a_model_without_colours_takes_them_from_the_photographs(tmp_path):
    import pycolmap

    folder = write_model(tmp_path / "m", true_cameras(), true_points(8))
    model = pycolmap.Reconstruction(str(folder))
    for point in model.points3D.values():
        point.color = np.zeros(3, np.uint8)
    model.write_binary(str(folder))
    cloud = start_from(folder, tmp_path / "init").result("points")
    assert cloud.colors.std() > 0.05 and (cloud.colors[:, 0] > cloud.colors[:, 2]).mean() > 0.7


def test_model_points_need_a_model_with_points(tmp_path):
    with pytest.raises(RequestError, match="none is given"):
        start_from(None, tmp_path / "a")
    with pytest.raises(RequestError, match="holds no points"):
        start_from(SAMPLES / "transforms.json", tmp_path / "b")
    empty = write_model(tmp_path / "m", true_cameras(), np.zeros((0, 3)))
    with pytest.raises(ReconstructionError, match="no points to start from"):
        start_from(empty, tmp_path / "c")


def test_align_keeps_what_came_without_pointmaps(tmp_path):
    before = start_from(write_model(tmp_path / "m", true_cameras(), true_points(8)), tmp_path / "i")
    inputs = {"views": small_views(), "pointmaps": Pointmaps([]),
              "cameras": before.result("cameras"), "points": before.result("points")}  # fmt: skip
    context = LocalContext(AlignStage.Config(), tmp_path / "align", inputs)
    AlignStage().run(context)
    assert np.array_equal(context.result("points").positions, inputs["points"].positions)
    assert np.allclose(
        context.result("cameras").cameras[0].cam_from_world,
        inputs["cameras"].cameras[0].cam_from_world,
    )
    del inputs["points"]
    with pytest.raises(ReconstructionError, match="There are no pointmaps"):
        AlignStage().run(LocalContext(AlignStage.Config(), tmp_path / "b", inputs))


def swapped(tmp_path, model, present, **settings):
    config = SwapConfig(cameras=str(model), **settings)
    context = LocalContext(
        config, tmp_path / "swap", {"views": small_views(), "cameras": present},
        SwapStage().sources(config, {}),
    )  # fmt: skip
    SwapStage().run(context)
    return context


def test_cameras_are_swapped_for_a_models_in_the_same_world(tmp_path, model):
    truth = true_cameras()
    named = [replace(c, name=f"{k:03d}", fx=900.0, fy=900.0) for k, c in enumerate(truth)]
    present = Cameras(tuple(named), np.diag([2.0, 2, 2, 1]), Scale("mm"))
    result = swapped(tmp_path, model, present).result("cameras")
    assert (result.units, result.input_from_world[0, 0]) == ("mm", 2)
    assert [round(c.fx, 1) for c in result.cameras] == [998.4] * 3
    for camera, true in zip(result.cameras, truth, strict=True):
        assert np.linalg.norm(camera.centre - true.centre) < 3  # of some 120 mm to the teeth
    kept = swapped(tmp_path, model, present, lenses=False).result("cameras")
    assert [c.fx for c in kept.cameras] == [900.0] * 3
    alone = Cameras(present.cameras[:1])
    with pytest.raises(RequestError, match=r"swap\.cameras: only 1"):
        swapped(tmp_path, model, alone)


def test_swap_names_the_photographs_that_it_leaves_out(tmp_path, model):
    named = [replace(c, name=f"{k:03d}") for k, c in enumerate(true_cameras())]
    told = json.loads((SAMPLES / "transforms.json").read_text())
    gone = told["frames"].pop()["file_path"]
    (tmp_path / "transforms.json").write_text(json.dumps(told))
    context = swapped(tmp_path, tmp_path / "transforms.json", Cameras(tuple(named)))
    assert context.warnings == [f"The model has no camera of {gone}; left out."]
    assert context.figures == {"views_registered": 2, "views_total": 3}  # as the summary says it


def test_swap_says_that_it_leaves_distortion_in(tmp_path, model):
    named = [replace(c, name=f"{k:03d}") for k, c in enumerate(true_cameras())]
    told = json.loads((SAMPLES / "transforms.json").read_text()) | {"k1": -0.3}
    (tmp_path / "transforms.json").write_text(json.dumps(told))
    bent = swapped(tmp_path, tmp_path / "transforms.json", Cameras(tuple(named)))
    assert len(bent.warnings) == 1 and "by up to 9.8 pixels" in bent.warnings[0]
    assert swapped(tmp_path / "straight", model, Cameras(tuple(named))).warnings == []


def test_swap_says_that_a_models_cameras_are_far_from_those_found(tmp_path):
    """World-to-camera matrices of OpenCV where a transforms.json has the other way and OpenGL."""
    named = [replace(c, name=f"{k:03d}") for k, c in enumerate(true_cameras())]
    told = json.loads((SAMPLES / "transforms.json").read_text())
    for frame in told["frames"]:
        frame["transform_matrix"] = frame["w2c_opencv"]
    (tmp_path / "transforms.json").write_text(json.dumps(told))
    far = swapped(tmp_path, tmp_path / "transforms.json", Cameras(tuple(named)))
    assert len(far.warnings) == 1 and "used all the same" in far.warnings[0]


def test_swap_without_cameras_is_refused():
    with pytest.raises(RequestError, match=r"swap\.cameras=PATH"):
        SwapStage().sources(SwapConfig(), {})


def test_points_of_the_samples_are_dense_by_default(workspace):
    folder = next(workspace.glob("init/*/points"))
    assert len(Points.load(folder)) > 2000
