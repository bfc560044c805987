"""Closed models of jaws, for printing."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import trimesh

from stages.export.mesh.nets import zero_surface
from stages.export.mesh.solid import (
    EXACT,
    _field,
    _Grid,
    _Seen,
    border_vertices,
    closed,
    is_closed,
    well_composed,
)
from stages.export.mesh.surface import Mesh, vertex_normals
from tests.stages.sheet_case import sheet


def jaw(across: int, down: int, section: Callable) -> Mesh:  # type: ignore[type-arg]
    """The outside of a jaw in mm: y away from the other one, the front towards z.

    Args:
        across, down: vertices.
        section: (v in 0..1, angle around y) -> (distance from y, y).
    """

    def shape(u, v):  # type: ignore[no-untyped-def]
        angle = np.pi * (0.15 + 0.7 * u)
        radius, y = section(v, angle)
        return radius * np.cos(angle), y, radius * np.sin(angle)

    mesh = sheet(across, down, shape, lambda u, v: (u, v, v))
    outward = (vertex_normals(mesh) * mesh.vertices * [1, 0, 1]).sum() > 0
    return mesh if outward else replace(mesh, faces=mesh.faces[:, [0, 2, 1]].copy())


def through(places: list[float], radii: list[float], heights: list[float]) -> Callable:  # type: ignore[type-arg]
    """A section with corners at some v."""
    return lambda v, angle: (np.interp(v, places, radii), np.interp(v, places, heights))


def arch() -> Mesh:
    """Wavy as teeth are."""
    return jaw(90, 30, lambda v, a: (9 + 0.5 * np.cos(14 * a) * (1 - v) + 0.6 * v, 7 * v))


def test_a_closed_model_is_watertight_and_keeps_what_was_seen() -> None:
    mesh = arch()
    # a hole, as where nothing was seen
    away = np.linalg.norm(mesh.vertices[mesh.faces].mean(1) - mesh.vertices[1245], axis=1) > 0.8
    mesh = replace(mesh, faces=mesh.faces[away])
    model = closed(mesh, height=3.0, depth=4.0, voxel=0.3)
    assert model is not None and is_closed(model)
    solid = trimesh.Trimesh(model.vertices, model.faces, process=False)
    assert solid.is_watertight and solid.is_winding_consistent and solid.volume > 300
    assert solid.body_count == 1
    top = model.vertices[:, 1].max()
    assert top == pytest.approx(mesh.vertices[:, 1].max() + 3, abs=0.01)
    flat_area = solid.area_faces[solid.face_normals[:, 1] > 0.999].sum()
    assert flat_area > 50, "it stands on a base"
    inner = mesh.vertices[~border_vertices(mesh)]
    inner = inner[np.isin(np.arange(len(mesh.vertices)), mesh.faces)[~border_vertices(mesh)]]
    from pipeline.geometry.mesh import Mesh as Surface

    distances = Surface(model.vertices, model.faces).distances(inner)
    assert np.percentile(distances, 95) < 0.05
    open_model = replace(model, faces=model.faces[1:])
    assert not is_closed(open_model)
    assert not is_closed(replace(model, faces=model.faces[:, ::-1])), "inside out"


def test_nothing_made_up_hides_what_was_seen_of_a_jaw() -> None:
    """Below the other jaw's teeth a mesh goes on forward in a ledge, which looks down."""

    mesh = jaw(90, 40, through([0, 0.5, 1], [14, 9, 9.6], [-0.5, 0, 7]))
    normals = vertex_normals(mesh)
    model = closed(mesh, height=3.0, depth=4.0, voxel=0.3)
    assert model is not None and is_closed(model)
    solid = trimesh.Trimesh(model.vertices, model.faces, process=False)
    wall = (mesh.vertices[:, 1] > 1) & ~border_vertices(mesh)
    rays = np.concatenate([mesh.vertices[wall] + 0.5 * normals[wall], normals[wall]], 1)
    seen = _Seen(model)
    ahead = seen.scene.cast_rays(seen.tensor(rays.astype(np.float32)))["t_hit"].numpy()
    assert (ahead < 20).mean() < 0.02
    assert model.vertices[:, 1].min() > mesh.vertices[:, 1].min() - 0.5
    assert solid.body_count == 1


def test_points_beside_a_surface_have_what_is_nearest() -> None:
    mesh = arch()
    grid, seen = _Grid.around(mesh.vertices, 2.0, 2.0, 0.4), _Seen(mesh)
    places, near = seen.beside(grid)
    every = np.indices(grid.shape).reshape(3, -1).T
    each = seen.nearest(grid.points(every))
    close = each.distance < EXACT * grid.voxel
    assert 0.02 < close.mean() < 0.5
    order = np.lexsort(places.T[::-1])
    np.testing.assert_array_equal(places[order], every[close])
    for name in ("there", "border", "distance", "cosine", "below"):
        np.testing.assert_array_equal(getattr(near, name)[order], getattr(each, name)[close])


