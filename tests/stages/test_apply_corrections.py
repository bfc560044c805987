"""What `teeth.yaml` says of photographs and crowns, applied to the teeth."""

from __future__ import annotations

import unicodedata
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.artifacts.dental.corrections import (
    Corrections,
    CrownCorrection,
    PhotoCorrection,
)
from pipeline.artifacts.teeth import UNREAD, Dentition, Teeth
from pipeline.artifacts.views import Views
from pipeline.errors import RequestError
from pipeline.studies.report.check import content
from stages.dentition.corrections import (
    LEFT_OUT,
    apply_corrections,
    area,
    shows_less,
    split_polygon,
)
from stages.dentition.crowns import dentition_of, outline_of
from stages.dentition.parts import perhaps_one
from tests import teeth_case as case


def applied(teeth: Teeth | None = None, **photographs: PhotoCorrection) -> tuple[Dentition, ...]:
    named = {name.replace("_jpg", ".jpg").lstrip("v"): photo for name, photo in photographs.items()}
    return apply_corrections(teeth or case.teeth(), case.views(), Corrections(named)).views


def numbers(view: Dentition) -> list[int]:
    return [crown.number for crown in view.all_crowns]


def test_a_number_is_put_right_and_certain() -> None:
    before = case.teeth().views
    place = case.original(0, "upper")
    photo = PhotoCorrection(crowns=(CrownCorrection(place, tooth=53),))
    after = applied(v1_front=photo)  # a stem names the photograph too
    assert after[0] is before[0] or numbers(after[0]) == numbers(before[0])
    crown = after[1].upper[0]
    assert (crown.number, crown.doubt) == (53, 0.0)
    assert np.array_equal(crown.zenith, before[1].upper[0].zenith)
    assert numbers(after[1])[1:] == numbers(before[1])[1:]


def test_a_place_beside_a_crown_means_the_nearest() -> None:
    x, y = case.original(0, "upper")
    beside = CrownCorrection((x - case.SCALE * 0.9 * case.SIDE, y), tooth=14)
    assert applied(v000=PhotoCorrection(crowns=(beside,)))[0].upper[0].number == 14
    with pytest.raises(RequestError, match=r"'000', crowns\[0\]: there is no crown at 4"):
        applied(v000=PhotoCorrection(crowns=(CrownCorrection((4, 4), tooth=14),)))


@pytest.mark.parametrize("second", [{"remove": True}, {"tooth": 14}])
def test_what_is_said_of_a_crown_that_is_removed_is_not_of_its_neighbour(
    second: dict[str, Any],
) -> None:
    place = case.original(2, "upper")
    crowns = (CrownCorrection(place, remove=True), CrownCorrection(place, **second))
    with pytest.raises(RequestError, match=r"crowns\[1\]: the crown at .* was removed by a line"):
        applied(v000=PhotoCorrection(crowns=crowns))


@pytest.mark.parametrize("mirrored", [False, True])
def test_numbers_that_no_mouth_can_have_are_refused(mirrored: bool) -> None:
    def said(*teeth: int) -> tuple[Dentition, ...]:
        row = teeth[::-1] if mirrored else teeth
        crowns = [
            CrownCorrection(case.original(k, "upper"), tooth=tooth)
            for k, tooth in enumerate(row) if tooth
        ]  # fmt: skip
        return applied(v000=PhotoCorrection(mirrored=mirrored or None, crowns=tuple(crowns)))

    with pytest.raises(RequestError, match=r"'000': 11 is said of crowns that are not side by"):
        said(0, 0, 11, 0, 11, 0)
    with pytest.raises(RequestError, match=r"run backwards \(23, 22, 21, 11, 12, 13 from left"):
        said(23, 22, 21, 11, 12, 13)
    assert said(13, 11, 12, 21, 21, 22)


def test_what_is_no_tooth_goes_and_landmarks_are_found_again() -> None:
    before = case.teeth().views[0]
    gone = CrownCorrection(case.original(1, "upper"), remove=True)
    after = applied(v000=PhotoCorrection(crowns=(gone,)))[0]
    assert numbers(after) == [13, 11, 21, 22, 23, *case.LOWER]
    assert before.upper[0].papilla_right is not None
    assert after.upper[0].papilla_right is None, "it has no neighbour any more"
    everything = [CrownCorrection(case.original(k, jaw), remove=True)
                  for jaw in ("upper", "lower") for k in range(6)]  # type: ignore[arg-type]  # fmt: skip
    assert applied(v000=PhotoCorrection(crowns=tuple(everything)))[0].all_crowns == ()


