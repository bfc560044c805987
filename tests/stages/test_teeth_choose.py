"""Which photographs of a folder take part, on made-up readings."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pipeline.artifacts.teeth import Dentition
from stages.dentition.crowns import dentition_of
from stages.teeth.choose import choose, layout_distance
from stages.teeth.read import Reading, numbered, row_extent
from tests.stages.crowns_case import SIZE, mouth

ROWS = {"upper": (14, 13, 12, 11, 21, 22, 23), "lower": (43, 42, 41, 31, 32, 33)}


def dentition(stretch: float = 1.0, **more: object) -> Dentition:
    """Two rows of numbered crowns; `stretch` makes the right half of the picture narrower."""
    outlines = []
    for outline in mouth(**more):  # type: ignore[arg-type]
        points = outline.polygon.copy()
        beyond = np.maximum(points[:, 0] - SIZE[0] / 2, 0)
        points[:, 0] -= (1 - stretch) * beyond
        number = ROWS[outline.jaw][outline.number - 1]
        outlines.append(
            replace(outline, polygon=points, number=number, doubt=0.05, numbers={number: 1.0})
        )
    return dentition_of(outlines, "000", SIZE, "front")


def reading(
    found: Dentition, kind: str = "front", sure: float = 0.9, apart: float = 0.1
) -> Reading:
    names = ("front", "right", "left", "upper", "lower", "other")
    kinds = {name: sure if name == kind else (1 - sure) / 5 for name in names}
    return Reading(found, kinds, apart)


def picture(sharp: float = 0.05, colour: float = 0.2, seed: int = 0) -> np.ndarray:
    grey = 0.5 + sharp * np.random.default_rng(seed).normal(size=(SIZE[1], SIZE[0], 1))
    tint = np.array([colour, 0, -colour])
    return np.clip(grey + tint, 0, 1).astype(np.float32)


def reasons(
    *readings: Reading, images: list[np.ndarray] | None = None, names: list[str] | None = None
) -> list[str]:
    pictures = images or [picture()] * len(readings)
    names = names or [f"p{k}.jpg" for k in range(len(readings))]
    chosen = choose(readings, pictures, names)
    for before, after in zip(readings, chosen, strict=True):
        assert replace(after, set_aside="") == before.dentition
    return [view.set_aside for view in chosen]


def test_a_good_photograph_takes_part() -> None:
    assert reasons(reading(dentition())) == [""]
    assert reasons(reading(dentition(degrees=40.0), "right")) == [""]


@pytest.mark.parametrize(("kind", "words"), [("upper", "upper jaw"), ("lower", "lower")])
def test_occlusal_views_are_set_aside(kind: str, words: str) -> None:
    (why,) = reasons(reading(dentition(), kind))
    assert words in why
    assert reasons(reading(dentition(), kind, sure=0.3)) == [""]


def test_one_jaw_alone_is_set_aside_only_if_it_looks_odd() -> None:
    alone = dentition(jaws=("upper",))
    assert "one jaw" in reasons(reading(alone, "other"))[0]
    assert reasons(reading(alone, "front")) == [""]  # a deep bite hides the other one


def test_open_mouths_are_set_aside() -> None:
    ajar, wide = (dentition(apart=gap) for gap in (18.0, 60.0))
    assert reasons(reading(ajar, apart=0.2)) == [""]
    assert "apart" in reasons(reading(ajar, apart=0.6))[0]
    assert "apart" in reasons(reading(wide, apart=0.0))[0]


def test_an_open_bite_that_closes_on_the_molars_takes_part() -> None:
    closed = dentition(apart=-2.0)
    assert closed.jaws_apart == 0
    assert reasons(reading(closed, "right", apart=0.7)) == [""]
    assert "apart" in reasons(reading(closed, "right", apart=0.9))[0]


def test_pictures_without_colour_teeth_or_size_are_set_aside() -> None:
    good = reading(dentition())
    assert "colour" in reasons(good, images=[picture(colour=0.0)])[0]
    few = replace(good.dentition, upper=good.dentition.upper[:2], lower=good.dentition.lower[:2])
    assert "(4 crowns)" in reasons(reading(few))[0]
    one = replace(good.dentition, upper=good.dentition.upper[:1], lower=())
    assert "(1 crown)" in reasons(reading(one))[0]
    none = reading(Dentition("000", SIZE, "none"), "other")
    assert "(0 crowns)" in reasons(none)[0]
    windows = tuple(replace(crown, score=0.7) for crown in good.dentition.upper)
    house = reading(replace(good.dentition, upper=windows, lower=windows))
    assert "hardly looks like teeth" in reasons(house)[0]
    tiny = [
        replace(crown, score=0.7, outline=crown.centre + 0.3 * (crown.outline - crown.centre))
        for crown in good.dentition.upper
    ]
    both = {jaw: (*getattr(good.dentition, jaw), *tiny) for jaw in ("upper", "lower")}
    braces = reading(replace(good.dentition, **both))
    assert reasons(braces) == [""], "many small crowns that are hardly sure say nothing"
    small = reading(replace(good.dentition, size=(1800, 1200)))
    assert "too small" in reasons(small)[0]


def test_of_two_that_show_the_same_the_clearer_one_is_kept() -> None:
    pair = [reading(dentition()), reading(dentition(degrees=8.0))]
    blurred = [picture(sharp=0.01), picture(sharp=0.06)]
    assert reasons(*pair, images=blurred) == ["it shows the same as p1.jpg, which is clearer", ""]
    assert reasons(*pair, images=blurred[::-1]) == [
        "", "it shows the same as p0.jpg, which is clearer",
    ]  # fmt: skip
    fewer = replace(pair[0].dentition, upper=pair[0].dentition.upper[1:])
    assert reasons(reading(fewer), pair[1])[0].startswith("it shows the same")


def test_other_views_of_the_same_teeth_are_both_kept() -> None:
    assert reasons(reading(dentition()), reading(dentition(stretch=0.3), "left")) == ["", ""]


@pytest.mark.parametrize(
    ("names", "kept"),
    [("right left", 2), ("left right", 2), ("right right2", 1), ("right 2", 1), ("1 2", 1)],
)
def test_sides_by_name_are_not_the_same_whatever_they_look_like(names: str, kept: int) -> None:
    """The mirror image of one side looks like the other."""
    pair = [reading(dentition(), "left"), reading(dentition(degrees=3.0), "left")]
    assert reasons(*pair, names=names.split()).count("") == kept


def test_a_photograph_that_is_no_use_pushes_no_other_aside() -> None:
    sharp, blurred = picture(sharp=0.06), picture(sharp=0.01)
    why = reasons(
        reading(dentition(), "upper"), reading(dentition()), images=[sharp, blurred]
    )  # fmt: skip
    assert why[0]
    assert why[1] == ""


def test_three_times_the_same_leaves_one() -> None:
    same = [reading(dentition())] * 3
    images = [picture(sharp=s) for s in (0.02, 0.06, 0.04)]
    why = reasons(*same, images=images)
    assert why[1] == ""
    assert all("p1.jpg" in why[k] for k in (0, 2))


def test_layout_distance_is_blind_to_turn_size_and_place() -> None:
    one = dentition()
    assert layout_distance(one, dentition(degrees=25.0)) == pytest.approx(0, abs=0.01)
    squeezed = layout_distance(one, dentition(stretch=0.3))
    assert squeezed is not None
    assert squeezed > 0.06
    unnumbered = replace(
        one, upper=tuple(replace(c, number=0) for c in one.upper),
        lower=tuple(replace(c, number=0) for c in one.lower),
    )  # fmt: skip
    assert layout_distance(one, unnumbered) is None


def test_extent() -> None:
    one = dentition()
    assert row_extent(one) == pytest.approx(288 / SIZE[0], abs=0.03)


def test_numbers_by_one_photograph_alone() -> None:
    """Order puts right what looks get wrong; what a person said stays; primary teeth are told."""
    found = dentition()
    upper = [replace(crown, number=0, doubt=1.0) for crown in found.upper]
    upper[2] = replace(upper[2], numbers={13: 0.6, 12: 0.4})
    upper[4] = replace(upper[4], numbers={61: 0.7, 21: 0.3})
    said = replace(found.lower[1], number=38, doubt=0.0)
    lower = (found.lower[0], said, *found.lower[2:])
    after = numbered(replace(found, upper=tuple(upper), lower=lower))
    assert [crown.number for crown in after.upper] == [14, 13, 12, 11, 61, 22, 23]
    assert [crown.number for crown in after.lower] == [43, 38, 41, 31, 32, 33]
    assert after.lower[1].doubt == 0
    assert all(0 < crown.doubt < 0.1 for crown in after.upper)
