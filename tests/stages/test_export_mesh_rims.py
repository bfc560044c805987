"""Rims of a mesh: even along themselves, and nothing else moves."""

from __future__ import annotations

import numpy as np

from stages.export.mesh.rims import even_border, even_rims
from stages.export.mesh.surface import Mesh, face_normals

WIDTH, HEIGHT = 40, 12


def sheet(kept: np.ndarray | None = None) -> Mesh:
    """Unit squares [HEIGHT, WIDTH] in a plane, each two triangles; those that are kept."""
    y, x = np.mgrid[: HEIGHT + 1, : WIDTH + 1]
    vertices = np.stack([x, y, np.zeros_like(x)], axis=-1).reshape(-1, 3).astype(np.float64)
    row, column = np.nonzero(np.ones((HEIGHT, WIDTH), bool) if kept is None else kept)
    corner = row * (WIDTH + 1) + column
    one = np.stack([corner, corner + 1, corner + WIDTH + 2], axis=1)
    two = np.stack([corner, corner + WIDTH + 2, corner + WIDTH + 1], axis=1)
    faces = np.concatenate([one, two]).astype(np.int32)
    used = np.unique(faces)
    number = np.cumsum(np.isin(np.arange(len(vertices)), used)) - 1
    return Mesh(vertices[used], number[faces].astype(np.int32), np.zeros((len(used), 3)))


def stairs() -> np.ndarray:
    """The upper rim goes up and down by one square every two."""
    kept = np.ones((HEIGHT, WIDTH), bool)
    kept[-1, ::4] = kept[-1, 1::4] = False
    return kept


def roughness(vertices: np.ndarray) -> float:
    """Spread of the heights of the upper rim, away from the corners."""
    rim = vertices[:, 1] > HEIGHT - 1.6
    within = (vertices[:, 0] > 4) & (vertices[:, 0] < WIDTH - 4)
    return float(np.ptp(vertices[rim & within, 1]))


def test_steps_are_evened_and_all_between_stays() -> None:
    mesh = sheet(stairs())
    even = even_rims(mesh)
    assert roughness(mesh.vertices) == 1
    assert roughness(even.vertices) < 0.6
    within = (np.abs(mesh.vertices - (WIDTH / 2, HEIGHT / 2, 0)) < (17, 4.4, 1)).all(1)
    np.testing.assert_array_equal(even.vertices[within], mesh.vertices[within])
    assert (even.vertices[:, 2] == 0).all()
    assert np.abs(even.vertices - mesh.vertices).max() < 1
    assert (face_normals(even)[:, 2] > 0).all()
    np.testing.assert_array_equal(even.faces, mesh.faces)


def test_a_straight_rim_stays() -> None:
    mesh = sheet()
    moved = np.linalg.norm(even_rims(mesh).vertices - mesh.vertices, axis=1) > 1e-12
    corners = np.isin(mesh.vertices[:, 0], (0, WIDTH)) & np.isin(mesh.vertices[:, 1], (0, HEIGHT))
    away = np.linalg.norm(
        mesh.vertices[:, None] - mesh.vertices[None, corners], axis=2
    ).min(axis=1) > 8  # fmt: skip
    assert not moved[away].any()
    assert moved[corners].all()


def test_the_border_of_a_side_is_evened_and_its_ends_and_the_rims_stay() -> None:
    mesh = sheet()
    middle = mesh.vertices[mesh.faces].mean(axis=1)
    step = HEIGHT / 2 + (middle[:, 0].astype(int) // 2 % 2)
    border = np.abs(mesh.vertices[:, 1] - HEIGHT / 2 - 0.5) < 1
    even = even_border(mesh, middle[:, 1] > step)
    moved = np.abs(even.vertices[:, 1] - mesh.vertices[:, 1])
    assert moved[border & (mesh.vertices[:, 0] == WIDTH / 2)].max() > 0.3
    rims = np.isin(mesh.vertices[:, 0], (0, WIDTH)) | np.isin(mesh.vertices[:, 1], (0, HEIGHT))
    np.testing.assert_array_equal(even.vertices[rims], mesh.vertices[rims])
    assert (face_normals(even)[:, 2] > 0).all()


def test_what_would_turn_over_is_held() -> None:
    """A thin tongue that ends in one triangle: its tip would go behind its base."""
    vertices = np.array([[0, 0, 0], [4, 0, 0], [2, 0.1, 0], [2, -3, 0]], np.float64)
    faces = np.array([[0, 1, 2], [1, 0, 3]], np.int32)
    mesh = Mesh(vertices, faces, np.zeros((4, 3)))
    even = even_rims(mesh)
    assert (face_normals(even)[:, 2] * face_normals(mesh)[:, 2] >= 0).all()


def test_no_faces_no_rims() -> None:
    empty = Mesh(np.zeros((0, 3)), np.zeros((0, 3), np.int32), np.zeros((0, 3)))
    assert len(even_rims(empty)) == 0
