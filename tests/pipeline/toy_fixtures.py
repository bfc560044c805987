"""Fixtures around the toy stages, for the tests of the engine and those of hostile surroundings."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import toy

import pipeline
from pipeline.artifacts import KINDS
from pipeline.stage import get_stage


@pytest.fixture
def toys(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[Path]:
    """Toy stages registered, and a folder with a preset and three input files."""
    monkeypatch.setitem(KINDS, "numbers", "toy:Numbers")
    monkeypatch.setattr("pipeline.stage._entry_points", lambda: toy.STAGES)
    get_stage.cache_clear()
    # with one thread a run starts no other process, which would not know the toys
    (tmp_path / "toy.yaml").write_text(f"stages: {toy.ORDER}\nthreads: 1\n")
    images = tmp_path / "images"
    images.mkdir()
    for index, value in enumerate((1, 2, 4)):
        (images / f"{index}.txt").write_text(str(value))
    yield tmp_path
    get_stage.cache_clear()


@pytest.fixture
def run(toys: Path) -> Callable[..., Any]:
    """Run the toy pipeline in its workspace; returns stage -> action."""

    def call(*overrides: str, **options: Any) -> dict[str, str]:
        summary = pipeline.run(
            options.pop("images", toys / "images"),
            workspace=toys / "w",
            preset=toys / "toy.yaml",
            overrides=overrides,
            **options,
        )
        return {stage.name: stage.action for stage in summary.stages}

    return call
