"""The pictures and charts of a run's report, a function per section: a case in, content out."""

from __future__ import annotations

import csv
import re
from collections.abc import Mapping
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.artifacts.cameras import Cameras
from pipeline.artifacts.views import Views, to_uint8
from pipeline.files import read_json
from pipeline.report import figures
from pipeline.report.case import Case
from pipeline.report.geometry import movement, scene_frame, similarity_onto, three_quarter
from pipeline.report.names import labels_of, title_of
from pipeline.report.pictures import (
    SMALL,
    Picture,
    flow_colors,
    flow_wheel,
    from_file,
    masked,
    picture,
    points_image,
)
from pipeline.report.tables import Cell, Table, cell

Content = dict[str, Any]

#: Pictures of a kind that one page carries at most, so that it stays light.
MOST_PAIRS, MOST_FLOWS, MOST_PREVIEWS, MOST_OTHERS = 12, 6, 4, 24


def photographs(case: Case) -> Content | None:
    """Thumbnails: which were placed, which not and why, which were held out."""
    views: Views | None = case.latest("views")
    if views is None:
        return None
    cameras: Cameras | None = case.latest("cameras")
    placed = set(cameras.by_name()) if cameras else set()
    held_out = case.latest("held_out")
    warnings = [text for _, text in case.warnings()]
    entries = []
    for view in views.views:
        why = ""
        if cameras and view.name not in placed:
            naming = [text for text in warnings if view.source_name and view.source_name in text]
            why = naming[0] if naming else ""
        state = "placed" if view.name in placed else "not placed" if cameras else "read"
        entries.append(_thumbnail(view, state, why))
    for view in held_out.views if held_out else ():
        entries.append(_thumbnail(view, "held out", "scored, but kept from every other stage"))
    return {
        "entries": entries,
        "placed": len(placed & {view.name for view in views.views}) if cameras else None,
        "total": len(views.views),
        "held_out": len(held_out.views) if held_out else 0,
        "unplaced": [
            view.source_name or view.name for view in views.views
            if cameras and view.name not in placed
        ],
        "masked": any(view.mask is not None for view in views.views),
    }  # fmt: skip


def _thumbnail(view: Any, state: str, why: str) -> Content:
    share = float(view.valid().mean())
    name = view.source_name or view.name
    return {
        "picture": picture(masked(view), f"Photograph {name}, {state}.", long_side=SMALL),
        "name": name, "view": view.name, "state": state, "why": why,
        "size": f"{view.width} × {view.height}",
        "mask": f"{100 * share:.0f} % used" if view.mask is not None else "",
    }  # fmt: skip


def matches(case: Case) -> Content | None:
    """Pairs with their matches, the matrix of counts, and whatever else init drew."""
    folder = case.folder("init", "pictures")
    if folder is None:
        return None
    table = read_json(folder / "matches.json")
    labels = labels_of(case)
    counts: dict[tuple[int, int], Mapping[str, Any]] = {}
    names: list[str] = []
    if isinstance(table, dict):
        names = list(table["views"])
        number = {name: k for k, name in enumerate(names)}
        counts = {
            (number[entry["views"][0]], number[entry["views"][1]]): entry
            for entry in table["pairs"]
        }
    by_pair = {tuple(entry["views"]): entry for entry in counts.values()}
    drawn, others = [], []
    for path in sorted(folder.glob("*.png")):
        named = re.fullmatch(r"matches_(.+)_(.+)", path.stem)
        entry = by_pair.get((named[1], named[2])) if named else None
        if named and entry:
            caption = f"{entry['verified']} of {entry['matches']} matches verified"
            title = f"{labels.get(named[1], named[1])} — {labels.get(named[2], named[2])}"
            drawn.append((-entry["evidence"], title, path, caption))
        else:
            title = title_of(path.stem, labels)
            others.append(from_file(path, title, title, 900))
    drawn.sort(key=lambda item: (item[0], item[1]))
    pictures = [
        {"picture": from_file(path, f"{title}: {caption}.", long_side=900), "title": title,
         "caption": caption}
        for _, title, path, caption in drawn[:MOST_PAIRS]
    ]  # fmt: skip
    verified = {pair: int(entry["verified"]) for pair, entry in counts.items()}
    return {
        "pictures": pictures,
        "others": others[:MOST_OTHERS],
        "matrix": figures.match_matrix(names, verified) if counts else None,
        "used": sum(bool(entry["used"]) for entry in counts.values()),
        "pairs": len(counts),
    }


def cameras(case: Case) -> Content | None:
    """The cameras of each stage in one plot, how far each moved, and the lenses."""
    stages = [name for name in case.providers("cameras") if len(case.load(name, "cameras"))]
    if not stages:
        return None
    found = {name: case.load(name, "cameras").cameras for name in stages}
    last = found[stages[-1]]
    points_from = [name for name in case.providers("points") if name in found]
    points = case.load(points_from[-1], "points") if points_from else None
    series = []
    for name in stages:
        shared = [c for c in found[name] if c.name in {other.name for other in last}]
        goals = {camera.name: camera for camera in last}
        onto = similarity_onto(shared, [goals[c.name] for c in shared]) if shared else None
        series.append((name, found[name], None if name == stages[-1] else onto))
    positions = points.positions if points is not None else np.zeros((0, 3), np.float32)
    colors = points.colors if points is not None else np.zeros((0, 3), np.float32)
    if points_from and points_from[-1] != stages[-1]:
        onto = next(moved for name, _, moved in series if name == points_from[-1])
        positions = onto.points(positions) if onto else positions
    labels = labels_of(case)
    steps = [
        (before, after, {name: (turn, shift) for name, turn, shift in
                         movement(found[before], found[after])})
        for before, after in pairwise(stages)
    ]  # fmt: skip
    head = ["view", "focal px"]
    for before, after, _ in steps:
        head += [f"{before} → {after}: turned °", "moved %"]
    rows = []
    for camera in last:
        row = [Cell(labels.get(camera.name, camera.name)), cell(camera.fx, 1)]
        for _, _, moved in steps:
            turn, shift = moved.get(camera.name, (None, None))
            row += [cell(turn, 3), cell(shift, 2)]
        rows.append(row)
    return {
        "charts": [
            figures.camera_plot(series, positions, colors, axis) for axis in ("top", "front")
        ],
        "table": Table(head, rows, sortable=True),
        "count": len(last),
        "stages": stages,
    }


