"""Labels and cameras of the dental path, on projections of a made-up patient."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pipeline.artifacts.dental.fdi import JAWS
from pipeline.artifacts.teeth import Crown, Dentition
from pipeline.errors import RequestError
from stages.init.dental.cameras import kernels
from stages.init.dental.cameras.bundle import nominal_rotation
from stages.init.dental.numbering.arch import ArchOptions, fit_arch
from stages.init.dental.numbering.sightings import upright
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
    tooth_at,
)
from tests.stages.mouth_case import arch_of, looks_like

#: Fewer rivals are tried than for a patient; with all 40 the numbers of these mouths are the same.
QUICK = ArchOptions(rows_tried=8)
WIDTH, HEIGHT = 512, 384
CENTRE = np.array([0.0, 0.0, -16.0])


def patient(seed: int) -> np.ndarray:
    """[L, 3] landmarks of a generated mouth: another arch and other teeth than the textbook's."""
    marks = arch_of(seed, arch_power=2.5, arch_width=1.04, size=1.0)
    points = np.empty((len(landmark_names()), 3))
    for jaw in JAWS:
        for kind, name in ((ZENITH, "zenith"), (TIP, "tip")):
            for position in range(14):
                at = landmark_index(jaw, kind, position)
                points[at] = marks[name, tooth_at(jaw, position)]
        for kind, name in ((PAPILLA, "papilla"), (EMBRASURE, "embrasure")):
            for position in range(13):
                at = landmark_index(jaw, kind, position)
                points[at] = marks[name, tooth_at(jaw, position)]
    return points


def photograph(
    points: np.ndarray, yaw: float, roll: float = 0.0, seed: int = 0, focal: float = 950.0
) -> tuple[Dentition, np.ndarray, tuple[tuple[int, ...], tuple[int, ...]]]:
    """What a camera at a yaw sees of the crowns that face it; its pose; the true teeth."""
    rng = np.random.default_rng(seed)
    turn = np.array(
        [[np.cos(roll), -np.sin(roll), 0], [np.sin(roll), np.cos(roll), 0], [0, 0, 1.0]]
    )
    pose = np.eye(4)
    pose[:3, :3] = nominal_rotation(yaw, 6.0)
    pose[:3, 3] = np.array([0.0, 0.0, 118.0]) - pose[:3, :3] @ CENTRE
    pose[:3] = turn @ pose[:3]
    camera = points @ pose[:3, :3].T + pose[:3, 3]
    pixels = focal * camera[:, :2] / camera[:, 2:] + np.array([WIDTH / 2, HEIGHT / 2])
    pixels = pixels + rng.normal(scale=0.6, size=pixels.shape)
    flat = upright(pixels, roll, WIDTH, HEIGHT)
    rows: list[tuple[Crown, ...]] = []
    teeth: list[tuple[int, ...]] = []
    for jaw in JAWS:
        shown = []
        for position in range(14):
            left = landmark_index(jaw, PAPILLA, max(position - 1, 0))
            right = landmark_index(jaw, PAPILLA, min(position, 12))
            across = flat[right, 0] - flat[left, 0] if 0 < position < 13 else 20.0
            zenith = pixels[landmark_index(jaw, ZENITH, position)]
            inside = 8 < zenith[0] < WIDTH - 8 and 8 < zenith[1] < HEIGHT - 8
            if across > 9 and inside:
                shown.append(position)
        first = max((p for p in shown if p - 1 not in shown and p <= 7), default=shown[0])
        shown = [p for p in shown if p >= first]
        gap = next((p for p in range(first, 14) if p not in shown), 14)
        shown = list(range(first, gap))
        crowns = []
        for k, position in enumerate(shown):

            def at(kind: int, index: int, jaw: str = jaw) -> np.ndarray:
                return pixels[landmark_index(jaw, kind, index)]  # type: ignore[arg-type]

            at_left, at_right = k == 0, k == len(shown) - 1
            crowns.append(
                Crown(
                    jaw=jaw,
                    zenith=at(ZENITH, position),
                    tip=at(TIP, position),
                    papilla_left=None if at_left else at(PAPILLA, position - 1),
                    papilla_right=None if at_right else at(PAPILLA, position),
                    embrasure_left=None if at_left else at(EMBRASURE, position - 1),
                    embrasure_right=None if at_right else at(EMBRASURE, position),
                    width=50.0,
                    height=50.0,
                    cut_left=at_left,
                    cut_right=at_right,
                    numbers=looks_like(tooth_at(jaw, position), 0.6),
                )
            )
        rows.append(tuple(crowns))
        teeth.append(tuple(tooth_at(jaw, p) for p in shown))
    return (
        Dentition("", (WIDTH, HEIGHT), "other", rows[0], rows[1], roll, 90.0),
        pose,
        (teeth[0], teeth[1]),
    )


def fit(dentitions: list[Dentition | None], options: ArchOptions, **more: object):
    """`fit_arch` without photographs: landmarks alone."""
    count = len(dentitions)
    images = [np.full((HEIGHT, WIDTH, 3), 0.5, np.float32)] * count
    valid = [np.ones((HEIGHT, WIDTH), bool)] * count
    focals = more.get("focals", [None] * count)
    return fit_arch(
        dentitions, images, valid, focals, replace(options, dense_rounds=0),
        int(more.get("threads", 1)), lambda *_: None,
    )  # fmt: skip


