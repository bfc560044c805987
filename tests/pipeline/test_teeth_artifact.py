"""Numbers of teeth, and the artifact `teeth`: what goes to the disk comes back."""

from __future__ import annotations

import json
from dataclasses import fields, replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from pipeline.artifacts import artifact_class
from pipeline.artifacts.dental.fdi import (
    ALL_TEETH,
    JAWS,
    is_left,
    is_primary,
    is_upper,
    other_side,
    permanent_of,
    primary_of,
    teeth_of,
    universal_number,
)
from pipeline.artifacts.teeth import Crown, Dentition, Teeth, filled

WIDTH, HEIGHT = 120, 80


@pytest.mark.parametrize(
    ("tooth", "universal"),
    [
        (11, "8"), (18, "1"), (21, "9"), (28, "16"), (38, "17"), (31, "24"), (41, "25"),
        (48, "32"), (55, "A"), (51, "E"), (61, "F"), (65, "J"), (75, "K"), (71, "O"), (81, "P"),
        (85, "T"),
    ],
)  # fmt: skip
def test_universal_numbers(tooth: int, universal: str) -> None:
    assert universal_number(tooth) == universal


def test_every_tooth_has_a_universal_number_of_its_own() -> None:
    assert len(ALL_TEETH) == 52
    names = {universal_number(tooth) for tooth in ALL_TEETH}
    assert names == {str(k) for k in range(1, 33)} | set("ABCDEFGHIJKLMNOPQRST")
    for nothing in (0, 10, 19, 49, 50, 56, 86, 91, -11):
        with pytest.raises(ValueError, match="no FDI number"):
            universal_number(nothing)


