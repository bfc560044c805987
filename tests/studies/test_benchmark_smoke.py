"""The smoke suite on the sample cases: methods side by side, from photographs to tables."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

import pipeline


@pytest.fixture(scope="module")
def out(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("smoke") / "out"


@pytest.fixture(scope="module")
def results(out: Path) -> dict[str, Any]:
    return pipeline.benchmark("smoke", out=out, jobs=2)


def test_every_cell_came_out(results: dict[str, Any]) -> None:
    assert results["problems"] == []
    assert len(results["cells"]) == 4
    for cell in results["cells"]:
        assert cell["status"] == "done", cell.get("reason")
        assert cell["registered"] == cell["total"]
        assert cell["peak_memory_mb"] > 50
        assert cell["poses"]["rotation_deg"]["median"] < 3
        assert cell["figures"]["input"]["psnr"] > 15


def test_methods_shared_the_cameras(results: dict[str, Any]) -> None:
    for scene in ("twelve_frames", "three_photos"):
        first, second = (cell for cell in results["cells"] if cell["scene"] == scene)
        assert first["keys"]["init"] == second["keys"]["init"]
        assert first["keys"]["fit"] != second["keys"]["fit"]
        actions = {stage["name"]: stage["action"] for stage in second["stages"]}
        assert actions["init"] == "cached" and actions["fit"] == "ran"


def test_unseen_views_have_both_protocols(results: dict[str, Any]) -> None:
    for cell in results["cells"]:
        if cell["scene"] == "twelve_frames":
            assert len(cell["held_out"]) == 3
            figures = cell["figures"]
            assert figures["refined"]["psnr"] >= figures["registered"]["psnr"] > 12
        else:
            assert set(cell["figures"]) == {"input"}


def test_what_is_written(out: Path, results: dict[str, Any]) -> None:
    text = (out / "tables.md").read_text()
    assert text.count("then refined with the scene frozen") == 2  # conclusion and caption
    assert "paper: PSNR" in text and "The data differ" in text
    assert (out / "tables.csv").read_text().count("\n") > 50
    assert "<html" in (out / "report.html").read_text()
