"""Two visits of one patient: what moved comes out, and who is somebody else is refused."""

from __future__ import annotations

import pickle
from collections.abc import Iterator, Mapping
from dataclasses import replace
from hashlib import sha256
from typing import Any

import numpy as np
import pytest

from pipeline.errors import ReconstructionError
from pipeline.geometry.rigid import angle_between, exponential
from pipeline.studies.register import comparing, movement, solving
from pipeline.studies.register.both_ways import agreed, mirrored
from pipeline.studies.register.comparing import compare_visits
from pipeline.studies.register.estimate import (
    Estimate,
    Started,
    compared_pairs,
    finished,
    started,
)
from pipeline.studies.register.geometry import refined_frame
from pipeline.studies.register.pictures.photometric import judged
from pipeline.studies.register.uncertainty import misfit
from pipeline.studies.register.visit import Visit, scale_of, teeth_points
from pipeline.studies.register.writing import described
from tests.studies.register_case import motion, toy_motions, toy_visit


@pytest.fixture(scope="module", autouse=True)
def frames() -> Iterator[None]:
    """Surfaces that were brought into one frame are not again: most comparisons here have the same
    ones, and differ in what came of both ways."""
    kept: dict[bytes, np.ndarray] = {}

    def remembered(first: Visit, second: Visit, *frame_and_teeth: Any) -> np.ndarray:
        key = sha256(pickle.dumps((first.teeth, second.teeth, frame_and_teeth))).digest()
        if key not in kept:
            kept[key] = refined_frame(first, second, *frame_and_teeth)
        return kept[key]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(comparing, "refined_frame", remembered)
        yield


@pytest.fixture(scope="module")
def motions() -> dict[int, np.ndarray]:
    return toy_motions()


@pytest.fixture(scope="module")
def ways() -> list[Estimate]:
    """What `found` was made of: the estimate from the first visit to the second, and back."""
    return []


@pytest.fixture(scope="module")
def begun() -> list[Started]:
    """What `ways` were before they agreed."""
    return []


@pytest.fixture(scope="module")
def found(
    motions: dict[int, np.ndarray], ways: list[Estimate], begun: list[Started]
) -> comparing.Comparison:
    second = toy_visit("second", motions, turn=3.0)
    frame = np.eye(4)
    frame[:3, :3] = 1.07 * exponential(np.array([0, 0, 0, 0.3, -0.2, 0.5]))[0]
    frame[:3, 3] = 20, -10, 5
    estimated = comparing.both_ways

    def kept(*visits_and_frame: Any) -> tuple[Estimate, Estimate]:
        ways[:] = estimated(*visits_and_frame)
        return ways[0], ways[1]

    def kept_too(*visits_and_frame: Any) -> Started:
        begun.append(started(*visits_and_frame))
        return begun[-1]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(comparing, "both_ways", kept)
        patch.setattr("pipeline.studies.register.both_ways.started", kept_too)
        return compare_visits(toy_visit("first"), second.in_frame(frame))


def test_known_movements_come_out(found: comparing.Comparison, motions: dict) -> None:
    """Within .1 mm and 2.5 degrees, in a frame and at a scale that nobody knows."""
    assert len(found.teeth) >= 16
    for tooth in found.teeth:
        true = solving.displacement(motions.get(tooth.tooth, np.eye(4)), tooth.at)
        off = tooth.displacement - true
        assert np.linalg.norm(off[:3]) < 0.1, tooth.tooth
        assert np.degrees(np.linalg.norm(off[3:])) < 2.5, tooth.tooth


def test_intervals_hold_the_truth_and_say_who_moved(
    found: comparing.Comparison, motions: dict
) -> None:
    axes = movement.tooth_axes(found.first.centres)
    inside = []
    for tooth in found.teeth:
        true = solving.displacement(motions.get(tooth.tooth, np.eye(4)), tooth.at)
        inside += list(
            np.abs(movement.to_parts(axes[tooth.tooth]) @ true - tooth.parts) <= tooth.half
        )
        assert tooth.certain == (tooth.tooth in motions), tooth.tooth
        assert tooth.still == (tooth.tooth not in motions), tooth.tooth
    assert np.mean(inside) >= 0.95


