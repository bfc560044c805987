"""Cameras and dense points from few photographs: ours against COLMAP.

    python benchmarks/init.py --data FOLDER [--only scan-3 castle] [--methods ours] [--out DIR]

FOLDER holds `scan_video_a`, `castle` and `berlin`, each with its photographs; the scan video has
exact cameras, depth and masks, the others are compared with COLMAP's model of all photographs.
A Markdown table is printed, and kept with the figures in DIR, where a later run adds to them.

Rotation errors are those between all pairs of cameras; translation errors those of the centres
after similarity alignment, in % of the largest distance. COLMAP gets the photographs in full size
and the hint that all are of one camera. Its sparse setting is that of `pipeline compare`. CPU
seconds compare on any machine, wall seconds on an idle one.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from init_scores import Truth, read_truth, rotation_errors, score_points, translation_errors

from pipeline.errors import ReconstructionError
from pipeline.geometry.models.known_cameras import model_files, read_cameras
from pipeline.measure import cpu_seconds
from pipeline.stage import LocalContext, get_stage
from pipeline.studies.compare.colmap_run import SETTINGS, Job, run_job
from pipeline.studies.compare.models import model_folders

METHODS = ("colmap", "sparse", "ours")

#: COLMAP's settings by method (`pipeline.studies.compare.colmap_run`).
COLMAP_SETTINGS = {"colmap": "defaults", "sparse": "sparse"}

COLUMNS = {
    "case": "set", "method": "method", "placed": "placed", "rotation": "rotation, deg",
    "translation": "translation, %", "focal": "focal, %", "init": "init, s (CPU)",
    "align": "align, s (CPU)", "teeth": "teeth: median / p90, mm", "far": "> 2 mm, %",
    "covered": "within .5 mm, % (seen by 2 / any)",
}  # fmt: skip


@dataclass(frozen=True)
class Case:
    """One set of photographs.

    Attributes:
        name: of the set.
        files: the photographs.
        truth: true cameras by file name; empty where COLMAP's model of `reference` is the truth.
        surface: all true views.
        reference: photographs whose COLMAP model is the truth.
    """

    name: str
    files: tuple[Path, ...]
    truth: dict[str, Truth]
    surface: tuple[Truth, ...] = ()
    reference: tuple[Path, ...] = ()


def cases(data: Path) -> Iterator[Case]:
    """All sets of photographs that are there."""
    scan = data / "scan_video_a"
    if (scan / "transforms.json").exists():
        yield from _scan_cases(scan)
    for name, choices in {
        "castle": {"11": range(11), "6": range(0, 11, 2), "3": (3, 5, 7), "3-wide": (2, 5, 8)},
        "berlin": {"3": range(3)},
    }.items():
        files = tuple(sorted((data / name / "images").glob("*.jpg")))
        for label, indices in choices.items():
            if files:
                chosen = tuple(files[k] for k in indices)
                yield Case(f"{name}-{label}", chosen, {}, reference=files)


def _scan_cases(folder: Path) -> Iterator[Case]:
    meta = json.loads((folder / "transforms.json").read_text())
    frames = meta["frames"]
    truth = [read_truth(folder, frame, meta["fl_x"]) for frame in frames]
    paths = [folder / frame["file_path"] for frame in frames]
    angles = [frame["angle_deg"] for frame in frames]
    spacing = (angles[-1] - angles[0]) / (len(angles) - 1)
    choices = {}
    for step, sets in ((2, 4), (4, 4), (6, 4), (8, 8)):
        last = len(frames) - 1 - 2 * step
        for start in np.rint(np.linspace(0, last, sets)).astype(int).tolist():
            chosen = [start, start + step, start + 2 * step]
            choices[f"scan-3@{step * spacing:.0f}-{'.'.join(map(str, chosen))}"] = chosen
    for count in (6, 9, 12, 24):
        spread = np.rint(np.linspace(0, len(frames) - 1, count)).astype(int).tolist()
        choices[f"scan-{count}"] = spread
    for name, chosen in choices.items():
        yield Case(
            name,
            tuple(paths[k] for k in chosen),
            {paths[k].name: truth[k] for k in chosen},
            surface=tuple(truth),
        )


@dataclass(frozen=True)
class Placed:
    """Cameras that a method found: file name -> [4, 4] cam_from_world, focal over long side."""

    poses: dict[str, np.ndarray]
    focals: dict[str, float]


def run_colmap(files: tuple[Path, ...], method: str, threads: int) -> tuple[Placed, float, float]:
    """COLMAP in a process of its own: cameras, wall and CPU seconds."""
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        (folder / "images").mkdir()
        for path in files:
            (folder / "images" / path.name).symlink_to(path.resolve())
        before = cpu_seconds()
        done = run_job(folder, Job(SETTINGS[COLMAP_SETTINGS[method]], threads=threads))
        if done["failure"]:
            raise RuntimeError(done["failure"])
        return read_placed(folder / "sparse"), done["seconds"], cpu_seconds() - before


def read_placed(folder: Path) -> Placed:
    """The cameras of the largest of COLMAP's models, or none."""
    cameras = [read_cameras(model_files(model).values())[0] for model in model_folders(folder)]
    best = max(cameras, key=len, default=[])
    return Placed(
        {camera.name: camera.cam_from_world for camera in best},
        {
            camera.name: camera.lens.mean_focal_length()
            / max(camera.lens.width, camera.lens.height)
            for camera in best
        },
    )


