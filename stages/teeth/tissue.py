"""What of a photograph is tooth or gum, by the network: outlines in pixels of the photograph."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
import numpy.typing as npt

from pipeline.artifacts.teeth import filled_polygons
from stages.teeth.network import Answer

Array = npt.NDArray[np.float64]
Array32 = npt.NDArray[np.float32]

#: Logit outside of what the network saw.
_UNSEEN = -20.0
#: Pieces and holes of fewer than this share of the photograph are none.
_LEAST_SHARE = 2e-4
#: Outlines are thinned to so many pixels.
_TOLERANCE = 0.5


def on_jaws(
    answers: Sequence[Answer], size: tuple[int, int], behind: Sequence[Array] = (),
    margin: float = 0.0,
) -> tuple[Array, ...]:  # fmt: skip
    """`Dentition.on_jaws` from looks at one photograph.

    Args:
        answers: the looks; where several saw a place, the last one's word counts.
        size: width and height of the photograph.
        behind: [K, 2] polygons around what is seen through a gap between the rows, and is neither.
        margin: pixels around these that are neither.
    """
    logit = np.full((size[1], size[0]), _UNSEEN, np.float32)
    for answer in answers:
        there = _in_photograph(answer, np.ones_like(answer.on_jaws), size) > 0.99
        logit[there] = _in_photograph(answer, answer.on_jaws, size)[there]
    if behind:
        hidden = filled_polygons(tuple(behind), size).astype(np.uint8)
        reach = 2 * round(margin) + 1
        kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (reach, reach))
        logit[cv2.dilate(hidden, kernel) > 0] = _UNSEEN
    contours, _ = cv2.findContours(
        (logit > 0).astype(np.uint8), cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE
    )
    least = _LEAST_SHARE * size[0] * size[1]
    thinned = [
        cv2.approxPolyDP(contour, _TOLERANCE, True)[:, 0]
        for contour in contours
        if cv2.contourArea(contour) >= least
    ]
    return tuple(polygon.astype(np.float64) + 0.5 for polygon in thinned if len(polygon) >= 3)


def _in_photograph(answer: Answer, values: Array32, size: tuple[int, int]) -> Array32:
    """Maps [h, w] of an answer, brought to the pixels of the photograph."""
    there = np.array(cv2.invertAffineTransform(answer.answer_from_image), np.float64)
    there[:, 2] += there[:, :2] @ [0.5, 0.5] - 0.5  # OpenCV counts pixel centres as whole numbers
    return np.asarray(cv2.warpAffine(values, there, size, flags=cv2.INTER_LINEAR), np.float32)
