"""What the page about a run says of how good the scene is."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pipeline.artifacts.metrics import Metrics, Scores
from pipeline.artifacts.views import read_png
from pipeline.pages.case import title_of
from pipeline.pages.parts import Block, Card, Comparison, Fact, Grid, Heading, Part, Section, Text
from pipeline.pages.pictures import LARGE, from_file, picture, thirds
from pipeline.pages.tables import POSES, block_table, views_table
from pipeline.stage import Parts

if TYPE_CHECKING:
    from pipeline.pages.case import Case

#: Below this a card is coloured: the scene explains its own photographs badly.
POOR_PSNR = 22.0
#: Views of which more than this counts, as a share, are not masked to speak of; scenes that cover
#: more than this of held-out views leave no gap to speak of.
WHOLE, MOSTLY = 0.995, 0.8
#: Comparisons on the page at most; with more than the second each is drawn smaller.
MOST_COMPARISONS, MANY_COMPARISONS, MEDIUM = 24, 12, 440
#: Comparisons that stand among the pictures to check.
FIRST = 2
TRAINING_NOTE = (
    "These are training views: the scene was made from them. The figure says how well the scene "
    "explains these photographs, not how right it is from directions that nobody photographed."
)


def metrics_of(case: Case) -> Metrics:
    """The figures in use; empty where there are none."""
    found: Metrics | None = case.latest("metrics")
    return found or Metrics({})


def cards(case: Case) -> Iterator[Card]:
    """How well the scene predicts photographs that it has not seen, and those that it has."""
    metrics = metrics_of(case)
    for name, scores in metrics.held_out.items():
        if scores.mean.get("psnr") is not None:
            psnr = scores.mean["psnr"]
            yield Card(f"{psnr:.2f} dB", f"PSNR of photographs held out ({name} cameras)")
    mean = metrics.input.mean
    if mean.get("psnr") is not None:
        ssim = f"; SSIM {mean['ssim']:.3f}" if mean.get("ssim") is not None else ""
        label = f"PSNR of the input photographs (training views){ssim}"
        yield Card(f"{mean['psnr']:.2f} dB", label, poor=mean["psnr"] < POOR_PSNR)


def findings(case: Case) -> Iterator[Fact]:
    """Plain sentences: how good the scene is, and what that was measured on."""
    metrics = metrics_of(case)
    mean, worst, counted = metrics.input.mean, metrics.input.worst, _counted(metrics.input)
    if mean.get("psnr") is not None:
        part = "them" if counted > WHOLE else f"the {100 * counted:.0f} % of them that masks leave"
        text = (
            f"Rendered from where the photographs were taken, the scene repeats {part} with a PSNR "
            f"of {mean['psnr']:.2f} dB"
        )
        if worst.get("psnr"):
            view = worst["psnr"]["view"]
            text += f" (worst: {case.labels.get(view, view)}, {worst['psnr']['value']:.2f} dB)"
        yield Fact(f"{text}. {TRAINING_NOTE}")
    yield from _about_unseen(metrics)
    coverage = metrics.figures.get("coverage")
    if coverage is not None:
        used = "" if counted > WHOLE else " that masks leave"
        yield Fact(
            f"The scene covers {100 * coverage:.1f} % of the photographs' pixels{used}; the rest "
            "stays empty."
        )
    if metrics.figures and not metrics.held_out:
        kept_back = case.latest("held_out")
        why = (
            "the true cameras of the photographs held out are not known (evaluate.ground_truth)"
            if kept_back and kept_back.views
            else "no photograph was held out (views.held_out, with evaluate.ground_truth)"
        )
        yield Fact(
            f"How right the scene is from other directions was not measured: {why}. Directions far "
            "from all photographs are guesses."
        )


def _about_unseen(metrics: Metrics) -> Iterator[Fact]:
    """Sentences on held-out photographs and on directions that nobody photographed."""
    blocks = metrics.held_out
    if blocks:
        count = max(len(scores.views) for scores in blocks.values())
        held_out = "photograph was" if count == 1 else "photographs were"
        told = ", ".join(
            f"{scores.mean['psnr']:.2f} dB ({name} cameras)" for name, scores in blocks.items()
        )
        yield Fact(
            f"{count} {held_out} held out, that is, never shown to the reconstruction. It predicts "
            f"{'it' if count == 1 else 'them'} with a PSNR of {told}{_shown(blocks)}."
        )
    unsupported = [scores.mean.get("unsupported") for scores in blocks.values()]
    if unsupported and unsupported[0] is not None:
        yield Fact(
            f"Of what the scene shows of them, {100 * unsupported[0]:.1f} % was seen by no input "
            "photograph: there the picture is a guess."
        )
    novel = metrics.part("novel")
    if novel.get("views"):
        shares = [100 * figures["unsupported"] for figures in novel["views"].values()]
        told = " and ".join(f"{share:.0f} %" for share in shares)
        yield Fact(
            f"Looked at from {novel['degrees_beyond']:.0f} degrees beyond the outermost "
            f"photographs, {told} of what the scene shows was never photographed."
        )


def _counted(scores: Scores) -> float:
    """Share of the pixels of some views that counts, 0..1; 1 where nobody says."""
    shares = [figures.get("pixels", 1.0) for figures in scores.views.values()]
    return sum(shares) / len(shares) if shares else 1.0


def _shown(blocks: Mapping[str, Scores]) -> str:
    """How little of held-out photographs the scene shows, where it is little."""
    coverage = next(iter(blocks.values())).mean.get("coverage")
    if coverage is None or coverage > MOSTLY:
        return ""
    return f"; the scene covers {100 * coverage:.0f} % of their pixels, and the rest counts as well"


def renders(case: Case) -> Iterator[Section]:
    """Photograph, render and error of each input view, the worst first."""
    shown, total = _comparisons(case, "comparison", metrics_of(case).input)
    if not shown:
        return
    said = (
        "The input photographs that the scene repeats worst; move the edge to compare. All others "
        "are below."
    )
    yield Section("", [Text(said), Grid(shown[:FIRST], "wide")], place="check")
    yield Section(
        "Renders beside the photographs", [Text(TRAINING_NOTE), Grid(shown, "wide")],
        f"{len(shown)} of {total} input views, worst first",
    )  # fmt: skip


def held_out(case: Case) -> Iterator[Section]:
    """The same of the photographs that the reconstruction never saw."""
    metrics = metrics_of(case)
    protocol = metrics.pictured
    scores = metrics.held_out.get(protocol, Scores()) if protocol else metrics.input
    shown, total = _comparisons(case, "heldout_comparison", scores)
    if shown:
        said = (
            "The reconstruction never saw these: they tell how right the scene is from new "
            f"directions. Rendered with {protocol or 'registered'} cameras."
        )
        yield Section(
            "Held-out photographs", [Text(said), Grid(shown, "wide")],
            f"{total} pictures, worst first", "open",
        )  # fmt: skip


def _comparisons(case: Case, kind: str, scores: Scores) -> tuple[list[Comparison], int]:
    """Pictures of a kind, worst first, and how many there are in all.

    Args:
        kind: ``"comparison"`` (input views) or ``"heldout_comparison"``.
        scores: whose figures stand in the captions.
    """
    labels = case.labels
    paths = _pictures(case, kind)
    size = LARGE if len(paths) <= MANY_COMPARISONS else MEDIUM
    entries = []
    for path in paths:
        view = path.stem.removeprefix(f"{kind}_")
        known = max((name for name in scores.views if name in view), key=len, default="")
        score = scores.views.get(known, {})
        psnr = score.get("psnr")
        entries.append((psnr if psnr is not None else 1e9, view, known, score, path))
    entries.sort(key=lambda entry: entry[:2])
    shown = [
        _comparison(path, labels.get(known or view, view), view.replace(known, "").strip("_"),
                    score, size)
        for _, view, known, score, path in entries[:MOST_COMPARISONS]
    ]  # fmt: skip
    return shown, len(paths)


def _pictures(case: Case, kind: str) -> list[Path]:
    name = next(iter(case.providers("metrics")[::-1]), None)
    folder = case.folder(name, "metrics") if name else None
    return sorted(folder.glob(f"{kind}_*.png")) if folder else []


def _comparison(
    path: Path, title: str, variant: str, score: Mapping[str, Any], size: int
) -> Comparison:
    image = read_png(path)
    parts = thirds(image)
    text = ", ".join(
        f"{name.upper()} {score[name]:.{digits}f}{unit}"
        for name, digits, unit in (("psnr", 2, " dB"), ("ssim", 3, ""), ("lpips", 3, ""))
        if isinstance(score.get(name), int | float)
    )
    heading = f"{title} {variant}".strip()
    if parts is None:
        whole = picture(image, f"Photograph, render and error of {title}.", "", 1400)
        return Comparison(heading, text, (whole,))
    photograph, render, error = (
        picture(part, f"{name} of {title}", name, size)
        for name, part in zip(("photograph", "render", "error"), parts, strict=True)
    )
    return Comparison(heading, text, (photograph, render, error))


def support(case: Case) -> Iterator[Section]:
    """Overlays that show what was never photographed."""
    labels = case.labels
    found = []
    for path in _pictures(case, "support")[:MOST_COMPARISONS]:
        view = path.stem.removeprefix("support_")
        title = labels.get(view, title_of(view, labels))
        if view.startswith("novel_"):
            title = f"from beyond the {view.removeprefix('novel_')} photograph"
        found.append(from_file(path, f"What of {title} was never photographed.", title, MEDIUM))
    if not found:
        return
    said = (
        "Marked parts are seen by no input photograph. What the scene shows there is invented, "
        "however plausible it looks."
    )
    legend = str(metrics_of(case).figures.get("support_legend", ""))
    if legend:
        said += f" {legend[0].upper()}{legend[1:]}."
    yield Section("What was never photographed", [Text(said), Grid(found)], place="chapter")


def figures(case: Case) -> Iterator[Part]:
    """Tables of the input views, of the held-out ones, and against the ground truth."""
    metrics = metrics_of(case)
    blocks: list[Block] = []
    scored = {"Input views (training views)": metrics.input} | {
        f"Held-out views, cameras {name}": scores for name, scores in metrics.held_out.items()
    }
    for title, scores in scored.items():
        if scores.views:
            blocks.append(Heading(title))
            if scores.protocol:
                blocks.append(Text(scores.protocol, soft=True))
            blocks.append(views_table(scores, case.labels))
    if any("lpips" in f and f["lpips"] is None for f in metrics.input.views.values()):
        blocks.append(
            Text("LPIPS is empty where no weights for it were given (evaluate.lpips_weights).",
                 soft=True)
        )  # fmt: skip
    poses, geometry = metrics.part("poses"), metrics.part("geometry")
    for what, group, titles in (("Cameras", poses, POSES), ("Geometry", geometry, {})):
        if group:
            blocks += [Heading(f"{what} against the ground truth"), block_table(group, titles)]
    if blocks:
        note = f"per view{', poses' if poses else ''}{', geometry' if geometry else ''}"
        yield Section("Figures", blocks, note)


PARTS: Parts = {
    "key figures": cards,
    "findings": findings,
    "support": support,
    "renders": renders,
    "held-out views": held_out,
    "scores": figures,
}
