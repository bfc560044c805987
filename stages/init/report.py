"""What the page about a run says of how the photographs were placed."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Any

from pipeline.artifacts.teeth import Teeth
from pipeline.files import read_json
from pipeline.pages.case import title_of
from pipeline.pages.charts import match_matrix
from pipeline.pages.page import CHECK
from pipeline.pages.parts import Block, Grid, Items, Section, Text, Tile
from pipeline.pages.pictures import from_file, picture
from pipeline.stage import Parts

if TYPE_CHECKING:
    from pipeline.pages.case import Case

#: Pictures of pairs on the page at most, and other pictures.
MOST_PAIRS, MOST_OTHERS = 12, 24


def matches(case: Case) -> Iterator[Section]:
    """Pairs with their matches, the matrix of counts, and whatever else was drawn."""
    folder = case.folder("init", "pictures")
    if folder is None:
        return
    table = read_json(folder / "matches.json")
    labels = case.labels
    counts: dict[tuple[int, int], Mapping[str, Any]] = {}
    names: list[str] = []
    if isinstance(table, dict):
        names = list(table["views"])
        place = {name: k for k, name in enumerate(names)}
        counts = {
            (place[entry["views"][0]], place[entry["views"][1]]): entry for entry in table["pairs"]
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
    if others:
        said = "What was found, drawn to be checked. Where it is wrong, so is the scene."
        yield Section("", [Text(said), Grid(others[:MOST_OTHERS], "wide")], place="check")
    drawn.sort(key=lambda item: (item[0], item[1]))
    tiles = [
        Tile(from_file(path, f"{title}: {caption}.", long_side=900), title, [caption])
        for _, title, path, caption in drawn[:MOST_PAIRS]
    ]
    if not tiles and not counts:
        return
    blocks: list[Block] = [
        Text(
            "Green matches agree on where the two cameras stood; red ones do not and were left "
            "out. The pairs that hold the photographs together most strongly:"
        ),
        Grid(tiles, "wide"),
    ]
    if counts:
        verified = {pair: int(entry["verified"]) for pair, entry in counts.items()}
        blocks.append(match_matrix(names, verified))
    used = sum(bool(entry["used"]) for entry in counts.values())
    yield Section("Matches", blocks, f"{used} of {len(counts)} pairs used")


def teeth_of(case: Case) -> Teeth | None:
    """The teeth of the last run: numbered, or kept by the stage that found them doubtful."""
    if case.failed is not None:
        kept: Teeth | None = case.evidence("teeth")
        if kept is not None:
            return kept if any(view.all_crowns for view in kept.views) else None
    latest: Teeth | None = case.latest("teeth")
    if latest is None or not any(c.number for view in latest.views for c in view.all_crowns):
        return None
    return latest


def teeth(case: Case) -> Iterator[Section]:
    """The labelled photographs, and which were set aside for what."""
    found = teeth_of(case)
    if found is None:
        return
    labels = case.labels
    drawn = []
    for view in found.views:
        image = found.pictures.get(view.name)
        if image is not None and not view.set_aside:
            title = labels.get(view.name, view.name)
            numbered = sum(bool(crown.number) for crown in view.all_crowns)
            said = f"{title}: {view.kind}, {numbered} of {len(view.all_crowns)} teeth numbered"
            drawn.append(picture(image, said, f"{said}.", 900))
    told = Text("What was taken for which tooth, by FDI number.")
    if (case.workspace / CHECK).is_file() and not case.nameless:
        told = Text(f"{told.text} Something is wrong?", link=(CHECK, "Put it right", "."))
    blocks: list[Block] = [told, *([Grid(drawn, "wide")] if drawn else [])]
    aside = [
        (labels.get(view.name, view.name), f"takes no part: {view.set_aside}")
        for view in found.views if view.set_aside
    ]  # fmt: skip
    if aside:
        blocks.append(Items(aside))
    yield Section("Teeth", blocks, place="chapter")


PARTS: Parts = {"matches": matches, "teeth": teeth}
