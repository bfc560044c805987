"""Overjet, overbite, midline and arch widths of generated mouths, against their own meshes."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from data_samples.mouths import Mouth, random_mouth
from data_samples.mouths.cameras import Camera as TrueCamera
from data_samples.mouths.cameras import look
from data_samples.mouths.rays import cast, ray_scene
from pipeline.artifacts.cameras import Camera
from pipeline.artifacts.teeth import Crown, Dentition, filled
from stages.dentition.crowns import dentition_of
from stages.export.measuring.landmarks import read_landmarks
from stages.export.measuring.measures import measure_mouth, mouth_axes
from tests.stages.mouth_case import CALM, outlines_of

WIDTH, HEIGHT = 640, 480
MM = {"unit": "mm", "uncertainty_percent": 0.0}
UP = np.array([0.0, 1.0, 0.0])
YAWS = ((-42.0, 4.0), (3.0, 4.0), (40.0, 4.0))


@cache
def grown(seed: int, **options: object) -> Mouth:
    return random_mouth(np.random.default_rng(seed), **{**CALM, **options})


def photographed(
    mouth: Mouth, angles: tuple[tuple[float, float], ...] = YAWS
) -> tuple[list[Dentition], list[Camera], list[np.ndarray]]:
    """Exact outlines with true numbers, cameras and depth, from some yaws and pitches."""
    scene = ray_scene((mouth.vertices, mouth.triangles))
    centres = np.array(list(mouth.tooth_centres().values()))
    pivot = (centres.min(0) + centres.max(0)) / 2 * [1, 1, 0] + [0, 0, -12.0]
    dentitions, cameras, depths = [], [], []
    for k, (yaw, pitch) in enumerate(angles):
        focal = 1.9 * WIDTH
        true = TrueCamera(
            WIDTH, HEIGHT, focal, focal, WIDTH / 2, HEIGHT / 2, look(yaw, pitch, 2.0, 125.0, pivot)
        )
        v, u = np.mgrid[:HEIGHT, :WIDTH] + 0.5
        hit = cast(scene, true.rays(np.stack([u, v], -1).reshape(-1, 2)))
        seen = np.isfinite(hit["t_hit"])
        labels = np.zeros(WIDTH * HEIGHT, np.uint8)
        labels[seen] = mouth.fdi[mouth.triangles[hit["primitive_ids"][seen], 0]]
        depth = np.where(seen, hit["t_hit"], 0).reshape(HEIGHT, WIDTH)
        labels = labels.reshape(HEIGHT, WIDTH)
        # 18 etc. are no numbers of ours
        read = dentition_of(outlines_of(labels, tell=False), f"{k:03d}", (WIDTH, HEIGHT), "front")
        dentitions.append(numbered(read, labels))
        cameras.append(
            Camera(f"{k:03d}", WIDTH, HEIGHT, focal, focal, WIDTH / 2, HEIGHT / 2,
                   true.cam_from_world)
        )  # fmt: skip
        depths.append(depth)
    return dentitions, cameras, depths


def numbered(read: Dentition, labels: np.ndarray) -> Dentition:
    def named(crown: Crown) -> Crown:
        inside = labels[filled((crown,), read.size)]
        return replace(crown, number=int(np.bincount(inside[inside > 0]).argmax()), doubt=0.001)

    return replace(read, upper=tuple(map(named, read.upper)), lower=tuple(map(named, read.lower)))


def truth(mouth: Mouth) -> dict[str, float]:
    """The same values from the crowns' own meshes (mm; x left, y up, z out)."""
    teeth = {tooth.plan.fdi: tooth for tooth in mouth.teeth}

    def tip(n: int) -> np.ndarray:
        """Middle of the biting edge, where it turns into the outer face."""
        tooth = teeth[n]
        ends = tooth.vertices[:, 1] * (1 if n > 30 else -1)
        edge = tooth.vertices[ends >= ends.max() - 0.5]
        out = edge @ tooth.outward
        return edge[out >= out.max() - 0.2].mean(0)

    def face(n: int, height: float) -> float:
        """How far out the outer face reaches at a height."""
        v = teeth[n].vertices
        return float(v[abs(v[:, 1] - height) < 0.4][:, 2].max())

    def meet(right: int, left: int) -> float:
        ends = []
        for n, side in ((right, 1), (left, -1)):
            tooth = teeth[n]
            low = tooth.vertices[tooth.local[:, 1] < 0.35 * tooth.plan.height]
            ends.append(side * (side * low[:, 0]).max())
        return float(np.mean(ends))

    above, below = (np.mean([tip(a), tip(b)], axis=0) for a, b in ((11, 21), (31, 41)))
    level = min(above[1], below[1])
    return {
        "overjet": above[2] - float(np.mean([face(n, level - 0.4) for n in (31, 41)])),
        "overbite": below[1] - above[1],
        "midline_shift": meet(41, 31) - meet(11, 21),
        "intercanine_upper": float(np.linalg.norm(tip(13) - tip(23))),
        "intercanine_lower": float(np.linalg.norm(tip(43) - tip(33))),
        "intermolar_upper": float(np.linalg.norm(teeth[16].labial - teeth[26].labial)),
        "intermolar_lower": float(np.linalg.norm(teeth[46].labial - teeth[36].labial)),
    }