def test_whatever_is_solid_gets_a_surface_without_loose_ends() -> None:
    for seed in range(3):
        noise = np.zeros((16, 16, 16), bool)
        noise[2:14, 2:14, 2:14] = np.random.default_rng(seed).random((12, 12, 12)) < 0.35
        solid = well_composed(noise)
        assert (solid >= noise).all()
        vertices, faces = zero_surface(_field(0.5 - solid.astype(np.float32), 1.0), 1)
        assert is_closed(Mesh(vertices, faces, vertices))
        assert trimesh.Trimesh(vertices, faces, process=False).is_watertight


def inside(model: Mesh, points: np.ndarray) -> np.ndarray:
    """[N] whether points [N, 3] are in a closed mesh."""
    seen = _Seen(model)
    return seen.scene.compute_occupancy(seen.tensor(points.astype(np.float32))).numpy() > 0


def around(radius: float, angles: np.ndarray, y: float) -> np.ndarray:
    """[N, 3] points of an arch."""
    return np.stack([radius * np.cos(angles), np.full_like(angles, y), radius * np.sin(angles)], 1)


def test_crowns_that_lean_outwards_are_solid_up_to_their_edge() -> None:
    """By 3 mm, as upper front teeth do: what is behind the edge is in front of the gum."""

    mesh = jaw(120, 40, through([0, 0.6, 1], [15, 12, 12], [0, 4.8, 8]))
    model = closed(mesh, height=3.0, depth=5.0, voxel=0.3)
    assert model is not None and is_closed(model)
    angles = np.linspace(0.25 * np.pi, 0.75 * np.pi, 30)
    assert inside(model, around(14, angles, 0.7)).all(), "behind the edge"
    assert inside(model, around(11, angles, 3.0)).all(), "behind the gum"
    assert not inside(model, around(13.6, angles, 6.0)).any(), "before the gum, below the edge"
    assert not inside(model, around(13.0, angles, -0.6)).any(), "above the edge"


def test_below_a_ragged_border_the_model_goes_on_evenly() -> None:
    def section(v, angle):  # type: ignore[no-untyped-def]
        y = v * (7 + 1.5 * np.sign(np.sin(40 * angle)))  # the gum is seen down to 5.5 or 8.5
        return 12 + 0.15 * y, y

    mesh = jaw(160, 40, section)
    model = closed(mesh, height=6.0, depth=4.0, voxel=0.3)
    assert model is not None and is_closed(model)
    wall = model.vertices[np.abs(model.vertices[:, 1] - 12.5) < 0.2]
    radius, angle = np.hypot(wall[:, 0], wall[:, 2]), np.arctan2(wall[:, 2], wall[:, 0])
    front = (radius > 11.5) & (np.abs(angle - np.pi / 2) < 0.25 * np.pi)
    assert front.sum() > 100
    assert np.ptp(radius[front]) < 0.5, "it was .45 mm from step to step, and is even"
    assert 12.6 < radius[front].mean() < 13.4


def test_a_jaw_that_was_seen_from_behind_as_well_stays_as_it_is() -> None:
    """A film shows the chewing surface and the inside, too."""

    mesh = jaw(120, 80, through([0, 0.4, 0.6, 1], [15.5, 15, 11, 10.5], [8, 0, 0, 8]))
    model = closed(mesh, height=3.0, depth=4.0, voxel=0.3)
    assert model is not None and is_closed(model)
    angles = np.linspace(0.25 * np.pi, 0.75 * np.pi, 30)
    for y in (2.0, 4.0, 6.0):
        assert inside(model, around(13, angles, y)).all()
        assert not inside(model, around(9.7, angles, y)).any(), "nothing is laid onto the inside"
        assert not inside(model, around(16.2, angles, y)).any()
    assert not inside(model, around(13, angles, -0.5)).any()


def test_gum_that_curls_in_at_its_border_does_not_cut_the_base() -> None:
    mesh = jaw(120, 50, through([0, 0.8, 1], [12, 12, 10.5], [0, 7, 7.3]))
    model = closed(mesh, height=4.0, depth=4.0, voxel=0.3)
    assert model is not None and is_closed(model)
    angles = np.linspace(0.25 * np.pi, 0.75 * np.pi, 30)
    assert all(inside(model, around(11.2, angles, y)).all() for y in (5.0, 8.0, 10.0))


def test_of_a_surface_that_only_looks_down_there_is_no_model() -> None:
    ledge = sheet(10, 10, lambda u, v: (8 * u, 0 * u, 8 * v), lambda u, v: (u, v, v))
    if vertex_normals(ledge)[0, 1] < 0:
        ledge = replace(ledge, faces=ledge.faces[:, [0, 2, 1]].copy())
    assert closed(ledge, height=3.0, depth=4.0, voxel=0.3) is None
