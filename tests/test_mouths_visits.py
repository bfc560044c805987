"""Mouths in which teeth moved between two visits: the truth that is written is what happened."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from data_samples.mouths import mouth as growing
from data_samples.mouths import random_options
from data_samples.mouths.mouth import build_mouth
from data_samples.mouths.moves import Move, axes_of, motion_of
from data_samples.mouths.visits import CALM, main


@pytest.fixture(scope="module", autouse=True)
def _coarse_shadows() -> object:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(growing, "RAYS", 3)
        yield


def test_moved_teeth_go_where_the_truth_says_and_no_others() -> None:
    options = random_options(np.random.default_rng(2), **CALM)
    moves = {11: Move(mesial=0.4, tip=3.0), 34: Move(buccal=0.8, extrusion=-0.5, rotation=-6.0)}
    before, after = build_mouth(options), build_mouth(options, moves)
    arches = {t.plan.fdi: row.arch for row in before.rows for t in row.teeth}
    for old, new in zip(before.teeth, after.teeth, strict=True):
        number = old.plan.fdi
        matrix = motion_of(arches[number], old, moves.get(number, Move()))
        assert np.allclose(old.vertices @ matrix[:3, :3].T + matrix[:3, 3], new.vertices), number
        assert (number in moves) != np.array_equal(old.vertices, new.vertices)
        assert np.array_equal(old.local, new.local)  # so it keeps its texture


@pytest.mark.parametrize("number", [13, 23, 33, 43])
def test_a_move_has_the_same_meaning_on_both_sides_and_in_both_jaws(number: int) -> None:
    mouth = build_mouth(random_options(np.random.default_rng(2), **CALM))
    row, tooth = next((r, t) for r in mouth.rows for t in r.teeth if t.plan.fdi == number)
    mesial, buccal, out_of_gum = axes_of(row.arch, tooth)
    assert mesial[0] * (1 if number // 10 in (1, 4) else -1) > 0  # towards the midline
    assert buccal[2] > 0  # forwards
    assert out_of_gum[1] * (-1 if number < 30 else 1) > 0
    for part, point, way in (
        ("tip", out_of_gum, mesial), ("torque", out_of_gum, buccal), ("rotation", mesial, buccal),
    ):  # fmt: skip
        matrix = motion_of(row.arch, tooth, Move(**{part: 5.0}))
        assert np.allclose(matrix[:3, :3] @ tooth.centre + matrix[:3, 3], tooth.centre)
        assert (matrix[:3, :3] @ point - point) @ way > 0.05, part


def test_both_visits_are_written_with_the_truth(tmp_path: Path) -> None:
    main(
        [
            "--out",
            str(tmp_path),
            "--views",
            "1",
            "--moved",
            "2",
            "--width",
            "80",
            "--calm",
            "--plain",
        ]
    )
    truth = json.loads((tmp_path / "truth.json").read_text())
    assert len(truth["moves"]) == len(truth["motions"]) == 2
    assert sorted(truth["visits"]) == ["a", "b"]
    for name in "ab":
        assert (tmp_path / name / "000.jpg").exists()
    for number, matrix in truth["motions"].items():
        moved = np.array(matrix) @ [*truth["centres_a"][number], 1]
        assert np.allclose(moved[:3], truth["centres_b"][number], atol=1e-3)
