"""Millimetres from teeth whose width is known."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from pipeline.artifacts.dental.fdi import permanent_of, teeth_of
from pipeline.artifacts.dental.sizes import TEXTBOOK_DEVIATION
from pipeline.errors import RequestError
from stages.init.dental.landmarks import Landmark
from stages.init.dental.solution import ArchFit

#: Relative standard deviation of a crown's width as it comes out between its landmarks: .059 of 213
#: crowns of eleven generated mouths, .07 of incisors and .05 of the others.
WIDTH_DEVIATION = 0.06
#: Scales by two crowns that are further apart than this contradict each other: three deviations.
DISAGREEING = 3 * 2**0.5 * WIDTH_DEVIATION


def crown_width(fit: ArchFit, tooth: int) -> float | None:
    """Distance in mm of the arch frame between where a crown touches its two neighbours, if seen.

    Contacts lie between papilla and embrasure; what was seen of either is taken.
    """
    order = teeth_of("upper" if tooth < 30 else "lower")
    position = order.index(tooth)
    if position in (0, len(order) - 1):
        return None
    widths = []
    for kind in ("papilla", "embrasure"):
        before = fit.landmarks.get(Landmark(kind, order[position - 1], tooth))
        after = fit.landmarks.get(Landmark(kind, tooth, order[position + 1]))
        if before is not None and after is not None:
            widths.append(float(np.linalg.norm(after - before)))
    return float(np.mean(widths)) if widths else None


def scale_from_widths(fit: ArchFit, widths: Mapping[int, float]) -> tuple[float, float]:
    """True millimetres per millimetre of the arch frame, and the relative standard deviation.

    Args:
        widths: FDI number -> mesiodistal width in mm, of a primary tooth that stands there as well;
            none: the textbook's scale.

    Raises:
        RequestError: none of these teeth was seen with both its neighbours.
    """
    if not widths:
        return 1.0, TEXTBOOK_DEVIATION
    ratios = _ratios(fit, widths)
    if not ratios:
        raise RequestError(
            f"init.dental.tooth_widths: of the teeth named ({', '.join(map(str, sorted(widths)))}) "
            "none was seen with both its neighbours, so that the scale can't be told. Name other "
            "teeth, such as 11 or 21."
        )
    found = np.array(list(ratios.values()))
    spread = float(np.log(found).std(ddof=1)) if len(found) > 1 else 0.0
    return float(np.median(found)), max(WIDTH_DEVIATION, spread) / float(np.sqrt(len(found)))


def width_doubts(fit: ArchFit, widths: Mapping[int, float]) -> list[str]:
    """What to say of widths that do not count, and of such as contradict each other."""
    ratios = _ratios(fit, widths)
    doubts = []
    if unseen := [str(tooth) for tooth in sorted(widths) if tooth not in ratios]:
        doubts.append(
            f"init.dental.tooth_widths: {', '.join(unseen)} tells nothing of the scale, for not "
            "both neighbours were seen."
        )
    least, most = (pick(ratios, key=lambda tooth: ratios[tooth]) for pick in (min, max))
    more = ratios[most] / ratios[least] - 1
    if more > DISAGREEING:
        doubts.append(
            f"init.dental.tooth_widths contradict each other: by {most} the mouth is {more:.0%} "
            f"larger than by {least}. Is one of them mistyped, or of another tooth?"
        )
    return doubts


def _ratios(fit: ArchFit, widths: Mapping[int, float]) -> dict[int, float]:
    """FDI number -> its width over that in the arch frame, of those seen with both neighbours."""
    return {
        tooth: known / measured
        for tooth, known in sorted(widths.items())
        if (place := permanent_of(tooth)) in (*teeth_of("upper"), *teeth_of("lower"))
        and (measured := crown_width(fit, place)) is not None
    }
