"""Parts of the comparison with COLMAP: models, databases, runs, poses, clouds."""

import sqlite3
import tempfile
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import open3d
import pytest

from pipeline.artifacts.teeth import Teeth
from pipeline.artifacts.views import View
from pipeline.errors import RequestError
from pipeline.geometry.models.model_points import as_points, read_model_points
from pipeline.store import Store
from pipeline.studies.compare import clouds, colmap_run, evidence, poses
from pipeline.studies.compare.colmap_run import (
    SETTINGS,
    Job,
    as_stored,
    run_job,
    run_on_views,
    thresholds,
)
from pipeline.studies.compare.compare import _entries_of
from pipeline.studies.compare.fits import fit_rows
from pipeline.studies.compare.models import read_largest
from pipeline.studies.compare.tables import tables_of
from stages.views.orientation import make_upright, upright_from_stored
from tests.studies import report_case as case
from tests.studies.comparison_scene import TRUTH, moved, true_cameras, true_points, write_model

IDENTITY = (1.0, np.eye(3), np.zeros(3))


def views_of(names):
    image = np.zeros((TRUTH["h"], TRUTH["w"], 3), np.float32)
    return [
        View(f"{k:03d}", image, source_name=name, source_size=(TRUTH["w"], TRUTH["h"]))
        for k, name in enumerate(names)
    ]


NAMES = [camera.name for camera in true_cameras()]


def test_all_stages_before_a_row_count_in_its_seconds(tmp_path):
    """The teeth's did not, which `init` waits for."""
    store = Store(case.write_case(tmp_path / "w", ("views", "init")))
    assert [entry.row["seconds"] for entry in _entries_of(store)] == [3.0]
    case.write_result(tmp_path / "w", "teeth", [Teeth(())])
    assert [entry.row["seconds"] for entry in _entries_of(store)] == [4.5]


def test_what_belongs_to_another_run_or_failed_has_no_cameras(tmp_path):
    """After `views` and `init` with other settings the rest stood beside them as if it were of one
    run, and a stage that had failed bore the cameras of the one before."""
    home = case.write_case(tmp_path / "w", ("views", "init"))
    before = {"cameras": {"stage": "init", "content": "of an earlier run"}}
    case.write_result(home, "align", [case.cameras(1.0), case.points(50)], inputs=before)
    store = Store(home)
    store.failures.record("fit", "0" * 64, "no such luck")
    rows = {entry.name: entry for entry in _entries_of(store)}
    assert len(rows["init (ours)"].cameras) == 3
    assert "another result of 'init'" in rows["align (ours)"].row["failure"]
    assert rows["fit (ours)"].row["failure"] == "no such luck"
    for name in ("align (ours)", "fit (ours)"):
        assert not rows[name].cameras and not rows[name].borrowed
    case.write_result(home, "fit", [case.cameras(1.0)], inputs=before)
    fits = fit_rows(
        home, tmp_path / "f", None, "none", truth=None, mesh=None, threads=1, reporter=None,
        message=print,
    )  # fmt: skip
    assert "has no fit" in fits[0]["failure"]


@pytest.mark.parametrize("orientation", range(1, 9))
def test_images_for_colmap_are_turned_back_to_how_they_are_stored(orientation):
    stored = np.random.default_rng(0).integers(0, 255, (4, 6, 3)).astype(np.uint8)
    linear = upright_from_stored(orientation, 6, 4)[:2, :2]
    assert np.array_equal(as_stored(make_upright(stored, orientation), linear), stored)


def test_the_largest_of_several_models_is_read(tmp_path):
    cameras, points = true_cameras(), true_points()
    write_model(tmp_path / "sparse" / "0", cameras[:2], points)
    write_model(tmp_path / "sparse" / "1", cameras, points)
    model = read_largest(tmp_path, views_of(NAMES))
    assert model.folder.name == "1" and model.sizes == (3, 2)
    assert list(model.cameras) == ["000", "001", "002"]
    assert np.allclose(model.cameras["001"].cam_from_world, cameras[1].cam_from_world)
    assert model.points.track_lengths().min() >= 2
    assert np.allclose(model.points.colors, np.array([200, 100, 50]) / 255)


