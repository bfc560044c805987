"""What a fit leaves while it runs: a checkpoint, its loss curve, and pictures of one view.

A killed run goes on from the checkpoint, to the same bytes.
"""

from __future__ import annotations

import hashlib
import json
import os
import struct
import zipfile
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.artifacts.views import write_png
from stages.fit.arrays import Arrays, Floats

#: What numpy and zipfile raise for a file of which any byte may be wrong.
_UNREADABLE = (
    OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile, NotImplementedError, RuntimeError,
    MemoryError, OverflowError, SyntaxError, struct.error, zlib.error,
)  # fmt: skip

COLUMNS = ("iteration", "loss", "psnr", "gaussians")


def write_curve(folder: Path, rows: Sequence[Sequence[float]]) -> None:
    """`curve.csv`: one row per report, running means of loss and PSNR (dB), count of Gaussians."""
    lines = [",".join(COLUMNS)]
    lines += [f"{int(i)},{loss:.6f},{psnr:.3f},{int(n)}" for i, loss, psnr, n in rows]
    temporary = folder / "curve.csv.tmp"
    temporary.write_text("\n".join(lines) + "\n")
    temporary.replace(folder / "curve.csv")


def write_preview(folder: Path, iteration: int, photograph: Floats, rendering: Floats) -> None:
    """`fit_00250.png`: a photograph [3, H, W] and its rendering, side by side."""
    both = np.concatenate([photograph, rendering], 2).transpose(1, 2, 0)
    eight_bit = np.ascontiguousarray(np.rint(np.clip(both, 0, 1) * 255).astype(np.uint8))
    write_png(folder / f"fit_{iteration:05d}.png", eight_bit)


def save_checkpoint(path: Path, arrays: Arrays, facts: dict[str, Any]) -> None:
    """Write arrays and JSON facts in one `.npz`, atomically: the old file or the new one."""
    temporary = path.with_name(path.name + ".tmp")
    text = np.frombuffer(json.dumps(facts).encode(), np.uint8)
    whole = {**arrays, "_facts": text}
    with temporary.open("wb") as file:
        np.savez(file, allow_pickle=False, _digest=_digest(whole), **whole)
        file.flush()
        os.fsync(file.fileno())
    temporary.replace(path)


def _digest(arrays: Arrays) -> Any:
    """SHA-256 of names, types, shapes and bytes: zip's own checks leave gaps."""
    found = hashlib.sha256()
    for name, array in sorted(arrays.items()):
        found.update(repr((name, str(array.dtype), array.shape)).encode())
        found.update(np.ascontiguousarray(array).view(np.uint8).reshape(-1).data)
    return np.frombuffer(found.digest(), np.uint8)


def load_checkpoint(path: Path) -> tuple[Arrays, dict[str, Any]] | None:
    """Read what `save_checkpoint` wrote, or None where there is nothing readable."""
    try:
        with np.load(path, allow_pickle=False) as data:
            arrays = {name: data[name] for name in data.files}
        if not np.array_equal(arrays.pop("_digest"), _digest(arrays)):
            return None
        facts = json.loads(arrays.pop("_facts").tobytes().decode())
    except _UNREADABLE:
        return None
    return arrays, facts