def test_visits_that_cannot_be_laid_over_each_other_are_not_called_two_patients(
    found: comparing.Comparison, ways: list[Estimate], monkeypatch: pytest.MonkeyPatch
) -> None:
    """One from the right, one from the left: they "agreed with a correlation of -1.00"."""
    right = replace(found.first, looks=found.first.looks[:1])
    left = replace(found.second, looks=found.second.looks[3:])
    with pytest.raises(ReconstructionError, match="from nearly the same side"):
        compare_visits(right, left)
    nothing = [replace(way, blocks=()) for way in ways]
    monkeypatch.setattr(comparing, "both_ways", lambda *_: nothing)
    with pytest.raises(ReconstructionError, match="No tooth of 'second' shows enough"):
        compare_visits(found.first, found.second)


def test_pictures_that_do_not_fit_widen_the_interval(
    found: comparing.Comparison, ways: list[Estimate], monkeypatch: pytest.MonkeyPatch
) -> None:
    """One way is enough: where a tooth's pictures hardly agree, its motion may be another one."""
    doubtful, (there, back) = 23, ways
    doubted = replace(there, fits={**there.fits, doubtful: 0.4})
    monkeypatch.setattr(comparing, "both_ways", lambda *_: (doubted, back))
    plain = {t.tooth: t for t in found.teeth}
    for tooth in compare_visits(found.first, found.second).teeth:
        number, before = tooth.tooth, plain[tooth.tooth].deviation
        wider = 1.0
        if number == doubtful:
            wider = misfit(0.4) / misfit(min(way.fits[number] for way in ways))
            assert wider > 3
        assert tooth.deviation == pytest.approx(wider * before), number


def test_with_many_photographs_marks_that_both_ways_tell_make_surer(
    found: comparing.Comparison, ways: list[Estimate], monkeypatch: pytest.MonkeyPatch
) -> None:
    there, back = (
        replace(w, told=frozenset(t)) for w, t in zip(ways, ((11, 23), (23, 24)), strict=True)
    )
    monkeypatch.setattr(comparing, "both_ways", lambda *_: (there, back))
    monkeypatch.setattr(comparing, "MANY", len(found.first.looks))
    assert {tooth.basis for tooth in found.teeth} == {"few"}
    for tooth in compare_visits(found.first, found.second).teeth:
        assert tooth.basis == ("marks" if tooth.tooth == 23 else "flow"), tooth.tooth
        half = comparing.halves(
            tooth.deviation, comparing.FACTORS[tooth.basis], comparing.FLOORS[tooth.basis]
        )
        assert tooth.half == pytest.approx(half)
    assert comparing.FACTORS["marks"] < comparing.FACTORS["flow"]


def test_with_many_photographs_a_tooth_that_one_way_alone_finds_is_not_measured(
    found: comparing.Comparison, ways: list[Estimate], monkeypatch: pytest.MonkeyPatch
) -> None:
    """One of a generated mouth was off by 3 mm, and sure of it: nothing spoke against it."""
    there, back = ways
    lost = replace(back, blocks=tuple(b for b in back.blocks if b.tooth != 23))
    monkeypatch.setattr(comparing, "both_ways", lambda *_: (there, lost))
    few = compare_visits(found.first, found.second)
    assert 23 in {tooth.tooth for tooth in few.teeth}
    monkeypatch.setattr(comparing, "MANY", len(found.first.looks))
    many = compare_visits(found.first, found.second)
    assert {t.tooth for t in many.teeth} == {t.tooth for t in few.teeth} - {23}
    assert 23 in many.missing