def test_a_crown_is_split_and_both_parts_numbered() -> None:
    x, y = case.original(2, "upper")
    top, end, side = y - 50, y + 60, case.SCALE * 7
    after = applied(v000=PhotoCorrection(crowns=(
        CrownCorrection((x, y), split=((x, top), (x + 1, end))),
        CrownCorrection((x - side, y), tooth=12),
        CrownCorrection((x + side, y), tooth=11),
        CrownCorrection(case.original(1, "upper"), tooth=13),
        CrownCorrection(case.original(0, "upper"), tooth=14),
    )))[0]  # fmt: skip
    assert numbers(after)[:7] == [14, 13, 12, 11, 21, 22, 23]
    parts = after.upper[2:4]
    assert [crown.doubt for crown in parts] == [0, 0]
    whole = area(case.teeth().views[0].upper[2].outline)
    assert sum(area(crown.outline) for crown in parts) == pytest.approx(whole)
    assert parts[0].outline[:, 0].max() == pytest.approx(x / case.SCALE, abs=1)
    unnumbered = CrownCorrection((x, y), split=((x, top), (x, end)))
    halves = applied(v000=PhotoCorrection(crowns=(unnumbered,)))[0].upper[2:4]
    assert [(crown.number, crown.doubt) for crown in halves] == [(0, 1.0), (0, 1.0)]
    missed = CrownCorrection((x, y), split=((x + 400, top), (x + 400, end)))
    with pytest.raises(RequestError, match="doesn't cross the crown"):
        applied(v000=PhotoCorrection(crowns=(missed,)))


def test_crowns_that_were_shown_as_one_are_told_apart() -> None:
    """A line along the border between two that look alike: nothing to cut, yet they are two."""
    whole = case.teeth().views[0]
    x, y = case.original(2, "upper")
    outlines = [outline_of(crown) for crown in whole.all_crowns]
    parts = split_polygon(
        outlines[2].polygon, np.array([x, 0]) / case.SCALE, np.array([x, 9]) / case.SCALE
    )
    outlines[2:3] = [replace(outlines[2], polygon=part) for part in parts]
    read = dentition_of(outlines, whole.name, whole.size, whole.kind, roll=0.0)
    line = CrownCorrection((x - 8, y), split=((x + 1, y - 90), (x + 1, y + 90)))
    after = applied(Teeth((read, *case.teeth().views[1:])), v000=PhotoCorrection(crowns=(line,)))[0]
    found = after.upper[2:4]
    assert [(crown.number, crown.doubt, dict(crown.numbers)) for crown in found] == [
        (0, 1.0, {})
    ] * 2
    assert [area(a.outline) for a in found] == [area(b.outline) for b in read.upper[2:4]]
    assert not perhaps_one(*found)


def test_a_number_of_the_other_jaw_moves_the_crown() -> None:
    change = CrownCorrection(case.original(5, "upper"), tooth=34)
    after = applied(v000=PhotoCorrection(crowns=(change,)))[0]
    assert 34 in [crown.number for crown in after.lower]
    assert len(after.upper) == 5
    assert after.lower[-1].tip[1] < after.lower[-1].zenith[1] or after.lower[-2].number == 34


def test_a_wisdom_tooth_between_others_is_refused() -> None:
    ends = tuple(CrownCorrection(case.original(k, "upper"), t) for k, t in ((0, 18), (5, 28)))
    assert numbers(applied(v000=PhotoCorrection(crowns=ends))[0])[:6] == [18, 12, 11, 21, 22, 28]
    between = CrownCorrection(case.original(4, "upper"), tooth=28)
    with pytest.raises(RequestError, match="'000': 28 is a wisdom tooth"):
        applied(v000=PhotoCorrection(crowns=(between,)))
    beyond = CrownCorrection(case.original(5, "upper"), remove=True)
    assert applied(v000=PhotoCorrection(crowns=(between, beyond)))[0].upper[-1].number == 28


