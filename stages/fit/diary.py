"""What a fit leaves to look at while it runs: its loss curve, and pictures of one view."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt

from pipeline.artifacts.views import write_png

Floats = npt.NDArray[np.float32]

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
