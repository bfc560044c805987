"""For the tests of clusters: the recipes of docs/batch.md, four small real cases, and patience."""

from __future__ import annotations

import csv
import re
import shutil
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
PAGE = ROOT / "docs" / "batch.md"
#: Small settings: what is tested is the way to the cluster and back.
SETTINGS = ("--stages", "views,teeth", "--set", "views.long_side=256", "--set", "report=false")


def block(language: str) -> str:
    """The block of a language on the page."""
    (found,) = re.findall(rf"```{language}\n(.*?)```", PAGE.read_text(), re.DOTALL)
    return str(found)


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
    with (out / "summary.csv").open(encoding="utf-8-sig") as stream:
        return list(csv.DictReader(stream))


def wait_for(condition: Callable[[], Any], seconds: float = 60) -> None:
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        if condition():
            return
        time.sleep(0.05)
    raise AssertionError("this never came to pass")