def rotation_errors(result, poses: list[np.ndarray]) -> list[float]:
    """Degrees between true and found relative rotations of neighbours."""
    errors = []
    found = [view.cam_from_world[:3, :3] for view in result.views]
    true = [pose[:3, :3] for pose in poses]
    for i in range(len(true) - 1):
        off = (found[i + 1] @ found[i].T) @ (true[i + 1] @ true[i].T).T
        errors.append(float(np.degrees(np.arccos(np.clip((np.trace(off) - 1) / 2, -1, 1)))))
    return errors


def three(yaws: tuple[float, ...] = (-42.0, 0.0, 42.0), rolls: tuple[float, ...] = (0, 0, 0)):
    points = patient(4)
    shots = [
        photograph(points, y, r, seed=i) for i, (y, r) in enumerate(zip(yaws, rolls, strict=True))
    ]
    return [s[0] for s in shots], [s[1] for s in shots], [s[2] for s in shots]


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
    # A primary canine among permanent incisors: what lies before it stays, what lies behind moves.
    one = textbook_arch(frozenset(), frozenset({23}))
    before, behind = (landmark_index("upper", TIP, position_of(t)) for t in (22, 24))
    np.testing.assert_array_equal(one[before], permanent[before])
    assert 0.3 < np.linalg.norm(one[behind] - permanent[behind]) < 1.0
    lower = is_lower_landmark()
    np.testing.assert_array_equal(primary[lower], permanent[lower])
    zenith, tip = (landmark_index("upper", kind, position_of(11)) for kind in (ZENITH, TIP))
    assert primary[zenith, 1] - primary[tip, 1] == pytest.approx(6.0, abs=0.3)


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

    def evaluate(x: np.ndarray) -> tuple[float, np.ndarray]:
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
        cost = kernels.add_priors(x, offsets, views, 125.0, 0.15, centres, True, H, b, H_own, b_own)
        cost += kernels.add_landmarks(
            x, offsets, views, view_of, landmark_of, pixels, deviations, template, lower, 1.2,
            rotations, centres, lens, jacobians, angles, focal_deviations, True,
            H, b, H_own, b_own, H_cross,
        )  # fmt: skip
        cost += kernels.add_matches(
            pairs, starts, matches, np.array([0.3]), np.array([2.0]), rotations, centres, lens,
            jacobians, angles, focal_deviations, True, H, b,
        )  # fmt: skip
        return cost, b

    unknowns = 0.3 * rng.normal(size=7 * views + 9)
    half_gradient = evaluate(unknowns)[1]
    for k in range(len(unknowns)):
        step = np.zeros_like(unknowns)
        step[k] = 1e-5
        slope = (evaluate(unknowns + step)[0] - evaluate(unknowns - step)[0]) / 2e-5
        assert slope == pytest.approx(2 * half_gradient[k], rel=1e-5, abs=1e-4)


@pytest.mark.parametrize("yaws", [(-42.0, 0.0, 42.0), (-30.0, 5.0, 33.0), (-48.0, -6.0, 30.0)])
def test_three_photographs(yaws: tuple[float, ...]) -> None:
    dentitions, poses, teeth = three(yaws)
    result = fit(dentitions, QUICK)
    assert [view.role for view in result.views] == ["right", "frontal", "left"]
    for view, (upper, lower) in zip(result.views, teeth, strict=True):
        assert view.upper == upper
        assert view.lower == lower
    assert max(rotation_errors(result, poses)) < 4
    assert result.doubts == ()


def test_any_order_and_any_number_of_threads_give_the_same() -> None:
    dentitions, _, _ = three()
    forward = fit(dentitions, QUICK)
    threaded = fit(dentitions, QUICK, threads=2)
    shuffled = fit([dentitions[k] for k in (2, 0, 1)], QUICK)
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
    result = fit(dentitions, QUICK, focals=[950.0, None, 950.0])
    assert result.views[0].focal == 950.0
    assert result.views[2].focal == 950.0
    assert result.views[1].focal != 1.9 * WIDTH


def test_swapped_order_is_said() -> None:
    dentitions, _, teeth = three()
    right = fit(dentitions, replace(QUICK, order=("right", "frontal", "left")))
    assert right.doubts == ()
    swapped = fit(dentitions, replace(QUICK, order=("left", "frontal", "right")))
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
    result = fit(dentitions, QUICK)
    assert result.views[1].upper[2] == wrong
    assert result.views[1].upper_doubts[2] < 0.001


def test_a_number_that_nobody_is_sure_of_binds_nothing() -> None:
    dentitions, _, teeth = three()
    dentitions[1] = with_crown(dentitions[1], 2, number=teeth[1][0][3], doubt=0.01)
    assert fit(dentitions, QUICK).views[1].upper == teeth[1][0]


def test_numbers_that_contradict_are_refused() -> None:
    dentitions, _, teeth = three()
    for index, tooth in ((2, teeth[1][0][4]), (3, teeth[1][0][2])):
        dentitions[1] = with_crown(dentitions[1], index, number=tooth, doubt=0.0)
    with pytest.raises(RequestError, match="contradict"):
        fit(dentitions, QUICK)


def test_unplaceable_photographs_are_named() -> None:
    dentitions, _, _ = three()
    few = replace(dentitions[1], upper=dentitions[1].upper[:2], lower=())
    result = fit([dentitions[0], few, dentitions[2]], QUICK)
    assert result.views[1] is None
    assert any("photo 1" in doubt for doubt in result.doubts)
    without = fit([dentitions[0], None, dentitions[2]], QUICK)
    assert without.views[1] is None
    assert not any("photo 1" in doubt for doubt in without.doubts)  # it was set aside before
    nothing = fit([None, None], QUICK)
    assert nothing.views == (None, None)
    assert nothing.doubts
    with pytest.raises(RequestError, match="order"):
        fit(dentitions, replace(QUICK, order=("right", "left")))
