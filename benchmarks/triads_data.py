"""Cases with truth, whole series, and mixes that must not pass, for `triads.py`."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from itertools import combinations, product
from pathlib import Path
from typing import Any

import numpy as np

#: The photographs of a triad, and of a series those with the jaws apart in their place.
SLOTS = ("0_right", "1_frontal", "2_left")
OPEN = ("right_open", "front_open", "left_open")
#: Photographs of a series that belong in a scene; of the fronts one is enough.
SIDES, FRONTS = frozenset({"0_right", "2_left"}), frozenset({"1_frontal", "front_b"})
#: Sorts of items. Those in `SORTS` are mixes of three photographs, those in `LARGER` of more.
CASE, SERIES = "case", "series"
ALIEN, TWO, MIRRORED_SIDE, MIRRORED_FRONT, SWAPPED, APART = SORTS = (
    "one of another patient", "sides of another patient", "one side mirrored", "frontal mirrored",
    "sides swapped", "jaws apart",
)  # fmt: skip
BESIDE, HALVES, TWO_BESIDE, BOTH = LARGER = (
    "another patient's beside three", "two of each of two patients",
    "two of another patient's beside three", "all of two patients",
)  # fmt: skip


@dataclass(frozen=True)
class TruthPoint:
    """A place well inside one crown, and the crown's number.

    Attributes:
        x, y: as fractions of the photograph's width and height.
        numbers: FDI numbers that are right, the likeliest first.
        partial: less than half of the crown's front is seen.
    """

    x: float
    y: float
    numbers: tuple[int, ...]
    partial: bool


@dataclass(frozen=True)
class Photo:
    """One photograph of an item.

    Attributes:
        patient: whose it is.
        path: the file.
        shown: stem that its place in the item has, whatever its file is called.
        truth: its truth points; empty where there are none.
        mirrored: to be mirrored before use.
        closed: the jaws are in contact.
    """

    patient: str
    path: Path
    shown: str
    truth: tuple[TruthPoint, ...] = ()
    mirrored: bool = False
    closed: bool = True


@dataclass(frozen=True)
class Item:
    """Photographs that are given to the pipeline together.

    Attributes:
        name: unique.
        sort: `CASE`, `SERIES` or one of `SORTS` and `LARGER`.
        photos: in the order in which they are given.
    """

    name: str
    sort: str
    photos: tuple[Photo, ...]

    @property
    def patients(self) -> frozenset[str]:
        """All whose photographs are in it."""
        return frozenset(photo.patient for photo in self.photos)


def read_truth(path: Path) -> dict[str, tuple[TruthPoint, ...]]:
    """`truth.json` of a triad: stem of the photograph -> its points."""
    photos = json.loads(path.read_text())["photos"]
    return {stem: tuple(_point(entry) for entry in entries) for stem, entries in photos.items()}


def _point(entry: dict[str, Any]) -> TruthPoint:
    others = tuple(int(tooth) for tooth in entry.get("alternatives", ()))
    return TruthPoint(
        entry["x"], entry["y"], (int(entry["tooth"]), *others), bool(entry.get("partial"))
    )


def read_cases(data: Path, only: tuple[str, ...] = ()) -> list[Item]:
    """The triads, by name."""
    cases = []
    for folder in sorted((data / "triads").iterdir()):
        if not (folder / "truth.json").exists() or (only and folder.name not in only):
            continue
        truth = read_truth(folder / "truth.json")
        photos = tuple(
            Photo(folder.name, folder / f"{stem}.jpg", stem, truth[stem]) for stem in SLOTS
        )
        cases.append(Item(folder.name, CASE, photos))
    return cases


def read_series(data: Path, cases: list[Item]) -> list[Item]:
    """Everything that a clinic took of some of the patients, with the truth of the triads; none
    where there is no `series/`."""
    truths = {(case.name, photo.path.stem): photo.truth for case in cases for photo in case.photos}
    found = []
    for folder in sorted((data / "series").glob("*/")):
        if folder.name not in {case.name for case in cases}:
            continue
        photos = tuple(
            Photo(
                folder.name, path, path.stem, truths.get((folder.name, path.stem), ()),
                closed=path.stem not in OPEN,
            )
            for path in sorted(folder.glob("*.jpg"))
        )  # fmt: skip
        found.append(Item(f"series/{folder.name}", SERIES, photos))
    return found


def make_pairs(cases: list[Item]) -> list[Item]:
    """The photograph from the front with that of one side, for either side."""
    return [
        replace(case, name=f"{case.name} {SLOTS[slot]}", photos=pair)
        for case in cases
        for slot, pair in ((0, case.photos[:2]), (2, case.photos[1:]))
    ]


def make_mixed_pairs(cases: list[Item]) -> list[Item]:
    """Pairs of which one photograph is another patient's, or was mirrored."""
    mixes = []
    for case, other in product(cases, cases):
        for side in (0, 2):
            places, front = (side, 1), case.photos[1]
            if case is not other:
                changed = {side: other.photos[side]}
                mixes.append(_with(case, ALIEN, changed, places))
                continue
            flipped = {side: replace(case.photos[side], mirrored=True)}
            mixes.append(_with(case, MIRRORED_SIDE, flipped, places))
            mixes.append(_with(case, MIRRORED_FRONT, {1: replace(front, mirrored=True)}, places))
    return mixes