def run_ours(case: Case, threads: int, settings: dict[str, Any], long_side: int) -> dict[str, Any]:
    """Stages `init` and `align`: their figures, and what is wrong where they refuse."""
    row: dict[str, Any] = {}
    with tempfile.TemporaryDirectory() as scratch:
        inputs: dict[str, Any] = {}
        contexts = {}
        for name, given in (
            ("views", {"long_side": long_side}),
            ("init", settings),
            ("align", {}),
        ):
            config = get_stage(name).Config.model_validate(given)
            context = contexts[name] = LocalContext(
                config, Path(scratch) / name, inputs=dict(inputs), threads=threads,
                sources={path.name: path for path in case.files},
            )  # fmt: skip
            wall, cpu = time.perf_counter(), time.process_time()
            try:
                get_stage(name).run(context)
            except ReconstructionError as error:
                return {"placed": f"0/{len(case.files)}", "message": str(error)}
            row[name] = [time.perf_counter() - wall, time.process_time() - cpu]
            inputs.update({kind: context.result(kind) for kind in get_stage(name).provides})
        views = inputs["views"].by_name()
        cameras = inputs["cameras"].cameras
        names = [views[camera.name].source_name for camera in cameras]
        found = Placed(
            {name: camera.cam_from_world for name, camera in zip(names, cameras, strict=True)},
            {
                name: camera.fx / max(camera.width, camera.height)
                for name, camera in zip(names, cameras, strict=True)
            },
        )
        row.update(score_cameras(case, found))
        row["warnings"] = contexts["init"].warnings + contexts["align"].warnings
        if case.surface:
            score = score_points(
                inputs["points"], cameras, [case.truth[name] for name in names], case.surface
            )
            row.update(
                teeth=[score.median, score.p90], far=score.far, points=score.points,
                covered=[score.covered_pair, score.covered_any],
            )  # fmt: skip
    return row


def score_cameras(case: Case, found: Placed) -> dict[str, Any]:
    """Errors of the cameras that have a truth."""
    names = sorted(set(found.poses) & set(case.truth))
    row: dict[str, Any] = {"placed": f"{len(found.poses)}/{len(case.files)}"}
    if len(names) < 2:
        return row
    poses = [found.poses[name] for name in names]
    truth = [case.truth[name].cam_from_world for name in names]
    rotation = rotation_errors(poses, truth)
    translation = translation_errors(poses, truth)
    focal = [found.focals[name] / case.truth[name].focal - 1 for name in names]
    row.update(
        rotation=[float(np.median(rotation)), float(rotation.max())],
        translation=[float(np.median(translation)), float(translation.max())],
        focal=100 * float(np.median(focal)),
    )
    return row


def table(rows: list[dict[str, Any]]) -> str:
    """Markdown."""

    def cell(row: dict[str, Any], name: str) -> str:
        value = row.get(name)
        if value is None:
            return ""
        if name in ("init", "align"):
            return f"{value[0]:.1f} ({value[1]:.1f})"
        if isinstance(value, list):
            return " / ".join(f"{entry:.{0 if name == 'covered' else 2}f}" for entry in value)
        return f"{value:.1f}" if isinstance(value, float) else str(value)

    lines = ["| " + " | ".join(COLUMNS.values()) + " |", "|" + "---|" * len(COLUMNS)]
    lines += ["| " + " | ".join(cell(row, name) for name in COLUMNS) + " |" for row in rows]
    return "\n".join(lines)


def with_reference(case: Case, kept: dict[str, Placed], threads: int) -> Case:
    """The case with COLMAP's cameras of all its photographs as truth where it has no other."""
    if case.truth:
        return case
    name = case.name.split("-")[0]
    if name not in kept:
        kept[name] = run_colmap(case.reference, "colmap", threads)[0]
    found = kept[name]
    # Sizes don't enter: only poses and relative focal lengths are compared.
    truth = {file: Truth(found.poses[file], found.focals[file], (1, 1)) for file in found.poses}
    return replace(case, truth=truth)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "--data", type=Path, required=True, help="folder with scan_video_a, castle and berlin"
    )
    parser.add_argument("--only", nargs="+", default=[""], help="sets whose name contains one")
    parser.add_argument("--methods", nargs="+", choices=METHODS, default=METHODS)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--long-side", type=int, default=512)
    parser.add_argument("--set", nargs="*", default=[], metavar="FIELD=VALUE", help="of init")
    parser.add_argument("--out", type=Path, help="folder for the figures, added to by later runs")
    options = parser.parse_args()
    settings: dict[str, Any] = {}
    for text in options.set:
        *parents, leaf = text.split("=", 1)[0].split(".")
        target = settings
        for parent in parents:
            target = target.setdefault(parent, {})
        value = text.split("=", 1)[1]
        target[leaf] = {"true": True, "false": False}.get(value, value)
    record = options.out / "init.json" if options.out else None
    rows = json.loads(record.read_text()) if record and record.exists() else []
    reference: dict[str, Placed] = {}
    chosen = [
        case for case in cases(options.data) if any(part in case.name for part in options.only)
    ]
    if not chosen:
        sys.exit(f"{options.data} has none of the sets that were asked for.")
    if "ours" in options.methods:
        run_ours(chosen[0], options.threads, settings, 256)  # compiles and imports
    for plain in chosen:
        case = with_reference(plain, reference, options.threads)
        for method in options.methods:
            if method == "ours":
                row = run_ours(case, options.threads, settings, options.long_side)
            else:
                found, *seconds = run_colmap(case.files, method, options.threads)
                row = {**score_cameras(case, found), "init": seconds}
            row = {"case": case.name, "method": method, **row}
            rows = [old for old in rows if (old["case"], old["method"]) != (case.name, method)]
            rows.append(row)
            print(table([row]).splitlines()[-1], row.get("message", ""), flush=True)
            if record:
                record.parent.mkdir(parents=True, exist_ok=True)
                record.write_text(json.dumps(rows, indent=1))
                record.with_suffix(".md").write_text(table(rows) + "\n")
    print(table(rows))


if __name__ == "__main__":
    main()
