"""`teeth`: the crowns in each photograph, with jaw, number and doubt, as `teeth.json`."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar, Self

import cv2
import numpy as np
import numpy.typing as npt

from pipeline.artifacts.base import Artifact
from pipeline.artifacts.dental.fdi import JAWS, Jaw, universal_number
from pipeline.artifacts.pictures import Picture, PicturesIn
from pipeline.artifacts.views import write_png

Point = npt.NDArray[np.float64]  # [2] x, y in pixels of the working image, pixel centres at .5
Bool = npt.NDArray[np.bool_]

#: Fixed-point bits of OpenCV's drawing coordinates.
_SHIFT = 4
#: Kind of a photograph that was not read: its neighbours in a film show the same teeth.
UNREAD = "unread"
#: Decimals of pixels and of probabilities in the file.
_DECIMALS, _PROBABILITY_DECIMALS = 2, 4


@dataclass(frozen=True)
class Crown:
    """One crown as seen in one photograph. All points are pixels of the working image as it is.

    "Left" and "right" are those of the image after its roll is taken out.

    Attributes:
        jaw: upper or lower.
        zenith: highest point of the gum line (lowest, in the lower jaw).
        tip: middle of the biting edge or cusp, where the crown ends towards the other jaw.
        papilla_left, papilla_right: tips of the gum beside it; None where it has no neighbour.
        embrasure_left, embrasure_right: where it parts from its neighbours; None where it has none.
        width, height: pixels, along and across the row.
        cut_left, cut_right: the row ends here, so that the crown may go on unseen.
        doubtful: its outline is weak: at the border of the image, or hardly told from the rest.
        outline: [K, 2] polygon around it.
        score: 0..1, how sure the reader is that this is one crown.
        numbers: FDI number -> probability by this photograph alone (those of .0001 and more).
        number: FDI number given to it, 0: none.
        doubt: 0..1 that `number` is wrong.
    """

    jaw: Jaw
    zenith: Point
    tip: Point
    papilla_left: Point | None
    papilla_right: Point | None
    embrasure_left: Point | None
    embrasure_right: Point | None
    width: float
    height: float
    cut_left: bool = False
    cut_right: bool = False
    doubtful: bool = False
    outline: npt.NDArray[np.float64] = field(default_factory=lambda: np.zeros((0, 2)))
    score: float = 1.0
    numbers: Mapping[int, float] = field(default_factory=dict)
    number: int = 0
    doubt: float = 1.0

    @property
    def centre(self) -> Point:
        """Middle between zenith and tip."""
        return np.asarray((self.zenith + self.tip) / 2)


@dataclass(frozen=True)
class Dentition:
    """The teeth in one photograph.

    Attributes:
        name: of the view.
        size: width and height of the working image, pixels.
        kind: what is photographed: `front`, `right` or `left` (buccal), `upper` or `lower`
            (occlusal), `other`; "none" where no teeth were found, `UNREAD` where nobody looked.
        upper, lower: crowns from left to right (after the roll is taken out).
        roll: radians by which the row of teeth is turned clockwise in the image.
        band_height: pixels from the upper to the lower gum line (median).
        jaws_apart: 0..1, how far the jaws are certainly not in contact.
        set_aside: why the photograph takes no part in the reconstruction; empty: it does.
        on_jaws: [K, 2] polygons around what is tooth or gum, and around holes in that; the rest is
            lip, cheek, or what holds them. None: nobody told.
        mirrored: True: the photograph is a mirror image, and what is said here is of the picture
            turned back. False: a person said that it is none. None: nobody asked.
    """

    name: str
    size: tuple[int, int]
    kind: str
    upper: tuple[Crown, ...] = ()
    lower: tuple[Crown, ...] = ()
    roll: float = 0.0
    band_height: float = 0.0
    jaws_apart: float = 0.0
    set_aside: str = ""
    on_jaws: tuple[npt.NDArray[np.float64], ...] | None = None
    mirrored: bool | None = None

    def crowns(self, jaw: Jaw) -> tuple[Crown, ...]:
        """The crowns of one jaw, from left to right."""
        return self.upper if jaw == "upper" else self.lower

    @property
    def all_crowns(self) -> tuple[Crown, ...]:
        """The crowns of both jaws."""
        return (*self.upper, *self.lower)

    def levelled(
        self, x: npt.NDArray[Any], y: npt.NDArray[Any]
    ) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
        """Pixels x, y (any shape) along the row of teeth, and across it from above to below."""
        c, s = np.cos(self.roll), np.sin(self.roll)
        return x * c + y * s, y * c - x * s

    @cached_property
    def mask(self) -> Bool:
        """[H, W] True on teeth."""
        return filled(self.all_crowns, self.size)

    @cached_property
    def on_jaws_mask(self) -> Bool:
        """[H, W] True on teeth and gum by `on_jaws`; everywhere, where nobody told."""
        if self.on_jaws is None:
            return np.ones((self.size[1], self.size[0]), bool)
        return filled_polygons(self.on_jaws, self.size) | self.mask

    @cached_property
    def above(self) -> Bool:
        """[H, W] True on the upper jaw's side: on its crowns, and beyond them from where both meet.

        They meet midway between the lines through their crowns' tips. Nearest crowns would not do:
        in a deep bite those of the lower jaw are hidden, and its gum is next to upper ones.
        """
        width, height = self.size
        if not self.upper or not self.lower:
            return np.full((height, width), bool(self.upper))
        y, x = np.mgrid[:height, :width] + 0.5
        along, across = self.levelled(x, y)
        meeting = np.zeros((height, width))
        for crowns in (self.upper, self.lower):
            tips = np.array([crown.tip for crown in crowns])
            places, heights = self.levelled(tips[:, 0], tips[:, 1])
            order = np.argsort(places, kind="stable")
            meeting += np.interp(along, places[order], heights[order]) / 2
        upper, lower = (filled(crowns, self.size) for crowns in (self.upper, self.lower))
        return np.asarray(upper | ((across < meeting) & ~lower))


def filled(crowns: tuple[Crown, ...], size: tuple[int, int]) -> Bool:
    """[H, W] True inside the outlines of some crowns; size is width and height."""
    mask = np.zeros((size[1], size[0]), bool)
    for crown in crowns:
        if len(crown.outline) >= 3:
            mask |= filled_polygons((crown.outline,), size)
    return mask


def filled_polygons(polygons: tuple[npt.NDArray[np.float64], ...], size: tuple[int, int]) -> Bool:
    """[H, W] True inside an odd number of polygons [K, 2]; size is width and height."""
    mask = np.zeros((size[1], size[0]), np.uint8)
    points = [np.round((p - 0.5) * (1 << _SHIFT)).astype(np.int32) for p in polygons]
    cv2.fillPoly(mask, points, 1, cv2.LINE_8, _SHIFT)
    return mask > 0


def moved_polygons(
    polygons: tuple[npt.NDArray[np.float64], ...] | None,
    move: Callable[[npt.NDArray[np.float64]], npt.NDArray[np.float64]],
) -> tuple[npt.NDArray[np.float64], ...] | None:
    """Polygons [K, 2] elsewhere; None stays None."""
    return None if polygons is None else tuple(move(polygon) for polygon in polygons)


@dataclass(frozen=True)
class Teeth(Artifact):
    """The teeth of a case, photograph by photograph.

    Attributes:
        views: one per view, in the order of the views.
        pictures: view name -> the photograph with outlines and numbers drawn on it.
    """

    kind: ClassVar[str] = "teeth"
    views: tuple[Dentition, ...]
    pictures: Mapping[str, Picture] = field(default_factory=dict)

    def by_name(self) -> dict[str, Dentition]:
        """View name -> its teeth."""
        return {view.name: view for view in self.views}

    @property
    def chosen(self) -> tuple[Dentition, ...]:
        """The photographs with teeth that are not set aside."""
        return tuple(v for v in self.views if not v.set_aside and v.all_crowns)

    def save(self, folder: Path) -> None:
        entries = [_view_entry(view) for view in self.views]
        text = json.dumps({"views": entries}, indent=1, sort_keys=True, allow_nan=False)
        (folder / "teeth.json").write_text(text + "\n")
        for name, picture in sorted(self.pictures.items()):
            write_png(folder / f"{name}.png", picture)

    @classmethod
    def load(cls, folder: Path) -> Self:
        entries = json.loads((folder / "teeth.json").read_text())["views"]
        return cls(tuple(_view(entry) for entry in entries), PicturesIn(folder))


_POINTS = (
    "zenith", "tip", "papilla_left", "papilla_right", "embrasure_left", "embrasure_right",
)  # fmt: skip


def _view_entry(view: Dentition) -> dict[str, Any]:
    return {
        "name": view.name,
        "width": view.size[0],
        "height": view.size[1],
        "kind": view.kind,
        "roll_degrees": round(float(np.degrees(view.roll)), 3),
        "band_height": round(float(view.band_height), _DECIMALS),
        "jaws_apart": round(float(view.jaws_apart), _PROBABILITY_DECIMALS),
        "set_aside": view.set_aside,
        "mirrored": view.mirrored,
        "on_jaws": None
        if view.on_jaws is None
        else [np.round(polygon, _DECIMALS).tolist() for polygon in view.on_jaws],
        "crowns": [_crown_entry(crown) for crown in view.all_crowns],
    }


def _crown_entry(crown: Crown) -> dict[str, Any]:
    entry: dict[str, Any] = {
        "jaw": crown.jaw,
        "number": crown.number,
        "universal": universal_number(crown.number) if crown.number else "",
        "doubt": round(float(crown.doubt), _PROBABILITY_DECIMALS),
        "score": round(float(crown.score), _PROBABILITY_DECIMALS),
        "numbers": {
            str(tooth): round(float(share), _PROBABILITY_DECIMALS)
            for tooth, share in sorted(crown.numbers.items())
        },
        "outline": np.round(crown.outline, _DECIMALS).tolist(),
        "width": round(float(crown.width), _DECIMALS),
        "height": round(float(crown.height), _DECIMALS),
    }
    for flag in ("cut_left", "cut_right", "doubtful"):
        entry[flag] = bool(getattr(crown, flag))
    for name in _POINTS:
        point = getattr(crown, name)
        entry[name] = None if point is None else np.round(point, _DECIMALS).tolist()
    return entry


def _view(entry: Mapping[str, Any]) -> Dentition:
    crowns = [_crown(crown) for crown in entry["crowns"]]
    rows = {jaw: tuple(crown for crown in crowns if crown.jaw == jaw) for jaw in JAWS}
    return Dentition(
        name=entry["name"],
        size=(entry["width"], entry["height"]),
        kind=entry["kind"],
        upper=rows["upper"],
        lower=rows["lower"],
        roll=float(np.radians(entry["roll_degrees"])),
        band_height=entry["band_height"],
        jaws_apart=entry["jaws_apart"],
        set_aside=entry["set_aside"],
        on_jaws=None
        if entry.get("on_jaws") is None
        else tuple(np.array(polygon, np.float64) for polygon in entry["on_jaws"]),
        mirrored=entry.get("mirrored"),
    )


def _crown(entry: Mapping[str, Any]) -> Crown:
    values = {f.name: entry[f.name] for f in fields(Crown)}
    for name in _POINTS:
        values[name] = None if values[name] is None else np.array(values[name], np.float64)
    values["outline"] = np.array(values["outline"], np.float64).reshape(-1, 2)
    values["numbers"] = {int(tooth): share for tooth, share in values["numbers"].items()}
    return Crown(**values)