def make_mixes(cases: list[Item], series: list[Item], count: int, seed: int = 0) -> list[Item]:
    """At most `count` mixes, of every sort in turn; fewer are the beginning of more."""
    rng = np.random.default_rng(seed)
    by_sort: dict[str, list[Item]] = {sort: [] for sort in SORTS}
    # Round by round each case lends its photographs to the one that follows it in a shuffled ring.
    ring = [cases[k] for k in rng.permutation(len(cases))]
    for step in range(1, min(4, len(ring))):
        for k, case in enumerate(ring):
            other = ring[(k + step) % len(ring)]
            slot = (k + step) % 3
            by_sort[ALIEN].append(_with(case, ALIEN, {slot: other.photos[slot]}))
            by_sort[TWO].append(_with(case, TWO, {0: other.photos[0], 2: other.photos[2]}))
    for k, case in enumerate(ring):
        right, front, left = case.photos
        for slot in (k % 2 * 2, 2 - k % 2 * 2):
            flipped = replace(case.photos[slot], mirrored=True)
            by_sort[MIRRORED_SIDE].append(_with(case, MIRRORED_SIDE, {slot: flipped}))
        by_sort[MIRRORED_FRONT].append(
            _with(case, MIRRORED_FRONT, {1: replace(front, mirrored=True)})
        )
        by_sort[SWAPPED].append(_with(case, SWAPPED, {0: left, 2: right}))
    by_name = {case.name: case for case in ring}
    for size in (1, 2, 3):
        for folder in series:
            opened = {photo.path.stem: photo for photo in folder.photos if not photo.closed}
            case = by_name[folder.photos[0].patient]
            for slots in combinations(range(3), size) if len(opened) == 3 else ():
                chosen = {slot: opened[OPEN[slot]] for slot in slots}
                by_sort[APART].append(_with(case, APART, chosen))
    queues = [list(reversed(items)) for items in by_sort.values()]
    mixes: list[Item] = []
    while len(mixes) < count and any(queues):
        mixes += [queue.pop() for queue in queues if queue]
    return mixes[:count]


def make_larger(cases: list[Item], count: int, seed: int = 0) -> list[Item]:
    """At most `count` mixes of four to six, of every sort in turn; fewer are the beginning of more.

    Where three belong together they may become a scene without the others. Where both patients have
    all three, it is to be said.
    """
    rng = np.random.default_rng(seed)
    ring = [cases[k] for k in rng.permutation(len(cases))]
    mixes: list[Item] = []
    for step in range(1, len(ring)):
        for k, case in enumerate(ring):
            other = ring[(k + step) % len(ring)]
            others = _but_one(other, k + step)
            for sort, mine, added in (
                (BESIDE, case.photos, (other.photos[(k + step) % 3],)),
                (HALVES, _but_one(case, k), others),
                (TWO_BESIDE, case.photos, others),
                (BOTH, case.photos, other.photos),
            ):
                more = tuple(replace(p, shown=f"{n}") for n, p in enumerate(added, len(mine)))
                name = " and ".join(f"{p.patient}/{p.path.stem}" for p in (*mine, *more))
                mixes.append(Item(f"{name} ({sort})", sort, (*mine, *more)))
    return mixes[:count]


def _but_one(case: Item, slot: int) -> tuple[Photo, ...]:
    """The photographs of a case without one of its three."""
    return tuple(photo for k, photo in enumerate(case.photos) if k != slot % 3)


def _with(
    case: Item, sort: str, changed: dict[int, Photo], places: tuple[int, ...] = (0, 1, 2)
) -> Item:
    """The case with some photographs replaced; they take the names of those they replace.

    `places` are those that the item has.
    """
    photos = tuple(
        replace(changed.get(slot, case.photos[slot]), shown=SLOTS[slot]) for slot in sorted(places)
    )
    words = [f"{slot}:{photo.patient}/{photo.path.stem}" for slot, photo in sorted(changed.items())]
    own = "".join(f" {SLOTS[slot]}" for slot in places if len(places) < 3 and slot not in changed)
    return Item(f"{case.name}{own} with {' '.join(words)} ({sort})", sort, photos)
