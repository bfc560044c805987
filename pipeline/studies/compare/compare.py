"""`pipeline compare`: the stages of a workspace beside COLMAP, and both against the truth."""

from __future__ import annotations

import sqlite3
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from pipeline.artifacts.cameras import Camera
from pipeline.artifacts.views import View
from pipeline.errors import RequestError
from pipeline.files import write_atomic, write_json
from pipeline.measure import usable_cores
from pipeline.pages.page import REPORT
from pipeline.process.privacy import kept_for, share_for
from pipeline.running.reporter import Reporter
from pipeline.store import CorruptResultError, Result, Store
from pipeline.store.places import stage_folder
from pipeline.studies.compare import clouds, evidence, poses
from pipeline.studies.compare.colmap_run import SETTINGS, photo_names, run_on_views, thresholds
from pipeline.studies.compare.fits import fit_rows
from pipeline.studies.compare.models import Model, model_folders, read_largest, read_truth
from pipeline.studies.compare.page import write_report
from pipeline.studies.compare.tables import markdown, tables_of
from pipeline.studies.report import run_report
from pipeline.studies.report.compared import FILE, FOLDER
from pipeline.studies.report.reading import renewed
from pipeline.untrusted.paths import given_path, home_told
from pipeline.workspace import read_request

#: The stages up to the fit, in their order. Seconds of all of them count; cameras and points are
#: compared of those that give some.
STAGES = ("views", "teeth", "init", "align", "swap", "sap", "flow", "fit")
#: How the rows of COLMAP are called.
TITLES = {"defaults": "COLMAP, defaults", "sparse": "COLMAP, sparse setting"}
GIVEN = "COLMAP, given model"


@dataclass(frozen=True)
class Comparison:
    """What `compare` found, and where it wrote it.

    Attributes:
        folder: ``WORKSPACE/compare``, with comparison.json, comparison.md and report.html.
        figures: what comparison.json says.
    """

    folder: Path
    figures: dict[str, Any]


@dataclass
class Entry:
    """One row: a stage of the workspace, or a run of COLMAP.

    Attributes:
        cameras: view name -> camera, in the row's own world.
        borrowed: the cameras are those of the stage before, since this one gives only points.
        points: [N, 3] in that world, or None.
        distance: from the cameras to the scene, in that world.
        model: COLMAP's.
        row: figures for the table of cameras.
    """

    name: str
    cameras: dict[str, Camera] = field(default_factory=dict)
    borrowed: bool = False
    points: clouds.Array | None = None
    distance: float = 1.0
    model: Model | None = None
    row: dict[str, Any] = field(default_factory=dict)


def compare(
    workspace: str | Path,
    *,
    colmap: str | Path | None = None,
    run_colmap: bool = False,
    ground_truth: str | Path | None = None,
    mesh: str | Path | None = None,
    fit: bool = True,
    threads: int = 0,
    reporter: Reporter | None = None,
) -> Comparison:
    """Set a workspace's cameras, points and fit beside COLMAP's on the same views.

    Args:
        workspace: of a run; its results in use are compared as they are.
        colmap: folder of a COLMAP model of the same photographs (or with numbered models in it).
        run_colmap: run COLMAP here, with its defaults and with a setting for few views.
        ground_truth: transforms.json or COLMAP model with the true cameras; None: the one that the
            run was evaluated with, if any.
        mesh: true surface in the frame of `ground_truth`; None: as above.
        fit: also fit from COLMAP's cameras and points, with the settings of the workspace.
        threads: 0 means all cores.
        reporter: hears of the progress.

    Returns:
        The figures and the folder ``WORKSPACE/compare`` that they were written to.

    Raises:
        RequestError: no such workspace or files, or nothing to compare with.
    """
    home = given_path(workspace, "workspace")
    model, truth, surface = (
        None if path is None else given_path(path, name)
        for path, name in ((colmap, "colmap"), (ground_truth, "ground_truth"), (mesh, "mesh"))
    )
    with kept_for(share_for(home)):
        return _compare(
            home, model, run_colmap, truth, surface, fit, threads or usable_cores(),
            reporter or Reporter(),
        )  # fmt: skip


