"""Overjet, overbite, midline and arch widths of generated mouths, against their own meshes."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import cv2
import numpy as np
import pytest

from data_samples.mouths import Mouth, random_mouth
from pipeline.artifacts.space.scale import NO_SCALE, Scale
from pipeline.artifacts.teeth import filled
from stages.export.measuring import measures
from stages.export.measuring.landmarks import read_landmarks
from stages.export.measuring.measures import measure_mouth, mouth_axes
from tests.stages.measured_mouth import YAWS, photographed, truth
from tests.stages.mouth_case import CALM

MM = Scale("mm", "length", 0.0)
UP = np.array([0.0, 1.0, 0.0])
SIZE = (480, 360)


@cache
def grown(seed: int, **options: object) -> Mouth:
    return random_mouth(np.random.default_rng(seed), **{**CALM, **options})


@cache
def seen(seed: int, angles: tuple[tuple[float, float], ...] = YAWS, **options: object):
    """Photographs of a mouth, taken once."""
    return photographed(grown(seed, **options), angles, SIZE)


def measured(seed: int, angles: tuple[tuple[float, float], ...] = YAWS, **options: object):
    reading = read_landmarks(*seen(seed, angles, **options))
    return {entry["name"]: entry for entry in measure_mouth(reading, UP, MM)}


OPEN = {"overbite": -2.0, "bite": "open", "overjet": 1.5}


@pytest.mark.parametrize(
    ("seed", "options"), [(0, {}), (1, {"overjet": 6.0}), (2, OPEN), (3, {"midline": 2.5})]
)
def test_what_is_measured_is_true_within_its_uncertainty(seed: int, options: dict) -> None:
    mouth = grown(seed, **options)
    true, found = truth(mouth), measured(seed, **options)
    assert set(found) == set(true)
    for name, entry in found.items():
        assert abs(entry["value"] - true[name]) <= entry["uncertainty"], (name, entry, true[name])
        assert entry["uncertainty"] < 5
        assert entry["sure"] in ("sure", "fair", "unsure")
        assert entry["not_visible"] == ""
        assert (entry["estimated"] is not None) == (name == "overbite" and options != OPEN)
    assert found["overjet"]["uncertainty"] < 2


@pytest.mark.parametrize(
    ("seed", "crown_height", "options"),
    [
        (5, 0.87, {"bite": "deep", "overbite": 5.0, "overjet": 3.0}),
        (6, 1.13, {"overbite": 2.0}),
        (7, 1.0, {"overbite": 0.8, "recession": 1.5}),
    ],
)
def test_a_covered_overbite_is_estimated_and_said_to_be(
    seed: int, crown_height: float, options: dict
) -> None:
    """Crowns a standard deviation taller and lower than the textbook's, and a receded gum."""
    given = {"crown_height": crown_height, **options}
    mouth = grown(seed, **given)
    entry, true = measured(seed, **given)["overbite"], truth(mouth)["overbite"]
    assert abs(entry["value"] - true) <= entry["uncertainty"] < 3
    assert "cover the edges of the lower ones" in entry["estimated"]["because"]
    assert entry["method"].startswith("estimated, not measured")
    assert entry["sure"] in ("fair", "unsure")
    assert entry["not_visible"] == ""
    assert entry["teeth"] == [11, 21, 31, 41]
    share, off = (entry["estimated"]["covered_percent" + end] for end in ("", "_uncertainty"))
    crown = np.mean([t.plan.height for t in mouth.teeth if t.plan.fdi in (31, 41)])
    assert abs(share - 100 * true / crown) <= off < 40
    ends = np.array(entry["points"])
    assert ends[1, 1] - ends[0, 1] == pytest.approx(entry["value"], abs=0.1), "up, behind"


def test_an_estimate_follows_the_bite_and_errs_with_the_crowns_height() -> None:
    def overbite(**options: object) -> float:
        return measured(8, **options)["overbite"]["value"]

    shallow, deep = overbite(overbite=1.0), overbite(overbite=4.0)
    assert deep - shallow == pytest.approx(3.0, abs=0.5)
    assert overbite(overbite=4.0, crown_height=0.9) > deep + 0.4


def test_an_estimate_needs_no_scale() -> None:
    reading = read_landmarks(*seen(8, overbite=3.0))
    larger = replace(
        reading,
        landmarks={
            key: replace(mark, point=7 * mark.point, covariance=49 * mark.covariance)
            for key, mark in reading.landmarks.items()
        },
    )
    here, there = (
        next(e for e in measure_mouth(r, UP, s) if e["name"] == "overbite")
        for r, s in ((reading, MM), (larger, NO_SCALE))
    )
    assert there["value"] == pytest.approx(7 * here["value"], rel=1e-3)
    assert there["uncertainty"] == pytest.approx(7 * here["uncertainty"], rel=1e-3)
    assert there["estimated"] == here["estimated"]
    assert there["unit"] == "none"
    rough = Scale("mm", "textbook_teeth", 15.0)
    sure, worse = measure_mouth(reading, UP, MM), measure_mouth(reading, UP, rough)
    for one, other in zip(sure, worse, strict=True):
        if one["value"] is not None:  # measured or estimated, it holds in 19 of 20 cases
            wider = np.hypot(one["uncertainty"], 1.96 * 0.15 * one["value"])
            assert other["uncertainty"] == pytest.approx(wider, rel=1e-2)
    # a scale of which nobody says how sure it is is not exact
    unsaid, five = Scale("mm", "cameras"), Scale("mm", "cameras", 5.0)
    assert measure_mouth(reading, UP, unsaid) == measure_mouth(reading, UP, five)


