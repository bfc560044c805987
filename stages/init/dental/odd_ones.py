"""Photographs beside a complete set that do not belong to it: found by leaving them out."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace

from stages.init.dental.mirror_images import Fit, Turned, is_said

#: So many stay: of three, one is from the front and one from each side, or the fit is doubtful.
FEWEST = 3
#: Of more it takes too long to try each.
MOST = 6


def without_odd_ones(turned: Turned, fit: Fit, kept: Collection[int]) -> Turned:
    """Leave out photographs with which a fit is doubtful and without which it is not.

    A close-up of some teeth, or one of another patient, says nothing against three others that
    agree. One goes after the other, each time that without which the rest agrees best; where three
    still disagree, nobody can tell which of them is right, and all stay.

    Args:
        turned: a doubtful fit.
        fit: places photographs; those without a dentition take no part.
        kept: photographs that stay whatever they show.

    Returns:
        The fit of those that agree, or `turned`.
    """
    rest = turned
    count = sum(dentition is not None for dentition in turned.dentitions)
    if count > MOST:
        return turned
    for _ in range(count - FEWEST):
        fewer = [_without(rest, k, fit) for k in range(len(rest.views)) if _may_go(rest, k, kept)]
        if not fewer:
            break
        rest = min(fewer, key=lambda less: (len(less.fit.doubts), -less.fit.confidence))
        if not rest.fit.doubts:
            return replace(rest, reasons=turned.fit.doubts)
    return turned


def _may_go(turned: Turned, number: int, kept: Collection[int]) -> bool:
    dentition = turned.dentitions[number]
    return dentition is not None and number not in kept and not is_said(dentition)


def _without(turned: Turned, number: int, fit: Fit) -> Turned:
    dentitions = [None if k == number else d for k, d in enumerate(turned.dentitions)]
    return replace(
        turned,
        dentitions=dentitions,
        fit=fit(turned.views, dentitions),
        left_out=(*turned.left_out, number),
    )
