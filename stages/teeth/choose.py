"""Which photographs take part: the right ones of a clinic's whole folder."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np
import numpy.typing as npt

from pipeline.artifacts.teeth import Dentition
from stages.dentition.corrections import SIDES, area, says_side, shows_less
from stages.teeth.grey import has_colour
from stages.teeth.read import Reading, row_extent

Array32 = npt.NDArray[np.float32]

#: Words for the kinds that are set aside.
_OCCLUSAL = {
    "upper": "the biting surfaces of the upper jaw",
    "lower": "the biting surfaces of the lower jaw",
}
#: With fewer crowns a photograph shows no row of teeth.
_LEAST_CROWNS = 5
#: A row of teeth narrower than this, over the photograph's long side, is a face.
_LEAST_EXTENT = 0.3
#: With a lower median score of its crowns, each counting by its area, a photograph shows something
#: else (clinics' photographs of teeth, braces too: .95 and more; of houses: .88 at most).
_LEAST_SCORE = 0.9
#: Two photographs whose crowns lie this near each other after a similarity transform, over the
#: width of their rows, show the same.
_SAME_VIEW = 0.02
#: The jaws are apart if that is so probable by the whole picture; or so, where every fourth upper
#: crown reaches down to a lower one: an open bite closes on the molars and shows a gap in front.
#: (Sides of 12 generated ones: .77 at most. Of 45 photographs with the jaws apart the outlines of 8
#: meet, tilted or touching: .86 at least.)
_APART, _SURELY_APART = 0.5, 0.8
#: Or if the gap between them (`Dentition.jaws_apart`) is larger.
_APART_GAP = 0.3
#: Photographs are compared in numbers that so many crowns have in common.
_COMMON_CROWNS = 5
#: Long side to which sharpness is compared.
_SHARPNESS_SIDE = 512


def choose(
    readings: Sequence[Reading], images: Sequence[Array32], names: Sequence[str]
) -> list[Dentition]:
    """Set aside, with a reason each, the photographs that tell nothing of the closed bite.

    Args:
        readings: of the photographs.
        images: [H, W, 3] float32 sRGB in 0..1 of each.
        names: how the user knows them.

    Returns:
        The dentitions, `set_aside` filled in.
    """
    reasons = [_unusable(*each) for each in zip(readings, images, strict=True)]
    for k, reason in _repeated(readings, images, names, reasons).items():
        reasons[k] = reason
    return [
        replace(reading.dentition, set_aside=reason)
        for reading, reason in zip(readings, reasons, strict=True)
    ]


def _unusable(reading: Reading, image: Array32) -> str:
    """Why a photograph by itself can't be used; empty: it can."""
    dentition = reading.dentition
    if not has_colour(image):
        return "it has no colour, as others have: an X-ray, or not a photograph"
    count = len(dentition.all_crowns)
    if count < _LEAST_CROWNS:
        return f"no row of teeth was found in it ({count} crown{'s' * (count != 1)})"
    if usual_score(dentition) < _LEAST_SCORE:
        return "what was found in it hardly looks like teeth"
    if row_extent(dentition) < _LEAST_EXTENT:
        return "the teeth are too small in it: a face, or taken from too far away"
    occlusal = {kind: reading.kinds[kind] for kind in _OCCLUSAL}
    jaw = max(occlusal, key=lambda kind: occlusal[kind])
    rows = (len(dentition.upper), len(dentition.lower))
    if sum(occlusal.values()) > 0.5:
        return f"it shows {_OCCLUSAL[jaw]}"
    if min(rows) <= 1 and max(rows) >= _LEAST_CROWNS and reading.kinds["other"] > 0.5:
        return "it shows one jaw only"
    if reading.apart > _least_apart(dentition) or dentition.jaws_apart > _APART_GAP:
        return "the jaws are apart in it"
    return ""


def _least_apart(dentition: Dentition) -> float:
    """How probable it must be, by the whole picture, that the jaws are apart."""
    return _SURELY_APART if dentition.jaws_apart == 0 else _APART


def usual_score(dentition: Dentition) -> float:
    """Median score of a photograph's crowns, each counting by its area.

    Crowns of a few pixels, such as those at the sides of a frontal photograph, score low, more so
    with brackets on them; of a house the large ones score low as well.
    """
    scores = np.array([crown.score for crown in dentition.all_crowns])
    areas = [area(crown.outline) for crown in dentition.all_crowns]
    order = np.argsort(scores)
    below = np.cumsum(np.array(areas)[order])
    return float(scores[order][np.searchsorted(below, below[-1] / 2)])


def _repeated(
    readings: Sequence[Reading], images: Sequence[Array32], names: Sequence[str],
    reasons: Sequence[str],
) -> dict[int, str]:  # fmt: skip
    """Photographs that show what a better one shows too -> why they are set aside."""
    usable = [k for k, reason in enumerate(reasons) if not reason]
    worth = {k: _worth(readings[k], images[k]) for k in usable}
    result: dict[int, str] = {}
    for k in sorted(usable, key=lambda k: -worth[k]):
        for other in sorted(usable, key=lambda k: -worth[k]):
            if other == k:
                break
            if other in result or likely(readings[k]) != likely(readings[other]):
                continue
            if SIDES.get(says_side(names[k])) == says_side(names[other]) != "":
                continue  # one is a mirror image, and of another side
            off = layout_distance(readings[k].dentition, readings[other].dentition)
            if off is not None and off < _SAME_VIEW:
                result[k] = shows_less(names[other])
                break
    return result


def likely(reading: Reading) -> str:
    """From the front or from which side a photograph is likeliest taken."""
    return max(("front", "right", "left"), key=lambda kind: reading.kinds[kind])


def _worth(reading: Reading, image: Array32) -> float:
    """How much a photograph tells: crowns found surely; then sharpness."""
    crowns = sum(c.score * (1 - c.doubt) for c in reading.dentition.all_crowns)
    scale = _SHARPNESS_SIDE / max(image.shape[:2])
    grey = cv2.cvtColor(cv2.resize(image, None, fx=scale, fy=scale), cv2.COLOR_RGB2GRAY)
    sharpness = float(np.abs(cv2.Laplacian(grey, cv2.CV_32F)).mean())
    return crowns + 10 * sharpness


def layout_distance(a: Dentition, b: Dentition) -> float | None:
    """How differently two photographs show the same crowns: RMS over the row's width, after a
    similarity transform; None where they have too few numbers in common."""
    first = {crown.number: crown.centre for crown in a.all_crowns if crown.number}
    second = {crown.number: crown.centre for crown in b.all_crowns if crown.number}
    common = sorted(set(first) & set(second))
    if len(common) < max(_COMMON_CROWNS, 0.6 * min(len(first), len(second))):
        return None
    p = np.array([complex(*first[tooth]) for tooth in common])
    q = np.array([complex(*second[tooth]) for tooth in common])
    p, q = p - p.mean(), q - q.mean()
    factor = (np.conj(p) @ q) / max(float((np.abs(p) ** 2).sum()), 1e-9)
    residual = np.sqrt((np.abs(factor * p - q) ** 2).mean())
    return float(residual / max(np.abs(q).max() * 2, 1e-9))