def measured(mouth: Mouth, angles: tuple[tuple[float, float], ...] = YAWS, scale=MM):
    reading = read_landmarks(*photographed(mouth, angles))
    return {entry["name"]: entry for entry in measure_mouth(reading, UP, scale)}


OPEN = {"overbite": -2.0, "bite": "open", "overjet": 1.5}


@pytest.mark.parametrize(
    ("seed", "options"), [(0, {}), (1, {"overjet": 6.0}), (2, OPEN), (3, {"midline": 2.5})]
)
def test_what_is_measured_is_true_within_its_uncertainty(seed: int, options: dict) -> None:
    mouth = grown(seed, **options)
    true, found = truth(mouth), measured(mouth)
    assert set(found) == set(true)
    for name, entry in found.items():
        if entry["value"] is None:
            assert name == "overbite"
            assert "cover the edges of the lower ones" in entry["not_visible"]
            continue
        assert abs(entry["value"] - true[name]) <= entry["uncertainty"], (name, entry, true[name])
        assert entry["uncertainty"] < 5
        assert entry["sure"] in ("sure", "fair", "unsure")
        assert entry["not_visible"] == ""
    assert (found["overbite"]["value"] is not None) == (options == OPEN)
    assert found["overjet"]["uncertainty"] < 2


def test_sides_are_the_patients() -> None:
    to_left = measured(grown(3, midline=2.5))["midline_shift"]
    to_right = measured(grown(3, midline=-2.5))["midline_shift"]
    assert to_left["direction"] == "lower midline to the patient's left"
    assert to_right["direction"] == "lower midline to the patient's right"
    assert to_left["value"] - to_right["value"] == pytest.approx(5.0, abs=1.0)


def test_a_tooth_that_is_not_there_is_named() -> None:
    found = measured(grown(4, missing=(13, 18, 28, 38, 48)))
    entry = found["intercanine_upper"]
    assert entry["value"] is None
    assert entry["not_visible"] == "no photograph shows 13 with depth"
    assert found["intercanine_lower"]["value"] is not None


def test_doubtful_numbers_give_nothing_and_the_scale_counts() -> None:
    dentitions, cameras, depths = photographed(grown(0))
    reading = read_landmarks(dentitions, cameras, depths)
    exact = {e["name"]: e for e in measure_mouth(reading, UP, MM)}
    rough = {
        e["name"]: e for e in measure_mouth(reading, UP, {"unit": "mm", "uncertainty_percent": 15})
    }
    width = exact["intermolar_upper"]
    assert rough["intermolar_upper"]["uncertainty"] == pytest.approx(
        np.hypot(width["uncertainty"], 0.15 * width["value"]), rel=0.01
    )
    unsure = [replace(d, upper=tuple(replace(c, doubt=0.7) for c in d.upper)) for d in dentitions]
    found = {e["name"]: e for e in measure_mouth(read_landmarks(unsure, cameras, depths), UP, MM)}
    assert found["overjet"]["not_visible"] == "it is not sure which tooth is 11 or 21"
    assert found["intercanine_lower"]["value"] is not None


def test_the_axes_are_the_mouths_own() -> None:
    """However the exports' frame lies, left is left and up is up."""
    turn = np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]])
    places = {("centre", n): turn @ p for n, p in grown(0).tooth_centres().items()}
    axes = mouth_axes(places, turn @ UP)
    np.testing.assert_allclose(axes @ turn, np.eye(3), atol=0.12)
    upper_only = {key: p for key, p in places.items() if key[1] < 30}
    np.testing.assert_allclose(mouth_axes(upper_only, turn @ UP) @ turn, np.eye(3), atol=0.12)
    front = {key: p for key, p in places.items() if key[1] in (11, 21, 31, 41)}
    np.testing.assert_allclose(mouth_axes(front, turn @ UP) @ turn, np.eye(3), atol=0.3)


def test_nothing_seen_is_said_so() -> None:
    for entry in measure_mouth(read_landmarks([], [], []), UP, MM):
        assert entry["value"] is None
        assert entry["not_visible"].startswith("no photograph shows")