def test_a_text_model_of_an_old_colmap_is_read(tmp_path):
    """Before version 3.12 there were no rigs and frames."""
    (tmp_path / "cameras.txt").write_text("1 SIMPLE_PINHOLE 512 384 998.4 256 192\n")
    (tmp_path / "images.txt").write_text(
        f"1 1 0 0 0 0 0 5 1 {NAMES[0]}\n10 20 1 30 40 -1\n2 1 0 0 0 -1 0 5 1 {NAMES[1]}\n10 20 1\n"
    )
    (tmp_path / "points3D.txt").write_text("1 0.5 0.25 3 255 0 51 0.7 1 0 2 0\n")
    model = read_largest(tmp_path, views_of(NAMES))
    assert set(model.cameras) == {"000", "001"}
    assert np.allclose(model.cameras["001"].centre, [1, 0, -5])
    assert np.allclose(model.points.positions, [[0.5, 0.25, 3]])
    assert np.allclose(model.points.colors, [[1, 0, 0.2]])
    seen = evidence.mapped_keypoints(tmp_path)
    assert seen[NAMES[0]].tolist() == [True, False]


def test_a_folder_without_a_model_is_refused(tmp_path):
    with pytest.raises(RequestError, match=r"--colmap.*holds no COLMAP model"):
        read_largest(tmp_path, views_of(NAMES))


@pytest.mark.parametrize("name", ["cameras", "images", "points3D"])
def test_a_model_that_is_cut_off_is_refused(tmp_path, name):
    write_model(tmp_path / "m", true_cameras(), true_points(12))
    assert len(read_largest(tmp_path / "m", views_of(NAMES)).cameras) == 3
    path = tmp_path / "m" / f"{name}.bin"
    path.write_bytes(path.read_bytes()[:-5])
    with pytest.raises(RequestError, match=rf"can't be read.*{name}.bin is cut off"):
        read_largest(tmp_path / "m", views_of(NAMES))


def test_model_points_become_a_cloud_to_start_from(tmp_path):
    cameras = true_cameras()
    sparse = read_model_points(write_model(tmp_path / "m", cameras, true_points()))
    by_name = {camera.name: camera for camera in cameras}
    cloud = as_points(sparse.positions, sparse.colors, sparse.observed, by_name)
    assert set(np.unique(cloud.confidence)) <= {2.0, 3.0} and cloud.confidence.max() == 3
    assert np.allclose(np.linalg.norm(cloud.normals, axis=1), 1, atol=1e-5)
    towards = cameras[1].centre - cloud.positions
    assert ((cloud.normals * towards).sum(1) > 0).all()
    gaps = np.linalg.norm(cloud.positions[:, None] - cloud.positions[None], axis=-1)
    assert np.allclose(cloud.scale, np.sort(gaps, 1)[:, 1:4].mean(1), rtol=1e-3)


def database(path, keypoints, pairs):
    """A COLMAP database of version 3.8, with one lens of 800 pixels for all images."""
    base = sqlite3.connect(path)
    base.executescript(
        "CREATE TABLE cameras (camera_id, model, width, height, params, prior_focal_length);"
        "CREATE TABLE images (image_id, name, camera_id);"
        "CREATE TABLE keypoints (image_id, rows, cols, data);"
        "CREATE TABLE two_view_geometries (pair_id, rows, cols, data, config);"
    )
    parameters = np.array([800, 512, 384], np.float64).tobytes()
    base.execute("INSERT INTO cameras VALUES (1, 0, 1024, 768, ?, 0)", (parameters,))
    for number, points in enumerate(keypoints, 1):
        base.execute("INSERT INTO images VALUES (?, ?, 1)", (number, f"{number}.jpg"))
        data = np.asarray(points, np.float32)
        base.execute(
            "INSERT INTO keypoints VALUES (?, ?, 2, ?)", (number, len(data), data.tobytes())
        )
    for (a, b), matches in pairs.items():
        data = np.asarray(matches, np.uint32).reshape(-1, 2)
        base.execute(
            "INSERT INTO two_view_geometries VALUES (?, ?, 2, ?, 2)",
            (a * evidence.PAIR_BASE + b, len(data), data.tobytes()),
        )
    base.commit()
    base.close()


def test_the_reason_for_no_model_names_the_best_pair(tmp_path):
    random = np.random.default_rng(0)
    points = random.uniform([-2, -2, 8], [2, 2, 12], (60, 3))
    angle = 2 * np.arctan(1 / 10)  # two cameras 2 apart, points about 10 away
    keypoints = [
        (points - [shift, 0, 0])[:, :2] / points[:, 2:] * 800 + [512, 384] for shift in (-1, 1)
    ]
    every = np.stack([np.arange(60)] * 2, 1)
    database(tmp_path / "d.db", [*keypoints, keypoints[0]], {(1, 2): every, (1, 3): every[:20]})
    known = evidence.read_evidence(tmp_path / "d.db")
    assert evidence.triangulation_angle(known, ("1.jpg", "2.jpg")) == pytest.approx(
        np.degrees(angle), rel=0.1
    )
    table = evidence.pair_table(known)
    assert table[0] == {"images": ["1.jpg", "2.jpg"], "inliers": 60}
    text = evidence.why_no_model(known, thresholds(SETTINGS["defaults"]))
    assert "1.jpg and 2.jpg, has 60" in text and "asking for 100 and 16" in text
    assert evidence.why_no_model(
        known, thresholds({}), "x] Discarding reconstruction due to y\n" * 2
    )[:50].startswith("models begun and discarded: y (2x)")
    mapped = {"1.jpg": np.arange(60) < 15, "2.jpg": np.ones(60, bool)}
    text = evidence.why_left_out(known, mapped, 30)
    assert text == (
        "3.jpg sees 15 of the model's points by 20 verified matches (COLMAP asks for 30 points)"
    )


