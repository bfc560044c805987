"""Read all photographs of a case."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from functools import partial
from itertools import compress
from typing import Any, TypeVar

import numpy as np

from pipeline.artifacts.views import View
from pipeline.kernels.threads import opencv_threads
from stages.teeth.read import (
    Glances,
    Reading,
    read_photograph,
    shows_both_rows,
    uprightness,
)

Item = TypeVar("Item")
Progress = Callable[[str, int, int], None]
Map = Callable[[Callable[..., Any], Iterable[Any]], Iterable[Any]]

#: A case is one of teeth if more than this share of so many photographs, evenly chosen, show them;
#: or so many of all: in a clinic's folder faces and X-rays may be more.
_ASKED, _SHARE, _SHOWING = 3, 0.3, 2
#: Share of a photograph that is tooth, and crowns in it, to show teeth.
_LEAST_TOOTH, _LEAST_CROWNS = 0.015, 6
#: Score of a crown at the first look that counts for that, and the share of all crowns that must
#: have it. Of 161 photographs of mouths one had .5, all others .67 and more; of eleven of a castle
#: the windows had up to .5.
_SURE, _MOST_SURE = 0.8, 0.6
#: Photographs stand on their heads if they look so much more upright that way. Of 90 photographs
#: of both rows that are upright none gains, and 86 lose more than this: all 36 of twelve patients'
#: closed bites (.24 and more) among them. Of 120 generated ones none gains more than .18.
_MORE_UPRIGHT = 0.2
#: Of a film, which has one way up, so many frames, evenly chosen, are asked that.
_FRAMES = 4


class PhotographReader:
    """Reads the photographs of a case.

    Args:
        views: the photographs.
        threads: how many are read side by side; changes nothing but the time.
    """

    def __init__(self, views: Sequence[View], threads: int) -> None:
        self._views = views
        self._threads = max(1, threads)
        self._glances = [Glances(view.image, view.valid()) for view in views]

    def worth_reading(self, spare: Collection[int] = ()) -> list[int]:
        """Places of the photographs to read: those that are not spare, and spare ones that show
        teeth if some of these show none. Nothing where this is no case of teeth.
        """
        first = [k for k in range(len(self._views)) if k not in spare]
        asked = evenly(first, _ASKED)
        sure = sum(self._show_teeth(asked)) > _SHARE * len(asked)
        showing = self._show_teeth(first)
        more: list[int] = []
        if any(showing) and not all(showing):
            more = [*compress(spare, self._show_teeth(spare))]
        return sorted([*first, *more]) if sure or sum(showing) + len(more) >= _SHOWING else []

    def _show_teeth(self, places: Iterable[int]) -> list[bool]:
        """Do photographs show teeth? A quick look at each."""
        with self._side_by_side() as map_:
            return list(map_(_has_teeth, [self._glances[k] for k in places]))

    def read(self, progress: Progress, places: Sequence[int] | None = None) -> list[Reading]:
        """Read the photographs at some places (None: all).

        Photographs are turned the right way up where that is clear, each by itself or else with
        the others; frames of a film together. The outlines remain those of the photographs.
        """
        numbers = range(len(self._views)) if places is None else places
        progress("reading teeth", 0, len(numbers))
        with self._side_by_side() as map_:
            first = map_(lambda number: self._glances[number].turned(0)[1], numbers)
            both = [
                number
                for number, crowns in zip(numbers, first, strict=True)
                if shows_both_rows(crowns)
            ]
            frames = [number for number in both if self._views[number].timestamp is not None]
            asked = sorted({*both} - {*frames} | {*evenly(frames, _FRAMES)})
            # what a photograph looks like on its head is seen while others are read
            tasks = [
                *(partial(self._read, number) for number in numbers),
                *(partial(_gain_upside_down, self._glances[number]) for number in asked),
            ]
            made, gains = [], []
            for done, result in enumerate(map_(lambda task: task(), tasks), 1):
                if isinstance(result, Reading):
                    made.append(result)
                    progress("reading teeth", done, len(numbers))
                else:
                    gains.append(result)
            readings = dict(zip(numbers, made, strict=True))
            over = self._on_their_heads(numbers, dict(zip(asked, gains, strict=True)))
            readings |= zip(over, map_(partial(self._read, quarters=2), over), strict=True)
        return [readings[number] for number in numbers]

    def _on_their_heads(self, numbers: Sequence[int], gains: dict[int, float | None]) -> list[int]:
        """Those to turn over of some photographs, by what such as were asked gain by that."""
        known = {number: gain for number, gain in gains.items() if gain is not None}
        if not known:
            return []
        every = float(np.mean([*known.values()]))

        def gain(number: int) -> float:
            own = known.get(number, every)
            clear = abs(own) > _MORE_UPRIGHT and self._views[number].timestamp is None
            return own if clear else every

        return [number for number in numbers if gain(number) > _MORE_UPRIGHT]

    def _read(self, number: int, quarters: int = 0) -> Reading:
        view = self._views[number]
        return read_photograph(
            view.image, view.valid(), view.name, quarters=quarters, glances=self._glances[number]
        )

    @contextmanager
    def _side_by_side(self) -> Iterator[Map]:
        """Map over photographs in threads, OpenCV keeping to one in each; one that would be left
        over for the end has all of them to itself.
        """
        with ThreadPoolExecutor(self._threads) as pool:

            def map_(function: Callable[..., Any], items: Iterable[Any]) -> Iterator[Any]:
                every = list(items)
                alone = len(every) - int(len(every) % self._threads == 1)
                with opencv_threads(1):
                    yield from pool.map(function, every[:alone])
                with opencv_threads(self._threads):
                    yield from pool.map(function, every[alone:])

            yield map_


def evenly(items: Sequence[Item], most: int) -> list[Item]:
    """At most so many of some items, evenly chosen."""
    if not items:
        return []
    chosen = np.linspace(0, len(items) - 1, min(len(items), most)).round().astype(int)
    return [items[int(k)] for k in np.unique(chosen)]


def _has_teeth(glances: Glances) -> bool:
    answer, crowns = glances.turned(0)
    if float((answer.tooth > 0).mean()) < _LEAST_TOOTH:
        return False
    sure = sum(crown.score > _SURE for crown in crowns)
    return sure >= max(_LEAST_CROWNS, _MOST_SURE * len(crowns))


def _gain_upside_down(glances: Glances) -> float | None:
    """How much more upright a photograph looks turned over; None where not both rows show."""
    answer, crowns = glances.turned(2)
    if not shows_both_rows(crowns):
        return None
    return uprightness(answer, crowns) - uprightness(*glances.turned(0))
