"""Saving the fit's state so that a killed run goes on where it was, to the same bytes."""

from __future__ import annotations

import json
import os
import zipfile
from pathlib import Path
from typing import Any

import numpy as np

from stages.fit.parts.base import Arrays


def save_checkpoint(path: Path, arrays: Arrays, facts: dict[str, Any]) -> None:
    """Write arrays and JSON facts in one `.npz`, atomically: the old file or the new one."""
    temporary = path.with_name(path.name + ".tmp")
    text = np.frombuffer(json.dumps(facts).encode(), np.uint8)
    with temporary.open("wb") as file:
        np.savez(file, allow_pickle=False, _facts=text, **arrays)
        file.flush()
        os.fsync(file.fileno())
    temporary.replace(path)


def load_checkpoint(path: Path) -> tuple[Arrays, dict[str, Any]] | None:
    """Read what `save_checkpoint` wrote, or None where there is nothing readable."""
    try:
        with np.load(path, allow_pickle=False) as data:
            arrays = {name: data[name] for name in data.files}
        facts = json.loads(arrays.pop("_facts").tobytes().decode())
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile):
        return None
    return arrays, facts