def test_an_overbite_is_less_sure_where_one_of_the_incisors_is_covered() -> None:
    """It is that of the others, and too small: the covered one reaches higher."""
    reading = read_landmarks(*seen(2, **OPEN))
    marks = {key: mark for key, mark in reading.landmarks.items() if key != ("tip", 31)}
    one = replace(reading, landmarks=marks, covered=reading.covered | {31})
    both, left = (
        next(e for e in measure_mouth(r, UP, MM) if e["name"] == "overbite") for r in (reading, one)
    )
    assert (both["teeth"], left["teeth"]) == ([11, 21, 31, 41], [11, 21, 41])
    assert left["uncertainty"] > 1.3 * both["uncertainty"]


def test_what_can_not_be_estimated_either_says_why() -> None:
    milk = measured(9, dentition="primary", missing=(), overbite=2.0)["overbite"]
    assert (milk["value"], milk["estimated"]) == (None, None)
    assert "cover the edges of the lower ones" in milk["not_visible"]
    assert "nor is it estimated where there are primary teeth" in milk["not_visible"]

    reverse = measured(10, bite="reverse", overbite=2.0, overjet=-2.5)["overbite"]
    assert reverse["value"] is None
    assert "estimated" not in reverse["not_visible"]

    dentitions, cameras, depths = seen(8, overbite=3.0)
    cut = [
        replace(d, lower=tuple(replace(c, doubtful=c.number in (31, 41)) for c in d.lower))
        for d in dentitions
    ]
    found = {e["name"]: e for e in measure_mouth(read_landmarks(cut, cameras, depths), UP, MM)}
    assert found["overbite"]["value"] is None
    assert "no photograph shows all of the gum's edge" in found["overbite"]["not_visible"]
    assert found["overjet"]["value"] is not None


def test_sides_are_the_patients() -> None:
    to_left = measured(3, midline=2.5)["midline_shift"]
    to_right = measured(3, midline=-2.5)["midline_shift"]
    assert to_left["direction"] == "lower midline to the patient's left"
    assert to_right["direction"] == "lower midline to the patient's right"
    assert to_left["value"] - to_right["value"] == pytest.approx(5.0, abs=1.0)


def test_a_shift_of_nothing_has_no_direction(monkeypatch: pytest.MonkeyPatch) -> None:
    midline = next(rule for rule in measures.RULES if rule.name == "midline_shift")
    to_left, to_right = midline.signs
    for shift, said in ((0.02, ""), (0.049, ""), (0.05, to_left), (-0.08, to_right)):
        rule = replace(midline, measure=lambda places, axes, mm=shift: (mm, np.zeros((2, 3))))
        monkeypatch.setattr(measures, "RULES", (rule,))
        assert measured(3, midline=2.5)["midline_shift"]["direction"] == said


def test_a_tooth_that_is_not_there_is_named() -> None:
    found = measured(4, missing=(13, 18, 28, 38, 48))
    entry = found["intercanine_upper"]
    assert entry["value"] is None
    assert entry["not_visible"] == "no photograph shows 13 with depth"
    assert found["intercanine_lower"]["value"] is not None
    # a midline is that between two teeth
    entry = measured(4, missing=(21, 18, 28, 38, 48))["midline_shift"]
    assert entry["not_visible"] == "no photograph shows 21 with depth"


def test_doubtful_numbers_give_nothing() -> None:
    dentitions, cameras, depths = seen(0)
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


@pytest.mark.parametrize("seed", [1, 4])
def test_the_upper_edges_that_a_scene_draws_too_long_make_no_reverse_bite(seed: int) -> None:
    """Beside the upper edges a scene may show their depth where the lower crowns are seen."""
    mouth = grown(seed, overjet=5.0)
    dentitions, cameras, depths = seen(seed, overjet=5.0)
    drawn = []
    for dentition, depth in zip(dentitions, depths, strict=True):
        upper = filled(dentition.upper, dentition.size)
        nearest = np.where(upper, depth, np.inf).astype(np.float32)
        longer = cv2.erode(nearest, np.ones((7, 7), np.uint8))  # three pixels
        drawn.append(np.where(np.isfinite(longer) & (depth > 0), longer, depth))
    found = {
        entry["name"]: entry
        for entry in measure_mouth(read_landmarks(dentitions, cameras, drawn), UP, MM)
    }
    assert abs(found["overjet"]["value"] - truth(mouth)["overjet"]) < 1


def test_the_midline_is_where_the_central_incisors_meet() -> None:
    """Photographs from the sides show another place, and count only where there is no other."""
    mouth = grown(3, midline=2.5)
    assert measured(3, midline=2.5)["midline_shift"]["value"] == pytest.approx(
        truth(mouth)["midline_shift"], abs=0.4
    )
    sides = measured(3, ((-42.0, 4.0), (40.0, 4.0)), midline=2.5)["midline_shift"]
    assert sides["value"] is None
    assert sides["not_visible"] == "no photograph from the front shows where 11 and 21 meet"


def test_nothing_seen_is_said_so() -> None:
    for entry in measure_mouth(read_landmarks([], [], []), UP, MM):
        assert entry["value"] is None
        assert entry["not_visible"].startswith("no photograph shows")
