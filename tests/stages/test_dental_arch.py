"""Labels and cameras of the dental path, on projections of a made-up patient."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pipeline.artifacts.dental.fdi import JAWS, Jaw
from pipeline.artifacts.teeth import Dentition
from pipeline.errors import RequestError
from stages.dentition.tooth_rows import POSITIONS
from stages.init.dental.cameras import kernels
from stages.init.dental.cameras.bundle import nominal_rotation
from stages.init.dental.numbering.arch import ArchOptions
from stages.init.dental.numbering.primary import ALL_PRIMARY
from stages.init.dental.template import (
    EMBRASURE,
    PAPILLA,
    TIP,
    ZENITH,
    is_lower_landmark,
    landmark_index,
    landmark_names,
    position_of,
    textbook_arch,
)
from tests.stages.dental_patient import (
    WIDTH,
    fit,
    patient,
    photograph,
    rotation_errors,
    three,
)
from tests.stages.mouth_case import looks_like

#: Fewer rivals are tried than for a patient; with all 40 the numbers of these mouths are the same.
QUICK = ArchOptions(rows_tried=8)
#: Hardly any rivals, where it does not matter which labelling wins.
SHORT = ArchOptions(rows_tried=3, candidates_per_view=2, beam=2)


def test_textbook_arch_is_symmetric_and_named_once() -> None:
    points, names = textbook_arch(), landmark_names()
    assert len(points) == len(names) == len(set(names)) == 108
    for jaw in JAWS:
        for kind, last in ((ZENITH, 13), (TIP, 13), (PAPILLA, 12), (EMBRASURE, 12)):
            for k in range(last + 1):
                a = points[landmark_index(jaw, kind, k)]
                b = points[landmark_index(jaw, kind, last - k)]
                np.testing.assert_allclose(a * [-1, 1, 1], b, atol=1e-9)


def test_closed_gap_moves_the_teeth_behind_it_forward() -> None:
    open_, closed = textbook_arch(), textbook_arch(frozenset({14}))
    behind = landmark_index("upper", ZENITH, 1)  # 16
    before = landmark_index("upper", ZENITH, 4)  # 13
    assert np.linalg.norm(closed[behind] - open_[behind]) > 4
    np.testing.assert_allclose(closed[before], open_[before], atol=0.5)


def test_primary_teeth_are_smaller_and_the_rest_moves_up() -> None:
    """Widths between embrasures, mm, of Wheeler's tables."""
    milk = frozenset({11, 12, 13, 14, 15, 21, 22, 23, 24, 25})
    permanent, primary = textbook_arch(), textbook_arch(frozenset(), milk)

    def width(points: np.ndarray, jaw: str, tooth: int) -> float:
        at = position_of(tooth)
        ends = [landmark_index(jaw, EMBRASURE, at + k) for k in (-1, 0)]  # type: ignore[arg-type]
        return float(np.linalg.norm(points[ends[1]] - points[ends[0]]))

    for tooth, wide, narrow in ((11, 8.5, 6.5), (12, 6.5, 5.1), (25, 6.8, 8.2)):
        assert width(permanent, "upper", tooth) == pytest.approx(wide, rel=0.12)
        assert width(primary, "upper", tooth) == pytest.approx(narrow, rel=0.12)
    # A primary canine among permanent incisors: what lies behind moves more than what lies before.
    one = textbook_arch(frozenset(), frozenset({23}))
    before, behind = (landmark_index("upper", TIP, position_of(t)) for t in (22, 24))
    assert np.linalg.norm(one[before] - permanent[before]) < 0.25
    assert 0.3 < np.linalg.norm(one[behind] - permanent[behind]) < 1.0
    lower = is_lower_landmark()
    np.testing.assert_array_equal(primary[lower], permanent[lower])
    zenith, tip = (landmark_index("upper", kind, position_of(11)) for kind in (ZENITH, TIP))
    assert primary[zenith, 1] - primary[tip, 1] == pytest.approx(6.0, abs=0.3)