@pytest.mark.parametrize("mirrored", [False, True])
def test_a_wisdom_tooth_may_have_been_read_as_two(mirrored: bool) -> None:
    x, y = case.original(5, "upper")
    parts = [CrownCorrection((x + side, y), tooth=28) for side in (-9, 9)]
    split = CrownCorrection((x, y), split=((x, y - 90), (x, y + 90)))
    photo = PhotoCorrection(crowns=(split, *parts), mirrored=mirrored or None)
    row = applied(v000=photo)[0].upper
    assert [crown.number for crown in row].count(28) == 1
    assert len(row) == 6, "it is one again"
    whole = case.teeth().views[0].upper[5]
    one = next(crown for crown in row if crown.number == 28)
    assert one.doubt == 0.0
    assert area(one.outline) == pytest.approx(area(whole.outline), rel=0.1)


def test_photographs_are_left_out_used_and_called_otherwise() -> None:
    teeth = case.teeth("it is blurred")
    after = applied(
        teeth, v000=PhotoCorrection(use=False), v001=PhotoCorrection(kind="left"),
        v002=PhotoCorrection(use=True),
    )  # fmt: skip
    assert [view.set_aside for view in after] == [LEFT_OUT, "", ""]
    assert [view.kind for view in after] == ["right", "left", "left"]
    empty = Teeth((Dentition("000", (300, 200), "none"), *teeth.views[1:]))
    with pytest.raises(RequestError, match="no tooth was found in this photograph"):
        applied(empty, v000=PhotoCorrection(use=True))


def test_the_next_best_takes_the_place_of_a_photograph_that_is_left_out() -> None:
    first, *others = case.teeth().views
    name = case.views().views[0].source_name
    aside = [replace(view, set_aside=shows_less(name)) for view in others]
    teeth = Teeth((first, *aside))
    assert [view.set_aside for view in applied(teeth, v000=PhotoCorrection(use=True))[1:]] == [
        shows_less(name)
    ] * len(aside)
    out = PhotoCorrection(use=False)
    after = applied(teeth, v000=out)
    assert [view.set_aside for view in after] == [
        LEFT_OUT,
        "",
        *[shows_less(name)] * len(aside[1:]),
    ]
    both = applied(teeth, v000=out, v001=out)
    assert [view.set_aside for view in both][:3] == [LEFT_OUT, LEFT_OUT, ""]


#: From left to right in a photograph of the patient's right side as it was taken.
TAKEN = (16, 15, 14, 13, 12, 11)


def side_view() -> Teeth:
    first = case.dentition("000", "right", TAKEN, ())
    return Teeth((first, *case.teeth().views[1:]))


def test_a_mirror_image_is_turned_over_after_its_crowns_were_put_right() -> None:
    x, y = case.original(1, "upper")
    photo = PhotoCorrection(mirrored=True, crowns=(
        CrownCorrection(case.original(0, "upper"), tooth=27),
        CrownCorrection((x, y), split=((x, y - 90), (x, y + 90))),
        CrownCorrection((x - 20, y), tooth=65),
        CrownCorrection(case.original(3, "upper"), remove=True),
    ))  # fmt: skip
    after = applied(side_view(), v000=photo)
    view = after[0]
    assert (view.kind, view.mirrored, view.name) == ("left", True, "000")
    # What a person has said is the patient's number; what was read in the mirror is the other's.
    assert numbers(view) == [21, 22, 24, 0, 65, 27]
    assert [crown.doubt for crown in view.upper] == [0.05, 0.05, 0.05, 1, 0, 0]
    assert view.upper[-1].centre[0] == pytest.approx(case.WIDTH - case.middle(0, "upper")[0])
    assert view.upper[0].centre[0] == pytest.approx(case.WIDTH - case.middle(5, "upper")[0])
    assert view.upper[2].papilla_left is None, "its neighbour was removed"
    assert [other.mirrored for other in after[1:]] == [None, None]


def test_the_side_that_a_mirror_image_shows_may_be_said_too() -> None:
    said = PhotoCorrection(kind="right", mirrored=True)
    assert applied(side_view(), v000=said)[0].kind == "right"
    front = PhotoCorrection(kind="front", mirrored=True, crowns=(
        CrownCorrection(case.original(0, "upper"), remove=True),
    ))  # fmt: skip
    assert applied(side_view(), v000=front)[0].kind == "front"


