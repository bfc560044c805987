"""Read all photographs of a case."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import cv2
import numpy as np

from pipeline.artifacts.views import View
from stages.teeth.instances import find_crowns
from stages.teeth.network import fitted, look
from stages.teeth.read import (
    Reading,
    look_turned,
    read_photograph,
    shows_both_rows,
    uprightness,
)

Progress = Callable[[str, int, int], None]

#: So many photographs, evenly chosen, are asked whether a case is one of teeth at all; more than
#: this share must show them.
_ASKED, _SHARE = 3, 0.3
#: Share of a photograph that is tooth, and crowns in it, to show teeth.
_LEAST_TOOTH, _LEAST_CROWNS = 0.015, 6
#: Score of a crown at the first look that counts for that.
_SURE = 0.8
#: Photographs stand on their heads if they look so much more upright that way, on average: those of
#: twelve patients lose .45 to .77.
_MORE_UPRIGHT = 0.2


def shows_teeth(views: Sequence[View]) -> bool:
    """Is this a case of teeth? One quick look at a few photographs."""
    chosen = np.unique(np.linspace(0, len(views) - 1, min(len(views), _ASKED)).round().astype(int))
    votes = [_has_teeth(views[int(k)]) for k in chosen]
    return bool(votes) and sum(votes) > _SHARE * len(votes)


def _has_teeth(view: View) -> bool:
    answer = look(view.image, view.valid(), fitted((view.height, view.width)), flip=False)
    if float((answer.tooth > 0).mean()) < _LEAST_TOOTH:
        return False
    return sum(crown.score > _SURE for crown in find_crowns(answer)) >= _LEAST_CROWNS


def read_photographs(views: Sequence[View], threads: int, progress: Progress) -> list[Reading]:
    """Read every photograph; the result does not depend on the number of threads.

    Photographs are turned the right way up where that is clear, each by itself or, if all were
    taken from behind the patient's head, together; the outlines remain those of the photographs.
    """
    before = cv2.getNumThreads()
    cv2.setNumThreads(max(1, threads))
    try:
        readings = []
        for number, view in enumerate(views):
            progress("reading teeth", number, len(views))
            readings.append(read_photograph(view.image, view.valid(), view.name))
        if _upside_down(views):
            readings = [
                read_photograph(view.image, view.valid(), view.name, quarters=2) for view in views
            ]
        progress("reading teeth", len(views), len(views))
        return readings
    finally:
        cv2.setNumThreads(before)


def _upside_down(views: Sequence[View]) -> bool:
    """Do the photographs stand on their heads, by those that show both rows of teeth?"""
    gains = []
    for view in views:
        looks = [look_turned(view.image, view.valid(), quarters) for quarters in (0, 2)]
        if all(shows_both_rows(crowns) for _, crowns in looks):
            present, opposite = (uprightness(answer, crowns) for answer, crowns in looks)
            gains.append(opposite - present)
    return bool(gains) and float(np.mean(gains)) > _MORE_UPRIGHT