def test_a_childs_arch_is_narrower_and_deeper_for_its_width() -> None:
    """Between the edges of canines and of what stands before the molars, and back to these, mm."""
    behind_incisors = frozenset(t for t in ALL_PRIMARY if t % 10 >= 3)

    def extent(points: np.ndarray, jaw: Jaw) -> tuple[float, float, float]:
        first, third, fifth = (
            points[landmark_index(jaw, TIP, POSITIONS // 2 + k)] for k in (0, 2, 4)
        )
        return 2 * third[0], 2 * fifth[0], first[2] - fifth[2]

    for jaw in JAWS:
        childs, changing, adults = (
            extent(textbook_arch(frozenset(), primary), jaw)
            for primary in (ALL_PRIMARY, behind_incisors, frozenset())
        )
        assert childs[0] < changing[0] < adults[0]
        assert childs[2] / childs[1] > 1.04 * adults[2] / adults[1]
        assert changing[2] / changing[1] > 1.04 * adults[2] / adults[1]
    assert extent(textbook_arch(frozenset(), ALL_PRIMARY), "upper") == pytest.approx(
        (28.5, 42.5, 20.5), abs=0.6
    )
    # All of it is the curve's: nothing lies on one spot behind its end.
    points = textbook_arch(frozenset(), ALL_PRIMARY)
    back = points[landmark_index("upper", TIP, POSITIONS - 2) :][:2]
    assert np.linalg.norm(back[1] - back[0]) > 5.0


def test_gradients_agree_with_finite_differences() -> None:
    rng = np.random.default_rng(3)
    views, count = 2, len(textbook_arch())
    nominal = np.stack([nominal_rotation(-40.0, 4.0), nominal_rotation(5.0, 4.0)])
    angles = np.radians([[8.0, 15.0, 6.0], [8.0, 8.0, 6.0]])
    focals, focal_deviations = np.full(views, 970.0), np.full(views, 0.12)
    template, lower = np.array(textbook_arch()), is_lower_landmark()
    view_of = np.repeat(np.arange(views), count)
    landmark_of = np.tile(np.arange(count), views)
    pixels = rng.uniform(-150, 150, (len(view_of), 2))
    deviations = rng.uniform(20, 40, (len(view_of), 2))
    pairs, starts = np.array([[0, 1]]), np.array([0, 60])
    matches = rng.uniform(-100, 100, (60, 4))
    offsets = rng.normal(size=(count, 3))

    def evaluate(x: np.ndarray, offsets: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
        n = len(x)
        H, b = np.zeros((n, n)), np.zeros(n)
        H_own, b_own = np.zeros((count, 3, 3)), np.zeros((count, 3))
        H_cross = np.zeros((count, n, 3))
        rotations, jacobians = np.empty((views, 3, 3)), np.empty((views, 3, 3))
        centres, lens = np.empty((views, 3)), np.empty(views)
        kernels.place_cameras(
            x, views, nominal, angles, 125.0, focals, focal_deviations, rotations, centres, lens,
            jacobians,
        )  # fmt: skip
        cost = kernels.add_priors(
            x, offsets, views, 125.0, 0.3, 0.1, centres, True, H, b, H_own, b_own
        )
        cost += kernels.add_landmarks(
            x, offsets, views, view_of, landmark_of, pixels, deviations, template, lower, 1.2,
            rotations, centres, lens, jacobians, angles, focal_deviations, True,
            H, b, H_own, b_own, H_cross,
        )  # fmt: skip
        cost += kernels.add_matches(
            pairs, starts, matches, np.array([0.3]), np.array([2.0]), rotations, centres, lens,
            jacobians, angles, focal_deviations, True, H, b,
        )  # fmt: skip
        return cost, b, b_own

    unknowns = 0.3 * rng.normal(size=7 * views + 9)
    _, half_gradient, half_own = evaluate(unknowns, offsets)

    def slope(of_unknowns: np.ndarray, of_offsets: np.ndarray) -> float:
        """Along a direction, by central differences."""
        costs = [
            evaluate(unknowns + sign * of_unknowns, offsets + sign * of_offsets)[0]
            for sign in (1e-5, -1e-5)
        ]
        return (costs[0] - costs[1]) / 2e-5

    for k, direction in enumerate(np.eye(len(unknowns))):
        found = slope(direction, np.zeros_like(offsets))
        assert found == pytest.approx(2 * half_gradient[k], rel=1e-5, abs=1e-4)
    for landmark in (0, 40, count - 1):
        for axis in range(3):
            direction = np.zeros_like(offsets)
            direction[landmark, axis] = 1
            found = slope(np.zeros_like(unknowns), direction)
            assert found == pytest.approx(2 * half_own[landmark, axis], rel=1e-5, abs=1e-4)


@pytest.mark.parametrize("yaws", [(-42.0, 0.0, 42.0), (-30.0, 5.0, 33.0), (-48.0, -6.0, 30.0)])
def test_three_photographs(yaws: tuple[float, ...]) -> None:
    dentitions, poses, teeth = three(yaws)
    result = fit(dentitions, QUICK)
    assert [view.role for view in result.views] == ["right", "frontal", "left"]
    for view, (upper, lower) in zip(result.views, teeth, strict=True):
        assert view.upper == upper
        assert view.lower == lower
    # its arch has another form than the textbook's: 4.2 to 4.5, with lens and distance known, too
    assert max(rotation_errors(result, poses)) < 5
    assert result.doubts == ()


@pytest.mark.parametrize("shown", [(0, 1), (1, 2)])
def test_two_photographs_one_of_them_from_the_front(shown: tuple[int, int]) -> None:
    dentitions, poses, teeth = three()
    result = fit([dentitions[k] for k in shown], QUICK)
    for view, k in zip(result.views, shown, strict=True):
        assert view.role == ("right", "frontal", "left")[k]
        assert (view.upper, view.lower) == teeth[k]
    # as of three photographs, and the arch's depth is less certain
    assert max(rotation_errors(result, [poses[k] for k in shown])) < 8
    assert result.doubts == ()


def test_two_photographs_of_the_sides_alone_are_doubted() -> None:
    dentitions, _, _ = three()
    result = fit([dentitions[0], dentitions[2]], QUICK)
    assert any(
        "right and left views, which share too few teeth: add one from the front" in doubt
        for doubt in result.doubts
    )


@pytest.mark.parametrize("height", [1.0, 1.25])
def test_a_mouth_of_textbook_size_does_not_come_out_smaller(height: float) -> None:
    """Offsets in true millimetres would be the cheaper the smaller the arch; and long crowns as
    wide as the textbook's are no small mouth."""
    factors = []
    for seed in (4, 5):
        points = patient(seed) * [1, height, 1]
        shots = [photograph(points, yaw, seed=k) for k, yaw in enumerate((-42.0, 0.0, 42.0))]
        shape = fit([shot[0] for shot in shots], SHORT).shape
        names = [name for name in landmark_names() if name in shape]
        found = np.stack([shape[name] for name in names])
        true = points[[landmark_names().index(name) for name in names]]
        spreads = [np.linalg.norm(p - p.mean(0), axis=1).mean() for p in (found, true)]
        factors.append(spreads[0] / spreads[1])
    # 1.05 and 1.03 (the generator's arches are small); by the adjustment alone 1.02 and .94.
    assert np.mean(factors) == pytest.approx(1.04, abs=0.03)


def test_any_order_and_any_number_of_threads_give_the_same() -> None:
    dentitions, _, _ = three()
    forward = fit(dentitions, SHORT)
    threaded = fit(dentitions, SHORT, threads=2)
    shuffled = fit([dentitions[k] for k in (2, 0, 1)], SHORT)
    assert [view.role for view in shuffled.views] == ["left", "right", "frontal"]
    for k, place in ((2, 0), (0, 1), (1, 2)):
        assert forward.views[k].upper == shuffled.views[place].upper
        np.testing.assert_array_equal(
            forward.views[k].cam_from_world, threaded.views[k].cam_from_world
        )


def test_roll_is_taken_out_and_put_back() -> None:
    dentitions, poses, teeth = three(rolls=(0.35, -0.2, 0.3))
    result = fit(dentitions, QUICK)
    assert [view.upper for view in result.views] == [upper for upper, _ in teeth]
    assert max(rotation_errors(result, poses)) < 7  # fewer crowns fit into turned pictures


def test_known_focal_lengths_are_held() -> None:
    dentitions, _, _ = three()
    result = fit(dentitions, SHORT, focals=[950.0, None, 950.0])
    assert result.views[0].focal == 950.0
    assert result.views[2].focal == 950.0
    assert result.views[1].focal != 1.9 * WIDTH


def test_swapped_order_is_said() -> None:
    dentitions, _, teeth = three()
    right = fit(dentitions, replace(SHORT, order=("right", "frontal", "left")))
    assert right.doubts == ()
    swapped = fit(dentitions, replace(SHORT, order=("left", "frontal", "right")))
    assert any("swapped" in doubt for doubt in swapped.doubts)
    assert swapped.views[0].upper == teeth[0][0]


def without_12(looks: bool) -> tuple[list[Dentition], list[tuple[int, ...]]]:
    """Photographs of a patient who lacks the right lateral incisor; its space is open."""
    dentitions, _, teeth = three()
    kept, expected = [], []
    for dentition, (upper, _) in zip(dentitions, teeth, strict=True):
        row = [
            crown if looks else replace(crown, numbers={})
            for crown, tooth in zip(dentition.upper, upper, strict=True)
            if tooth != 12
        ]
        kept.append(replace(dentition, upper=tuple(row)))
        expected.append(tuple(tooth for tooth in upper if tooth != 12))
    return kept, expected


def test_missing_tooth_leaves_the_other_numbers_right() -> None:
    kept, expected = without_12(looks=True)
    result = fit(kept, QUICK)
    for view, upper in zip(result.views, expected, strict=True):
        assert all(found in (0, true) for found, true in zip(view.upper, upper, strict=True))
        assert view.upper.count(0) <= 1


def test_premolars_whose_space_has_closed_are_found_missing() -> None:
    """Molars stand where premolars would, and may look like them."""
    gone = (15, 25)
    kept: list[Dentition | None] = []
    expected = []
    shift = textbook_arch(frozenset(gone)) - textbook_arch()
    shots = [photograph(patient(4) + shift, yaw, seed=k) for k, yaw in enumerate((-42.0, 0, 42.0))]
    for dentition, _, (upper, _) in shots:
        row = [
            replace(crown, numbers=looks_like(tooth - 1 if tooth % 10 == 6 else tooth, 0.5))
            for crown, tooth in zip(dentition.upper, upper, strict=True)
            if tooth not in gone
        ]
        kept.append(replace(dentition, upper=tuple(row)))
        expected.append(tuple(tooth for tooth in upper if tooth not in gone))
    result = fit(kept, QUICK)
    for view, upper in zip(result.views, expected, strict=True):
        assert view.upper == upper


def test_what_is_wrong_without_looks_is_marked() -> None:
    kept, expected = without_12(looks=False)
    result = fit(kept, QUICK)
    for view, upper in zip(result.views, expected, strict=True):
        for found, true, doubt in zip(view.upper, upper, view.upper_doubts, strict=True):
            assert found in (0, true) or doubt > 0.1


def test_merged_crowns_leave_the_other_numbers_right() -> None:
    dentitions, _, teeth = three()
    row = dentitions[0].upper
    i = teeth[0][0].index(14)
    merged = replace(
        row[i],
        papilla_right=row[i + 1].papilla_right,
        embrasure_right=row[i + 1].embrasure_right,
        width=row[i].width + row[i + 1].width,
        numbers={},
    )
    dentitions[0] = replace(dentitions[0], upper=(*row[:i], merged, *row[i + 2 :]))
    expected = (*teeth[0][0][:i], 0, *teeth[0][0][i + 2 :])
    result = fit(dentitions, QUICK)
    for k, (found, true) in enumerate(zip(result.views[0].upper, expected, strict=True)):
        assert k == i or found in (0, true)


def with_crown(dentition: Dentition, index: int, **changes: object) -> Dentition:
    """A dentition with one upper crown changed."""
    row = dentition.upper
    changed = replace(row[index], **changes)  # type: ignore[arg-type]
    return replace(dentition, upper=(*row[:index], changed, *row[index + 1 :]))


def test_a_number_that_a_person_has_said_is_kept() -> None:
    dentitions, _, teeth = three()
    wrong = teeth[1][0][3]
    dentitions[1] = with_crown(dentitions[1], 2, number=wrong, doubt=0.0)
    result = fit(dentitions, SHORT)
    assert result.views[1].upper[2] == wrong
    assert result.views[1].upper_doubts[2] < 0.001


def test_a_wisdom_tooth_that_a_person_has_said_is_none_of_the_row() -> None:
    dentitions, _, teeth = three()
    dentitions[0] = with_crown(dentitions[0], 0, number=18, doubt=0.0)
    assert fit(dentitions, QUICK).views[0].upper == (0, *teeth[0][0][1:])


def test_a_number_that_nobody_is_sure_of_binds_nothing() -> None:
    dentitions, _, teeth = three()
    dentitions[1] = with_crown(dentitions[1], 2, number=teeth[1][0][3], doubt=0.01)
    assert fit(dentitions, QUICK).views[1].upper == teeth[1][0]


def test_numbers_that_contradict_are_refused() -> None:
    dentitions, _, teeth = three()
    for index, tooth in ((2, teeth[1][0][4]), (3, teeth[1][0][2])):
        dentitions[1] = with_crown(dentitions[1], index, number=tooth, doubt=0.0)
    with pytest.raises(RequestError, match="given for photo 1 contradict"):
        fit(dentitions, SHORT)


@pytest.mark.parametrize(("view", "step"), [(1, 1), (2, 0)], ids=["side by side", "elsewhere"])
def test_a_primary_tooth_and_its_successor_are_not_both_taken_for_one(view: int, step: int) -> None:
    dentitions, _, teeth = three()
    tooth = 21
    index = teeth[1][0].index(tooth)
    dentitions[1] = with_crown(dentitions[1], index, number=tooth, doubt=0.0)
    other = teeth[view][0].index(tooth) + step
    dentitions[view] = with_crown(dentitions[view], other, number=61, doubt=0.0)
    with pytest.raises(RequestError, match=f"21 in photo 1, 61 in photo {view}"):
        fit(dentitions, SHORT)


def test_unplaceable_photographs_are_named() -> None:
    dentitions, _, _ = three()
    few = replace(dentitions[1], upper=dentitions[1].upper[:2], lower=())
    result = fit([dentitions[0], few, dentitions[2]], SHORT)
    assert result.views[1] is None
    assert any("photo 1" in doubt for doubt in result.doubts)
    without = fit([dentitions[0], None, dentitions[2]], SHORT)
    assert without.views[1] is None
    assert not any("photo 1" in doubt for doubt in without.doubts)  # it was set aside before
    nothing = fit([None, None], SHORT)
    assert nothing.views == (None, None)
    assert nothing.doubts
    with pytest.raises(RequestError, match="order"):
        fit(dentitions, replace(SHORT, order=("right", "left")))