def test_a_database_is_read_without_a_copy_in_the_temporary_folder(tmp_path, monkeypatch):
    """It names photographs, and a killed comparison would leave it there."""
    database(tmp_path / "d.db", [np.zeros((3, 2))] * 2, {})
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "none"))
    assert evidence.read_evidence(tmp_path / "d.db").keypoints.keys() == {"1.jpg", "2.jpg"}


def test_colmap_on_images_without_texture_says_why(tmp_path):
    views = views_of(NAMES[:2])
    said = []
    done = run_on_views(
        tmp_path / "colmap_defaults", views, {}, seed=0, threads=1, message=said.append
    )
    assert done["models"] == 0 and done["failure"] is None and len(said) == 1
    known = evidence.read_evidence(tmp_path / "colmap_defaults" / "database.db")
    assert "no two images have verified matches" in evidence.why_no_model(known, thresholds({}))
    again = run_on_views(
        tmp_path / "colmap_defaults", views, {}, seed=0, threads=2, message=said.append
    )
    assert again == done and len(said) == 1


def test_a_crash_of_colmap_is_told(tmp_path):
    (tmp_path / "images").mkdir()
    done = run_job(tmp_path, Job({"mapping": {"no_such_option.x": 1}}))
    assert done["models"] == 0 and "ended with status" in done["failure"]


def test_what_ended_early_is_run_again(tmp_path, monkeypatch):
    failures = iter(["COLMAP ended with status -9", None])

    def fake(folder, job):
        (folder / "sparse").mkdir()
        return {"models": 0, "seconds": 1.0, "failure": next(failures)}

    monkeypatch.setattr(colmap_run, "run_job", fake)
    for failure in ("COLMAP ended with status -9", None, None):
        done = run_on_views(
            tmp_path / "colmap", views_of(["a.png"]), {}, seed=0, threads=1, message=print
        )
        assert done["failure"] == failure


def test_known_focal_lengths_and_masks_reach_colmap(tmp_path):
    (tmp_path / "images").mkdir()
    (tmp_path / "masks").mkdir()
    picture = cv2.imread(str(Path(__file__).parents[2] / "data_samples/three_photos/frontal.jpg"))
    mask = np.zeros(picture.shape[:2], np.uint8)
    mask[:, :256] = 255
    for name in ("a.png", "b.png"):
        cv2.imwrite(str(tmp_path / "images" / name), picture)
        cv2.imwrite(str(tmp_path / "masks" / f"{name}.png"), mask)
    run_job(tmp_path, Job(focals={"a.png": 777.0}, masked=True))
    known = evidence.read_evidence(tmp_path / "database.db")
    assert known.lenses["b.png"].focal_length == pytest.approx(777)
    assert len(known.keypoints["a.png"]) and known.keypoints["a.png"][:, 0].max() <= 257


def test_pose_errors_are_those_put_in():
    truth = {camera.name: camera for camera in true_cameras()}
    found = {
        name: moved(camera, 1.0 if name == NAMES[0] else 0.0) for name, camera in truth.items()
    }
    points = true_points()
    distance = poses.scene_distance(found, 2 * points)
    assert distance == pytest.approx(2 * poses.scene_distance(truth, points), rel=0.05)
    figures = poses.score(found, truth, distance, "mm")
    assert figures["relative_rotation_deg"]["max"] == pytest.approx(1, abs=1e-6)
    assert figures["rotation_deg"]["max"] == pytest.approx(1, abs=0.4)
    assert figures["focal_percent"] == pytest.approx(0)
    assert poses.score({}, truth, 1.0, "mm") == {}


def sphere_surface(tmp_path):
    mesh = open3d.geometry.TriangleMesh.create_sphere(10, 40)
    open3d.io.write_triangle_mesh(str(tmp_path / "sphere.ply"), mesh)
    look = []
    for side in (-15, 0, 15):
        pose = np.eye(4)
        pose[:3, 3] = [side, 0, 60]
        camera = true_cameras()[0]
        look.append(moved(camera, 0))
        object.__setattr__(look[-1], "cam_from_world", pose)
        object.__setattr__(look[-1], "fx", 500.0)
        object.__setattr__(look[-1], "fy", 500.0)
    return clouds.read_surface(tmp_path / "sphere.ply", look)