def _compare(
    home: Path, colmap: Path | None, run_colmap: bool, ground_truth: Path | None,
    mesh: Path | None, fit: bool, threads: int, reporter: Reporter,
) -> Comparison:  # fmt: skip
    store, prepared = _workspace(home)
    views = _loaded(store, prepared, "views").views
    if ground_truth is None:
        ground_truth = _of_the_run(store, "ground_truth", reporter)
        mesh = mesh or (ground_truth and _of_the_run(store, "mesh", reporter))
    _check(colmap, run_colmap, ground_truth, mesh)
    given = read_largest(colmap, views) if colmap is not None else None
    truth: dict[str, Camera] = {}
    units = "arbitrary"
    if ground_truth is not None:
        truth, units = read_truth(ground_truth, views)
    surface = clouds.read_surface(mesh, list(truth.values())) if mesh else None
    store.create()
    folder = stage_folder(home, FOLDER)

    ours = _entries_of(store)
    rivals = [_given_entry(given, views)] if given else []
    if run_colmap:
        seed = prepared.manifest["seed"]
        rivals = [
            _run_entry(folder, name, views, seed, threads, reporter) for name in SETTINGS
        ]  # fmt: skip
    entries = [*ours, *rivals]
    best = max(
        (entry for entry in rivals if entry.model), key=lambda e: len(e.cameras), default=None
    )
    reference = truth or (best.cameras if best else {})
    for entry in entries:
        entry.row.update(name=entry.name, registered=len(entry.cameras), views=len(views))
        if entry.cameras:
            entry.row["focal_per_side"] = poses.focal_per_side(entry.cameras)
        if entry is not best or truth:
            entry.row["errors"] = poses.score(entry.cameras, reference, entry.distance, units)
    figures: dict[str, Any] = {
        "workspace": str(home),
        "results": {name: used.key for name in STAGES if (used := store.current(name))},
        "views": [view.name for view in views],
        "reference": "ground truth" if truth else best.name if best else None,
        "reference_views": len(reference),
        "units": units,
        "cameras": [entry.row for entry in entries if not entry.borrowed],
        "points": _point_rows(entries, best, reference, surface),
        "points_to": best.name if best else None,
        "pairs": {entry.name: entry.row.pop("pairs") for entry in rivals if "pairs" in entry.row},
    }
    if fit and rivals:
        why = "COLMAP made no model of these views"
        figures["fits"] = fit_rows(
            home, folder / "colmap", best.model.folder if best and best.model else None, why,
            truth=ground_truth, mesh=mesh, threads=threads, reporter=reporter,
            message=reporter.message,
        )  # fmt: skip
        figures["fits_from"] = best.name if best else None
    tables = tables_of(figures)
    figures["tables"] = [table.described() for table in tables]
    write_json(folder / FILE, figures)
    write_atomic(folder / "comparison.md", markdown(tables))
    write_report(folder / REPORT, figures, _series(entries, best, truth), photo_names(views))
    if (home / REPORT).exists():  # it shows these tables
        try:
            run_report(home)
        except Exception as error:
            reporter.message(f"The report {home / REPORT} could not be renewed: {error}")
    return Comparison(folder, figures)


def _workspace(home: Path) -> tuple[Store, Result]:
    read_request(home)
    store = Store(home)
    prepared = store.current("views")
    if prepared is None:
        raise RequestError(f"{home} holds no prepared views yet. Run 'pipeline run' first.")
    return store, prepared


def _loaded(store: Store, result: Result, kind: str) -> Any:
    try:
        return store.load(result, kind)
    except CorruptResultError as error:
        raise RequestError(
            f"The cached result of '{result.stage}' is damaged ({error}) and was moved aside. Run "
            "'pipeline run' again to make it anew."
        ) from error


def _of_the_run(store: Store, setting: str, reporter: Reporter) -> Path | None:
    """The file that the run was evaluated with."""
    used = store.current("evaluate")
    named = used.manifest["config"].get(setting) if used else None
    path = Path(home_told(named)) if named else None
    if path is None or path.exists():
        return path
    option = setting.replace("_", "-")
    reporter.message(
        f"evaluate.{setting} of the run is not there any more ({named}), and nothing is compared "
        f"with it. --{option} names it where it is now."
    )
    return None


def _check(
    colmap: Path | None, run_colmap: bool, ground_truth: Path | None, mesh: Path | None,
) -> None:  # fmt: skip
    if colmap is not None and run_colmap:
        raise RequestError("Give either --colmap FOLDER or --run-colmap, not both.")
    if colmap is None and not run_colmap and ground_truth is None:
        raise RequestError(
            "Say what to compare with: --run-colmap, or --colmap FOLDER with a model of the same "
            "photographs; --ground-truth FILE adds the true cameras."
        )
    if mesh is not None and ground_truth is None:
        raise RequestError(
            "--mesh needs --ground-truth: the true cameras say where the mesh lies in the scene."
        )


def _entries_of(store: Store) -> list[Entry]:
    """The stages of a workspace that give cameras or points, in their order."""
    found, seconds = [], 0.0
    for name in STAGES:
        result = store.current(name)
        entry = Entry(f"{name} (ours)")
        if result is not None and (other := renewed(store, result)):
            if {"cameras", "points"} & result.contents.keys():
                entry.row["failure"] = (
                    f"made from another result of '{other}' than there is now; run the pipeline to "
                    "its end first"
                )
        elif result is not None:
            seconds += result.manifest["wall_seconds"]
            if "cameras" in result.contents:
                entry.cameras = _loaded(store, result, "cameras").by_name()
            if "points" in result.contents:
                entry.points = _loaded(store, result, "points").positions
            entry.row["seconds"] = round(seconds, 1)
        elif failure := store.failures.of(name):
            entry.row["failure"] = failure["message"]
        if entry.cameras or entry.points is not None or "failure" in entry.row:
            found.append(entry)
    # `sap` thins points only, `fit` starts from those there are: the others hold on
    cameras: dict[str, Camera] = {}
    points: clouds.Array | None = None
    for entry in (entry for entry in found if "failure" not in entry.row):
        entry.borrowed = not entry.cameras and entry.points is not None
        cameras = entry.cameras = entry.cameras or cameras
        points = points if entry.points is None else entry.points
        if cameras:
            entry.distance = poses.scene_distance(cameras, points)
    return found


