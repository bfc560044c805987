"""A child's photograph among an adult's is told by the looks of its teeth."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from pipeline.artifacts.dental.fdi import is_upper, primary_of
from stages.init.dental.numbering.hypotheses import Labelling
from stages.init.dental.numbering.primary import age_doubts
from stages.init.dental.template import position_of

NAMES = ["right.jpg", "front.jpg", "left.jpg"]
FRONT = (14, 13, 12, 11, 21, 22, 23, 24, 44, 43, 42, 41, 31, 32, 33, 34)
SHOWN = (FRONT[:6] + FRONT[8:14], FRONT, FRONT[2:8] + FRONT[10:])


def crown(tooth: int, primary: float) -> Any:
    """A crown that looks primary with this probability."""
    numbers = {tooth: 1 - primary, primary_of(tooth): primary}
    return SimpleNamespace(numbers=numbers, number=0, doubt=1.0)


def doubts(*primary: float) -> list[str]:
    """Of photographs whose crowns all look primary with these probabilities."""
    dentitions, labels = [], []
    for teeth, share in zip(SHOWN, primary, strict=True):
        rows = [[t for t in teeth if is_upper(t) == upper] for upper in (True, False)]
        crowns = [[crown(tooth, share) for tooth in row] for row in rows]
        dentitions.append(SimpleNamespace(crowns=lambda jaw, crowns=crowns: crowns[jaw == "lower"]))
        upper, lower = (tuple(position_of(tooth) for tooth in row) for row in rows)
        labels.append((upper, lower))
    labelling = Labelling((0, 1, 2), ("right", "frontal", "left"), tuple(labels))
    best: Any = SimpleNamespace(labelling=labelling)
    return age_doubts(best, dentitions, NAMES)  # type: ignore[arg-type]


@pytest.mark.parametrize("share", [0.0, 1e-3, 0.05, 0.6])
def test_photographs_of_one_age_are_not_doubted(share: float) -> None:
    assert doubts(share, share, share) == []


def test_a_side_on_which_the_looks_are_less_sure_is_not_doubted() -> None:
    """Even by the looks is 1 in 1,000: a child's sides come down to that beside a sure front."""
    assert doubts(1e-3, 0.6, 2e-3) == []


@pytest.mark.parametrize("odd", [0, 1, 2])
@pytest.mark.parametrize(("child", "word"), [(0.4, "primary"), (0.0, "permanent")])
def test_a_photograph_of_another_age_is_named(odd: int, child: float, word: str) -> None:
    shares = [0.0 if child else 0.4] * 3
    shares[odd] = child
    (said,) = doubts(*shares)
    assert said.startswith(f"{NAMES[odd]} shows {word} teeth")
