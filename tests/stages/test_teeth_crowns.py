"""From outlines to a dentition: order, roll, landmarks, on crowns whose shape is a formula."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from pipeline.artifacts.dental.fdi import Jaw
from pipeline.artifacts.teeth import Crown, Dentition
from stages.dentition.crowns import (
    MEETING,
    NATURAL_TILT,
    ZENITH_FLATNESS,
    Outline,
    centroid,
    dentition_of,
    mirrored_dentition,
    outline_of,
)
from tests.stages.crowns_case import (
    HEIGHT,
    LOWER_WIDTHS,
    MIDDLE,
    RISE,
    ROUND,
    SIZE,
    UPPER_WIDTHS,
    mouth,
    row,
    turned,
)

#: Landmarks lie this near to where the formula has them, pixels.
NEAR = 2.5


def read(outlines: list[Outline], **more: object) -> Dentition:
    return dentition_of(outlines, "000", SIZE, "front", **more)  # type: ignore[arg-type]


def shuffled(outlines: list[Outline]) -> list[Outline]:
    return [outlines[k] for k in np.random.default_rng(0).permutation(len(outlines))]


def place(point: np.ndarray | None, degrees: float) -> np.ndarray:
    """A landmark in the frame of the formulas: from the picture's middle, turned back."""
    assert point is not None
    return turned(point[None], -degrees)[0] - MIDDLE


@pytest.mark.parametrize("degrees", [0.0, 9.0, -17.0, 30.0, -45.0, 45.0])
def test_order_and_landmarks_at_any_roll(degrees: float) -> None:
    found = read(shuffled(mouth(degrees)))
    assert np.degrees(found.roll) == pytest.approx(degrees, abs=0.5)
    for jaw, widths in (("upper", UPPER_WIDTHS), ("lower", LOWER_WIDTHS)):
        up = -1 if jaw == "upper" else 1
        crowns = found.crowns(jaw)
        assert [crown.number for crown in crowns] == list(range(1, len(widths) + 1))
        for k, (crown, x) in enumerate(zip(crowns, row(widths, jaw), strict=True)):
            half = widths[k] / 2
            # Gum lines that fall towards each other meet a little above the corner.
            meeting = RISE * (1 - MEETING * HEIGHT / half) ** 2
            expected = {
                "zenith": (x, up * (HEIGHT + 1)),
                "tip": (x, up * 1.0),
                "papilla_left": (x - half, up * (HEIGHT - meeting + 1)),
                "papilla_right": (x + half, up * (HEIGHT - meeting + 1)),
                "embrasure_left": (x - half, up * (ROUND + 1)),
                "embrasure_right": (x + half, up * (ROUND + 1)),
            }
            for name, wanted in expected.items():
                end = {"left": k == 0, "right": k == len(widths) - 1}
                if end.get(name.rpartition("_")[2]):
                    assert getattr(crown, name) is None
                    continue
                at = place(getattr(crown, name), degrees)
                assert np.linalg.norm(at - wanted) < NEAR, (jaw, k, name)
            assert crown.width == pytest.approx(widths[k], abs=NEAR)
            assert crown.height == pytest.approx(HEIGHT, abs=NEAR)
            assert (crown.cut_left, crown.cut_right) == (k == 0, k == len(widths) - 1)
            assert not crown.doubtful
    assert found.band_height == pytest.approx(2 * HEIGHT, abs=3)
    assert found.jaws_apart == pytest.approx(2 / 140, abs=0.01)


def test_upside_down_photographs_are_turned() -> None:
    found = read(mouth(180.0))
    assert abs(np.degrees(found.roll)) == pytest.approx(180, abs=0.5)
    assert [crown.number for crown in found.upper] == list(range(1, 8))
    for crown in found.upper:
        assert crown.zenith[1] > crown.tip[1]


def test_a_row_that_is_nearly_level_is_not_turned() -> None:
    """A view from above or below tilts the rows as much."""
    found = read(mouth(np.degrees(NATURAL_TILT) - 0.7))
    assert found.roll == 0
    given = read(mouth(30.0), roll=np.radians(28.0))
    assert given.roll == np.radians(28.0)


def test_a_zenith_off_the_middle_is_found() -> None:
    """It is the middle of the stretch that is nearly as high as the highest point."""
    found = read(mouth(bump=0.4))
    reach = np.sqrt(ZENITH_FLATNESS * found.band_height / RISE)
    share = 0.4 + ((1 - 0.4) - (1 + 0.4)) * reach / 2
    assert share > 0.15
    for crown, x, width in zip(found.upper, row(UPPER_WIDTHS, "upper"), UPPER_WIDTHS, strict=True):
        offset = place(crown.zenith, 0)[0] - x
        assert offset == pytest.approx(share * width / 2, abs=0.5)


