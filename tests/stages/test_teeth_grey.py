"""Black-and-white photographs, read as if they had colour."""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path

import cv2
import numpy as np

from pipeline.artifacts.teeth import Teeth
from pipeline.artifacts.views import View, Views
from pipeline.stage import LocalContext
from stages.teeth.config import TeethConfig
from stages.teeth.grey import has_colour, tinted
from stages.teeth.stage import TeethStage
from tests.conftest import SAMPLES

RNG = np.random.default_rng(0)


def test_what_is_grey_has_no_colour() -> None:
    grey = np.repeat(RNG.random((40, 60, 1), np.float32), 3, axis=2)
    assert not has_colour(grey)
    assert has_colour(grey * np.float32([1, 0.6, 0.6]))


def test_what_is_tinted_keeps_its_lightness() -> None:
    shades = np.repeat(np.linspace(0, 1, 50, dtype=np.float32)[None, :, None], 3, axis=2)
    result = tinted(shades)
    lightness, a, b = cv2.split(cv2.cvtColor(result, cv2.COLOR_RGB2Lab))
    before = cv2.cvtColor(shades, cv2.COLOR_RGB2Lab)[..., 0]
    np.testing.assert_allclose(lightness, before, atol=1.5)
    middle = (before > 30) & (before < 60)
    assert a[middle].min() > 15 and b[middle].min() > 10, "gum is red"
    assert np.abs(a[before > 99]).max() < 3, "highlights are white"
    assert result.min() >= 0 and result.max() <= 1


def read(folder: Path, grey: Collection[str]) -> tuple[Teeth, list[str]]:
    """What the stage finds in the sample photographs, some of them without colour, and warns of."""
    views = []
    for path in sorted(SAMPLES.glob("*.jpg")):
        image = cv2.imread(str(path))[..., ::-1]
        if path.stem in grey:
            image = np.repeat(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)[..., None], 3, axis=2)
        views.append(View(path.stem, np.float32(image / 255), source_name=path.name))
    context = LocalContext(TeethConfig(), folder, {"views": Views(tuple(views))})
    TeethStage().run(context)
    return context.result("teeth"), context.warnings


def test_black_and_white_photographs_are_read(tmp_path: Path) -> None:
    coloured, _ = read(tmp_path / "coloured", set())
    teeth, said = read(tmp_path / "grey", {"frontal", "left_buccal", "right_buccal"})
    assert len(said) == 1 and "black-and-white" in said[0]
    for grey, as_taken in zip(teeth.chosen, coloured.chosen, strict=True):
        found, known = ({c.number for c in v.all_crowns} for v in (grey, as_taken))
        assert len(found & known) > 0.8 * len(known)


def test_one_without_colour_among_others_is_set_aside(tmp_path: Path) -> None:
    teeth, said = read(tmp_path, {"left_buccal"})
    assert [view.kind for view in teeth.chosen] == ["front", "right"]
    assert len(said) == 1 and "left_buccal.jpg is not used" in said[0] and "no colour" in said[0]
