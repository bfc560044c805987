"""Sections about kinds of artifact that several stages make: cameras and points, stage by stage."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise

import numpy as np

from pipeline.artifacts.cameras import Cameras
from pipeline.pages.case import Case
from pipeline.pages.charts import camera_plot
from pipeline.pages.directions import movement, scene_frame, similarity_onto, three_quarter
from pipeline.pages.page import number
from pipeline.pages.parts import Block, Grid, Section, Text, Tile
from pipeline.pages.pictures import picture, points_image
from pipeline.pages.tables import Cell, Table, cell


def cameras(case: Case) -> Iterator[Section]:
    """The cameras of each stage in one plot, how far each moved, and the lenses."""
    stages = [name for name in case.providers("cameras") if len(case.load(name, "cameras"))]
    if not stages:
        return
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
    labels = case.labels
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
    charts = [camera_plot(series, positions, colors, axis) for axis in ("top", "front")]
    blocks: list[Block] = [Grid(charts, "wide")]
    if len(stages) > 1:
        said = (
            "Cameras of different stages are compared after a similarity that brings them as near "
            "as it can; “moved” is in percent of the largest distance between two cameras."
        )
        blocks.append(Text(said, soft=True))
    blocks.append(Table(head, rows, sortable=True))
    yield Section("Cameras", blocks, f"{len(last)} placed; {', '.join(stages)}")


def points(case: Case) -> Iterator[Section]:
    """Each stage's cloud from a three-quarter direction: what entered a stage, and what it left."""
    tiles, counts = [], []
    placed = case.latest("cameras")
    for name in case.providers("points"):
        cloud = case.load(name, "points")
        own = case.load(name, "cameras") or _cameras_before(case, name) or placed
        frame = three_quarter(scene_frame(own.cameras if own else ()))
        shown = points_image(cloud.positions, cloud.colors, frame)
        alt = f"{len(cloud):,} points after {name}, seen from the side and above."
        lines = [
            f"{key.replace('_', ' ')}: {number(value)}"
            for key, value in case.by_name[name].summary.items()
            if key.startswith("points_") and isinstance(value, int)
        ]
        tiles.append(Tile(picture(shown, alt), f"after {name}: {number(len(cloud))} points", lines))
        counts.append(f"{name} {number(len(cloud))}")
    if tiles:
        yield Section("Points", [Grid(tiles)], ", ".join(counts))


def _cameras_before(case: Case, stage: str) -> Cameras | None:
    """The cameras that a stage without own ones worked with."""
    names = [record.name for record in case.stages]
    before = [n for n in case.providers("cameras") if names.index(n) <= names.index(stage)]
    return case.load(before[-1], "cameras") if before else None


#: Kind of artifact -> its section; it stands after those of the first stage that makes the kind.
KINDS = {"cameras": cameras, "points": points}