def test_a_tooth_with_another_number_at_the_second_visit_is_measured_or_missing_not_both(
    found: comparing.Comparison, ways: list[Estimate], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(comparing, "both_ways", lambda *_: tuple(ways))
    teeth = {n if n != 11 else 18: points for n, points in found.second.teeth.items()}
    second = Visit("second", found.second.looks, teeth)
    again = compare_visits(found.first, second)
    assert 11 in {tooth.tooth for tooth in again.teeth} and 11 not in again.missing
    assert 18 in again.missing


def test_what_certainly_moved_is_no_reference(
    found: comparing.Comparison, ways: list[Estimate], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Where pictures say little, what noise may do is far enough to take a moved tooth in."""
    taken_in = tuple(replace(way, still=(12, *way.still)) for way in ways)
    monkeypatch.setattr(comparing, "both_ways", lambda *_: taken_in)
    plain = {t.tooth: t for t in found.teeth}
    again = compare_visits(found.first, found.second)
    assert again.still == found.still
    for tooth in again.teeth:
        assert tooth.parts == pytest.approx(plain[tooth.tooth].parts, abs=1e-6), tooth.tooth


def test_what_one_way_lost_the_other_finds(
    found: comparing.Comparison, begun: list[Started], motions: dict
) -> None:
    """The pictures of both choose, whichever way is lost, in each other's frame and scale."""
    there, back = begun
    assert abs(found.relative_scale - 1) > 0.05
    true = solving.displacement(motions[12], there.centres[12])

    def off(way: Started) -> float:
        state = way.state.motions[12]
        return solving.travel(solving.displacement(state, way.centres[12]) - true)

    assert off(there) < 0.2  # both ways found it here
    lost = motion(there.centres[12], (1.4, 0.0, 0.0), (0.0, 0.0, 0.0))
    assert off(agreed(with_motion(there, 12, lost), back)[0]) < 0.2
    kept, mended = agreed(there, with_motion(back, 12, np.eye(4)))
    assert kept.state.motions[12] is there.state.motions[12]
    again = mirrored(mended.state.motions[12], there.first_from_second)
    assert np.allclose(again, there.state.motions[12], atol=1e-6)


def test_contrast_itself_improves_what_few_photographs_show(
    found: comparing.Comparison, begun: list[Started], motions: dict
) -> None:
    """And nothing else: not what four photographs show, not a tooth that stood still."""
    still = sorted(set(found.first.teeth) - set(motions))
    few = [replace(visit, looks=visit.looks[:3]) for visit in (found.first, found.second)]
    for count in (3, 4):
        way = begun[0]
        if count == 3:
            way = started(few[0], few[1], way.first_from_second, still)
        shift = np.eye(4)
        shift[:3, 3] = 0.15, 0.15, 0
        way = with_motion(with_motion(way, 12, shift @ motions[12]), 11, shift)
        better, fits = judged(
            way.first, way.second, way.state, still, way.centres,
            compared_pairs(way.first, way.state),
        )  # fmt: skip
        assert (12 in better) == (count == 3)
        assert not set(better) & set(still)
        assert set(fits) >= {11, 12, 21}
        if count == 3:
            true, centre = solving.displacement(motions[12], way.centres[12]), way.centres[12]
            off = solving.displacement(better[12], centre) - true
            assert solving.travel(off) < 0.1
            assert fits[12] > 0.8


@pytest.fixture(scope="module")
def faint(motions: dict[int, np.ndarray]) -> Started:
    """Two visits with faint marks under shading that stays with the light, as far as flow goes."""
    first, second = (
        toy_visit("first", smooth=True, larger=2),
        toy_visit("second", motions, turn=3.0, smooth=True, larger=2),
    )
    return started(first, second, np.eye(4), sorted(set(first.teeth) - set(motions)))


@pytest.fixture(scope="module")
def off_by_marks(faint: Started, motions: dict[int, np.ndarray]) -> np.ndarray:
    """By how much turns are off that marks in larger photographs tell, degrees."""
    return turns_off(finished(faint), motions)


def test_marks_tell_turns_where_shading_stays_with_the_light(
    faint: Started, off_by_marks: np.ndarray, motions: dict
) -> None:
    """Flow takes shading along; where there are no marks what it says is kept."""
    rng = np.random.default_rng(3)
    blank = tuple(
        replace(p, look=replace(p.look, larger=rng.random(p.look.image.shape, np.float32)))
        for p in faint.first
    )
    off = turns_off(finished(replace(faint, first=blank)), motions)
    assert (off > 1.0).all()
    assert (off_by_marks < 0.75 * off).all()


def test_larger_photographs_tell_turns_better(
    faint: Started, off_by_marks: np.ndarray, motions: dict
) -> None:
    small = replace(
        faint,
        first=tuple(replace(p, look=replace(p.look, larger=None)) for p in faint.first),
        second=tuple(replace(p, look=replace(p.look, larger=None)) for p in faint.second),
    )
    off_small = turns_off(finished(small), motions)
    assert (off_by_marks < off_small).all()
    assert off_by_marks.sum() < 0.6 * off_small.sum()


def turns_off(found: Estimate, motions: dict) -> np.ndarray:
    """By how much the turns that came out for teeth are off, degrees."""
    pairs = [(found.state.motions[n], motion) for n, motion in motions.items()]
    return np.array([angle_between(a[:3, :3], b[:3, :3]) for a, b in pairs])


def with_motion(found: Started, tooth: int, motion: np.ndarray) -> Started:
    """The same where a tooth is thought to have done something else."""
    motions = {**found.state.motions, tooth: motion}
    return replace(found, state=replace(found.state, motions=motions))


def test_the_scale_between_the_runs_comes_out(found: comparing.Comparison) -> None:
    assert found.relative_scale == pytest.approx(1 / 1.07, rel=2e-3)
    assert scale_of(found.first_from_second) == found.relative_scale


@pytest.mark.parametrize(
    ("doubts", "factor"),
    [((None, 2.0), 1.07), ((2.0, None), 1.0), ((None, 10.0), 1.0), ((10.0, None), 1.07)],
)
def test_the_surer_scale_counts_and_how_far_the_first_run_was_scaled_is_said(
    found: comparing.Comparison, ways: list[Estimate], monkeypatch: pytest.MonkeyPatch,
    doubts: tuple[float | None, float | None], factor: float,
) -> None:  # fmt: skip
    """Cameras in millimetres come before textbook teeth, and after a length."""
    monkeypatch.setattr(comparing, "both_ways", lambda *_: tuple(ways))
    first, second = (
        replace(visit, scale_percent=doubt, scale_source=f"{doubt}")
        for visit, doubt in zip((found.first, found.second), doubts, strict=True)
    )
    again = compare_visits(first, second)
    said = described(again)
    surer = 2.0 if 2.0 in doubts else None
    assert (said["scale_deviation_percent"], said["scale_source"]) == (surer, f"{surer}")
    assert said["relative_scale"] == pytest.approx(1 / 1.07, rel=2e-3)
    assert said["first_scaled_by"] == pytest.approx(factor, rel=5e-3)
    assert scale_of(again.first_from_second) == pytest.approx(factor / 1.07, rel=5e-3)
    for number, centre in again.first.centres.items():
        assert centre == pytest.approx(again.first_scaled_by * first.centres[number])


def test_words_say_what_is_certain(found: comparing.Comparison) -> None:
    """One of six parts may lie beyond its interval by chance: that is no movement."""
    beyond = replace(found, teeth=tuple(replace(t, half=t.half / 1e6) for t in found.teeth))
    for tooth in described(beyond)["teeth"]:
        assert tooth["words"].startswith("no movement") != tooth["moved"], tooth["fdi"]


def test_teeth_that_stood_still_lie_on_each_other_in_one_frame(
    found: comparing.Comparison,
) -> None:
    frame = found.first_from_second
    for number in found.still:
        there = frame[:3, :3] @ found.second.centres[number] + frame[:3, 3]
        assert np.linalg.norm(there - found.first.centres[number]) < 0.4, number


def test_nothing_moved_says_so() -> None:
    """And a number of which a run has no place in 3D is left out."""
    first, again = (
        Visit(whole.name, whole.looks[1:], teeth_points(whole.looks[1:]))
        for whole in (toy_visit("first"), toy_visit("again", turn=-4.0))
    )
    assert 25 in first.teeth and 25 in again.teeth
    found = compare_visits(replace(first, teeth=without(first.teeth, 25)), again)
    assert 25 not in {tooth.tooth for tooth in found.teeth}
    assert 25 in found.missing
    assert len(found.teeth) >= 14
    assert not [tooth.tooth for tooth in found.teeth if tooth.certain]


def without(teeth: Mapping[int, np.ndarray], number: int) -> dict[int, np.ndarray]:
    """All but one."""
    return {n: points for n, points in teeth.items() if n != number}


def test_two_patients_are_refused() -> None:
    """Of whom one photograph each shows the upper teeth."""

    def seen(whole: Visit) -> Visit:
        look = whole.looks[1]
        upper = (replace(look, labels=np.where(look.labels < 30, look.labels, 0)),)
        return Visit(whole.name, upper, teeth_points(upper))

    anna, berta = seen(toy_visit("anna")), seen(toy_visit("berta", patient=2))
    with pytest.raises(ReconstructionError, match="one patient"):
        compare_visits(anna, berta)


def test_teeth_of_one_side_are_refused_in_words() -> None:
    visit = toy_visit("anna")
    right = {n: points for n, points in visit.teeth.items() if n // 10 in (1, 4)}
    with pytest.raises(ReconstructionError, match=r"'anna' .*: teeth of both sides are needed"):
        compare_visits(visit, replace(visit, teeth=right, name="anna"))


def test_teeth_that_no_frame_brings_together_are_refused() -> None:
    visit = toy_visit("anna")
    few = {n: points for n, points in visit.teeth.items() if n in (11, 12, 13)}
    other = type(visit)("berta", visit.looks, few)
    with pytest.raises(ReconstructionError, match="can't be brought into one frame"):
        compare_visits(visit, other)