def test_primary_and_permanent_lead_to_each_other() -> None:
    for tooth in ALL_TEETH:
        assert permanent_of(permanent_of(tooth)) == permanent_of(tooth)
        assert is_primary(tooth) == (tooth > 50)
        if is_primary(tooth):
            assert primary_of(permanent_of(tooth)) == tooth == primary_of(tooth)
        elif tooth % 10 <= 5:
            assert permanent_of(primary_of(tooth)) == tooth
        else:
            with pytest.raises(ValueError, match="no primary tooth"):
                primary_of(tooth)
        # The place in the mouth is the same.
        assert is_upper(tooth) == is_upper(permanent_of(tooth)) == (tooth // 10 in (1, 2, 5, 6))
        assert is_left(tooth) == is_left(permanent_of(tooth)) == (tooth // 10 in (2, 3, 6, 7))


def test_the_other_side_has_the_same_teeth() -> None:
    pairs = {11: 21, 17: 27, 38: 48, 41: 31, 51: 61, 75: 85}
    for tooth, other in pairs.items():
        assert (other_side(tooth), other_side(other)) == (other, tooth)
    for tooth in ALL_TEETH:
        other = other_side(tooth)
        assert other_side(other) == tooth
        assert is_left(other) != is_left(tooth)
        assert is_upper(other) == is_upper(tooth)
        assert (other % 10, is_primary(other)) == (tooth % 10, is_primary(tooth))


def test_rows_go_from_the_patients_right_to_the_left() -> None:
    for jaw in JAWS:
        row = teeth_of(jaw)
        assert len(row) == 14
        assert [is_left(tooth) for tooth in row] == [False] * 7 + [True] * 7
        assert all(is_upper(tooth) == (jaw == "upper") for tooth in row)
        assert [tooth % 10 for tooth in row] == [7, 6, 5, 4, 3, 2, 1, 1, 2, 3, 4, 5, 6, 7]


def box(left: float, top: float, width: float, height: float) -> np.ndarray:
    """[4, 2] outline through the middles of the outermost pixels."""
    corners = np.array([[0, 0], [width - 1, 0], [width - 1, height - 1], [0, height - 1]])
    return corners + 0.5 + np.array([left, top])


def crown(outline: np.ndarray, jaw: str = "upper", **more: object) -> Crown:
    low, high = outline.min(0), outline.max(0)
    ends = [np.array([(low[0] + high[0]) / 2, y]) for y in (low[1], high[1])]
    zenith, tip = ends if jaw == "upper" else ends[::-1]
    return Crown(
        jaw, zenith, tip, None, low, None, high, *(high - low), outline=outline, **more,
    )  # type: ignore[arg-type]  # fmt: skip


def dentition() -> Dentition:
    upper = (
        crown(
            box(20, 10, 20, 25), number=11, doubt=0.25, score=0.875, cut_left=True,
            numbers={11: 0.75, 12: 0.25},
        ),
        crown(box(41, 10, 18, 25), number=61, doubt=0.0, doubtful=True),
    )  # fmt: skip
    lower = (crown(box(22, 40, 20, 25), "lower", cut_right=True, numbers={85: 1.0}),)
    return Dentition(
        "000", (WIDTH, HEIGHT), "front", upper, lower, np.radians(12.5), 55.25, 0.125,
        mirrored=True,
    )  # fmt: skip


def teeth() -> Teeth:
    picture = np.random.default_rng(0).integers(0, 255, (8, 9, 3)).astype(np.uint8)
    aside = Dentition(
        "001", (50, 40), "upper", set_aside="it shows one jaw only", mirrored=False
    )  # fmt: skip
    return Teeth((dentition(), aside), {"000": picture})


def same(a: object, b: object) -> bool:
    for entry in fields(Crown):
        left, right = getattr(a, entry.name), getattr(b, entry.name)
        if isinstance(left, np.ndarray):
            if not np.array_equal(left, right):
                return False
        elif left != right:
            return False
    return True


def test_what_is_saved_comes_back(tmp_path: Path) -> None:
    teeth().save(tmp_path)
    assert artifact_class("teeth") is Teeth
    back = Teeth.load(tmp_path)
    for before, after in zip(teeth().views, back.views, strict=True):
        assert after.roll == pytest.approx(before.roll)
        plain = replace(before, roll=after.roll, upper=(), lower=())
        assert replace(after, upper=(), lower=()) == plain
        for a, b in zip(before.all_crowns, after.all_crowns, strict=True):
            assert same(a, b)
    (tmp_path / "000.png").unlink()  # what is loaded needs its folder no more
    assert list(back.pictures) == ["000"]
    np.testing.assert_array_equal(back.pictures["000"], teeth().pictures["000"])
    assert back.by_name()["001"].set_aside
    assert [view.mirrored for view in back.views] == [True, False]
    assert [view.name for view in back.chosen] == ["000"]


def test_the_same_teeth_are_the_same_bytes(tmp_path: Path) -> None:
    made = []
    for name in ("a", "b", "c"):
        (tmp_path / name).mkdir()
        (Teeth.load(tmp_path / "a") if name == "c" else teeth()).save(tmp_path / name)
        made.append({p.name: p.read_bytes() for p in sorted((tmp_path / name).iterdir())})
    assert made[0] == made[1] == made[2]
    assert sorted(made[0]) == ["000.png", "teeth.json"]


def test_the_file_says_both_numbers_and_holds_no_folder(tmp_path: Path) -> None:
    teeth().save(tmp_path)
    first, second = json.loads((tmp_path / "teeth.json").read_text())["views"]
    assert [c["number"] for c in first["crowns"]] == [11, 61, 0]
    assert [c["universal"] for c in first["crowns"]] == ["8", "F", ""]
    assert first["crowns"][0]["numbers"] == {"11": 0.75, "12": 0.25}
    assert first["roll_degrees"] == 12.5
    assert second["crowns"] == []


def test_teeth_of_which_nobody_said_whether_they_are_mirrored(tmp_path: Path) -> None:
    Teeth((replace(dentition(), mirrored=None),)).save(tmp_path)
    assert Teeth.load(tmp_path).views[0].mirrored is None
    file = tmp_path / "teeth.json"
    before = json.loads(file.read_text())
    del before["views"][0]["mirrored"]  # as files had it when nobody could say so
    file.write_text(json.dumps(before))
    assert Teeth.load(tmp_path).views[0].mirrored is None


def test_teeth_and_gum_are_told_from_lips(tmp_path: Path) -> None:
    """Inside one outline, and not in a hole of it; a crown in the hole is tooth all the same."""
    told = replace(dentition(), on_jaws=(box(10, 5, 60, 70), box(15, 38, 40, 30)))
    expected = np.zeros((HEIGHT, WIDTH), bool)
    expected[5:75, 10:70] = True
    expected[38:68, 15:55] = False
    rim = np.zeros_like(expected)  # of the hole: on its own border a polygon counts as inside
    rim[37:69, 14:56] = True
    rim[40:66, 17:53] = False
    expected |= told.mask
    np.testing.assert_array_equal(told.on_jaws_mask[~rim], expected[~rim])
    Teeth((told,)).save(tmp_path)
    np.testing.assert_array_equal(Teeth.load(tmp_path).views[0].on_jaws_mask, told.on_jaws_mask)


def test_where_nobody_told_all_may_be_gum(tmp_path: Path) -> None:
    assert dentition().on_jaws_mask.all()
    nothing = replace(dentition(), on_jaws=())
    np.testing.assert_array_equal(nothing.on_jaws_mask, nothing.mask)
    Teeth((nothing, dentition())).save(tmp_path)
    assert [view.on_jaws for view in Teeth.load(tmp_path).views] == [(), None]


def test_nothing_is_a_dentition_too(tmp_path: Path) -> None:
    empty = Dentition("000", (30, 20), "none")
    assert not empty.mask.any()
    assert not empty.above.any()
    assert Teeth((empty,)).chosen == ()
    Teeth((empty,)).save(tmp_path)
    assert Teeth.load(tmp_path).views == (empty,)


def test_mask_is_the_crowns_pixels() -> None:
    expected = np.zeros((HEIGHT, WIDTH), bool)
    expected[10:35, 20:40] = expected[10:35, 41:59] = expected[40:65, 22:42] = True
    np.testing.assert_array_equal(dentition().mask, expected)


def test_outline_of_a_mask_fills_to_the_mask() -> None:
    shape = np.zeros((HEIGHT, WIDTH), np.uint8)
    cv2.ellipse(shape, (50, 40), (30, 18), 25, 0, 360, 1, -1)
    contours, _ = cv2.findContours(shape, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    outline = contours[0][:, 0] + 0.5
    np.testing.assert_array_equal(filled((crown(outline),), (WIDTH, HEIGHT)), shape > 0)


def test_above_is_the_side_of_the_upper_crowns() -> None:
    view = replace(dentition(), roll=0.0)
    assert view.above.shape == (HEIGHT, WIDTH)
    assert view.above[:36].all()
    assert not view.above[40:, 22:42].any()
    only = replace(view, lower=())
    assert only.above.all()
    assert not replace(view, upper=()).above.any()


@pytest.mark.parametrize("roll", [0.0, 0.5, -0.5])
def test_gum_below_upper_crowns_is_the_lower_jaws(roll: float) -> None:
    """In a deep bite the lower front teeth are hidden: their gum is next to upper crowns."""
    c, s = np.cos(roll), np.sin(roll)

    def turned(points: np.ndarray) -> np.ndarray:
        return (points - [60, 40]) @ np.array([[c, s], [-s, c]]) + [60, 40]

    def placed(left: float, top: float, tip: float) -> Crown:
        ends = turned(np.array([[left + 5.0, top], [left + 5.0, tip]]))
        low, high = sorted((top, tip))
        return replace(crown(turned(box(left, low, 10, high - low))), zenith=ends[0], tip=ends[1])

    upper = tuple(placed(left, 25, 42) for left in (30, 40, 50, 60, 70, 80))
    lower = tuple(placed(left, 55, 38) for left in (20, 90))  # nothing between them
    view = replace(dentition(), upper=upper, lower=lower, roll=roll)

    def above(*points: tuple[float, float]) -> list[bool]:
        return [bool(view.above[int(y), int(x)]) for x, y in turned(np.array(points))]

    assert above((35, 30), (55, 41), (60, 20), (95, 33), (25, 33)) == [True] * 5
    assert above((55, 44), (60, 50), (75, 44), (25, 45), (95, 45), (60, 62)) == [False] * 6


def test_a_crown_in_the_corner_or_without_an_outline_harms_nothing() -> None:
    outside = crown(box(-30, -20, 60, 40))
    bare = replace(outside, outline=np.zeros((0, 2)))
    mask = filled((outside, bare), (WIDTH, HEIGHT))
    assert mask[:20, :30].all()
    assert mask.sum() == 600
