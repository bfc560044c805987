"""What the page about a run says of the files that came out."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from math import floor, log10
from typing import TYPE_CHECKING, Any

from pipeline.pages.parts import Hero, Link, Section, Text
from pipeline.pages.pictures import from_file
from pipeline.pages.tables import Cell, Table
from pipeline.stage import Parts

if TYPE_CHECKING:
    from pipeline.pages.case import Case

LINKS = (
    Link("results/viewer.html", "Turn the scene around"),
    Link("results/orbit.mp4", "Video"),
    Link("results/mesh.stl", "Mesh (.stl)"),
    Link("results/mesh_without_scale.stl", "Mesh without a scale (.stl)"),
    Link("results/mesh.glb", "Mesh with photographs (.glb)"),
    Link("results/mesh_without_scale.glb", "Mesh with photographs, without a scale (.glb)"),
    Link("results/splats.ply", "Splats (.ply)"),
    Link("results/README.txt", "What the files are"),
)


def links(case: Case) -> Iterator[Link]:
    """The files, unless they are those of an earlier run."""
    if case.failed is None and case.providers("exports"):
        yield from LINKS


def preview(case: Case) -> Iterator[Hero]:
    """The scene as it came out."""
    for name in case.providers("exports")[::-1]:
        folder = case.folder(name, "exports")
        if folder and (folder / "preview.png").is_file():
            said = "A photograph, the scene from its place, and from another."
            yield Hero(from_file(folder / "preview.png", said, "", 1100), said)
            return


def measurements(case: Case) -> Iterator[Section]:
    """Overjet, overbite and the like, each with how sure it is, or why it can't be had."""
    for name in case.providers("exports")[::-1]:
        folder = case.folder(name, "exports")
        if folder is None or not (folder / "teeth.json").is_file():
            continue
        found = json.loads((folder / "teeth.json").read_text())
        entries, scale = found.get("measurements", ()), found.get("scale", {})
        if not entries:
            return
        rows = [_measured(entry) for entry in entries]
        notes = [
            "By itself, from the teeth's numbers and outlines: check those first. The uncertainty "
            "holds in 19 of 20 cases, that of the scale in it. The viewer says how each is "
            "measured, and draws it.",
            str(scale.get("text", "")),
        ]
        blocks = [Table(("", "value", "how sure"), rows, stacked=True)]
        texts = [Text(note, soft=True) for note in notes if note]
        yield Section("Measured on the teeth", [*blocks, *texts], place="chapter")
        return


def _measured(entry: Mapping[str, Any]) -> list[Cell]:
    """A row: what, how much, and how sure that is."""
    title = Cell(str(entry["title"]))
    if entry["value"] is None:
        return [title, Cell("not visible"), Cell(str(entry["not_visible"]))]
    value, off = entry["value"], entry["uncertainty"]
    unit, digits = " mm", 1
    if entry["unit"] != "mm":  # of any size, as the viewer has them (`lengthText`)
        unit, digits = " (no scale)", min(max(1 - floor(log10(max(off, 1e-6))), 0), 6)
    signed = entry["name"] in ("overjet", "overbite")
    shown = round(value if signed else abs(value), digits) + 0.0
    said = [entry["direction"], entry["sure"]]
    if entry["estimated"]:
        said = ["estimated", *said]
    remark = "; ".join(word for word in said if word)
    return [title, Cell(f"{shown:.{digits}f} ± {off:.{digits}f}{unit}"), Cell(remark)]


PARTS: Parts = {"preview": preview, "links": links, "measurements": measurements}
