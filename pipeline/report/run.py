"""The report of a run: what to say, in which order."""

from __future__ import annotations

import platform
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import yaml

from pipeline.planning import library_version
from pipeline.report import CHECK, REPORT, check, compared, scored, sections
from pipeline.report.case import Case, held_out_blocks, read_case, read_metrics
from pipeline.report.check import write_check_page
from pipeline.report.names import labels_of
from pipeline.report.page import number, seconds, write_page
from pipeline.report.tables import POSES, block_table, costs

#: Below this a card is coloured: the scene explains its own photographs badly.
POOR_PSNR = 22.0
#: Names of photographs in the command line that the page shows.
MOST_NAMED = 4
TRAINING_NOTE = (
    "These are training views: the scene was made from them. The figure says how well the scene "
    "explains these photographs, not how right it is from directions that nobody photographed."
)


def write_run_report(workspace: Path) -> Path:
    """Write the report of a workspace's last request; see `pipeline.report.run_report`."""
    case = read_case(workspace)
    notes = case.notes

    def drawn(title: str, build: Callable[[Case], Any], otherwise: Any) -> Any:
        # One damaged or foreign file must not cost the reader the rest of the report.
        try:
            return build(case)
        except Exception as error:
            notes.append(f"The part '{title}' could not be drawn: {type(error).__name__}: {error}")
            return otherwise

    to_check = drawn("page to put the teeth right", write_check_page, None)
    photographs = drawn("photographs", sections.photographs, None)
    metrics = drawn("metrics", read_metrics, {})
    content: dict[str, Any] = {
        "photographs": photographs,
        "teeth": drawn("teeth", check.labelled, None),
        "matches": drawn("matches", sections.matches, None),
        "cameras": drawn("cameras", sections.cameras, None),
        "points": drawn("points", sections.points, None),
        "flow": drawn("flow", sections.flow, None),
        "fit": drawn("fit", sections.fit, None),
        "renders": drawn("renders", scored.renders, None),
        "held_out": drawn("held-out views", _held_out, None),
        "support": drawn("support", scored.support, []),
        "scores": drawn("scores", scored.scores, []),
        "comparison_with_colmap": drawn("comparison", compared.comparison, None),
        "hero": drawn("preview", sections.hero, None),
        "failure_pictures": drawn("failure", sections.failure_pictures, []),
        "poses": block_table(metrics["poses"], POSES, "") if metrics.get("poses") else None,
        "geometry": block_table(metrics["geometry"], {}, "") if metrics.get("geometry") else None,
        "support_legend": metrics.get("support_legend", ""),
        "no_lpips": _lpips_missing(metrics),
    }
    manifests = {record.name: record.manifest for record in case.stages}
    return write_page(
        "run.html", workspace / REPORT, **content,
        title=workspace.resolve().name, case=case, failed=case.failed, notes=notes,
        stale=[r for r in case.stages if r.state in ("stale", "pending") and r.result],
        missing=[r for r in case.stages if r.result is None and not r.failure],
        warnings=list(case.warnings()), costs=costs(manifests),
        cards=drawn("key figures", lambda case: cards(case, photographs, metrics), []),
        facts=drawn("findings", lambda case: facts(case, photographs, metrics), []),
        links=links(case), settings=settings(case), versions=versions(case),
        command=command(case), date=time.strftime("%Y-%m-%d %H:%M"), training_note=TRAINING_NOTE,
        diagnosis=diagnosis(case), check=CHECK if to_check else "",
    )  # fmt: skip


def _held_out(case: Case) -> dict[str, Any] | None:
    metrics = read_metrics(case)
    pictured = metrics.get("held_out", {}).get("pictures")
    protocol = pictured if isinstance(pictured, str) else next(iter(held_out_blocks(metrics)), None)
    content = scored.renders(case, "heldout_comparison", protocol)
    return {**content, "protocol": protocol} if content else None


