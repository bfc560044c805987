"""Global alignment and fusion of synthetic pointmaps with known cameras."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from pipeline.artifacts.cameras import Camera, Cameras
from pipeline.artifacts.confidence import FILLED
from pipeline.artifacts.pointmaps import PointmapPair, Pointmaps
from pipeline.artifacts.points import Points
from pipeline.artifacts.space.scale import Scale
from pipeline.artifacts.views import View, Views
from pipeline.errors import ReconstructionError, RequestError
from pipeline.geometry.depths import view_depths
from pipeline.geometry.start import start_from_cameras, start_from_tree
from pipeline.stage import LocalContext
from stages.align.fusion import FusionOptions, fuse
from stages.align.stage import AlignConfig, AlignStage, _fill_confidence
from tests.stages import dense_scene as _scene

ANGLES = (-24.0, -8.0, 6.0, 21.0)
SIZES = ((128, 96), (120, 96), (128, 96), (96, 80))

SCALE = Scale("mm", "length", 2.5)


@pytest.fixture(scope="module")
def world():
    cameras, images, depths, _ = _scene.scene(ANGLES, SIZES)
    return cameras, images, depths


def in_frame(view: Camera, depth: np.ndarray, frame: Camera) -> np.ndarray:
    points = view.unproject(depth) @ frame.rotation.T + frame.translation
    return points.astype(np.float32)


def pointmaps(world, noise: float, scales: bool = True) -> Pointmaps:
    """Neighbour pairs with noise, holes, confident-looking outliers, and a scale of their own."""
    cameras, _, depths = world
    rng = np.random.default_rng(5)
    pairs = []
    for k in range(len(cameras) - 1):
        scale = rng.uniform(0.5, 2.0) if scales else 1.0
        maps, trust = [], []
        for v in (k, k + 1):
            points = in_frame(cameras[v], depths[v], cameras[k])
            points = points * (1 + noise * rng.normal(size=(*depths[v].shape, 1)))
            confidence = rng.uniform(4, 12, depths[v].shape)
            if noise:
                wild = rng.random(depths[v].shape) < 0.03
                points[wild] *= rng.uniform(0.6, 1.6, (wild.sum(), 1))
                confidence[wild] = 2.0
                confidence[:12, :20] = 1.0
                points[:12, :20] = 77.0
            maps.append((scale * points).astype(np.float32))
            trust.append(confidence.astype(np.float32))
        pairs.append(PointmapPair(f"{k:03d}", f"{k + 1:03d}", *maps, *trust))
    return Pointmaps(pairs)


def views_of(world) -> Views:
    cameras, images, _ = world
    return Views(tuple(View(c.name, image) for c, image in zip(cameras, images, strict=True)))


def run(folder: Path, config: AlignConfig, threads: int = 2, **inputs) -> LocalContext:
    context = LocalContext(config, folder, inputs, threads=threads)
    AlignStage().run(context)
    return context


def pose_errors(found: tuple[Camera, ...], truth: list[Camera]) -> tuple[float, float, float]:
    """Largest errors after alignment: rotation in degrees, centre and focal length relative."""
    turn, _ = Rotation.align_vectors(
        np.concatenate([c.rotation for c in truth]), np.concatenate([c.rotation for c in found])
    )
    matrix = turn.as_matrix()
    rotation = max(
        np.degrees(Rotation.from_matrix(f.rotation @ matrix.T @ t.rotation.T).magnitude())
        for f, t in zip(found, truth, strict=True)
    )
    a = np.array([matrix @ c.centre for c in found])
    b = np.array([c.centre for c in truth])
    a, b = a - a.mean(0), b - b.mean(0)
    scale = (a * b).sum() / (a * a).sum()
    centre = np.linalg.norm(scale * a - b, axis=1).max() / np.ptp(b, axis=0).max()
    focal = max(abs(f.fx / t.fx - 1) for f, t in zip(found, truth, strict=True))
    return float(rotation), float(centre), float(focal)


def test_exact_pointmaps_give_the_exact_cameras(world):
    start = start_from_tree(list(pointmaps(world, 0.0)))
    found = tuple(start.cameras[name] for name in sorted(start.cameras))
    rotation, centre, focal = pose_errors(found, world[0])
    assert rotation < 0.01
    assert centre < 1e-3
    assert focal < 1e-4


def test_cameras_from_noisy_pointmaps_with_holes_and_outliers(world, tmp_path):
    pairs = pointmaps(world, 0.004)
    context = run(
        tmp_path, AlignConfig(samples=1000, iterations=150), views=views_of(world), pointmaps=pairs
    )
    cameras = context.result("cameras")
    rotation, centre, focal = pose_errors(cameras.cameras, world[0])
    assert rotation < 0.3
    assert centre < 0.01
    assert focal < 0.01
    points: Points = context.result("points")
    assert abs(np.median(points.positions, axis=0)).max() < 0.01
    assert np.mean([c.rotation[1, 1] for c in cameras.cameras]) > 0.99  # y down
    depth = cameras.cameras[0].project(points.positions)[1]
    assert 0.9 < np.median(depth) < 1.1
    assert context.figures["views_registered"] == 4
    assert context.figures["points"] == len(points)
    assert not context.warnings


def test_optimisation_improves_a_disturbed_start(world):
    from stages.align.optimise import AlignOptions, optimise

    pairs = list(pointmaps(world, 0.002))
    start = start_from_tree(pairs)
    rng = np.random.default_rng(1)
    moved = {}
    for name, view in start.cameras.items():
        pose = view.cam_from_world.copy()
        pose[:3, :3] = Rotation.from_rotvec(rng.normal(0, 0.02, 3)).as_matrix() @ pose[:3, :3]
        moved[name] = replace(view, cam_from_world=pose, fx=view.fx * 1.03, fy=view.fy * 1.03)
    disturbed = replace(start, cameras=moved)
    before = pose_errors(tuple(moved[n] for n in sorted(moved)), world[0])
    better, residual = optimise(pairs, disturbed, AlignOptions(iterations=200, samples=600))
    after = pose_errors(tuple(better.cameras[n] for n in sorted(moved)), world[0])
    assert after[0] < 0.3 * before[0]
    assert after[2] < 0.5 * before[2]
    assert residual < 0.02
    again, _ = optimise(pairs, disturbed, AlignOptions(iterations=200, samples=600))
    for name in moved:
        assert np.array_equal(
            again.cameras[name].cam_from_world, better.cameras[name].cam_from_world
        )


def test_known_cameras_stay_and_pair_scales_are_found(world, tmp_path):
    mouth = np.diag([-1.0, 1, -1, 1])
    truth = Cameras(tuple(world[0]), np.diag([3.0, 3.0, 3.0, 1.0]), SCALE, True, mouth)
    pairs = pointmaps(world, 0.0)
    start = start_from_cameras(list(pairs), truth.by_name())
    rng = np.random.default_rng(5)
    first = start.pair_from[0]
    assert first is not None
    assert first[0] == pytest.approx(1 / rng.uniform(0.5, 2.0), rel=1e-3)
    context = run(tmp_path, AlignConfig(), views=views_of(world), pointmaps=pairs, cameras=truth)
    kept = context.result("cameras")
    for found, given in zip(kept.cameras, truth.cameras, strict=True):
        np.testing.assert_allclose(found.cam_from_world, given.cam_from_world, atol=1e-9)
    assert kept.scale == SCALE and kept.given
    np.testing.assert_array_equal(kept.mouth_from_world, mouth)
    np.testing.assert_array_equal(kept.input_from_world, truth.input_from_world)
    surface = np.concatenate(
        [c.unproject(z).reshape(-1, 3) for c, z in zip(world[0], world[2], strict=True)]
    )
    points: Points = context.result("points")
    assert np.percentile(cKDTree(surface).query(points.positions)[0], 99) < 0.03
    towards = np.stack([c.centre for c in world[0]]).mean(0) - points.positions
    assert ((points.normals * towards).sum(1) > 0).mean() > 0.93
    np.testing.assert_allclose(np.linalg.norm(points.normals, axis=1), 1, atol=1e-4)


def test_a_surface_seen_by_all_views_is_there_once(world, tmp_path):
    truth = Cameras(tuple(world[0]))
    given = {"views": views_of(world), "pointmaps": pointmaps(world, 0.0), "cameras": truth}
    once = run(tmp_path / "a", AlignConfig(), **given).result("points")
    all_of_it = run(tmp_path / "b", AlignConfig(merge=False), **given).result("points")
    assert len(all_of_it) > 0.95 * sum(z.size for z in world[2])
    assert len(once) < 0.6 * len(all_of_it)
    # Nothing is lost: what was dropped has a neighbour that was kept.
    distance = cKDTree(once.positions).query(all_of_it.positions)[0]
    assert np.percentile(distance, 98) < 0.06


def test_any_thread_count_gives_the_same_bytes(world, tmp_path):
    given = {"views": views_of(world), "pointmaps": pointmaps(world, 0.004)}
    config = AlignConfig(iterations=20, samples=400)
    run(tmp_path / "a", config, threads=1, **given)
    run(tmp_path / "b", config, threads=2, **given)
    files = sorted(path.relative_to(tmp_path / "a") for path in (tmp_path / "a").rglob("*.*"))
    assert len(files) >= 4
    for name in files:
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes()


def test_the_same_depth_in_two_pairs_counts_once(world):
    pairs = list(pointmaps(world, 0.0, scales=False))[:2]
    start = start_from_cameras(pairs, {c.name: c for c in world[0]})
    merged = view_depths(pairs, start)
    np.testing.assert_allclose(merged["001"].depth, world[2][1], rtol=1e-4)
    larger = np.maximum(pairs[0].confidence_j, pairs[1].confidence_i)
    np.testing.assert_allclose(merged["001"].confidence, larger, rtol=1e-5)


def test_floaters_are_refuted_and_fill_yields_to_measurements(world):
    cameras, images, depths = world
    trust = [np.full(z.shape, 5.0, np.float32) for z in depths]
    spoiled = [z.copy() for z in depths]
    spoiled[1][40:50, 50:60] *= 0.7  # stands before what the others see
    trust[1][60:70, 40:60] = 1.1  # a guess where others have measured
    spoiled[1][60:70, 40:60] *= 0.99
    cloud = fuse(spoiled, trust, images, cameras, FusionOptions(), 2)
    surface = np.concatenate(
        [c.unproject(z).reshape(-1, 3) for c, z in zip(cameras, depths, strict=True)]
    )
    distance = cKDTree(surface).query(cloud.positions)[0]
    assert distance.max() < 0.15
    assert cloud.fill == 0
    alone = fuse([spoiled[1]], [trust[1]], images[1:2], cameras[1:2], FusionOptions(), 1)
    assert alone.fill == len(range(61, 70, 3)) * len(range(40, 60, 3))


def test_of_few_views_no_more_are_asked_to_agree_than_there_are(world):
    cameras, images, depths = (part[:3] for part in world)
    trust = [np.full(z.shape, 5.0, np.float32) for z in depths]
    every, more = (
        fuse(depths, trust, images, cameras, FusionOptions(min_agreeing=number), 1)
        for number in (2, 100)
    )
    assert len(every) == len(more) > 0


def test_a_view_that_sees_through_counts_as_much_as_one_that_agrees(world):
    cameras, images, depths = (part[:3] for part in world)
    trust = [np.full(z.shape, 5.0, np.float32) for z in depths]
    spoiled = [z.copy() for z in depths]
    patch = np.zeros(depths[0].shape, bool)
    patch[40:60, 45:65] = True
    spoiled[0][patch] *= 0.9
    false = cameras[0].unproject(spoiled[0])[patch]
    pixels, z = cameras[1].project(false.reshape(-1, 3))
    columns, rows = np.floor(pixels).astype(int).T
    spoiled[1][rows, columns] = z  # the second view agrees, the third sees what is behind
    cloud = fuse(spoiled, trust, images, cameras, FusionOptions(), 2)
    distance = cKDTree(false.reshape(-1, 3)).query(cloud.positions)[0]
    believed = fuse(spoiled[:2], trust[:2], images[:2], cameras[:2], FusionOptions(), 2)
    assert (cKDTree(false.reshape(-1, 3)).query(believed.positions)[0] < 0.02).sum() > 200
    assert (distance < 0.02).sum() < 40


def turned(cameras: list[Camera], factor: float) -> list[Camera]:
    """Cameras about the vertical axis, so much further around it."""
    ahead = np.array([camera.rotation[2] for camera in cameras])
    angles = np.arctan2(ahead[:, 0], ahead[:, 2]) * (factor - 1)
    moved = []
    for camera, angle in zip(cameras, angles, strict=True):
        pose = camera.cam_from_world.copy()
        pose[:3, :3] = pose[:3, :3] @ Rotation.from_euler("y", angle).as_matrix().T
        moved.append(replace(camera, cam_from_world=pose))
    return moved


@pytest.mark.parametrize(
    ("count", "factor", "provisional", "setting", "expected"),
    [
        (4, 1.0, False, "auto", 1.0),
        (5, 1.0, False, "auto", 1.0),
        (6, 1.0, False, "auto", FILLED),
        (4, 3.0, False, "auto", FILLED),
        (4, 1.0, True, "auto", FILLED),
        (4, 1.0, False, 1.4, 1.4),
    ],
    ids=["near", "five", "six", "wide", "provisional", "set"],
)
def test_what_is_completed_counts_in_full_between_few_near_photographs(
    world, count, factor, provisional, setting, expected
):
    cameras = turned((world[0] * 2)[:count], factor)
    if count > 4:  # no two in the same place
        cameras[4:] = turned(cameras[4:], 0.5)
    given = Cameras(tuple(cameras), provisional=provisional, mouth_from_world=np.eye(4))
    config = AlignConfig(fill_confidence=setting)
    assert _fill_confidence(config, given, cameras) == expected
    for other in (None, replace(given, mouth_from_world=None)):
        assert _fill_confidence(config, other, cameras) == (1.4 if setting == 1.4 else FILLED)


def test_highlights_do_not_colour_the_cloud(world):
    cameras, images, depths = world
    shiny = [image.copy() for image in images]
    shiny[1][30:60, 40:80] = 1.0
    trust = [np.full(z.shape, 5.0, np.float32) for z in depths]
    trust[1] += 1  # the shiny view is the most trusted: its pixels are the ones that stay
    cloud = fuse(depths, trust, shiny, cameras, FusionOptions(), 2)
    pixels, _ = cameras[1].project(cloud.positions)
    inside = (np.abs(pixels - (60, 45)) < (15, 10)).all(1)
    assert inside.sum() > 300
    truth = _scene.texture(cloud.positions[inside].astype(np.float64))
    off = np.abs(cloud.colors[inside] - truth).max(1)
    assert (off < 0.1).mean() > 0.95


def test_views_without_a_pair_are_left_out_and_named(world, tmp_path):
    pairs = Pointmaps(list(pointmaps(world, 0.0))[:2])
    context = run(tmp_path, AlignConfig(iterations=5), views=views_of(world), pointmaps=pairs)
    assert [c.name for c in context.result("cameras").cameras] == ["000", "001", "002"]
    assert "no pointmap ties them to the others: 003." in context.warnings[0]
    known = Cameras(tuple(world[0][:3]))  # why one has none an earlier stage has said
    everything = Pointmaps(list(pointmaps(world, 0.0)))
    inputs = {"views": views_of(world), "pointmaps": everything, "cameras": known}
    context = run(tmp_path / "known", AlignConfig(iterations=5), **inputs)
    assert len(context.result("cameras")) == 3 and context.warnings == []


def test_masked_pixels_give_no_points(world, tmp_path):
    cameras, images, _ = world
    mask = np.zeros(images[0].shape[:2], bool)
    mask[:, 60:] = True
    views = Views((View("000", images[0], mask), View("001", images[1], images[1][..., 0] < 0)))
    pairs = Pointmaps(list(pointmaps(world, 0.0, scales=False))[:1])
    context = run(
        tmp_path, AlignConfig(), views=views, pointmaps=pairs, cameras=Cameras(tuple(cameras[:2]))
    )
    pixels, _ = cameras[0].project(context.result("points").positions)
    assert len(pixels) == mask.sum()
    assert pixels[:, 0].min() > 59.9


@pytest.mark.parametrize("asked", [{}, {"refine": "always"}, {"matches": "always"}])
def test_points_that_come_without_pointmaps_stay_as_they_are(world, tmp_path, asked):
    cameras = Cameras(tuple(world[0]))
    place = np.random.default_rng(0).normal(size=(50, 3)).astype(np.float32)
    unit = place / np.linalg.norm(place, axis=1, keepdims=True)
    points = Points(
        place, np.full((50, 3), 0.4, np.float32), unit,
        np.full(50, 1.2, np.float32), np.full(50, 0.1, np.float32),
    )  # fmt: skip
    context = run(
        tmp_path, AlignConfig(**asked), views=views_of(world),
        pointmaps=Pointmaps([]), cameras=cameras, points=points,
    )  # fmt: skip
    for name in ("positions", "colors", "normals", "confidence", "scale"):
        np.testing.assert_array_equal(
            getattr(context.result("points"), name), getattr(points, name)
        )
    assert [c.name for c in context.result("cameras").cameras] == [c.name for c in world[0]]
    assert [text.partition("=")[0] for text in context.warnings] == [f"align.{k}" for k in asked]


def test_nothing_to_align_is_a_diagnosis(world, tmp_path):
    with pytest.raises(ReconstructionError, match="overlap"):
        run(tmp_path, AlignConfig(), views=views_of(world), pointmaps=Pointmaps([]))
    first = next(iter(pointmaps(world, 0.0)))
    nothing = replace(
        first,
        confidence_i=np.ones_like(first.confidence_i),
        confidence_j=np.ones_like(first.confidence_j),
    )
    with pytest.raises(ReconstructionError, match="overlap"):
        run(tmp_path, AlignConfig(), views=views_of(world), pointmaps=Pointmaps([nothing]))


def test_pointmaps_of_another_size_are_refused(world, tmp_path):
    first = next(iter(pointmaps(world, 0.0)))
    small = replace(first, points_i=first.points_i[:-1], confidence_i=first.confidence_i[:-1])
    with pytest.raises(RequestError, match="128x95"):
        run(tmp_path, AlignConfig(), views=views_of(world), pointmaps=Pointmaps([small]))