@pytest.mark.parametrize("jaw", ["upper", "lower"])
def test_one_jaw_alone(jaw: Jaw) -> None:
    found = read(mouth(20.0, jaws=(jaw,)))
    other = found.lower if jaw == "upper" else found.upper
    assert other == ()
    assert np.degrees(found.roll) == pytest.approx(20, abs=0.5)
    assert found.band_height == pytest.approx(1.8 * HEIGHT, rel=0.05)
    assert found.jaws_apart == 0
    up = -1 if jaw == "upper" else 1
    for crown in found.crowns(jaw):
        assert up * (place(crown.zenith, 20) - place(crown.tip, 20))[1] > 0.9 * HEIGHT


def test_across_a_gap_there_is_no_papilla() -> None:
    found = read(mouth(gaps={3: 20.0}))
    before, after = found.upper[2], found.upper[3]
    for crown, side in ((before, "right"), (after, "left")):
        assert getattr(crown, f"papilla_{side}") is None
        assert getattr(crown, f"embrasure_{side}") is None
    assert before.papilla_left is not None
    assert after.papilla_right is not None
    # A gap inside is no end of the row.
    assert not before.cut_right
    assert not after.cut_left
    narrow = read(mouth(gaps={3: 4.0})).upper
    assert narrow[2].papilla_right is not None
    np.testing.assert_array_equal(narrow[2].papilla_right, narrow[3].papilla_left)


def test_papillae_hardly_move_with_how_far_round_crowns_overlap() -> None:
    """In one photograph neighbours touch, in another one covers some of the other."""
    round_ = np.stack([f(np.linspace(0, 2 * np.pi, 400)) for f in (np.cos, np.sin)], 1)

    def height(apart: float) -> float:
        """Of the papilla above the middle of round crowns, upwards."""
        outlines = [
            Outline(round_ * (22, 35) + MIDDLE + (k * (44 + apart), 36 * up), jaw)
            for jaw, up in (("upper", -1), ("lower", 1))
            for k in (-1, 0, 1)
        ]
        crown = read(outlines).upper[1]
        assert crown.papilla_left is not None
        return float(MIDDLE[1] - 36 - crown.papilla_left[1])

    touching, overlapping, apart = height(0.0), height(-4.0), height(6.0)
    assert 8 < touching < 35, "above where they are widest"
    assert 0 < overlapping - touching < 5, "the corner of their outlines moves by 15"
    assert apart == pytest.approx(touching, abs=1), "with a gap between them as where they touch"


def test_jaws_apart_are_measured() -> None:
    assert read(mouth(apart=28.0)).jaws_apart == pytest.approx(28 / 140, abs=0.03)
    deep = read(mouth(apart=-30.0))
    assert deep.jaws_apart == 0
    assert deep.band_height == pytest.approx(2 * HEIGHT - 30, abs=4)


def test_crowns_at_the_border_and_weak_ones_are_doubtful() -> None:
    outlines = mouth()
    shift = np.array([-(outlines[0].polygon[:, 0].min() + 10), 0])
    moved = [replace(o, polygon=np.maximum(o.polygon + shift, 0.5)) for o in outlines]
    moved[3] = replace(moved[3], score=0.3)
    found = read(moved)
    assert [crown.doubtful for crown in found.upper] == [True, False, False, True, *[False] * 3]


def test_bad_outlines_are_left_out_and_nothing_is_a_dentition() -> None:
    line = Outline(np.zeros((2, 2)), "upper")
    assert read([line]).all_crowns == ()
    empty = dentition_of([], "a", SIZE, "none", set_aside="why")
    assert (empty.set_aside, empty.band_height) == ("why", 0.0)
    assert len(read([*mouth(), line]).all_crowns) == len(UPPER_WIDTHS) + len(LOWER_WIDTHS)
    single = read([mouth()[2]]).upper[0]
    assert single.papilla_left is None
    assert single.cut_left
    assert single.cut_right


def test_outlines_lead_to_the_same_dentition_again() -> None:
    first = read(mouth(33.0), set_aside="why")
    again = dentition_of(
        [outline_of(crown) for crown in first.all_crowns], "000", SIZE, "front", first.roll, "why",
    )  # fmt: skip
    assert as_text(first) == as_text(again)
    crown = first.upper[0]
    assert (crown.score, crown.numbers, crown.number, crown.doubt) == (0.9, {11: 1.0}, 1, 0.3)


