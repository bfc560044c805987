"""Cores, time and memory, also where the system lacks the calls that Linux has."""

from __future__ import annotations

import os
import sys
import time
from pathlib import Path

import pytest

from pipeline import measure
from pipeline.config import load_config


def test_linux_counts_the_cores_that_may_be_used() -> None:
    assert 1 <= measure.usable_cores() <= (os.cpu_count() or 1)


def test_without_affinity_all_cores_count(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delattr(os, "sched_getaffinity", raising=False)
    monkeypatch.setattr(measure, "granted_cores", lambda: float("inf"))
    assert measure.usable_cores() == os.cpu_count()
    assert load_config().threads == os.cpu_count()
    monkeypatch.setattr(os, "cpu_count", lambda: None)
    assert measure.usable_cores() == 1


@pytest.mark.parametrize(
    ("files", "granted"),
    [
        ({"cpu.max": "150000 100000\n"}, 1.5),
        ({"cpu.max": "max 100000\n"}, float("inf")),
        ({"cpu/cpu.cfs_quota_us": "400000\n", "cpu/cpu.cfs_period_us": "100000\n"}, 4),
        ({"cpu/cpu.cfs_quota_us": "-1\n", "cpu/cpu.cfs_period_us": "100000\n"}, float("inf")),
        ({"cpu.max": "strange"}, float("inf")),
        ({}, float("inf")),
    ],
)
def test_a_containers_share_of_time_counts(
    files: dict[str, str], granted: float, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name, text in files.items():
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(text)
    assert measure.granted_cores(tmp_path) == granted
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(64)), raising=False)
    monkeypatch.setattr(measure, "granted_cores", lambda: granted)
    assert measure.usable_cores() == min(64, {1.5: 2, 4: 4}.get(granted, 64))


def test_without_resource_and_proc_it_still_measures(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "resource", None)  # the import fails, as on Windows

    def missing(*_: object, **__: object) -> None:
        raise FileNotFoundError

    monkeypatch.setattr(Path, "write_text", missing)
    monkeypatch.setattr(Path, "read_text", missing)
    with measure.Measurement() as work:
        end = time.process_time() + 0.1
        while time.process_time() < end:
            pass
    assert work.figures["cpu_seconds"] > 0.09
    assert work.figures["wall_seconds"] > 0.09
    assert work.figures["peak_memory_mb"] == 0


def test_with_resource_alone_memory_is_known(monkeypatch: pytest.MonkeyPatch) -> None:
    kib = measure.peak_mb(False)
    assert 10 < kib < 100_000
    monkeypatch.setattr(sys, "platform", "darwin")
    assert measure.peak_mb(False) == pytest.approx(kib / 1024, rel=0.1)


def test_no_other_module_asks_the_system_itself() -> None:
    root = Path(measure.__file__).parents[1]
    for package in ("dentalsplat", "pipeline", "stages"):
        for path in (root / package).rglob("*.py"):
            if path != Path(measure.__file__):
                text = path.read_text(encoding="utf-8")
                assert "sched_getaffinity" not in text and "import resource" not in text, path
