"""Fits started from COLMAP's cameras, and points, beside the one in a workspace."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from shutil import copyfile
from typing import Any

from pipeline.artifacts.dental.corrections import (
    CORRECTIONS,
    corrections_file,
    read_corrections,
)
from pipeline.artifacts.metrics import Metrics
from pipeline.errors import PipelineError
from pipeline.files import read_json
from pipeline.front.commands import run
from pipeline.running.reporter import Reporter
from pipeline.stage import get_stage
from pipeline.store import Result, Store
from pipeline.studies.report.reading import renewed
from pipeline.untrusted.paths import home_told
from pipeline.workspace import read_request

#: Stages of a run that a comparison repeats, in their order.
REPEATED = ("views", "teeth", "init", "align", "sap", "flow", "fit", "evaluate")
#: Those that only dense points have a use for.
FOR_DENSE = ("align", "sap")

OURS = "this pipeline"


def fit_rows(
    workspace: Path, folder: Path, model: Path | None, why_not: str, *, truth: Path | None,
    mesh: Path | None, threads: int, reporter: Reporter | None, message: Callable[[str], None],
) -> list[dict[str, Any]]:  # fmt: skip
    """Score the fit of a workspace, and the same fit from COLMAP's cameras, and from its points.

    The settings of every stage are those that the results in use were made with, and what a person
    put right about the teeth holds.

    Args:
        workspace: with a finished run up to `evaluate`.
        folder: workspace of the fits from COLMAP.
        model: COLMAP's model, or None.
        why_not: said in the rows of COLMAP where there is no model.
        truth, mesh: what takes the place of those that the run was scored with where they have
            gone, if anything.
    """
    store = Store(workspace)
    results = {name: _of_this_run(store, name) for name in REPEATED}
    rows = [_row_in_use(results)]
    present = [name for name in REPEATED if results[name] is not None]
    for title, points in (
        ("COLMAP's cameras, our dense points", "dense"),
        ("COLMAP's cameras and points", "model"),
    ):
        row: dict[str, Any] = {"start": title}
        rows.append(row)
        if "fit" not in present:
            row["failure"] = "no fit to set it beside: this workspace has none"
        elif model is None:
            row["failure"] = why_not
        else:
            message(f"fit from {title}")
            changes = settings_of(results) | {
                "init.method": "auto", "init.cameras": str(model.resolve()), "init.points": points,
                "threads": threads, "report": False,
            }  # fmt: skip
            changes |= _in_place_of_gone(changes, truth, mesh)
            stages = [n for n in present if points == "dense" or n not in FOR_DENSE]
            if "evaluate" not in stages:
                stages.append("evaluate")
            row.update(_run(workspace, folder, changes, stages, reporter))
    return rows


def settings_of(results: Mapping[str, Result | None]) -> dict[str, Any]:
    """The settings that results were made with, as overrides of a run in another workspace.

    A setting that this version no longer has is left out.
    """
    changes: dict[str, Any] = {}
    for name, result in results.items():
        if result is not None:
            changes["seed"] = result.manifest["seed"]
            known = get_stage(name).Config.model_fields
            for field, value in result.manifest["config"].items():
                if field in known:
                    changes[f"{name}.{field}"] = value
    return changes


def _in_place_of_gone(
    settings: Mapping[str, Any], truth: Path | None, mesh: Path | None
) -> dict[str, Any]:
    """What a run is scored with, where a file of these has gone."""
    given = {"evaluate.ground_truth": truth, "evaluate.mesh": mesh if truth else None}
    named = {name: settings.get(name) for name in given}
    if all(path is None or Path(home_told(path)).exists() for path in named.values()):
        return {}
    return {name: path and str(path.absolute()) for name, path in given.items()}


def take_corrections(workspace: Path, folder: Path) -> None:
    """Give another workspace the `teeth.yaml` of one, or none where that has none.

    Raises:
        RequestError: it can't be read, or says something that isn't understood.
    """
    said = corrections_file(None, {"workspace": workspace})
    if said is None:
        (folder / CORRECTIONS).unlink(missing_ok=True)
        return
    read_corrections(said)
    folder.mkdir(parents=True, exist_ok=True)
    copyfile(said, folder / CORRECTIONS)


def _of_this_run(store: Store, name: str) -> Result | None:
    """The result in use of a stage, unless it was made from others than are in use now."""
    result = store.current(name)
    return None if result is None or renewed(store, result) else result


def _row_in_use(results: Mapping[str, Result | None]) -> dict[str, Any]:
    row: dict[str, Any] = {"start": OURS}
    fit, scored = results["fit"], results["evaluate"]
    if fit is None:
        return row | {"failure": "this workspace has no fit; run 'pipeline run' first"}
    if scored is None:
        return row | {"failure": "the fit is not evaluated; run 'pipeline run --stages evaluate'"}
    if scored.manifest["inputs"]["gaussians"]["content"] != fit.contents["gaussians"]:
        return row | {"failure": "evaluated was an earlier fit; run 'pipeline run' again"}
    return row | figures_of(
        Metrics.load(scored.folder / "metrics"), fit.manifest,
        sum(entry.manifest["wall_seconds"] for entry in results.values() if entry),
    )  # fmt: skip


def _run(
    workspace: Path, folder: Path, changes: Mapping[str, Any], stages: list[str],
    reporter: Reporter | None,
) -> dict[str, Any]:  # fmt: skip
    try:
        take_corrections(workspace, folder)
        done = run(
            read_request(workspace)["images"], workspace=folder, overrides=changes, stages=stages,
            reporter=reporter,
        )  # fmt: skip
    except PipelineError as error:
        return {"failure": str(error)}
    seconds = sum(stage.figures["wall_seconds"] for stage in done.stages)
    by_name = {stage.name: stage for stage in done.stages}
    scored, fit = by_name["evaluate"].folder, by_name["fit"].folder
    assert scored is not None
    assert fit is not None
    return figures_of(Metrics.load(scored / "metrics"), read_json(fit / "manifest.json"), seconds)


def figures_of(metrics: Metrics, fit: Mapping[str, Any], seconds: float) -> dict[str, Any]:
    """The figures of one fit: mean PSNR and SSIM of input views and held-out photographs."""
    row: dict[str, Any] = {
        "iterations": fit["summary"].get("iterations"),
        "gaussians": metrics.figures["gaussians"],
        "views": len(metrics.input.views),
        "psnr": metrics.input.mean["psnr"],
        "ssim": metrics.input.mean["ssim"],
        "seconds": round(seconds, 1),
    }
    for protocol, scores in sorted(metrics.held_out.items()):
        row[f"held_out_{protocol}"] = {
            "psnr": scores.mean["psnr"],
            "ssim": scores.mean["ssim"],
            "views": len(scores.views),
        }
    return row
