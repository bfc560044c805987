"""Surfaces from depth maps and from points, and their files."""

from pathlib import Path

import numpy as np
import open3d
import pytest

from pipeline.artifacts.cameras import Camera
from pipeline.errors import StageError
from stages.export.mesh.building import MeshHere, MeshProcess, MeshTask
from stages.export.mesh.files import write_mesh_ply, write_stl
from stages.export.mesh.surface import (
    Mesh,
    drop_small_parts,
    face_normals,
    fuse_depths,
    keep_near,
    poisson,
    repair,
    smoothed,
    trusted_depth,
)
from stages.export.pictures.orbits import look_at

VOXEL = 0.04


def ball_depth(camera: Camera) -> np.ndarray:
    """Exact depth of the unit ball, 0 beside it."""
    direction = camera.unproject(np.ones((camera.height, camera.width))) - camera.centre
    b = direction @ camera.centre
    a = (direction**2).sum(-1)
    root = b**2 - a * (camera.centre @ camera.centre - 1)
    return np.where(root > 0, (-b - np.sqrt(np.maximum(root, 0))) / a, 0)


def ball_frames():  # type: ignore[no-untyped-def]
    for degrees in (-40, -10, 20, 50):
        a = np.radians(degrees)
        pose = look_at(
            3 * np.array([np.sin(a), 0.1, -np.cos(a)]), np.zeros(3), np.array([0, -1, 0])
        )
        camera = Camera("", 128, 96, 120.3, 119.0, 64.4, 47.2, pose)
        depth = ball_depth(camera)
        point = camera.unproject(np.where(depth > 0, depth, 1))
        image = np.clip(127 + 100 * point, 0, 255).astype(np.uint8)
        yield camera, image, trusted_depth(depth, np.ones_like(depth), 10.0)


def fused() -> Mesh:
    return fuse_depths(ball_frames(), VOXEL, 4 * VOXEL)


def test_fusion_finds_the_ball_where_it_was_seen() -> None:
    mesh = fused()
    assert len(mesh) > 1000
    error = np.abs(np.linalg.norm(mesh.vertices, axis=1) - 1)
    assert np.median(error) < 0.1 * VOXEL
    assert np.percentile(error, 95) < 0.5 * VOXEL
    outward = (face_normals(mesh) * mesh.vertices[mesh.faces[:, 0]]).sum(1)
    assert (outward > 0).mean() > 0.99
    assert mesh.vertices[:, 2].max() < 0.6, "the far side was not seen"
    np.testing.assert_allclose(mesh.colors, 127 / 255 + 100 / 255 * mesh.vertices, atol=0.06)


def test_fusion_gives_the_same_arrays_each_time() -> None:
    first, second = fused(), fused()
    for name in ("vertices", "faces", "colors"):
        assert getattr(first, name).tobytes() == getattr(second, name).tobytes()


def test_smoothing_irons_out_noise() -> None:
    mesh = fused()
    random = np.random.default_rng(0)
    along = 1 + 0.2 * VOXEL * random.standard_normal((len(mesh.vertices), 1))
    rough = Mesh(mesh.vertices * along, mesh.faces, mesh.colors)

    def unevenness(mesh: Mesh) -> float:
        normals = face_normals(mesh)
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
        middles = mesh.vertices[mesh.faces].mean(1)
        middles /= np.linalg.norm(middles, axis=1, keepdims=True)
        return float(np.median(np.degrees(np.arccos(np.clip((normals * middles).sum(1), -1, 1)))))

    smooth = smoothed(rough, VOXEL)
    assert unevenness(smooth) < 0.5 * unevenness(rough)
    assert np.abs(np.linalg.norm(smooth.vertices, axis=1) - 1).mean() < 0.3 * VOXEL
    assert smooth.vertices[:, 2].max() < 0.8


def test_poisson_follows_the_points_and_is_cut_where_there_are_none() -> None:
    random = np.random.default_rng(0)
    points = random.standard_normal((4000, 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    points = points[points[:, 2] < 0.2]
    closed, density = poisson(points, points, 0.5 + 0.5 * points, 6)
    assert len(density) == len(closed.vertices)
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


def ball_task() -> MeshTask:
    cameras, images, depths = zip(*ball_frames(), strict=True)
    points = fused().vertices[::7].astype(np.float32)
    return MeshTask(
        "tsdf", np.array([[c.width, c.height, c.fx, c.fy, c.cx, c.cy] for c in cameras], float),
        np.array([c.cam_from_world for c in cameras]), images, depths,
        points, points, np.ones_like(points), 0.5, VOXEL, 2.0, 7, 2000,
    )  # fmt: skip


def test_a_process_of_its_own_makes_the_same_mesh_and_leaves_nothing(tmp_path: Path) -> None:
    task = ball_task()
    with MeshHere(task) as here, MeshProcess(task, tmp_path) as apart:
        wanted, found = here.result(), apart.result()
    assert wanted is not None and found is not None
    assert 1000 < len(wanted) <= 2000
    for name in ("vertices", "faces", "colors"):
        assert (getattr(wanted, name) == getattr(found, name)).all()
    assert not list(tmp_path.iterdir())


def test_a_process_that_fails_is_explained(tmp_path: Path) -> None:
    with MeshProcess(ball_task(), tmp_path) as apart:
        (tmp_path / "mesh_task.tmp").write_bytes(b"no task")
        with pytest.raises(StageError, match=r"mesh could not be made.*export\.mesh=false"):
            apart.result()
    assert not list(tmp_path.iterdir())
