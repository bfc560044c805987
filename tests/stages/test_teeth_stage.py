"""The `teeth` stage: how much of a film is read."""

from __future__ import annotations

from collections.abc import Callable, Collection
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from pipeline.artifacts.teeth import Dentition, Teeth
from pipeline.artifacts.views import View, Views
from pipeline.stage import LocalContext
from stages.dentition.crowns import dentition_of, outline_of
from stages.teeth import reader
from stages.teeth.config import TeethConfig
from stages.teeth.read import Reading
from stages.teeth.reader import PhotographReader
from stages.teeth.stage import TeethStage
from tests import teeth_case

COUNT = 30


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The photographs that are read; nothing is found in them."""
    names: list[str] = []

    class Reader:
        def __init__(self, views: list[View], threads: int) -> None:
            self.views = views

        def worth_reading(self, spare: Collection[int]) -> list[int]:
            return [k for k in range(len(self.views)) if k not in spare]

        def read(self, progress: Callable[..., None], places: list[int]) -> list[Reading]:
            read = [self.views[k] for k in places]
            names.extend(view.name for view in read)
            kinds = {"upper": 0.0, "lower": 0.0, "other": 1.0}
            return [
                Reading(Dentition(view.name, (view.width, view.height), "other"), kinds, 0.0)
                for view in read
            ]

    monkeypatch.setattr("stages.teeth.reader.PhotographReader", Reader)
    return names


def run(folder: Path, **config: Any) -> Teeth:
    teeth: Teeth = context(folder, **config).result("teeth")
    return teeth


def context(folder: Path, **config: Any) -> LocalContext:
    image = np.full((24, 32, 3), 0.5, np.float32)
    views = Views(tuple(View(f"{k:03d}", image) for k in range(COUNT)))
    context = LocalContext(TeethConfig(**config), folder, {"views": views})
    TeethStage().run(context)
    return context


def test_of_a_film_some_frames_are_read_from_end_to_end(tmp_path: Path, asked: list[str]) -> None:
    teeth = run(tmp_path)
    assert len(teeth.views) == COUNT
    numbers = [int(name) for name in asked]
    assert (len(numbers), numbers[0], numbers[-1]) == (12, 0, COUNT - 1)
    assert set(np.diff(numbers)) <= {2, 3}
    assert [d.kind for d in teeth.views if d.name not in asked] == ["unread"] * (COUNT - 12)


def test_the_reader_can_be_told_to_read_all_of_it_or_nothing(
    tmp_path: Path, asked: list[str]
) -> None:
    run(tmp_path / "all", method="reader")
    assert len(asked) == COUNT
    run(tmp_path / "none", method="none")
    assert len(asked) == COUNT


@pytest.mark.parametrize("crowns", [0, 6])
def test_where_all_photographs_of_teeth_are_set_aside_it_is_said_why(
    tmp_path: Path, asked: list[str], monkeypatch: pytest.MonkeyPatch, crowns: int
) -> None:
    outlines = [outline_of(c) for c in teeth_case.dentition("000", "front").upper[:crowns]]

    def aside(readings: list[Reading], *_: object) -> list[Dentition]:
        names = [reading.dentition.name for reading in readings]
        return [dentition_of(outlines, name, (32, 24), "front", set_aside="why") for name in names]

    monkeypatch.setattr("stages.teeth.choose.choose", aside)
    said = context(tmp_path, most_views=2).warnings
    photographs = ["000", f"{COUNT - 1:03d}"] if crowns else []
    assert said == [f"{name} is not used to place the teeth: why." for name in photographs]


@pytest.mark.parametrize(
    ("sure", "unsure", "shows"), [(8, 0, True), (8, 4, True), (8, 8, False), (5, 0, False)]
)
def test_what_repeats_is_not_yet_teeth(
    sure: int, unsure: int, shows: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A few windows of a castle look surely like crowns, most of them hardly."""
    crowns = [SimpleNamespace(score=score) for score in [0.95] * sure + [0.7] * unsure]
    answer = SimpleNamespace(tooth=np.ones((24, 32), np.float32))
    glances = SimpleNamespace(turned=lambda quarters: (answer, crowns))
    monkeypatch.setattr(reader, "Glances", lambda image, valid: glances)
    view = View("000", np.full((24, 32, 3), 0.5, np.float32))
    assert PhotographReader([view], 1).worth_reading() == [0] * shows


@pytest.mark.parametrize(
    ("showing", "spare", "read"),
    [
        ("111111", "", "012345"),
        ("000000", "", ""),
        ("100000", "", "012345"),  # a third of the three asked show them
        ("010000", "", ""),
        ("010010", "", "012345"),
        ("000100", "", ""),
        ("111111", "135", "024"),  # a film: neighbours show the same
        ("110111", "135", "012345"),
        ("011111", "135", "012345"),
        ("010100", "135", ""),  # nothing hints at teeth
        ("010010", "135", "0124"),
        ("000010", "135", "024"),
    ],
)
def test_what_of_a_clinics_folder_is_worth_reading(
    showing: str, spare: str, read: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(reader, "Glances", lambda image, valid: float(image[0, 0, 0]))
    monkeypatch.setattr(reader, "_has_teeth", lambda shows: shows > 0)
    views = [View("x", np.full((2, 2, 3), int(shows), np.float32)) for shows in showing]
    found = PhotographReader(views, 1).worth_reading([int(k) for k in spare])
    assert "".join(map(str, found)) == read
