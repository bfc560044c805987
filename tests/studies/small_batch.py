"""A batch of four small real cases for the tests of clusters, and patience."""

from __future__ import annotations

import csv
import shutil
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
#: Small settings: what is tested is the way to the cluster and back.
SETTINGS = ("--stages", "views,teeth", "--set", "views.long_side=256", "--set", "report=false")


def write_cases(folder: Path) -> None:
    """Four cases of three photographs each."""
    frames = sorted((ROOT / "data_samples" / "twelve_frames").glob("*.jpg"))
    for number in range(4):
        case = folder / f"case_{number}"
        case.mkdir(parents=True)
        for frame in frames[3 * number : 3 * number + 3]:
            shutil.copy(frame, case)


def summary(out: Path) -> list[dict[str, str]]:
    """The rows of a batch's table."""
    with (out / "summary.csv").open() as stream:
        return list(csv.DictReader(stream))


def wait_for(condition: Callable[[], Any], seconds: float = 60) -> None:
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        if condition():
            return
        time.sleep(0.05)
    raise AssertionError("this never came to pass")
