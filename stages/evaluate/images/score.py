"""Figures of one view, and of all of them."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from stages.evaluate.images.metrics import detail, psnr, ssim

Image = npt.NDArray[np.uint8]
Mask = npt.NDArray[np.bool_]
Figures = dict[str, float | None]

#: What an exact copy counts as: JSON has no infinity, and a mean over views must stay finite.
LARGEST_PSNR = 100.0

#: A pixel is covered by Gaussians if the render's alpha is above this.
COVERED = 0.5

#: LPIPS halves a picture four times.
SMALLEST_LPIPS = 16

#: Figures of which less is better.
LOWER_IS_BETTER = ("lpips", "flip", "unsupported")
#: Figures that have a mean and a worst view, in this order; `pixels` says nothing about quality.
SUMMARISED = (
    "psnr", "ssim", "lpips", "flip", "detail", "coverage", "unsupported", "psnr_mask", "ssim_mask",
)  # fmt: skip


def score_view(
    render: Image,
    photo: Image,
    alpha: npt.NDArray[np.floating],
    mask: Mask,
    *,
    region: Mask | None = None,
    lpips: Callable[[Image, Image, Mask | None], float] | None = None,
    flip: Callable[[Image, Image], npt.NDArray[np.float32]] | None = None,
) -> Figures:
    """Compare a render with the photograph.

    Args:
        render, photo: [H, W, 3] uint8.
        alpha: [H, W] accumulated opacity of the render, 0..1.
        mask: [H, W] pixels that count.
        region: [H, W] part that is scored by itself, such as teeth; None for none.
        lpips: (render, photo, pixels that count) -> LPIPS; None where there are no weights.
        flip: (render, photo) -> FLIP per pixel; None to leave it out.

    Returns:
        psnr (dB, at most `LARGEST_PSNR`), ssim, lpips (None without `lpips`), flip (if asked for),
        detail (power of fine detail over the photograph's; None where that has none), coverage
        (share of pixels with alpha above `COVERED`) and pixels (share of the image that counts);
        with a region that has pixels psnr_mask and ssim_mask, of it alone. LPIPS and FLIP look at
        neighbourhoods: pixels that do not count are black in both pictures.
    """
    whole = None if mask.all() else mask
    figures: Figures = {
        "psnr": min(psnr(render, photo, whole), LARGEST_PSNR),
        "ssim": ssim(render, photo, whole),
        "lpips": None,
        "detail": detail(render, photo, whole),
        "coverage": float((alpha[mask] > COVERED).mean()),
        "pixels": float(mask.mean()),
    }
    pair = render, photo
    if whole is not None:
        pair = np.where(mask[..., None], render, 0), np.where(mask[..., None], photo, 0)
    if lpips is not None and min(mask.shape) >= SMALLEST_LPIPS:
        figures["lpips"] = lpips(*pair, whole)
    if flip is not None:
        figures["flip"] = float(flip(*pair)[mask].mean(dtype=np.float64))
    if region is not None and (region & mask).any():
        figures["psnr_mask"] = min(psnr(render, photo, region & mask), LARGEST_PSNR)
        figures["ssim_mask"] = ssim(render, photo, region & mask)
    return figures


def summary_of(views: Mapping[str, Mapping[str, float | None]]) -> dict[str, Any]:
    """Mean and worst figures over views: each view counts the same, as in the papers' tables.

    Args:
        views: view name -> figures of `score_view`; at least one. A figure that some views lack
            is summarised over the others.

    Returns:
        {"mean": {figure: value}, "worst": {figure: {"view": name, "value": value}}}; the mean of
        a figure that is None everywhere is None, and it has no worst view.
    """
    mean: dict[str, float | None] = {}
    worst = {}
    for key in SUMMARISED:
        if not any(key in figures for figures in views.values()):
            continue
        known = {name: views[name].get(key) for name in sorted(views)}
        values = {name: value for name, value in known.items() if value is not None}
        mean[key] = math.fsum(values.values()) / len(values) if values else None
        if values:
            sign = -1 if key in LOWER_IS_BETTER else 1
            name = min(values, key=lambda name: (sign * values[name], name))
            worst[key] = {"view": name, "value": values[name]}
    return {"mean": mean, "worst": worst}
