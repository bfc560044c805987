"""Figures of one view, and of all of them."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from stages.evaluate.metrics import psnr, ssim

#: What an exact copy counts as: JSON has no infinity, and a mean over views must stay finite.
LARGEST_PSNR = 100.0

#: A pixel is covered by Gaussians if the render's alpha is above this.
COVERED = 0.5


def score_view(
    render: npt.NDArray[np.uint8],
    photo: npt.NDArray[np.uint8],
    alpha: npt.NDArray[np.floating],
    mask: npt.NDArray[np.bool_],
) -> dict[str, float]:
    """Compare a render with the photograph.

    Args:
        render, photo: [H, W, 3] uint8.
        alpha: [H, W] accumulated opacity of the render, 0..1.
        mask: [H, W] pixels that count.

    Returns:
        psnr (dB, at most `LARGEST_PSNR`), ssim, coverage (share of pixels with alpha above
        `COVERED`) and pixels (share of the image that counts).
    """
    whole = None if mask.all() else mask
    return {
        "psnr": min(psnr(render, photo, whole), LARGEST_PSNR),
        "ssim": ssim(render, photo, whole),
        "coverage": float((alpha[mask] > COVERED).mean()),
        "pixels": float(mask.mean()),
    }


def summary_of(views: Mapping[str, Mapping[str, float]]) -> dict[str, Any]:
    """Mean and worst figures over views: each view counts the same, as in the papers' tables.

    Args:
        views: view name -> figures of `score_view`; at least one.

    Returns:
        {"mean": {figure: value}, "worst": {figure: {"view": name, "value": value}}}.
    """
    names = sorted(views)
    mean = {
        key: math.fsum(views[name][key] for name in names) / len(names)
        for key in ("psnr", "ssim", "coverage")
    }
    worst = {}
    for key in mean:
        name = min(names, key=lambda name, key=key: (views[name][key], name))  # type: ignore[misc]
        worst[key] = {"view": name, "value": views[name][key]}
    return {"mean": mean, "worst": worst}
