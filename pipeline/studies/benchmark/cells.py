"""The cells of a benchmark: one method on some photographs of one scene."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from pipeline.artifacts.metrics import Metrics
from pipeline.config import flattened, load_config
from pipeline.errors import PipelineError, RequestError, StageError
from pipeline.front.commands import run
from pipeline.planning import PlannedStage
from pipeline.runner import Runner
from pipeline.running.reporter import Reporter
from pipeline.stage import get_stage
from pipeline.store import Result, read_own
from pipeline.store.places import remove
from pipeline.studies.benchmark.results import FINISHED
from pipeline.studies.benchmark.splits import Split, pictures_of, split_views
from pipeline.studies.benchmark.suite import LoadedSuite, Method, Scene, TableSpec
from pipeline.workspace import make_request

#: Kinds of artifact that no figure needs: stages that only make these are left out.
NOT_MEASURED = {"exports"}

#: The stage whose seconds are no part of a reconstruction.
SCORING = "evaluate"


@dataclass(frozen=True)
class Cell:
    """One method on some photographs of one scene; `results` says what the fields mean.

    Attributes:
        images: input and held-out photographs, in viewing order.
        photographs, held_out: their file names.
        stages: what is run.
        overrides: everything that the preset does not say, ``{"stage.key": value}``.
        workspace: relative to the benchmark's folder.
    """

    id: str
    scene: str
    method: str
    preset: str
    protocol: str
    views: int
    seed: int
    known_cameras: bool
    images: tuple[str, ...]
    photographs: tuple[str, ...]
    held_out: tuple[str, ...]
    stages: tuple[str, ...]
    workspace: str
    overrides: dict[str, Any] = field(default_factory=dict)

    def to_dict(self) -> dict[str, Any]:
        """As JSON values."""
        return {
            name: list(value) if isinstance(value, tuple) else value
            for name, value in dataclasses.asdict(self).items()
        }

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> Cell:
        """What `to_dict` gave, back."""
        plain: dict[str, Any] = {
            name: tuple(value) if isinstance(value, list) else value
            for name, value in values.items()
        }
        return cls(**plain)

    def describe(self) -> str:
        """E.g. ``scan_video_a, 6 views, paper``."""
        parts = [self.scene, f"{self.views} views", self.method]
        if self.known_cameras:
            parts.append("known cameras")
        if self.seed:
            parts.append(f"seed {self.seed}")
        return ", ".join(parts)


def plan_cells(
    loaded: LoadedSuite, overrides: Mapping[str, Any] | None = None
) -> tuple[list[Cell], dict[str, list[str]]]:
    """List what a suite measures; a cell that several tables show is there once.

    Args:
        overrides: settings for all cells, over those of the suite.

    Returns:
        The cells, those of one workspace side by side, and table name -> ids of its cells.

    Raises:
        RequestError: a preset or an override is wrong, or a scene has too few photographs.
    """
    suite = loaded.suite
    cells: dict[str, Cell] = {}
    tables: dict[str, list[str]] = {}
    for table in suite.tables:
        names = tables.setdefault(table.name, [])
        for scene in (suite.scene(name) for name in table.scenes or [s.name for s in suite.scenes]):
            files = pictures_of(loaded.images(scene))
            for count in table.view_counts:
                split = split_views(files, table.split, count, table.test_every)
                for name in table.methods or [m.name for m in suite.methods]:
                    for seed in suite.seeds:
                        cell = _cell(
                            loaded, table, scene, split, suite.method(name), seed, overrides or {}
                        )
                        cells.setdefault(cell.id, cell)
                        names.append(cell.id)
    places = {cell.workspace: None for cell in cells.values()}
    return [c for place in places for c in cells.values() if c.workspace == place], tables


def _cell(
    loaded: LoadedSuite,
    table: TableSpec,
    scene: Scene,
    split: Split,
    method: Method,
    seed: int,
    overrides: Mapping[str, Any],
) -> Cell:
    protocol = f"test_every_{table.test_every}" if table.split == "test_every" else table.split
    views = len(split.photographs)
    place = f"all_{views}_views" if table.split == "all" else f"{views}_views"
    parts = [scene.name, protocol, f"{views}_views", method.name, f"seed{seed}"]
    settings: dict[str, Any] = {
        **flattened(loaded.suite.overrides),
        **flattened(scene.overrides),
        **flattened(method.overrides),
        **overrides,
    }
    settings.setdefault("report", False)  # one report of the benchmark is enough
    if split.held_out:
        settings["views.held_out"] = [path.name for path in split.held_out]
    for name in ("ground_truth", "masks", "mesh"):
        if path := getattr(scene, name):
            settings[f"{SCORING}.{name}"] = str(loaded.file(path))
    if table.known_cameras and scene.ground_truth is not None:
        parts.append("known_cameras")
        settings["init.method"] = "known"
        settings["init.cameras"] = str(loaded.file(scene.ground_truth))
        settings["fit.optimize_poses"] = False
    settings["seed"] = seed
    preset = loaded.preset(method)
    try:
        order = load_config(preset, settings).run.stages
    except RequestError as error:
        raise RequestError(f"The method '{method.name}' of the suite: {error}") from None
    stages = tuple(s for s in order if not set(get_stage(s).provides) <= NOT_MEASURED)
    if not any("metrics" in get_stage(name).provides for name in stages):
        raise RequestError(
            f"The method '{method.name}' of the suite gives no figures: none of its stages "
            f"({', '.join(stages)}) scores the result. Add 'evaluate'."
        )
    everything = pictures_of(loaded.images(scene))
    wanted = {*split.photographs, *split.held_out}
    return Cell(
        id="-".join(parts),
        scene=scene.name,
        method=method.name,
        preset=preset,
        protocol=protocol,
        views=views,
        seed=seed,
        known_cameras=table.known_cameras,
        images=tuple(str(path) for path in everything if path in wanted),
        photographs=tuple(path.name for path in split.photographs),
        held_out=tuple(path.name for path in split.held_out),
        stages=stages,
        workspace=f"{scene.name}/{place}{f'_{seed}' if seed else ''}",
        overrides=settings,
    )


# -- running ---------------------------------------------------------------------------------------


def plan_stages(cell: Cell, out: Path) -> list[PlannedStage]:
    """Look at the stages of a cell without running any."""
    request = make_request(
        cell.images, out / cell.workspace, cell.preset, cell.overrides, cell.stages
    )
    config = load_config(request.preset, request.overrides)
    return Runner(request, config, Reporter()).plan()


def finished_record(cell: Cell, out: Path) -> dict[str, Any] | None:
    """The record of a cell that need not run again: all that it came from is still the same.

    A failure to reconstruct counts as well: the same input would fail again.
    """
    record = read_own(record_path(cell, out))
    if record is None or record.get("status") not in FINISHED:
        return None
    planned = plan_stages(cell, out)
    keys = {stage.name: stage.key for stage in planned if stage.key is not None}
    if record["keys"] != {name: key for name, key in keys.items() if name in record["keys"]}:
        return None
    if record["status"] == "done" and any(stage.state != "cached" for stage in planned):
        return None
    return record


def record_path(cell: Cell, out: Path) -> Path:
    return out / "cells" / f"{cell.id}.json"


def run_cell(cell: Cell, out: Path, threads: int, reporter: Reporter) -> dict[str, Any]:
    """Run one cell, whatever comes of it, and tell its figures.

    Args:
        out: the benchmark's folder.
        threads: of this cell, unless the suite says otherwise.

    Returns:
        The record of the cell, as `results` documents it.
    """
    workspace = out / cell.workspace
    # A stage that goes on from a checkpoint would be timed from there on only.
    for leftover in workspace.glob("*/*.partial"):
        remove(leftover)
    record = _told(cell)
    try:
        summary = run(
            cell.images,
            workspace=workspace,
            preset=cell.preset,
            overrides={"threads": threads, **cell.overrides},
            stages=cell.stages,
            reporter=reporter,
        )
        actions = {stage.name: stage.action for stage in summary.stages}
        results = [stage.result for stage in plan_stages(cell, out) if stage.result is not None]
        keys = {stage.name: stage.key for stage in summary.stages}
        return record | {"status": "done", "keys": keys, **_figures(cell, results, actions, out)}
    except PipelineError as error:
        status = {2: "refused", 3: "failed"}.get(error.exit_status, "fault")
        return record | {"status": status, "reason": str(error), **_as_far_as_it_came(cell, out)}


def _as_far_as_it_came(cell: Cell, out: Path) -> dict[str, Any]:
    """The stages of a cell that has no figures; none where its request can't even be planned."""
    try:
        planned = plan_stages(cell, out)
    except PipelineError:
        planned = []
    ran = [stage.result for stage in planned if stage.result is not None]
    return {
        "keys": {stage.name: stage.key for stage in planned if stage.key is not None},
        "stages": [_stage_entry(result, "", out) for result in ran],
    }


