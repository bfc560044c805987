"""What several test files share."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

import pipeline
from pipeline.runner import RunSummary

SAMPLES = Path(__file__).resolve().parents[1] / "data_samples" / "three_photos"
SHORT = {
    "fit.iterations": 150,
    "export.video_seconds": 1,
    "export.mesh_faces": 5000,
}


@pytest.fixture(scope="session")
def short_settings() -> dict[str, int]:
    """What makes a whole run short."""
    return SHORT


@pytest.fixture(scope="session")
def sample_run(tmp_path_factory: pytest.TempPathFactory) -> RunSummary:
    """The whole job on the three sample photographs, with a short fit; not to be changed.

    Processes that test beside each other share it: one computes a stage, the others wait for it.
    """
    folder = tmp_path_factory.getbasetemp()
    if "PYTEST_XDIST_WORKER" in os.environ:
        folder = folder.parent
    return pipeline.run(SAMPLES, workspace=folder / "sample_run", overrides=SHORT)
