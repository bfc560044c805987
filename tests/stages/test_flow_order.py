"""Viewing order, angles and pairs."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.artifacts.cameras import Camera
from pipeline.geometry.order import viewing_order
from stages.flow.order import neighbour_pairs, parallax_angle


def orbit(angles: np.ndarray, radius: float = 5.0) -> np.ndarray:
    """Centres [N, 3] on a horizontal circle about the origin; 0 degrees is in front."""
    turn = np.radians(angles)
    return np.stack([radius * np.sin(turn), 0 * turn, -radius * np.cos(turn)], -1)


def looking_at_origin(angle: float, roll: float = 0.0, radius: float = 5.0) -> Camera:
    a, r = np.radians([angle, roll])
    yaw = np.array([[np.cos(a), 0, np.sin(a)], [0, 1, 0], [-np.sin(a), 0, np.cos(a)]])
    spin = np.array([[np.cos(r), -np.sin(r), 0], [np.sin(r), np.cos(r), 0], [0, 0, 1]])
    pose = np.eye(4)
    pose[:3, :3] = spin @ yaw
    pose[:3, 3] = -pose[:3, :3] @ orbit(np.array(angle), radius)
    return Camera("a", 200, 150, 250.0, 250.0, 100.0, 75.0, pose)


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("count", [3, 6, 12, 24])
def test_shuffled_arc_is_put_in_order(count: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    angles = np.linspace(-50, 50, count) + rng.uniform(-0.3, 0.3, count) * 100 / count
    shuffled = rng.permutation(count)
    centres = orbit(angles[shuffled]) + rng.normal(0, 0.05, (count, 3))
    along = shuffled[viewing_order(centres)]
    expected = np.argsort(angles)
    assert along.tolist() in (expected.tolist(), expected[::-1].tolist())


def test_of_both_directions_the_one_with_the_earlier_view_first() -> None:
    centres = orbit(np.array([20.0, 0.0, -20.0, 40.0]))
    assert viewing_order(centres) == [2, 1, 0, 3]
    assert viewing_order(centres[::-1]) == [0, 3, 2, 1]


def test_path_is_the_shortest_of_all() -> None:
    from itertools import permutations

    for seed in range(6):
        centres = np.random.default_rng(seed).normal(size=(7, 3))

        def length(path: tuple[int, ...] | list[int], centres: np.ndarray = centres) -> float:
            return float(np.linalg.norm(np.diff(centres[list(path)], axis=0), axis=-1).sum())

        shortest = min(length(path) for path in permutations(range(7)))
        assert length(viewing_order(centres)) == pytest.approx(shortest)


def test_few_and_coincident_views() -> None:
    assert viewing_order(np.zeros((0, 3))) == []
    assert viewing_order(np.zeros((1, 3))) == [0]
    assert viewing_order(orbit(np.array([3.0, 1.0]))) == [0, 1]
    assert sorted(viewing_order(np.zeros((5, 3)))) == [0, 1, 2, 3, 4]


@pytest.mark.parametrize("with_points", [False, True])
def test_angle_between_views(with_points: bool) -> None:
    points = np.random.default_rng(0).normal(0, 0.01, (500, 3)) if with_points else None
    a, b = looking_at_origin(-10), looking_at_origin(25)
    assert parallax_angle(a, b, points) == pytest.approx(35, abs=0.1)


def test_angle_on_points_does_not_mind_a_rolled_camera() -> None:
    points = np.random.default_rng(0).normal(0, 0.01, (500, 3))
    a, b = looking_at_origin(0), looking_at_origin(10, roll=90)
    assert parallax_angle(a, b, points) == pytest.approx(10, abs=0.1)


def test_views_of_different_things_have_no_angle() -> None:
    points = np.random.default_rng(0).normal((0, 0, 30), 0.3, (500, 3))
    assert parallax_angle(looking_at_origin(0), looking_at_origin(90), points) == np.inf


def test_neighbour_pairs() -> None:
    assert neighbour_pairs([2, 0, 1], 1) == [(2, 0), (0, 1)]
    assert neighbour_pairs([2, 0, 1], 2) == [(2, 0), (2, 1), (0, 1)]
    assert neighbour_pairs([5], 3) == []