def unfinished_record(cell: Cell, reason: str) -> dict[str, Any]:
    """The record of a cell that ended by a fault of ours outside of any stage."""
    return _told(cell) | {"status": "fault", "reason": reason, "keys": {}, "stages": []}


def _told(cell: Cell) -> dict[str, Any]:
    """What every record says of its cell."""
    unsaid = ("images", "stages", "overrides")
    return {name: value for name, value in cell.to_dict().items() if name not in unsaid}


def _figures(
    cell: Cell, results: list[Result], actions: Mapping[str, str], out: Path
) -> dict[str, Any]:
    """What the manifests and metrics.json of a finished cell say."""
    stages = [_stage_entry(result, actions[result.stage], out) for result in results]
    building = [stage for stage in stages if stage["name"] != SCORING]
    scoring = [stage for stage in stages if stage["name"] == SCORING]
    path = next(r.folder for r in reversed(results) if "metrics" in r.contents) / "metrics"
    metrics = Metrics.load(path)
    if not metrics.input.mean:
        raise StageError(f"{path / Metrics.FILE} holds no mean figures of the input views.")
    figures = {"input": metrics.input.mean}
    figures |= {protocol: scores.mean for protocol, scores in metrics.held_out.items()}
    record = {
        "stages": stages,
        "seconds": round(sum(stage["wall_seconds"] for stage in building), 3),
        "cpu_seconds": round(sum(stage["cpu_seconds"] for stage in building), 3),
        "scoring_seconds": round(sum(stage["wall_seconds"] for stage in scoring), 3),
        "peak_memory_mb": max(stage["peak_memory_mb"] for stage in building),
        "registered": cell.views - len(metrics.figures.get("views_unplaced", [])),
        "total": cell.views,
        "gaussians": metrics.figures.get("gaussians"),
        "figures": figures,
        "metrics": str((path / Metrics.FILE).relative_to(out)),
    }
    return record | {name: part for name in ("poses", "geometry") if (part := metrics.part(name))}


def _stage_entry(result: Result, action: str, out: Path) -> dict[str, Any]:
    names = ("wall_seconds", "cpu_seconds", "peak_memory_mb", "threads", "summary", "warnings")
    return {
        "name": result.stage,
        "key": result.key,
        "folder": str(result.folder.relative_to(out)),
        "action": action,
        **{name: result.manifest[name] for name in names},
    }