def points(case: Case) -> Content | None:
    """Each stage's cloud from a three-quarter direction: what entered SAP, and what it left."""
    entries = []
    placed = case.latest("cameras")
    for name in case.providers("points"):
        cloud = case.load(name, "points")
        own = case.load(name, "cameras") or _cameras_before(case, name) or placed
        frame = three_quarter(scene_frame(own.cameras if own else ()))
        shown = points_image(cloud.positions, cloud.colors, frame)
        figures_of = case.by_name[name].summary
        entries.append(
            {"picture": picture(shown, f"{len(cloud):,} points after {name}, seen from the side "
                                "and above."),
             "stage": name, "count": len(cloud),
             "removed": {key: value for key, value in figures_of.items()
                         if key.startswith("points_") and isinstance(value, int)}}
        )  # fmt: skip
    return {"entries": entries} if entries else None


def _cameras_before(case: Case, stage: str) -> Cameras | None:
    """The cameras that a stage without own ones worked with."""
    names = [record.name for record in case.stages]
    before = [n for n in case.providers("cameras") if names.index(n) <= names.index(stage)]
    return case.load(before[-1], "cameras") if before else None


def flow(case: Case) -> Content | None:
    """Some pairs: the photograph, the flow in colours, and where it is trusted."""
    artifact = case.latest("flow")
    if artifact is None or not len(artifact):
        return None
    views = case.latest("views")
    by_name = views.by_name() if views else {}
    labels = labels_of(case)
    step = max(1, -(-len(artifact.pairs) // MOST_FLOWS))
    entries = []
    for pair in artifact.pairs[::step]:
        full, largest = flow_colors(pair.forward)
        trusted, largest = flow_colors(pair.forward, pair.mask_forward)
        first, second = labels.get(pair.name_i, pair.name_i), labels.get(pair.name_j, pair.name_j)
        share = float(pair.mask_forward.mean())
        tiles = []
        if pair.name_i in by_name:
            image = to_uint8(by_name[pair.name_i].image)
            tiles.append(picture(image, f"Photograph {first}.", first, SMALL + 100))
        tiles += [
            picture(full, f"Flow from {first} to {second} in colours.", "flow", SMALL + 100),
            picture(trusted, f"The same, {100 * share:.0f} % of it trusted, the rest grey.",
                    f"trusted: {100 * share:.0f} %", SMALL + 100),
        ]  # fmt: skip
        entries.append({"title": f"{first} → {second}", "tiles": tiles, "largest": largest})
    return {
        "entries": entries, "total": len(artifact),
        "wheel": picture(flow_wheel(), "Colour wheel: hue is direction, saturation is length."),
    }  # fmt: skip


def fit(case: Case) -> Content | None:
    """Loss, PSNR and number of Gaussians over the iterations, and the previews."""
    folder = case.folder("fit", "pictures")
    if folder is None:
        return None
    charts = []
    rows = _curve(folder / "curve.csv")
    if len(rows.get("iteration", ())) > 1:
        x = rows["iteration"]
        for name, title, log in (
            ("loss", "loss (running mean)", True),
            ("psnr", "PSNR of training views, dB", False),
            ("gaussians", "Gaussians", False),
        ):
            if name in rows:
                first, last = rows[name][0], rows[name][-1]
                charts.append(
                    figures.line_chart(
                        x, {name: rows[name]}, ("iteration", title),
                        f"{title}: from {first:.6g} to {last:.6g} in {x[-1]:.0f} iterations.",
                        log=log,
                    )
                )  # fmt: skip
    previews = sorted(folder.glob("fit_*.png"))
    chosen = (
        {round(k) for k in np.linspace(0, len(previews) - 1, MOST_PREVIEWS)} if previews else ()
    )
    shown = [
        from_file(previews[k], f"Photograph and render after {int(previews[k].stem[4:])} "
                  "iterations.", f"after {int(previews[k].stem[4:])} iterations", 900)
        for k in sorted(chosen)
    ]  # fmt: skip
    return {"charts": charts, "previews": shown} if charts or shown else None


def _curve(path: Path) -> dict[str, list[float]]:
    if not path.is_file():
        return {}
    with path.open(newline="") as stream:
        lines = list(csv.DictReader(stream))
    return {name: [float(line[name]) for line in lines] for name in (lines[0] if lines else ())}


def failure_pictures(case: Case) -> list[Picture]:
    """What a failed stage drew of the trouble."""
    failed = case.failed
    if failed is None:
        return []
    paths = sorted((case.workspace / failed.name / "failure").glob("*.png"))
    return [
        from_file(path, title, title, 900)
        for path in paths[:MOST_PAIRS]
        for title in [title_of(path.stem, labels_of(case))]
    ]


def hero(case: Case) -> Picture | None:
    """The first picture of the page: what came out."""
    for name in case.providers("exports")[::-1]:
        folder = case.folder(name, "exports")
        if folder and (folder / "preview.png").is_file():
            return from_file(
                folder / "preview.png", "The scene, rendered from several directions.", "", 1100
            )
    return None
