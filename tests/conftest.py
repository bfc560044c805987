"""What several test files share."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

import pytest
from filelock import FileLock
from hypothesis import settings

import pipeline
from pipeline.process.native import one_blas_thread
from pipeline.running.outcomes import RunSummary
from tests.personal_data import with_personal_data

SAMPLES = Path(__file__).resolve().parents[1] / "data_samples" / "three_photos"
SHORT = {
    "views.long_side": 384,
    "fit.iterations": 120,
    "export.video_seconds": 1,
    "export.mesh_faces": 5000,
}

# How long an example takes is the machine's affair, which may be busy.
settings.register_profile("any machine", deadline=None)
settings.load_profile("any machine")

#: Files that take a minute or half of it, for few tests: begun first (`--no-loadscope-reorder`), so
#: that no process is left with one of them when the others are done.
LONG = (
    "test_benchmark_smoke", "test_teeth_mouths", "test_batch", "test_register_command",
    "test_register", "test_splats_stage", "test_register_hardware", "test_viewer_steering",
    "test_viewer_marks", "test_viewer_tools", "test_peers", "test_comparison_run",
)  # fmt: skip

# Tests start hundreds of processes: the first one compiles the modules, not each.
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    items.sort(key=lambda item: item.path.stem not in LONG)


@pytest.fixture(scope="session", autouse=True)
def calm_blas() -> Iterator[None]:
    """As stages have it: OpenBLAS's threads would spin beside other tests that need the cores."""
    with one_blas_thread():
        yield


@pytest.fixture(scope="session")
def short_settings() -> dict[str, int]:
    """What makes a whole run short."""
    return SHORT


@pytest.fixture(scope="session")
def shared_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder that processes that test beside each other have in common."""
    folder = tmp_path_factory.getbasetemp()
    return folder.parent if "PYTEST_XDIST_WORKER" in os.environ else folder


@pytest.fixture(scope="session")
def named_samples(shared_folder: Path) -> Path:
    """The three sample photographs with a patient's name in every place, pixels as they are."""
    folder = shared_folder / "Prognath_Anna"
    with FileLock(shared_folder / "named_samples.lock"):
        if not folder.is_dir():
            folder.mkdir()
            for photo in sorted(SAMPLES.glob("*.jpg")):
                name = f"Prognath_Anna_{photo.name}"
                (folder / name).write_bytes(with_personal_data(photo.read_bytes()))
    return folder


@pytest.fixture(scope="session")
def sample_run(shared_folder: Path, named_samples: Path) -> RunSummary:
    """The whole job on the three sample photographs, with a short fit; not to be changed.

    Processes that test beside each other share it: one computes a stage, the others wait for it.
    """
    return pipeline.run(named_samples, workspace=shared_folder / "sample_run", overrides=SHORT)
