"""Distances to a mesh, support by input views, perceptual metrics: cases with known answers."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from pipeline.artifacts.cameras import Camera
from pipeline.errors import RequestError
from pipeline.geometry.mesh import Mesh
from pipeline.geometry.rigid import exponential
from stages.evaluate.geometry import geometry_figures
from stages.evaluate.held_out import register
from stages.evaluate.images.flip import flip_map
from stages.evaluate.images.perceptual import VGG_BLOCKS, Lpips, find_vgg_weights
from stages.evaluate.support import TINT, beyond, overlay, support_map, unsupported_share
from stages.evaluate.surface import f_score, icp, nearest_distances, surface_figures, thinned
from stages.splatting.support import SeenSurface, seen_surface, supporting_views

SQUARE = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], float)
TWO = np.array([[0, 1, 2], [0, 2, 3]])


def box() -> Mesh:
    import open3d as o3d

    made = o3d.geometry.TriangleMesh.create_box(2.0, 3.0, 1.0)
    return Mesh(np.asarray(made.vertices), np.asarray(made.triangles))


def camera(name: str = "000", x: float = 0.0, z: float = -4.0) -> Camera:
    """Looks along +z."""
    pose = np.eye(4)
    pose[:3, 3] = -np.array([x, 0, z])
    return Camera(name, 40, 30, 40.0, 40.0, 20.0, 15.0, pose)


def test_distances_agree_with_open3d() -> None:
    import open3d as o3d

    random = np.random.default_rng(0)
    points = random.uniform(-1, 4, (300, 3))
    others = random.uniform(-1, 4, (400, 3))
    clouds = [o3d.geometry.PointCloud(o3d.utility.Vector3dVector(p)) for p in (points, others)]
    expected = np.asarray(clouds[0].compute_point_cloud_distance(clouds[1]))
    np.testing.assert_allclose(nearest_distances(points, others), expected, atol=1e-4)
    mesh = box()
    made = o3d.geometry.TriangleMesh.create_box(2.0, 3.0, 1.0)
    dense = made.sample_points_uniformly(400_000, use_triangle_normal=False)
    to_cloud = np.asarray(clouds[0].compute_point_cloud_distance(dense))
    ours = mesh.distances(points)
    assert (ours <= to_cloud + 1e-4).all()  # samples are never nearer than the surface
    assert np.abs(ours - to_cloud).max() < 0.02
    far = Mesh(mesh.vertices + 1000, np.asarray(made.triangles))  # single precision, far out
    np.testing.assert_allclose(far.distances(points + 1000), ours, atol=1e-4)


def test_distances_of_a_box_by_hand() -> None:
    points = np.array([[1, 1, 3.0], [1, 1, 0.4], [-3, 1.0, 0.5], [3, 4, 0.5]])
    np.testing.assert_allclose(box().distances(points), [2, 0.4, 3, np.sqrt(2)], atol=1e-6)


def test_depth_of_a_mesh_is_z() -> None:
    depth = Mesh(SQUARE, TWO).depth(camera())
    v, u = np.mgrid[:30, :40] + 0.5
    inside = (np.abs(u - 20) < 10 - 1e-6) & (np.abs(v - 15) < 10 - 1e-6)
    np.testing.assert_allclose(depth[inside], 4, atol=1e-5)
    assert (depth[~inside] == 0).all()


def test_figures_of_two_planes() -> None:
    """Points .3 above half of a square: accuracy .3, completeness .3 there and farther beyond."""
    x, y = np.meshgrid(np.linspace(-1, 1, 81), np.linspace(-1, 1, 81))
    seen = np.stack([x, y, 0 * x], -1).reshape(-1, 3)
    points = seen[seen[:, 0] < 1e-9] + (0, 0, 0.3)
    mesh = Mesh(SQUARE, TWO)
    figures = surface_figures(mesh, points, points, seen, (0.2, 0.31), "mm")
    for key in ("median", "mean", "p90"):
        assert figures["accuracy_mm"][key] == pytest.approx(0.3, abs=1e-5)
    expected = np.hypot(0.3, np.maximum(seen[:, 0], 0))
    assert figures["completeness_mm"]["mean"] == pytest.approx(expected.mean(), abs=2e-3)
    assert figures["fscore"]["0.2"] == 0
    recall = (expected < 0.31).mean()
    assert figures["fscore"]["0.31"] == pytest.approx(2 * recall / (1 + recall), abs=0.01)
    assert figures["chamfer"] == pytest.approx(0.5 * (0.3 + expected.mean()), abs=2e-3)
    share = surface_figures(mesh, points, points, seen, (1.0,), "arbitrary")
    assert share["accuracy"]["mean"] == pytest.approx(30 / mesh.diagonal, abs=1e-3)
    assert "percent" in share["unit"]


def test_f_score_extremes() -> None:
    assert f_score(np.zeros(3), np.zeros(5), 0.1) == 1
    assert f_score(np.ones(3), np.ones(5), 0.1) == 0
    assert f_score(np.array([0, 1.0]), np.zeros(5), 0.5) == pytest.approx(2 / 3)


def test_thinning_keeps_one_point_a_cube() -> None:
    points = np.random.default_rng(0).uniform(0, 1, (5000, 3))
    kept = thinned(points, 0.25)
    assert len(kept) == 64
    assert len(np.unique(np.floor(kept / 0.25), axis=0)) == 64


def test_icp_undoes_a_small_similarity_in_spite_of_outliers() -> None:
    mesh = box()
    random = np.random.default_rng(1)
    surface = mesh.closest(random.uniform(-0.5, 3.5, (4000, 3)))
    turn, _ = exponential(np.array([0, 0, 0, 0.03, -0.02, 0.04]))
    moved = (surface - (0.05, -0.04, 0.03)) @ turn / 1.02
    moved[:300] += random.uniform(0.5, 1, (300, 3))
    before = mesh.distances(moved[300:])
    scale, rotation, shift = icp(mesh, moved)
    after = mesh.distances(scale * moved[300:] @ rotation.T + shift)
    assert np.median(before) > 0.02
    assert np.median(after) < 0.002


def test_only_where_the_mesh_is_counts() -> None:
    """A wall behind the mesh is no error, and a side that nobody saw is not missing."""
    import open3d as o3d

    made = o3d.geometry.TriangleMesh.create_box(1.0, 1.0, 1.0)
    mesh = Mesh(np.asarray(made.vertices) - 0.5, np.asarray(made.triangles))
    cameras = {name: camera(name, x) for name, x in (("000", -0.3), ("001", 0.3))}
    registration = register(cameras, cameras, 4.0)
    surfaces = []
    for one in cameras.values():
        depth = mesh.depth(one)
        surfaces.append(SeenSurface(one, np.where(depth > 0, depth, 6.0).astype(np.float32)))
    cloud = np.concatenate([s.camera.unproject(s.depth).reshape(-1, 3) for s in surfaces])
    figures = geometry_figures(
        mesh, surfaces, cameras, registration, {}, cloud, "cameras", (0.5, 1.0), "mm"
    )
    assert figures is not None
    for block in (figures, figures["points"]):
        assert block["accuracy_mm"]["mean"] < 1e-4
        assert block["completeness_mm"]["mean"] < 0.01
        assert block["fscore"] == {"0.5": 1.0, "1.0": 1.0}
    away = {name: replace(one, cam_from_world=np.diag([1.0, -1, -1, 1]) @ one.cam_from_world)
            for name, one in cameras.items()}  # fmt: skip
    nothing = geometry_figures(
        mesh, surfaces, away, registration, {}, None, "cameras", (0.5,), "mm"
    )
    assert nothing is None


def test_support_counts_the_views_that_saw_a_point() -> None:
    """A wall at z = 2; before half of it, for the second camera, stands something nearer."""
    first, second = camera("000", -0.2), camera("001", 0.2)
    depth = np.full((30, 40), 6.0, np.float32)
    blocked = depth.copy()
    blocked[:, :20] = 3.0
    surfaces = [SeenSurface(first, depth), SeenSurface(second, blocked)]
    points = np.array([[0.9, 0, 2.0], [-0.9, 0, 2.0], [0, 0, -2.0], [50, 0, 2.0], [0, 0, -9.0]])
    np.testing.assert_array_equal(supporting_views(points, surfaces, 0.02), [2, 1, 0, 0, 0])


def test_support_map_of_a_novel_view() -> None:
    """Moved sideways by a quarter of the picture, a wall has a quarter that nobody saw."""
    surfaces = [SeenSurface(camera("000"), np.full((30, 40), 6.0, np.float32))]
    novel = camera("novel", x=6.0 * 10 / 40)
    rendered = np.ones((30, 40), bool)
    rendered[:10] = False
    count = support_map(novel, np.full((30, 40), 6.0), rendered, surfaces, 0.02)
    assert (count[10:, :30] == 1).all()
    assert (count[10:, 30:] == 0).all()
    assert unsupported_share(count, rendered) == pytest.approx(0.25)
    assert unsupported_share(count, np.zeros_like(rendered)) == 0
    picture = overlay(np.full((30, 40, 3), 100, np.uint8), count, rendered)
    assert (picture[10:, :30] == 100).all()
    np.testing.assert_array_equal(picture[20, 35], np.rint(0.4 * 100 + 0.6 * np.array(TINT)))
    assert not (picture[:10] == 100).any()


def test_what_an_input_view_may_not_use_supports_nothing() -> None:
    valid = np.ones((30, 40), bool)
    valid[:, :20] = False
    surface = seen_surface(camera(), np.full((30, 40), 6.0), np.ones((30, 40), bool), valid)
    points = camera().unproject(np.full((30, 40), 6.0)).reshape(-1, 3)
    count = supporting_views(points, [surface], 0.02).reshape(30, 40)
    assert (count[:, :20] == 0).all()
    assert (count[:, 21:] == 1).all()


def test_novel_cameras_lie_beyond_the_outermost() -> None:
    cameras = []
    for k, degrees in enumerate((0, -30, 40)):
        turn, _ = exponential(np.array([0, 0, 0, 0, np.radians(degrees), 0]))
        pose = np.eye(4)
        pose[:3, :3], pose[2, 3] = turn, 5.0
        cameras.append(Camera(f"{k:03d}", 40, 30, 40.0, 40.0, 20.0, 15.0, pose))
    first, last = beyond(cameras, np.zeros(3), 20)
    yaw = [np.degrees(np.arctan2(c.rotation[0, 2], c.rotation[0, 0])) for c in (first, last)]
    np.testing.assert_allclose(sorted(yaw), [-50, 60], atol=1e-6)
    for novel in (first, last):
        assert np.linalg.norm(novel.centre) == pytest.approx(5)
        np.testing.assert_allclose(novel.project(np.zeros((1, 3)))[0], [[20, 15]], atol=1e-9)
    assert beyond(cameras[:1], np.zeros(3), 20) == []


def test_flip_of_equal_and_of_opposite_pictures() -> None:
    random = np.random.default_rng(0)
    image = random.integers(0, 256, (24, 32, 3)).astype(np.uint8)
    assert flip_map(image, image).max() == 0
    black, white = np.zeros((24, 32, 3), np.uint8), np.full((24, 32, 3), 255, np.uint8)
    error = flip_map(black, white)
    assert error.shape == (24, 32)
    assert error.mean() > 0.9
    left = image.copy()
    left[:, :4] = 255 - left[:, :4]
    assert flip_map(left, image)[:, :4].mean() > 5 * flip_map(left, image)[:, 24:].mean()


def test_flip_agrees_with_its_authors_program() -> None:
    flip_evaluator = pytest.importorskip("flip_evaluator")
    random = np.random.default_rng(1)
    coarse = random.integers(0, 256, (2, 9, 12, 3)).astype(np.uint8)
    image, truth = (cv2.resize(picture, (120, 90)) for picture in coarse)
    truth[:20] = image[:20] + random.integers(0, 3, (20, 120, 3)).astype(np.uint8)
    pair = [picture.astype(np.float32) / 255 for picture in (truth, image)]
    wanted, _, _ = flip_evaluator.evaluate(*pair, "LDR", applyMagma=False, computeMeanError=False)
    np.testing.assert_allclose(flip_map(image, truth), wanted[..., 0], atol=1e-4)


def random_vgg(seed: int) -> dict[str, Any]:
    import torch

    made = torch.Generator().manual_seed(seed)
    state, inputs = {}, 3
    for block, channels in zip(VGG_BLOCKS, (64, 128, 256, 512, 512), strict=True):
        for index in block:
            size = (channels, inputs, 3, 3)
            scale = (2 / (9 * inputs)) ** 0.5
            state[f"features.{index}.weight"] = scale * torch.randn(size, generator=made)
            state[f"features.{index}.bias"] = 0.1 * torch.randn(channels, generator=made)
            inputs = channels
    return state


def test_lpips_agrees_with_torchmetrics(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """On random features, since nobody may download the trained ones for a test."""
    import torch
    from torchmetrics.functional.image import lpips as theirs

    state = random_vgg(0)
    layers: list[torch.nn.Module] = []
    for number, block in enumerate(VGG_BLOCKS):
        if number:
            layers.append(torch.nn.MaxPool2d(2))
        for index in block:
            weight = state[f"features.{index}.weight"]
            layers += [torch.nn.Conv2d(weight.shape[1], weight.shape[0], 3, padding=1)]
            layers += [torch.nn.ReLU()]
    vgg = torch.nn.Sequential(*layers, torch.nn.MaxPool2d(2))
    vgg.load_state_dict({name.removeprefix("features."): value for name, value in state.items()})
    monkeypatch.setattr(theirs, "_get_tv_model_features", lambda net, pretrained: vgg)
    monkeypatch.setattr(torch, "load", _on_cpu(torch.load))
    reference = theirs._LPIPS(net="vgg", pnet_rand=True)
    torch.save(state, tmp_path / "vgg.pth")
    ours = Lpips.from_file(tmp_path / "vgg.pth")
    random = np.random.default_rng(0)
    image = random.integers(0, 256, (48, 40, 3)).astype(np.uint8)
    truth = random.integers(0, 256, (48, 40, 3)).astype(np.uint8)
    pair = [torch.from_numpy(p).permute(2, 0, 1)[None].float() / 127.5 - 1 for p in (image, truth)]
    assert ours(image, truth) == pytest.approx(float(reference(*pair)), abs=1e-4)
    assert ours(image, image) == 0
    assert ours(image, truth) > 0.01


def test_lpips_of_a_masked_picture_is_that_of_what_counts(tmp_path: Path) -> None:
    """Two thirds that are black in both pictures made it three times as good."""
    import torch

    torch.save(random_vgg(0), tmp_path / "vgg.pth")
    lpips = Lpips.from_file(tmp_path / "vgg.pth")
    random = np.random.default_rng(0)
    image, truth = random.integers(0, 256, (2, 96, 192, 3)).astype(np.uint8)
    mask = np.zeros((96, 192), bool)
    mask[:, :64] = True
    for picture in (image, truth):
        picture[~mask] = 0
    alone = lpips(image[:, :64], truth[:, :64])
    assert lpips(image, truth, mask) == pytest.approx(alone, rel=0.1)
    assert lpips(image, truth) < 0.5 * alone
    assert lpips(image, truth, np.ones_like(mask)) == pytest.approx(lpips(image, truth), rel=1e-6)


def _on_cpu(load: Any) -> Any:
    """The linear layers that torchmetrics brings were saved on a GPU."""
    return lambda file, **options: load(file, **{**options, "map_location": "cpu"})


def test_lpips_weights_are_found_or_not(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TORCH_HOME", str(tmp_path))
    assert find_vgg_weights(None) is None
    with pytest.raises(RequestError, match="there is no file"):
        find_vgg_weights(str(tmp_path / "vgg.pth"))
    cached = tmp_path / "hub" / "checkpoints" / "vgg16-397923af.pth"
    cached.parent.mkdir(parents=True)
    cached.write_bytes(b"no weights")
    assert find_vgg_weights(None) == cached
    with pytest.raises(RequestError, match="does not hold torchvision's weights"):
        Lpips.from_file(cached)
