"""For the tests of batches: folders of toy cases, and what was computed of them."""

from __future__ import annotations

import json
from collections import Counter
from pathlib import Path

from tests.studies import toy_batch

PRESET = f"stages: {toy_batch.ORDER}\nreport: false\n"


def add_case(folder: Path, name: str, *values: int) -> Path:
    case = folder / "cases" / name
    case.mkdir(parents=True)
    for value in values:
        (case / f"{value}.jpg").write_text(str(value))
    return case


def computed(folder: Path) -> Counter[str]:
    lines = (folder / "log.txt").read_text().splitlines()
    return Counter(json.loads(line)[0] for line in lines)