def numbered(outlines: list[Outline]) -> list[Outline]:
    """With numbers that are those of teeth; the third of each row was said by a person."""
    count = {"upper": len(UPPER_WIDTHS), "lower": len(LOWER_WIDTHS)}
    first = {"upper": [14, 13, 12, 11, 21, 22, 63], "lower": [44, 43, 42, 41, 31, 32]}
    result = []
    for jaw in ("upper", "lower"):
        row = [outline for outline in outlines if outline.jaw == jaw]
        assert len(row) == count[jaw]
        for k, (outline, number) in enumerate(zip(row, first[jaw], strict=True)):
            shares = {number: 0.75, 24: 0.25}
            result.append(
                replace(outline, number=number, numbers=shares, doubt=0.0 if k == 2 else 0.3)
            )
    return result


@pytest.mark.parametrize("degrees", [0.0, -17.0, 40.0, 180.0])
def test_teeth_of_a_mirror_image(degrees: float) -> None:
    """As they would have been read from the picture turned over."""
    outlines = numbered(mouth(degrees, bump=0.4, gaps={3: 20.0}))
    found = read(outlines, set_aside="why")
    over = mirrored_dentition(found)
    turned_over = [replace(o, polygon=o.polygon * [-1, 1] + [SIZE[0], 0]) for o in outlines]
    expected = read(turned_over)
    assert np.sin(over.roll - expected.roll) == pytest.approx(0, abs=1e-9)
    assert (over.band_height, over.jaws_apart) == (found.band_height, found.jaws_apart)
    assert (over.set_aside, over.mirrored) == ("why", True)
    assert [crown.number for crown in over.upper] == [53, 12, 11, 21, 12, 23, 24]
    assert [crown.number for crown in over.lower] == [42, 41, 31, 42, 33, 34]
    assert [crown.doubt for crown in over.upper] == [0.3, 0.3, 0.3, 0.3, 0, 0.3, 0.3]
    assert over.upper[-1].numbers == {24: 0.75, 14: 0.25}
    for crown, wanted in zip(over.all_crowns, expected.all_crowns, strict=True):
        np.testing.assert_allclose(crown.outline, wanted.outline[::-1])
        for name, value in vars(wanted).items():
            if isinstance(value, np.ndarray) and name != "outline":
                assert np.linalg.norm(getattr(crown, name) - value) < NEAR
            elif name not in ("outline", "number", "numbers", "width", "height"):
                assert getattr(crown, name) == value, name
    again = mirrored_dentition(over)
    assert again.roll == found.roll
    for crown, wanted in zip(again.all_crowns, found.all_crowns, strict=True):
        for name, value in vars(wanted).items():
            if isinstance(value, np.ndarray):
                np.testing.assert_allclose(getattr(crown, name), value)
            else:
                assert getattr(crown, name) == value, name


def test_sides_change_and_crowns_without_outline_stay_in_a_mirror_image() -> None:
    found = replace(read(mouth()), kind="right")
    assert mirrored_dentition(found).kind == "left"
    assert mirrored_dentition(replace(found, kind="left")).kind == "right"
    assert mirrored_dentition(replace(found, kind="front")).kind == "front"
    bare = tuple(replace(crown, outline=np.zeros((0, 2)), number=0) for crown in found.upper)
    over = mirrored_dentition(replace(found, upper=bare))
    assert [crown.number for crown in over.upper] == [0] * len(bare)
    assert over.upper[0].zenith[0] == SIZE[0] - bare[-1].zenith[0]
    empty = mirrored_dentition(Dentition("a", SIZE, "none"))
    assert (empty.all_crowns, empty.mirrored) == ((), True)


def as_text(dentition: Dentition) -> str:
    def plain(value: object) -> object:
        if isinstance(value, Crown):
            return vars(value)
        return value.tolist() if isinstance(value, np.ndarray) else str(value)

    return json.dumps(vars(dentition), default=plain)


def test_centroid_is_that_of_the_area() -> None:
    square = np.array([[0, 0], [1, 0], [2, 0], [4, 0], [4, 2], [0, 2.0]])
    np.testing.assert_allclose(centroid(square), [2, 1])
    np.testing.assert_allclose(centroid(square[::-1]), [2, 1])
    np.testing.assert_allclose(centroid(np.array([[0, 0], [1, 1], [2, 2.0]])), [1, 1])