def _lpips_missing(metrics: dict[str, Any]) -> bool:
    views = metrics.get("views", {}).values()
    return any("lpips" in figures and figures["lpips"] is None for figures in views)


def diagnosis(case: Case) -> str:
    """Why the run failed, without the place of the pictures that the page shows itself."""
    return (
        (case.failed.failure or "").partition(" Pictures that show it: ")[0] if case.failed else ""
    )


def cards(case: Case, photographs: Any, metrics: dict[str, Any]) -> list[dict[str, Any]]:
    """The figures at the top: value, what it is, and whether it is poor."""
    found: list[dict[str, Any]] = []

    def card(value: str, label: str, *, poor: bool = False) -> None:
        found.append({"value": value, "label": label, "poor": poor})

    if photographs and photographs["placed"] is not None:
        placed, total = photographs["placed"], photographs["total"]
        card(f"{placed} of {total}", "photographs placed in space", poor=placed < total)
    for name, block in held_out_blocks(metrics).items():
        psnr = block.get("mean", {}).get("psnr")
        if psnr is not None:
            card(f"{psnr:.2f} dB", f"PSNR of photographs held out ({name} cameras)")
    mean = metrics.get("mean", {})
    if mean.get("psnr") is not None:
        psnr = mean["psnr"]
        ssim = f"; SSIM {mean['ssim']:.3f}" if mean.get("ssim") is not None else ""
        card(f"{psnr:.2f} dB", f"PSNR of the input photographs (training views){ssim}",
             poor=psnr < POOR_PSNR)  # fmt: skip
    figures = case.figures()
    if "gaussians" in figures:
        card(number(figures["gaussians"]), "Gaussians in the scene")
    computed = [record.manifest["wall_seconds"] for record in case.stages if record.result]
    if computed:
        card(seconds(sum(computed)), "computing time, all stages")
    return found


def facts(case: Case, photographs: Any, metrics: dict[str, Any]) -> list[str]:
    """Plain sentences: what came out, and how sure that is."""
    found = []
    figures = case.figures()
    if photographs and photographs["placed"] is not None:
        if not photographs["unplaced"]:
            found.append(f"All {photographs['total']} photographs were placed in space.")
        else:
            found.append(
                f"{len(photographs['unplaced'])} of {photographs['total']} photographs could not "
                f"be placed and are not part of the scene: {', '.join(photographs['unplaced'])}."
            )
    mean, worst = metrics.get("mean", {}), metrics.get("worst", {})
    if mean.get("psnr") is not None:
        labels = labels_of(case)
        text = (
            "Rendered from where the photographs were taken, the scene repeats them with a PSNR of "
            f"{mean['psnr']:.2f} dB"
        )
        if worst.get("psnr"):
            view = worst["psnr"]["view"]
            text += f" (worst: {labels.get(view, view)}, {worst['psnr']['value']:.2f} dB)"
        found.append(f"{text}. {TRAINING_NOTE}")
    found += _about_unseen(metrics)
    if metrics.get("coverage") is not None:
        found.append(
            f"The scene covers {100 * metrics['coverage']:.1f} % of the photographs' pixels; the "
            "rest stays empty."
        )
    if metrics and not held_out_blocks(metrics):
        found.append(
            "How right the scene is from other directions was not measured: no photograph was held "
            "out (views.held_out). Directions far from all photographs are guesses."
        )
    cameras = case.latest("cameras")
    if cameras is not None:
        found.append(
            "Lengths are in millimetres." if cameras.units == "mm" else
            "Lengths have no unit: nothing can be measured in millimetres in this scene. Give a "
            "known length (init.length) for that."
        )  # fmt: skip
    if "reprojection_error_px" in figures:
        found.append(
            f"Matched spots are met by the cameras within {figures['reprojection_error_px']:.2f} "
            "pixels (root mean square)."
        )
    return found