def _given_entry(model: Model, views: Sequence[View]) -> Entry:
    entry = Entry(GIVEN, model.cameras, points=model.points.positions, model=model)
    entry.distance = poses.scene_distance(model.cameras, model.points.positions)
    entry.row.update(models=len(model.sizes), model_sizes=list(model.sizes))
    if len(model.cameras) < len(views):
        database = evidence.database_beside(model.folder)
        why = "there is no database.db beside the model that would say why"
        if database is not None:
            why = _why(entry, database, views, thresholds({}), "")
        entry.row["why_not_all"] = why
    return entry


def _run_entry(
    folder: Path, setting: str, views: Sequence[View], seed: int, threads: int, reporter: Reporter
) -> Entry:
    entry = Entry(TITLES[setting])
    home = folder / f"colmap_{setting}"
    done = run_on_views(
        home, views, SETTINGS[setting], seed=seed, threads=threads, message=reporter.message
    )
    entry.row.update(models=done["models"], seconds=done["seconds"])
    if model_folders(home / "sparse"):
        try:
            entry.model = read_largest(home / "sparse", views)
        except RequestError as error:
            entry.row["failure"] = str(error)
            return entry
        entry.cameras = entry.model.cameras
        entry.points = entry.model.points.positions
        entry.distance = poses.scene_distance(entry.cameras, entry.points)
        entry.row["model_sizes"] = list(entry.model.sizes)
    if done["failure"]:
        entry.row["failure"] = done["failure"]
    elif len(entry.cameras) < len(views):
        log = (home / "log.txt").read_text(errors="replace")
        why = _why(entry, home / "database.db", views, thresholds(SETTINGS[setting]), log)
        entry.row["failure" if entry.model is None else "why_not_all"] = why
    return entry


def _why(
    entry: Entry, database: Path, views: Sequence[View], asked: Mapping[str, float], log: str
) -> str:
    """Why COLMAP left views out, from its database; also keeps the matches of each pair."""
    try:
        known = evidence.read_evidence(database)
    except sqlite3.Error as error:
        return f"its database can't be read ({error})"
    labels = photo_names(views) if log else {}  # a given model has names of its own
    known = evidence.renamed(known, labels)
    entry.row["pairs"] = evidence.pair_table(known)
    if entry.model is None:
        return evidence.why_no_model(known, asked, log)
    mapped = evidence.mapped_keypoints(entry.model.folder)
    return evidence.why_left_out(known, mapped, asked["pose_inliers"])


def _point_rows(
    entries: Sequence[Entry], best: Entry | None, reference: Mapping[str, Camera],
    surface: clouds.Surface | None,
) -> list[dict[str, Any]]:  # fmt: skip
    """The table of points: on the mesh if there is one, else against COLMAP's."""
    rows = []
    other = None
    if best is not None and best.points is not None and len(reference) >= 2:
        motion = _motion(best, reference)
        other = clouds.moved_by(best.points, motion) if motion else None
    for entry in entries:
        if entry.points is None:
            continue
        row: dict[str, Any] = {"name": entry.name, "points": len(entry.points)}
        if entry.model is not None and len(entry.model.sizes) > 1:
            row["model"] = entry.model.folder.name
        rows.append(row)
        motion = _motion(entry, reference)
        if motion is None:
            row["failure"] = "fewer than two cameras to align it by"
        elif surface is not None:
            row["mesh"] = clouds.against_surface(entry.points, motion, surface)
        elif other is not None and entry is not best:
            extent = clouds.robust_extent(other)
            row["cloud"] = clouds.against_cloud(entry.points, motion, other, extent)
    return rows


def _series(
    entries: Sequence[Entry], best: Entry | None, truth: Mapping[str, Camera]
) -> list[tuple[str, list[Camera], poses.Motion | None]]:
    """Cameras to draw: title, cameras, and what brings them into the world of the last ones."""
    if not truth and best is None:
        return []
    reference = truth or (best.cameras if best else {})
    series: list[tuple[str, list[Camera], poses.Motion | None]] = []
    for entry in entries:
        motion = _motion(entry, reference)
        if motion and not entry.borrowed and (truth or entry is not best):
            series.append((entry.name, list(entry.cameras.values()), motion))
    last = "ground truth" if truth else best.name if best else ""
    return [*series, (last, list(reference.values()), None)]


def _motion(entry: Entry, reference: Mapping[str, Camera]) -> poses.Motion | None:
    try:
        return poses.alignment(entry.cameras, reference, entry.distance)
    except ValueError:
        return None
