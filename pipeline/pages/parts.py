"""What a stage says on the page about a run: cards, facts, links, sections made of blocks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar, Literal

from pipeline.pages.charts import Chart
from pipeline.pages.pictures import Picture
from pipeline.pages.tables import Table


@dataclass(frozen=True)
class Card:
    """A figure at the top: its value, what it is, and whether it is poor."""

    value: str
    label: str
    poor: bool = False


@dataclass(frozen=True)
class Fact:
    """A plain sentence about what came out, and how sure that is."""

    text: str


@dataclass(frozen=True)
class Link:
    """A file that came out: its path in the workspace, and what the page calls it."""

    path: str
    text: str


@dataclass(frozen=True)
class Hero:
    """The first picture of the page: what came out."""

    picture: Picture
    caption: str


@dataclass(frozen=True)
class Text:
    """A paragraph, with a link after it where there is one: (address, words, what follows)."""

    macro: ClassVar[str] = "text"
    text: str
    soft: bool = False
    link: tuple[str, str, str] | None = None


@dataclass(frozen=True)
class Heading:
    """A heading inside a section, and what stands softly beside it."""

    macro: ClassVar[str] = "heading"
    text: str
    soft: str = ""


@dataclass(frozen=True)
class Items:
    """A list: (what, what is said of it)."""

    macro: ClassVar[str] = "items"
    entries: Sequence[tuple[str, str]]


@dataclass(frozen=True)
class Legend:
    """A small round picture that explains the colours of those below it."""

    macro: ClassVar[str] = "legend"
    picture: Picture
    text: str


@dataclass(frozen=True)
class Badge:
    """A word with a colour: ``good``, ``warn``, ``bad``, or none."""

    text: str
    tone: str = ""


@dataclass(frozen=True)
class Tile:
    """A picture with a title, lines beneath it, and a badge with a remark."""

    macro: ClassVar[str] = "titled"
    picture: Picture
    title: str
    lines: Sequence[str] = ()
    badge: Badge | None = None
    remark: str = ""


@dataclass(frozen=True)
class Comparison:
    """A photograph and its render under one movable edge, and the error beside them.

    Attributes:
        pictures: (photograph, render, error), or only one picture of them all.
    """

    macro: ClassVar[str] = "comparison"
    title: str
    score: str
    pictures: tuple[Picture, Picture, Picture] | tuple[Picture]


@dataclass(frozen=True)
class Grid:
    """Pictures, charts and comparisons side by side; `size` is how large each is."""

    macro: ClassVar[str] = "grid"
    entries: Sequence[Picture | Chart | Tile | Comparison]
    size: Literal["", "wide", "small", "three"] = ""


Block = Text | Heading | Items | Legend | Grid | Chart | Table


@dataclass(frozen=True)
class Section:
    """A section of the page.

    Attributes:
        title: its heading; of no use where `place` is ``check``.
        blocks: what stands in it; a section without any is left out.
        note: beside the title of a folded section.
        place: ``check``: among the pictures to check; ``chapter``: by itself, before all that is
            folded; ``folded`` or ``open``: under "Everything else".
    """

    title: str
    blocks: Sequence[Block]
    note: str = ""
    place: Literal["check", "chapter", "folded", "open"] = "folded"


Part = Card | Fact | Link | Hero | Section