def test_accuracy_and_completeness_on_a_mesh(tmp_path):
    surface = sphere_surface(tmp_path)
    random = np.random.default_rng(0)
    whole = random.normal(size=(20_000, 3))
    whole *= 10 / np.linalg.norm(whole, axis=1, keepdims=True)
    front = whole[whole[:, 2] < -5]
    noisy = front * (1 + 0.02 * random.choice([-1, 1], (len(front), 1)))  # .2 off, in or out
    elsewhere = random.uniform(-40, 40, (2000, 3)) + np.array(
        [0, 60, 0]
    )  # what the mesh doesn't have
    cloud = np.concatenate([noisy, elsewhere])
    motion = (0.5, np.eye(3), np.array([1.0, 2, 3]))
    local = (cloud - motion[2]) / motion[0]
    figures = clouds.against_surface(local, motion, surface)
    assert figures["points_on_mesh"] == pytest.approx(len(noisy), rel=0.02)
    assert figures["accuracy"]["median"] == pytest.approx(0.2, rel=0.15)
    assert figures["completeness"]["median"] < 0.6
    half = clouds.against_surface(local[cloud[:, 0] < 0], motion, surface)
    assert half["covered_percent"] < 0.7 * figures["covered_percent"]
    assert clouds.against_surface(local[:5], motion, surface) == {"points_on_mesh": 5}


def test_a_mesh_that_cant_be_used_is_refused(tmp_path):
    with pytest.raises(RequestError, match="Give a triangle mesh"):
        clouds.read_surface(tmp_path / "none.ply", [])
    mesh = open3d.geometry.TriangleMesh.create_sphere(1)
    mesh.translate([1000, 0, 0])
    open3d.io.write_triangle_mesh(str(tmp_path / "far.ply"), mesh)
    with pytest.raises(RequestError, match="seen by two"):
        clouds.read_surface(tmp_path / "far.ply", true_cameras())


def test_distances_between_clouds():
    grid = np.stack(np.meshgrid(*[np.arange(10.0)] * 3), -1).reshape(-1, 3)
    figures = clouds.against_cloud(grid[:500] + np.array([0, 0, 0.25]), IDENTITY, grid, 10.0)
    assert figures["to_other_percent"]["median"] == pytest.approx(2.5)
    assert figures["from_other_percent"]["mean"] > 10
    point = grid[:1]  # a model of one point has no extent; JSON has no infinite figures
    assert clouds.against_cloud(grid, IDENTITY, point, clouds.robust_extent(point)) == {}


def test_points_without_anything_to_measure_them_by_are_counted():
    row = {"name": "sap (ours)", "points": 4711}
    figures = {
        "reference": "ground truth", "reference_views": 3, "views": NAMES, "units": "mm",
        "cameras": [], "points": [row],
    }  # fmt: skip
    (table,) = tables_of(figures)
    assert table.rows == [["sap (ours)", "4,711"]]
    assert "nearest" not in table.explanation


def test_which_of_several_models_the_points_are_of_is_said():
    near = {"to_other_percent": {"median": 1, "p90": 2}}
    rows = [
        {"name": "sap (ours)", "points": 4711, "cloud": near},
        {"name": "COLMAP, defaults", "points": 8, "model": "1"},
    ]
    figures = {
        "reference": None, "reference_views": 0, "views": NAMES, "units": "mm", "cameras": [],
        "points": rows, "points_to": "COLMAP, defaults",
    }  # fmt: skip
    (table,) = tables_of(figures)
    assert "COLMAP's points (COLMAP, defaults)" in table.explanation
    assert table.notes == [
        ("COLMAP, defaults", "of its models the points are those of number 1, the largest")
    ]


def test_numbered_photographs_are_not_taken_for_numbered_views(tmp_path, monkeypatch):
    """Views 000, 001, 002 of photographs 001, 002, 000: only the right cameras may match."""
    cameras = true_cameras()
    names = ["001.png", "002.png", "000.png"]

    def fake(folder, job):
        written = [replace(c, name=f"{k:03d}.png") for k, c in enumerate(cameras)]
        write_model(folder / "sparse" / "0", written, true_points(12))
        return {"models": 1, "seconds": 0.0, "failure": None}

    monkeypatch.setattr(colmap_run, "run_job", fake)
    folder = tmp_path / "colmap_defaults"
    run_on_views(folder, views_of(names), {}, seed=0, threads=1, message=print)
    model = read_largest(folder, views_of(names))
    for name, camera in zip(["000", "001", "002"], cameras, strict=True):
        assert np.allclose(model.cameras[name].cam_from_world, camera.cam_from_world)
