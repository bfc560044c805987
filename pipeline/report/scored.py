"""What the evaluation left: renders beside the truth, support, tables of figures."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pipeline.artifacts.views import read_png
from pipeline.report.case import Case, held_out_blocks, read_metrics
from pipeline.report.names import labels_of, title_of
from pipeline.report.pictures import LARGE, Picture, from_file, picture, thirds
from pipeline.report.tables import views_table

Content = dict[str, Any]

#: Comparisons on one page at most; with more than the second each is drawn smaller.
MOST_COMPARISONS, MANY_COMPARISONS, MEDIUM = 24, 12, 440


def renders(case: Case, kind: str = "comparison", block: str | None = None) -> Content | None:
    """Photograph, render and error of each view, the worst first.

    Args:
        kind: ``"comparison"`` (input views) or ``"heldout_comparison"``.
        block: protocol of the held-out views whose figures stand in the captions.
    """
    name = next(iter(case.providers("metrics")[::-1]), None)
    folder = case.folder(name, "metrics") if name else None
    metrics = read_metrics(case)
    if folder is None:
        return None
    scored = metrics.get("held_out", {}).get(block, {}) if block else metrics
    scores: Mapping[str, Mapping[str, Any]] = scored.get("views", {})
    labels = labels_of(case)
    paths = list(folder.glob(f"{kind}_*.png"))
    size = LARGE if len(paths) <= MANY_COMPARISONS else MEDIUM
    entries = []
    for path in paths:
        view = path.stem.removeprefix(f"{kind}_")
        known = max((n for n in scores if n in view), key=len, default="")
        score = scores.get(known, {})
        psnr = score.get("psnr")
        entries.append((psnr if psnr is not None else 1e9, view, known, score, path))
    entries.sort(key=lambda entry: entry[:2])
    shown = [
        _comparison(path, labels.get(known or view, view), view.replace(known, "").strip("_"),
                    score, size)
        for _, view, known, score, path in entries[:MOST_COMPARISONS]
    ]  # fmt: skip
    return {"entries": shown, "total": len(paths)} if shown else None


def _comparison(
    path: Path, title: str, variant: str, score: Mapping[str, Any], size: int
) -> Content:
    image = read_png(path)
    parts = thirds(image)
    text = ", ".join(
        f"{name.upper()} {score[name]:.{digits}f}{unit}"
        for name, digits, unit in (("psnr", 2, " dB"), ("ssim", 3, ""), ("lpips", 3, ""))
        if isinstance(score.get(name), int | float)
    )
    content: Content = {"title": f"{title} {variant}".strip(), "score": text, "whole": None}
    if parts is None:
        content["whole"] = picture(image, f"Photograph, render and error of {title}.", "", 1400)
        return content
    names = ("photograph", "render", "error")
    content |= {
        name: picture(part, f"{name} of {title}", name, size)
        for name, part in zip(names, parts, strict=True)
    }
    return content


def support(case: Case) -> list[Picture]:
    """Overlays that show what was never photographed."""
    name = next(iter(case.providers("metrics")[::-1]), None)
    folder = case.folder(name, "metrics") if name else None
    labels = labels_of(case)
    found = []
    for path in sorted(folder.glob("support_*.png")) if folder else ():
        view = path.stem.removeprefix("support_")
        title = labels.get(view, title_of(view, labels))
        if view.startswith("novel_"):
            title = f"from beyond the {view.removeprefix('novel_')} photograph"
        found.append(from_file(path, f"What of {title} was never photographed.", title, MEDIUM))
    return found[:MOST_COMPARISONS]


def scores(case: Case) -> list[Content]:
    """Tables of the input views and of both protocols of the held-out ones."""
    metrics = read_metrics(case)
    labels = labels_of(case)
    found = []
    if metrics.get("views"):
        found.append(
            {"title": "Input views (training views)", "text": metrics.get("protocol", ""),
             "table": views_table(metrics, labels)}
        )  # fmt: skip
    found += [
        {"title": f"Held-out views, cameras {name}", "text": block.get("protocol", ""),
         "table": views_table(block, labels)}
        for name, block in held_out_blocks(metrics).items()
    ]  # fmt: skip
    return found