def _about_unseen(metrics: dict[str, Any]) -> list[str]:
    """Sentences on held-out photographs and on directions that nobody photographed."""
    found = []
    blocks = held_out_blocks(metrics)
    psnrs = {name: block["mean"]["psnr"] for name, block in blocks.items()}
    if psnrs:
        count = max(len(block["views"]) for block in blocks.values())
        told = ", ".join(f"{psnr:.2f} dB ({name} cameras)" for name, psnr in psnrs.items())
        found.append(
            f"{_counted(count, 'photograph was', 'photographs were')} held out, that is, never "
            f"shown to the reconstruction. It predicts {'it' if count == 1 else 'them'} with a "
            f"PSNR of {told}."
        )
    unsupported = [block["mean"].get("unsupported") for block in blocks.values()]
    if unsupported and unsupported[0] is not None:
        found.append(
            f"Of what the held-out photographs show, {100 * unsupported[0]:.1f} % lies where no "
            "input photograph saw anything: there the picture is a guess."
        )
    novel = metrics.get("novel", {})
    if novel.get("views"):
        shares = [100 * figures["unsupported"] for figures in novel["views"].values()]
        told = " and ".join(f"{share:.0f} %" for share in shares)
        found.append(
            f"Looked at from {novel['degrees_beyond']:.0f} degrees beyond the outermost "
            f"photographs, {told} of what the scene shows was never photographed."
        )
    return found


def _counted(count: int, one: str, several: str) -> str:
    return f"{count} {one if count == 1 else several}"


def links(case: Case) -> list[tuple[str, str]]:
    """(relative address, text) of the files that came out."""
    if case.failed is not None or not case.providers("exports"):
        named: list[tuple[str, str]] = []
    else:
        named = [
            ("results/viewer.html", "Turn the scene around"),
            ("results/orbit.mp4", "Video"),
            ("results/mesh.stl", "Mesh (.stl)"),
            ("results/splats.ply", "Splats (.ply)"),
            ("results/README.txt", "What the files are"),
        ]
    named.append((CHECK, "Check the teeth"))
    named.append(("compare/report.html", "Comparison with COLMAP"))
    return [(path, text) for path, text in named if (case.workspace / path).is_file()]


def settings(case: Case) -> list[tuple[str, str]]:
    """(stage, its resolved settings as YAML): of its result, or of the next run."""
    found = []
    if case.config is not None:
        found.append(("run", _yaml(case.config.run.model_dump(mode="json"))))
    for record in case.stages:
        values = record.manifest.get("config")
        if values is None and case.config and record.name in case.config.sections:
            values = case.config.sections[record.name].model_dump(mode="json")
        if values is not None:
            found.append((record.name, _yaml(values)))
    return found


def versions(case: Case) -> list[tuple[str, str]]:
    """(what, version) of what computed the results and of what wrote this page."""
    found: dict[str, str] = {}
    for record in case.stages:
        found |= record.manifest.get("key_material", {}).get("libraries", {})
    own = [("dentalsplat", library_version("dentalsplat")), ("Python", sys.version.split()[0]),
           ("system", f"{platform.system()} {platform.machine()}")]  # fmt: skip
    return own + sorted(found.items())


def command(case: Case) -> str:
    """The request as a command line, with names of files instead of their folders."""
    request = case.request
    images = [Path(path).name for path in request.get("images", [])]
    if len(images) > MOST_NAMED:
        images = [images[0], "...", images[-1]]
    parts = ["pipeline run", *images]
    if request.get("preset"):
        parts.append(f"-c {Path(request['preset']).name}")
    if request.get("stages"):
        parts.append(f"--stages {','.join(request['stages'])}")
    if request.get("from"):
        parts.append(f"--from {request['from']}")
    parts += [f"--set {text}" for text in request.get("overrides", [])]
    return " ".join(parts)


def _yaml(values: Any) -> str:
    return yaml.safe_dump(values, sort_keys=False, allow_unicode=True, default_flow_style=None)
