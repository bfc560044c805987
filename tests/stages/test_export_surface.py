"""Surfaces from depth maps and from points, and their files."""

from pathlib import Path

import numpy as np
import open3d
import pytest

from pipeline.artifacts.cameras import Camera
from pipeline.kernels import kernel_threads
from stages.export.mesh.field import TRUNCATION, Field, colors_of, fuse
from stages.export.mesh.files import write_mesh_ply, write_stl
from stages.export.mesh.nets import zero_surface
from stages.export.mesh.surface import (
    Mesh,
    drop_small_parts,
    face_normals,
    keep_near,
    poisson,
    repair,
    trusted_depth,
)
from stages.export.pictures.orbits import look_at
from tests.stages import export_scene as scene

VOXEL = 0.04


def ball_frames():  # type: ignore[no-untyped-def]
    for degrees in (-40, -10, 20, 50):
        a = np.radians(degrees)
        pose = look_at(
            3 * np.array([np.sin(a), 0.1, -np.cos(a)]), np.zeros(3), np.array([0, -1, 0])
        )
        camera = Camera("", 128, 96, 120.3, 119.0, 64.4, 47.2, pose)
        depth = scene.ball_depth(camera)
        point = camera.unproject(np.where(depth > 0, depth, 1))
        image = np.clip(127 + 100 * point, 0, 255).astype(np.uint8)
        yield camera, image, trusted_depth(depth, np.ones_like(depth), 10.0)


def ball_points() -> np.ndarray:
    random = np.random.default_rng(1).standard_normal((4000, 3))
    points = random / np.linalg.norm(random, axis=1, keepdims=True)
    return points[points[:, 2] < 0.2]


def fused(step: int = 1, noise: float = 0.0, smooth: bool = False) -> Mesh:
    cameras, images, depths = zip(*ball_frames(), strict=True)
    random = np.random.default_rng(0)
    rough = [
        d + noise * random.standard_normal(d.shape).astype(np.float32) * (d > 0) for d in depths
    ]
    field, maps = fuse(cameras, images, rough, VOXEL, ball_points(), 5 * VOXEL)
    field = field.smoothed() if smooth else field
    vertices, faces = zero_surface(field, step)
    return Mesh(vertices, faces, colors_of(vertices, maps, TRUNCATION * VOXEL))


@pytest.mark.parametrize(("step", "smooth"), [(1, False), (2, False), (2, True), (4, True)])
def test_fusion_finds_the_ball_where_it_was_seen(step: int, smooth: bool) -> None:
    mesh = fused(step, smooth=smooth)
    assert len(mesh) > 2500 / step**2
    error = np.abs(np.linalg.norm(mesh.vertices, axis=1) - 1)
    assert np.median(error) < 0.15 * VOXEL
    assert np.percentile(error, 95) < 0.5 * VOXEL
    outward = (face_normals(mesh) * mesh.vertices[mesh.faces[:, 0]]).sum(1)
    assert (outward > 0).mean() > 0.99
    assert mesh.vertices[:, 2].max() < 0.6, "the far side was not seen"
    np.testing.assert_allclose(mesh.colors, 127 / 255 + 100 / 255 * mesh.vertices, atol=0.06)


def test_fusion_gives_the_same_arrays_at_any_number_of_threads() -> None:
    with kernel_threads(1):
        first = fused(2, smooth=True)
    with kernel_threads(2):
        second = fused(2, smooth=True)
    for name in ("vertices", "faces", "colors"):
        assert getattr(first, name).tobytes() == getattr(second, name).tobytes()


def test_smoothing_irons_out_noise() -> None:
    def unevenness(mesh: Mesh) -> float:
        normals = face_normals(mesh)
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
        middles = mesh.vertices[mesh.faces].mean(1)
        middles /= np.linalg.norm(middles, axis=1, keepdims=True)
        return float(np.median(np.degrees(np.arccos(np.clip((normals * middles).sum(1), -1, 1)))))

    noise = 0.3 * VOXEL
    rough, smooth = fused(1, noise), fused(1, noise, smooth=True)
    assert unevenness(smooth) < 0.6 * unevenness(rough)
    assert np.abs(np.linalg.norm(smooth.vertices, axis=1) - 1).mean() < 0.2 * VOXEL
    assert smooth.vertices[:, 2].max() < 0.8


def test_smoothing_keeps_bends_and_fills_holes() -> None:
    # the distance from a ball of 6 voxels around (4, 4, 4), in a block with all its neighbours
    blocks = np.stack(np.meshgrid(*[np.arange(-1, 2)] * 3, indexing="ij"), -1).reshape(-1, 3)
    places = blocks[:, None, None, None] * 8 + np.stack(np.indices((8, 8, 8)), -1)
    values = ((np.linalg.norm(places - 4.0, axis=-1) - 6) / TRUNCATION).astype(np.float32)
    weights = np.ones_like(values)
    weights[13, 2:4, 2:4, 2:4] = 0
    number = {tuple(block): row for row, block in enumerate(blocks.tolist())}
    neighbours = np.array(
        [[number.get(tuple(a), -1) for a in (block + blocks).tolist()] for block in blocks],
        np.int32,
    )
    smooth = Field(1.0, blocks, neighbours, values * (weights > 0), weights).smoothed()
    assert (smooth.weights[13] > 0).all()
    error = np.abs(smooth.values[13] - values[13])[:, :, 7] * TRUNCATION
    assert error.max() < 0.03, "in voxels; a blur of variance 1 moves this by 1 / 6"