def test_a_photograph_that_is_no_mirror_image_stays_as_it_is() -> None:
    before = side_view().views[0]
    after = applied(side_view(), v000=PhotoCorrection(mirrored=False))[0]
    assert (after.mirrored, after.kind, numbers(after)) == (False, "right", list(TAKEN))
    assert np.array_equal(after.upper[0].outline, before.upper[0].outline)


def test_what_is_said_later_is_of_the_photograph_as_it_was_taken() -> None:
    """Settings add numbers to those of a file that has turned the photograph over."""
    once = Teeth(applied(side_view(), v000=PhotoCorrection(mirrored=True)))
    number = PhotoCorrection(crowns=(CrownCorrection(case.original(0, "upper"), tooth=27),))
    after = applied(once, v000=number)[0]
    assert (after.mirrored, after.kind) == (True, "left")
    assert numbers(after) == [21, 22, 23, 24, 25, 27]
    assert after.upper[-1].centre[0] == pytest.approx(case.WIDTH - case.middle(0, "upper")[0])
    back = applied(Teeth((after, *once.views[1:])), v000=PhotoCorrection(mirrored=False))[0]
    assert (back.mirrored, back.kind, numbers(back)) == (False, "right", [27, *TAKEN[1:]])


def test_unknown_and_doubled_photographs_are_refused() -> None:
    with pytest.raises(RequestError, match=r"no photograph 'O_right.jpg'.*Did you mean '0_right"):
        applied(O_right_jpg=PhotoCorrection(use=True))
    # that both end in .jpg makes no name like another
    with pytest.raises(RequestError, match=r"no photograph 'IMG_1.jpg'\. The photographs are"):
        applied(IMG_1_jpg=PhotoCorrection(use=True))
    with pytest.raises(RequestError, match=r"'000' and '0_right.jpg' are the same photograph"):
        applied(v000=PhotoCorrection(use=True), v0_right_jpg=PhotoCorrection(use=False))


def test_accents_of_a_name_may_be_composed_or_not() -> None:
    views = case.views(("Zähne rechts.jpg", "Zähne.jpg", "links.jpg"))
    said = {unicodedata.normalize("NFD", "Zähne.jpg"): PhotoCorrection(use=False)}
    assert said.keys().isdisjoint(view.source_name for view in views.views)
    after = apply_corrections(case.teeth(), views, Corrections(said))
    assert [view.set_aside for view in after.views] == ["", LEFT_OUT, ""]
    shown = content(after, views, Corrections(said))["photographs"]
    assert [photo["earlier"]["use"] for photo in shown] == [None, False, None]


def test_what_was_said_of_a_photograph_that_was_not_read_is_refused() -> None:
    first, *others = case.teeth().views
    unread = Teeth((Dentition(first.name, first.size, UNREAD), *others))
    number = PhotoCorrection(crowns=(CrownCorrection((5, 5), tooth=11),))
    for photo in (number, PhotoCorrection(use=True)):
        with pytest.raises(RequestError, match=r"'0_right.jpg': its teeth have not been read"):
            applied(unread, v0_right_jpg=photo)
    assert applied(unread, v0_right_jpg=PhotoCorrection(use=False))[0].set_aside == LEFT_OUT


def test_what_was_said_of_another_picture_of_that_name_is_refused() -> None:
    photo = PhotoCorrection(use=False, sha256="1" * 16)
    assert applied(v001=photo)[1].set_aside == LEFT_OUT
    with pytest.raises(RequestError, match=r"photograph '0_right.jpg': .* another picture"):
        applied(v0_right_jpg=photo)
    unknown = Views(tuple(replace(view, source_sha256="") for view in case.views().views))
    assert apply_corrections(case.teeth(), unknown, Corrections({"000": photo})).views[0].set_aside


@given(
    st.floats(0, np.pi), st.floats(-0.5, 0.5),
    st.lists(st.floats(0.3, 2.0), min_size=3, max_size=12),
)  # fmt: skip
def test_parts_of_a_polygon_make_the_whole(angle: float, off: float, radii: list[float]) -> None:
    around = np.linspace(0, 2 * np.pi, len(radii), endpoint=False)
    polygon = np.array(radii)[:, None] * np.stack([np.cos(around), np.sin(around)], 1)
    along = np.array([np.cos(angle), np.sin(angle)])
    start = off * np.array([-along[1], along[0]])
    parts = split_polygon(polygon, start, start + along)
    assert sum(map(area, parts)) == pytest.approx(area(polygon))
