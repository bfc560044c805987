"""Numbers that placed photographs agree on."""

from dataclasses import replace

import numpy as np
import pytest

from pipeline.artifacts.dental.fdi import primary_of, teeth_of
from pipeline.artifacts.teeth import Dentition, Teeth
from pipeline.errors import RequestError
from stages.dentition.joint_numbers import agreed_numbers
from tests.stages import arch_wall_case as wall


def numbers_of(dentition: Dentition) -> list[int]:
    return [crown.number for crown in dentition.all_crowns]


def agreed(cameras, views, dentitions) -> list[Dentition]:
    depths = [wall.depth_of(camera) for camera in cameras]
    found = agreed_numbers(Teeth(tuple(dentitions)), views, cameras, depths)
    return list(found.views)


def counted_on(dentition: Dentition, by: int) -> Dentition:
    """A photograph whose upper teeth all look like, and carry the numbers of, others."""
    row = teeth_of("upper")
    crowns = []
    for crown in dentition.upper:
        wrong = row[int(np.clip(row.index(crown.number) + by, 0, len(row) - 1))]
        crowns.append(replace(crown, numbers=wall.looks_like(wrong, 0.8), number=wrong))
    return replace(dentition, upper=tuple(crowns))


def test_what_was_right_stays_and_grows_surer() -> None:
    cameras, views, read = wall.case()
    for camera, dentition in zip(cameras, agreed(cameras, views, read), strict=True):
        assert numbers_of(dentition) == wall.truth_of(camera)
        assert max(crown.doubt for crown in dentition.all_crowns) < 0.01


@pytest.mark.parametrize("by", [-1, 1])
def test_a_photograph_that_counts_wrong_is_outvoted(by: int) -> None:
    cameras, views, read = wall.case()
    read[2] = counted_on(read[2], by)
    for camera, dentition in zip(cameras, agreed(cameras, views, read), strict=True):
        assert numbers_of(dentition) == wall.truth_of(camera)


def test_both_halves_of_a_crown_carry_its_number() -> None:
    cameras, views, read = wall.case()
    read[1] = wall.split(cameras[1], read[1], 14, [15, 14])
    found = agreed(cameras, views, read)[1]
    wanted = wall.truth_of(cameras[1])
    wanted.insert(wanted.index(14), 14)
    assert numbers_of(found) == wanted


def test_a_crown_of_unknown_depth_is_numbered_by_its_row() -> None:
    cameras, views, read = wall.case()
    depths = [wall.depth_of(camera) for camera in cameras]
    hidden = next(crown for crown in read[2].upper if crown.number == 22)
    row = tuple(
        replace(crown, number=0, doubt=1.0, numbers={21: 0.5, 22: 0.5})
        if crown is hidden
        else crown
        for crown in read[2].upper
    )
    read[2] = replace(read[2], upper=row)
    left, right = (int(edge) for edge in (hidden.outline[:, 0].min(), hidden.outline[:, 0].max()))
    depths[2][: wall.HEIGHT // 2, left : right + 1] = 0
    found = agreed_numbers(Teeth(tuple(read)), views, cameras, depths).views[2]
    assert numbers_of(found) == wall.truth_of(cameras[2])


def test_what_a_person_said_of_one_photograph_counts_for_all() -> None:
    """All teeth behind the first premolar look as if they stood one place further back."""
    cameras, views, read = wall.case()
    said = replace(
        read[0], upper=tuple(replace(c, doubt=0.0, number=15) if c.number == 14 else c
                             for c in read[0].upper if c.number != 15),
    )  # fmt: skip
    read = [
        said,
        *(replace(d, upper=tuple(c for c in d.upper if c.number != 15)) for d in read[1:]),
    ]
    found = agreed(cameras, views, read)
    truth = [number for number in wall.truth_of(cameras[1]) if number != 15]
    assert numbers_of(found[1]) == [15 if number == 14 else number for number in truth]
    assert [c.doubt for c in found[0].upper if c.number == 15] == [0.0]


def test_a_primary_tooth_and_its_successor_are_not_both_said_of_one_place() -> None:
    cameras, views, read = wall.case()
    for k, number in ((0, 14), (1, 54)):
        upper = (replace(c, doubt=0.0, number=number) if c.number == 14 else c
                 for c in read[k].upper)  # fmt: skip
        read[k] = replace(read[k], upper=tuple(upper))
    with pytest.raises(RequestError, match=r"14 in .*, 54 in .*\. A primary tooth and the one"):
        agreed(cameras, views, read)


def test_a_wisdom_tooth_that_a_person_said_is_one_in_all_photographs() -> None:
    """Here both molars before it are gone, and nothing else moves."""
    cameras, views, read = wall.case()
    read = [replace(d, upper=tuple(c for c in d.upper if c.number != 17)) for d in read]
    shown = [16 in numbers_of(dentition) for dentition in read]
    assert shown[:2] == [True, True]
    upper = tuple(replace(c, doubt=0.0, number=18) if c.number == 16 else c for c in read[0].upper)
    found = agreed(cameras, views, [replace(read[0], upper=upper), *read[1:]])
    for camera, dentition in zip(cameras, found, strict=True):
        truth = [number for number in wall.truth_of(camera) if number != 17]
        assert numbers_of(dentition) == [18 if number == 16 else number for number in truth]


@pytest.mark.parametrize(("primary", "number"), [(0.003, 15), (0.5, 55)])
def test_a_primary_tooth_among_permanent_ones_must_look_the_more_like_it(
    primary: float, number: int
) -> None:
    cameras, views, _ = wall.case()
    looks = {15: {primary_of(15): primary, 15: 1 - primary}}
    found = agreed(cameras, views, [wall.photographed(camera, looks) for camera in cameras])
    assert number in numbers_of(found[0])
    assert {15, 55} - {number} not in numbers_of(found[0])


def test_photographs_that_are_not_placed_keep_their_numbers() -> None:
    cameras, views, read = wall.case()
    lost = replace(counted_on(read[2], 1), name="lost")
    aside = replace(read[1], name="aside", set_aside="it shows the same")
    depths = [wall.depth_of(camera) for camera in cameras]
    found = agreed_numbers(Teeth((*read, lost, aside)), views, cameras, depths)
    assert found.views[5:] == (lost, aside)


def test_one_photograph_has_nobody_to_agree_with() -> None:
    cameras, views, read = wall.case()
    teeth = Teeth((read[2],))
    depths = [wall.depth_of(camera) for camera in cameras]
    assert agreed_numbers(teeth, views, cameras, depths) is teeth
