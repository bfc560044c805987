"""Read all photographs of a case."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from functools import partial
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

#: So many photographs, evenly chosen, are asked whether a case is one of teeth at all; more than
#: this share must show them.
_ASKED, _SHARE = 3, 0.3
#: Share of a photograph that is tooth, and crowns in it, to show teeth.
_LEAST_TOOTH, _LEAST_CROWNS = 0.015, 6
#: Score of a crown at the first look that counts for that, and the share of all crowns that must
#: have it. Of 161 photographs of mouths one had .5, all others .67 and more; of eleven of a castle
#: the windows had up to .5.
_SURE, _MOST_SURE = 0.8, 0.6
#: Photographs stand on their heads if they look so much more upright that way. Of 90 photographs of
#: both rows that are upright none gains, and 89 lose more than this; the mean of a patient's three
#: loses .45 to .77 (twelve patients).
_MORE_UPRIGHT = 0.1
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

    def shows_teeth(self) -> bool:
        """Is this a case of teeth? One quick look at a few photographs."""
        with self._side_by_side() as map_:
            votes = list(map_(_has_teeth, evenly(self._glances, _ASKED)))
        return bool(votes) and sum(votes) > _SHARE * len(votes)

    def read(self, progress: Progress) -> list[Reading]:
        """Read every photograph.

        Photographs are turned the right way up where that is clear, each by itself or else with
        the others; frames of a film together. The outlines remain those of the photographs.
        """
        numbers = range(len(self._views))
        progress("reading teeth", 0, len(numbers))
        with self._side_by_side() as map_:
            first = map_(lambda glances: glances.turned(0)[1], self._glances)
            both = [number for number, crowns in enumerate(first) if shows_both_rows(crowns)]
            frames = [number for number in both if self._views[number].timestamp is not None]
            asked = sorted({*both} - {*frames} | {*evenly(frames, _FRAMES)})
            # what a photograph looks like on its head is seen while others are read
            tasks = [
                *(partial(self._read, number) for number in numbers),
                *(partial(_gain_upside_down, self._glances[number]) for number in asked),
            ]
            readings, gains = [], []
            for done, result in enumerate(map_(lambda task: task(), tasks), 1):
                if isinstance(result, Reading):
                    readings.append(result)
                    progress("reading teeth", done, len(numbers))
                else:
                    gains.append(result)
            over = self._on_their_heads(dict(zip(asked, gains, strict=True)))
            for number, reading in zip(
                over, map_(partial(self._read, quarters=2), over), strict=True
            ):
                readings[number] = reading
        return readings

    def _on_their_heads(self, gains: dict[int, float | None]) -> list[int]:
        """The photographs to turn over, by what some of them gain by that, where it is known."""
        known = {number: gain for number, gain in gains.items() if gain is not None}
        if not known:
            return []
        every = float(np.mean([*known.values()]))

        def gain(number: int) -> float:
            own = known.get(number, every)
            clear = abs(own) > _MORE_UPRIGHT and self._views[number].timestamp is None
            return own if clear else every

        return [number for number in range(len(self._views)) if gain(number) > _MORE_UPRIGHT]

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


def read_photographs(views: Sequence[View], threads: int, progress: Progress) -> list[Reading]:
    """Read every photograph (`PhotographReader.read`)."""
    return PhotographReader(views, threads).read(progress)


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
