"""`benchmarks/register.py --calibrate`: intervals that cover what they are to, and no more."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from pipeline.studies.register import comparing

SCRIPT = Path(__file__).resolve().parents[2] / "benchmarks" / "register.py"


@pytest.fixture(scope="module")
def benchmark() -> ModuleType:
    spec = importlib.util.spec_from_file_location("benchmark_of_register", SCRIPT)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


def mouth(  # type: ignore[no-untyped-def]
    benchmark: ModuleType, seed: int, teeth: int, true: tuple[float, float], basis: str = "marks"
):
    """Errors of teeth that are off by `true` times what is stated as their deviation."""
    rng = np.random.default_rng(seed)
    deviation = np.exp(rng.normal(0, 0.5, (teeth, 6))) * np.repeat([0.3, 4.0], 3)
    off = rng.normal(size=(teeth, 6)) * deviation * np.repeat(true, 3)
    moved = np.arange(teeth) % 3 == 0
    off[~moved] /= 5  # teeth that stood still look better than they are measured
    return benchmark.Errors(
        moved, np.linalg.norm(off[:, :3], axis=1), np.linalg.norm(off[:, 3:], axis=1), off,
        np.zeros((teeth, 6)), deviation, np.zeros(teeth, bool), np.full(teeth, basis),
    )  # fmt: skip


def test_factors_come_out_that_moved_teeth_ask_for(benchmark: ModuleType) -> None:
    """1.96 deviations of a part that is as sure as said, twice that of one half as sure."""
    errors = mouth(benchmark, 1, 3000, (1.0, 2.0))
    (shift, turn), floors = benchmark.calibrated(errors)
    assert shift == pytest.approx(1.96, rel=0.1)
    assert turn == pytest.approx(3.92, rel=0.1)
    new = mouth(benchmark, 2, 3000, (1.0, 2.0))
    half = comparing.halves(new.deviation, (shift, turn), floors)
    inside = np.abs(new.parts) <= half
    assert inside[new.moved].mean() == pytest.approx(0.95, abs=0.01)
    assert new.covered(half)[new.moved].mean() == pytest.approx(0.95, abs=0.02)


def test_few_teeth_ask_for_more_than_the_worst_of_them(benchmark: ModuleType) -> None:
    factors = np.arange(1.0, 11.0)
    assert benchmark.enough(factors, 0.95) == benchmark.MARGIN * 10
    assert benchmark.enough(factors, 0.8) == 9.0
    assert benchmark.enough(np.arange(1.0, 20.0), 0.95) == 19.0


def test_a_mouth_is_judged_by_the_others(
    benchmark: ModuleType, capsys: pytest.CaptureFixture[str]
) -> None:
    """One mouth that errs far beyond what is stated can't make its own interval wider."""
    mouths = {seed: mouth(benchmark, seed, 60, (1.0, 1.0)) for seed in (1, 2, 3)}
    mouths[4] = mouth(benchmark, 4, 60, (40.0, 40.0))
    benchmark.calibrate(mouths)
    said = capsys.readouterr().out.splitlines()
    alone = next(line for line in said if line.startswith("left out one by one, moved"))
    covered, teeth = map(int, alone.split("covered ")[1].split()[0].split("/"))
    assert teeth == 80
    assert 55 <= covered < 70


def test_what_measures_a_tooth_has_factors_of_its_own(
    benchmark: ModuleType, capsys: pytest.CaptureFixture[str]
) -> None:
    marks = mouth(benchmark, 1, 600, (1.0, 1.0))
    flow = mouth(benchmark, 2, 600, (3.0, 3.0), "flow")
    benchmark.calibrate({1: benchmark.together([marks, flow])})
    lines = [line for line in capsys.readouterr().out.splitlines() if "left out" not in line]
    assert [line for line in lines if line.startswith("by ")] == ["by marks:", "by flow:"]
    for said, kind in zip(lines[1::2], (marks, flow), strict=True):
        factors, _ = benchmark.calibrated(kind)
        assert f"factors {np.round(factors, 2)}" in said