def test_nothing_seen_is_nothing_meshed() -> None:
    cameras, images, depths = zip(*ball_frames(), strict=True)
    field, _ = fuse(cameras, images, [0 * depth for depth in depths], VOXEL, ball_points(), 0.2)
    vertices, faces = zero_surface(field.smoothed(), 2)
    assert vertices.shape == (0, 3) and faces.shape == (0, 3)


def test_poisson_follows_the_points_and_is_cut_where_there_are_none() -> None:
    random = np.random.default_rng(0)
    points = random.standard_normal((4000, 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    points = points[points[:, 2] < 0.2]
    closed = poisson(points, points, 0.5 + 0.5 * points, 6)
    mesh = keep_near(closed, points, 0.15)
    assert np.abs(np.linalg.norm(mesh.vertices, axis=1) - 1).mean() < 0.02
    assert mesh.vertices[:, 2].max() < 0.4


def test_depth_at_steps_and_where_it_is_transparent_is_not_trusted() -> None:
    depth = np.full((20, 30), 2.0)
    depth[:, 15:] = 3.0
    depth[0, 0], depth[19, 29] = np.nan, 9.0
    alpha = np.ones_like(depth)
    alpha[10, 3] = 0.2
    trusted = trusted_depth(depth, alpha, 5.0)
    assert trusted[10, 10] == 2 and trusted[10, 20] == 3
    assert trusted[10, 3] == 0 and trusted[0, 0] == 0 and trusted[19, 29] == 0
    assert (trusted[:, 14:16] == 0).all()


def test_repair_removes_what_is_broken_and_keeps_to_the_number_of_faces() -> None:
    mesh = fused()
    island = Mesh(np.eye(3) + 5, np.array([[0, 1, 2]], np.int32), np.zeros((3, 3)))
    count = len(mesh.vertices)
    wing = 1.01 * mesh.vertices[mesh.faces[0, :1]]  # a flap on an edge that has two faces
    broken = Mesh(
        np.concatenate([mesh.vertices, island.vertices, wing]),
        np.concatenate(
            [
                mesh.faces,
                island.faces + count,
                mesh.faces[:5],  # twice
                [[7, 7, 9], [mesh.faces[0, 0], mesh.faces[0, 1], count + 3]],  # null; three-winged
            ]
        ).astype(np.int32),
        np.concatenate([mesh.colors, island.colors, [[0, 0, 0]]]),
    )
    mended = drop_small_parts(repair(broken, 800, 20), 0.02)
    assert 400 < len(mended) <= 800
    legacy = open3d.geometry.TriangleMesh(
        open3d.utility.Vector3dVector(mended.vertices), open3d.utility.Vector3iVector(mended.faces)
    )
    assert legacy.is_edge_manifold(allow_boundary_edges=True)
    assert legacy.is_vertex_manifold()
    assert np.abs(np.linalg.norm(mended.vertices, axis=1) - 1).max() < 2 * VOXEL
    error = np.abs(mended.colors - (127 / 255 + 100 / 255 * mended.vertices))
    assert np.percentile(error, 99) < 0.05


def test_the_files_open_elsewhere(tmp_path: Path) -> None:
    mesh = fused()
    write_mesh_ply(tmp_path / "mesh.ply", mesh)
    write_stl(tmp_path / "mesh.stl", mesh)
    ply = open3d.io.read_triangle_mesh(str(tmp_path / "mesh.ply"))
    np.testing.assert_allclose(np.asarray(ply.vertices), mesh.vertices, atol=1e-6)
    assert np.array_equal(np.asarray(ply.triangles), mesh.faces)
    np.testing.assert_allclose(np.asarray(ply.vertex_colors), mesh.colors, atol=0.003)
    stl = open3d.io.read_triangle_mesh(str(tmp_path / "mesh.stl"))
    assert len(stl.triangles) == len(mesh)
    np.testing.assert_allclose(stl.get_surface_area(), ply.get_surface_area(), rtol=1e-5)
    data = (tmp_path / "mesh.stl").read_bytes()
    assert len(data) == 84 + 50 * len(mesh)


def test_no_triangle_without_area_in_stl(tmp_path: Path) -> None:
    vertices = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 0, 0]], np.float32)
    faces = np.array([[0, 1, 2], [1, 3, 2]], np.int32)  # two vertices lie in one place
    write_stl(tmp_path / "a.stl", Mesh(vertices, faces, np.ones((4, 3), np.float32)))
    data = (tmp_path / "a.stl").read_bytes()
    assert int.from_bytes(data[80:84], "little") == 1 and len(data) == 84 + 50
    corners = np.frombuffer(data, "<f4", 9, 84 + 12).reshape(3, 3)
    np.testing.assert_array_equal(corners, vertices[:3])
