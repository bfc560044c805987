"""One crown that was read as two.

A groove between the cusps of a molar, a filling or a wire can look like the border between two
teeth. What lies on either side still looks like the same place in the row.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import cv2
import numpy as np
import numpy.typing as npt

from pipeline.artifacts.dental.fdi import JAWS
from pipeline.artifacts.teeth import Crown, Dentition
from stages.dentition.crowns import GAP, Outline, outline_of, with_outlines
from stages.dentition.tooth_rows import crown_evidence

Array = npt.NDArray[np.float64]

#: Neighbours that look like the same place in the row with less probability are two crowns. Of 75
#: labelled photographs 80 of 776 pairs of neighbours have more, among them 10 of the 13 that are
#: one tooth.
LEAST_ALIKE = 0.15
#: Pixels of the picture in which parts are joined, for each of the photograph.
_FINER = 4.0


def perhaps_one(first: Crown, second: Crown) -> bool:
    """May two neighbours of one jaw be parts of one crown?"""
    if min(len(first.outline), len(second.outline)) < 3:
        return False
    evidence = [np.exp(crown_evidence(crown, crown.jaw)) for crown in (first, second)]
    if float(evidence[0] @ evidence[1]) < LEAST_ALIKE:
        return False
    return _distance(first.outline, second.outline) <= GAP * min(first.width, second.width)


def _distance(first: Array, second: Array) -> float:
    """Least distance between the corners of two outlines."""
    return float(np.linalg.norm(first[:, None] - second[None], axis=2).min())


def joined_parts(dentition: Dentition, rows: Sequence[Sequence[int]]) -> Dentition:
    """The dentition with neighbours that have the same number joined to one crown.

    Args:
        dentition: as read.
        rows: number of each crown of the upper and of the lower row, 0: none.
    """
    outlines: list[Outline] = []
    changed = False
    for jaw, numbers in zip(JAWS, rows, strict=True):
        mine = [outline_of(crown) for crown in dentition.crowns(jaw)]
        for k, (one, other) in reversed(list(enumerate(pairwise(numbers)))):
            if one == other != 0:
                mine[k : k + 2] = [_joined(mine[k], mine[k + 1])]
                changed = True
        outlines += mine
    if not changed:
        return dentition
    return with_outlines(dentition, outlines)


def _joined(first: Outline, second: Outline) -> Outline:
    """One crown of two parts: what lies between them where they are nearest is filled."""
    both = np.concatenate([first.polygon, second.polygon])
    corner = both.min(axis=0) - 2
    size = np.ceil((both.max(axis=0) + 2 - corner) * _FINER).astype(int)
    mask = np.zeros((size[1], size[0]), np.uint8)
    for part in (first, second):
        cv2.fillPoly(mask, [np.round((part.polygon - corner) * _FINER).astype(np.int32)], 1)
    reach = max(3, 2 * round(_FINER * _distance(first.polygon, second.polygon)) + 3)
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (reach, reach))
    padded = cv2.copyMakeBorder(mask, reach, reach, reach, reach, cv2.BORDER_CONSTANT, value=0)
    closed = cv2.morphologyEx(padded, cv2.MORPH_CLOSE, kernel)
    contours, _ = cv2.findContours(closed, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    contour = cv2.approxPolyDP(max(contours, key=cv2.contourArea), _FINER / 4, True)[:, 0]
    numbers = {
        tooth: (first.numbers.get(tooth, 0.0) + second.numbers.get(tooth, 0.0)) / 2
        for tooth in {**first.numbers, **second.numbers}
    }
    said = next((part for part in (first, second) if part.doubt == 0), first)
    return replace(
        said, polygon=(contour - reach) / _FINER + corner,
        score=max(first.score, second.score), numbers=numbers,
    )  # fmt: skip
