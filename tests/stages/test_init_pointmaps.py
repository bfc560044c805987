"""The stage with pointmaps made elsewhere, and how it is told which model to ask."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from pipeline.artifacts.cameras import Camera
from pipeline.artifacts.pointmaps import PointmapPair, write_pair
from pipeline.artifacts.views import View, Views
from pipeline.errors import RequestError
from pipeline.geometry.rigid import angle_between
from pipeline.stage import LocalContext
from stages.align.stage import AlignConfig, AlignStage
from stages.init.stage import InitConfig, InitStage

SAMPLES = Path(__file__).resolve().parents[2] / "data_samples" / "three_photos"
TRUTH = json.loads((SAMPLES / "transforms.json").read_text())


def sample():
    """The sample's photographs at half size, where its depth maps are, and the true cameras."""
    views, cameras, depths = [], [], []
    for number, frame in enumerate(TRUTH["frames"]):
        depth = cv2.imread(str(SAMPLES / frame["depth_file_path"]), cv2.IMREAD_UNCHANGED) / 200
        image = cv2.imread(str(SAMPLES / frame["file_path"]))[..., ::-1]
        height, width = depth.shape
        image = cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA) / np.float32(255)
        name = f"{number:03d}"
        views.append(View(name, image, source_name=Path(frame["file_path"]).name))
        focal = TRUTH["fl_x"] / 2
        pose = np.array(frame["w2c_opencv"])
        cameras.append(Camera(name, width, height, focal, focal, width / 2, height / 2, pose))
        depths.append(depth)
    return Views(tuple(views)), cameras, depths


def write_pointmaps(folder, views, cameras, depths, noise=0.01, outliers=0.05):
    """Each pair in its own scale, with noise and outliers, named by the photographs' files."""
    folder.mkdir()
    rng = np.random.default_rng(5)
    for i, j in ((0, 1), (1, 2), (0, 2)):
        scale = rng.uniform(0.5, 2)
        maps, confidences = [], []
        for k in (i, j):
            world = cameras[k].unproject(depths[k])
            local = world @ cameras[i].rotation.T + cameras[i].translation
            local = local * (1 + noise * rng.normal(size=(*local.shape[:2], 1)))
            local = scale * (local + 0.2 * noise * local[..., 2:] * rng.normal(size=local.shape))
            wild = rng.random(depths[k].shape) < outliers
            local[wild] *= rng.uniform(0.5, 2, (int(wild.sum()), 1))
            known = depths[k] > 0
            confidences.append(np.where(known, np.where(wild, 2, 8), 1).astype(np.float32))
            maps.append(np.where(known[..., None], local, np.nan).astype(np.float32))
        names = [Path(views.views[k].source_name).stem for k in (i, j)]
        pair = PointmapPair(*names, *maps, *confidences)
        write_pair(folder / f"{names[0]}_{names[1]}.npz", pair)


def test_pointmaps_from_files_become_cameras_that_align_improves(tmp_path):
    views, truth, depths = sample()
    write_pointmaps(tmp_path / "maps", views, truth, depths)
    config = InitConfig(method="files", pointmap={"files": str(tmp_path / "maps")})
    sources = InitStage().sources(config, {})
    assert len(sources) == 3 and all(str(tmp_path) not in label for label in sources)
    init = LocalContext(config, tmp_path / "init", {"views": views}, sources, threads=2)
    InitStage().run(init)
    cameras = init.result("cameras")
    assert cameras.provisional
    assert init.figures["views_registered"] == 3
    assert len(init.result("points")) > 10_000
    inputs = {"views": views, "pointmaps": init.result("pointmaps"), "cameras": cameras}
    align = LocalContext(AlignConfig(), tmp_path / "align", inputs, threads=2)
    AlignStage().run(align)
    aligned = align.result("cameras")
    assert not aligned.provisional
    for found in aligned.cameras:
        assert abs(found.fx / truth[0].fx - 1) < 0.01
    for i, j in ((0, 1), (1, 2)):
        ours = aligned.cameras[j].rotation @ aligned.cameras[i].rotation.T
        assert angle_between(ours, truth[j].rotation @ truth[i].rotation.T) < 0.5


def test_a_known_focal_length_is_held(tmp_path):
    views, truth, depths = sample()
    write_pointmaps(tmp_path / "maps", views, truth, depths)
    ratio = 1.01 * truth[0].fx / 256
    config = InitConfig(method="files", pointmap={"files": str(tmp_path / "maps")}, focal=ratio)
    init = LocalContext(config, tmp_path / "init", {"views": views}, threads=2)
    InitStage().run(init)
    inputs = {kind: init.result(kind) for kind in ("views", "pointmaps", "cameras")}
    align = LocalContext(AlignConfig(), tmp_path / "align", inputs, threads=2)
    AlignStage().run(align)
    for camera in align.result("cameras").cameras:
        assert camera.fx == pytest.approx(1.01 * truth[0].fx)


def test_paths_stay_out_of_the_result():
    from pipeline.config import result_fields

    one = InitConfig(method="files", pointmap={"files": "a", "max_memory_gb": 3})
    other = InitConfig(method="files", pointmap={"files": "b"}, cameras="c")
    assert result_fields(one) == result_fields(other)


def test_which_model_is_asked(monkeypatch, tmp_path):
    weights = tmp_path / "weights.pth"
    weights.write_bytes(b"x")
    config = InitConfig(pointmap={"checkpoint": str(weights)})
    monkeypatch.setattr("stages.pointmaps.predict.available", lambda: ["vggt", "dust3r"])
    with pytest.raises(RequestError, match=r"Several .*init\.method=vggt"):
        InitStage().sources(config, {})
    monkeypatch.setattr("stages.pointmaps.predict.available", lambda: ["dust3r"])
    assert InitStage().sources(config, {}) == {"checkpoint": weights}
    monkeypatch.setattr("stages.pointmaps.predict.available", list)
    assert InitStage().sources(config, {}) == {}
    with pytest.raises(RequestError, match="would not use it"):
        InitStage().sources(InitConfig(method="dust3r", cameras="x"), {})


def test_another_version_of_a_model_is_another_key(tmp_path, monkeypatch):
    package = tmp_path / "checkout" / "mast3r"
    package.mkdir(parents=True)
    (package / "model.py").write_text("layers = 1\n")
    config = InitConfig(method="mast3r", pointmap={"package_folder": str(tmp_path / "checkout")})
    before = InitStage().backend(config)
    assert before.startswith("mast3r (") and "torch" in before
    assert InitStage().backend(config) == before
    (package / "model.py").write_text("layers = 2\n")
    after = InitStage().backend(config)
    assert after != before
    monkeypatch.setattr("stages.pointmaps.predict.library_version", lambda name: "0.0")
    assert InitStage().backend(config) != after
    assert InitStage().backend(InitConfig()) == ""
    files = InitConfig(method="files", pointmap={"files": str(tmp_path)})
    assert InitStage().backend(files) == ""
