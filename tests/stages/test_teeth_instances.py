"""From the network's maps to crowns: what is parted, and what is one tooth all the same."""

from __future__ import annotations

import numpy as np
import pytest

from stages.teeth.instances import find_crowns
from stages.teeth.network import Answer

SIZE = (40, 80)
LEFT, MIDDLE, RIGHT = 20, 40, 60


def answer(
    places: tuple[int, int], sure: float = 0.95, lower: tuple[float, float] = (-6.0, -6.0),
    tooth: float = 6.0, to_one: float = 0.0,
) -> Answer:  # fmt: skip
    """Two crowns side by side, the second one with a place and a logit of tooth of its own.

    They point to their own middles, and by a share `to_one` to the one between them.
    """
    rows, columns = np.indices(SIZE).astype(np.float32)
    second = columns >= MIDDLE
    within = (np.abs(rows - 20) < 12) & (columns >= LEFT) & (columns < RIGHT)
    middle = np.where(second, (MIDDLE + RIGHT) / 2, (LEFT + MIDDLE) / 2)
    inside = np.clip(1 - np.abs(columns - middle) / 11, 0, 1) * within
    position = np.full((8, *SIZE), np.log((1 - sure) / 7), np.float32)
    for number, place in enumerate(places):
        position[place, second == bool(number)] = np.log(sure)
    logit = np.where(second, np.float32(tooth), np.float32(6))
    maps = {
        "tooth": np.where(within, logit, -6),
        "inside": inside,
        "centre": [(1 - to_one) * middle + to_one * MIDDLE - columns, 20 - rows],
        "border": np.clip(1 - np.abs(columns - MIDDLE) / 2, 0, 1) * within,
        "lower": np.where(second, *lower[::-1]),
        "left": np.full(SIZE, -6.0),
        "primary": np.full(SIZE, -6.0),
        "position": position,
    }
    return Answer(
        **{name: np.asarray(values, np.float32) for name, values in maps.items()},
        on_jaws=maps["tooth"], kind=np.zeros(6, np.float32), apart=0.0,
        answer_from_image=np.eye(2, 3),
    )  # fmt: skip


def test_parts_of_one_molar_are_one_crown() -> None:
    (crown,) = find_crowns(answer((5, 5)))
    across = np.ptp(crown.polygon[:, 0])
    assert across == pytest.approx(RIGHT - LEFT, abs=2)
    assert np.exp(crown.position[5]) == pytest.approx(0.95, abs=0.01)


def test_parts_of_any_tooth_are_one_crown_if_they_point_to_one_middle() -> None:
    (crown,) = find_crowns(answer((1, 1), to_one=0.8))
    assert np.ptp(crown.polygon[:, 0]) == pytest.approx(RIGHT - LEFT, abs=2)


@pytest.mark.parametrize(
    ("places", "more"),
    [
        pytest.param((1, 1), {"to_one": 0.2}, id="a middle each"),
        pytest.param((1, 2), {"to_one": 0.8}, id="neighbours that point to one middle"),
        pytest.param((5, 6), {}, id="neighbours"),
        pytest.param((4, 4), {}, id="premolars"),
        pytest.param((5, 5), {"sure": 0.8}, id="not sure enough"),
        pytest.param((5, 5), {"lower": (-6.0, 6.0)}, id="one of each jaw"),
    ],
)
def test_what_may_be_two_teeth_stays_two(places: tuple[int, int], more: dict[str, object]) -> None:
    assert len(find_crowns(answer(places, **more))) == 2  # type: ignore[arg-type]


def test_what_is_no_crown_by_itself_joins_none() -> None:
    (crown,) = find_crowns(answer((5, 5), tooth=0.1))
    assert np.ptp(crown.polygon[:, 0]) == pytest.approx(MIDDLE - LEFT, abs=2)
