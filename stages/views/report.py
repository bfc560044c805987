"""What the page about a run says of the photographs."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

from pipeline.artifacts.cameras import Cameras
from pipeline.artifacts.views import View, Views
from pipeline.pages.parts import Badge, Block, Grid, Section, Text, Tile
from pipeline.pages.pictures import SMALL, masked, picture
from pipeline.stage import Parts

if TYPE_CHECKING:
    from pipeline.pages.case import Case

#: Colours of what became of a photograph.
TONES = {"placed": "good", "not placed": "bad"}


def photographs(case: Case) -> Iterator[Section]:
    """Thumbnails: which were placed, which not and why, which were held out."""
    views: Views | None = case.latest("views")
    if views is None:
        return
    cameras: Cameras | None = case.latest("cameras")
    placed = set(cameras.by_name()) if cameras else set()
    held_out = case.latest("held_out")
    warnings = [text for _, text in case.warnings()]
    tiles = []
    for view in views.views:
        why = ""
        if cameras and view.name not in placed:
            naming = [text for text in warnings if view.source_name and view.source_name in text]
            why = naming[0] if naming else ""
        state = "placed" if view.name in placed else "not placed" if cameras else "read"
        tiles.append(_thumbnail(view, state, why))
    for view in held_out.views if held_out else ():
        tiles.append(_thumbnail(view, "held out", "kept from every stage but evaluate"))
    total = len(views.views)
    note = f"{total} read"
    if cameras:
        note = f"{len(placed & {view.name for view in views.views})} of {total} placed"
    if held_out and held_out.views:
        note += f", {len(held_out.views)} held out"
    blocks: list[Block] = [Grid(tiles, "small")]
    if any(view.mask is not None for view in views.views):
        blocks.insert(0, Text("What masks leave out is darkened.", soft=True))
    yield Section("Photographs", blocks, note, "open")


def _thumbnail(view: View, state: str, why: str) -> Tile:
    name = view.source_name or view.name
    size = f"{view.width} × {view.height}"
    used = f" · {100 * float(view.valid().mean()):.0f} % used" if view.mask is not None else ""
    return Tile(
        picture(masked(view), f"Photograph {name}, {state}.", long_side=SMALL), name,
        [f"{view.name} · {size}{used}"], Badge(state, TONES.get(state, "")), why,
    )  # fmt: skip


PARTS: Parts = {"photographs": photographs}
