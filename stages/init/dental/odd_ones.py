"""Photographs that do not belong to the others: found by what agrees without them."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator
from dataclasses import replace
from itertools import combinations, product

from pipeline.artifacts.teeth import Dentition
from pipeline.errors import ReconstructionError
from stages.dentition.corrections import SIDES
from stages.init.dental.mirror_images import Fit, Turned, is_said

#: What makes a mouth: one from the front and one from each side. Three others are always doubtful.
COMPLETE = ("front", *SIDES)
#: Where another set of as many is as sure but for this, nobody can tell which is right: those of
#: twelve patients have .94 to 1.
AS_SURE = 0.05
#: Of more sets it takes too long to try each: two of every kind are eight, three of each 27.
MOST_TRIED = 12

Set = frozenset[int]


class SeveralMouthsError(ReconstructionError):
    """Photographs are of two patients, or of two visits of one, or half of them may be."""


def without_odd_ones(turned: Turned, fit: Fit, kept: Collection[int]) -> Turned:
    """Leave out photographs with which a fit is doubtful and without which it is not.

    A close-up of some teeth, or one of another patient, says nothing against three others that
    agree. Each set of one from the front and one from either side is tried; to the surest that
    agrees comes, one after the other, what agrees with it. Of three, nobody can tell which of them
    is right.

    Args:
        turned: a doubtful fit.
        fit: places photographs; those without a dentition take no part.
        kept: photographs that stay whatever they show.

    Returns:
        The fit of those that agree, if they are more than the others and no other set of as many is
        as sure: whose case it is else, nobody can tell. `turned` where none do; with `mouths` where
        half of them do, or two sets that have no photograph in common and no mixture of them.
    """
    there = frozenset(k for k, dentition in enumerate(turned.dentitions) if dentition is not None)
    stay = frozenset(k for k in there if _stays(turned.dentitions[k], k, kept))
    tried = [some for some in _complete(turned, there) if some != there]
    if len(tried) > MOST_TRIED:
        return turned
    agree = _agreeing(turned, tried, fit)
    if len(agree) == 2 and not frozenset.intersection(*agree):
        one, other = (tuple(sorted(some)) for some in agree)
        return replace(turned, mouths=(one, other))
    best, as_good = Set(), 0
    while agree:
        rank = {some: (len(some & stay), one.fit.confidence) for some, one in agree.items()}
        best = max(rank, key=rank.__getitem__)
        found, (stays, sure) = agree[best], rank[best]
        as_good = sum(rank[some] > (stays, sure - AS_SURE) for some in rank)
        larger = [best | {k} for k in sorted(there - best) if len(best) + 1 < len(there)]
        agree = _agreeing(turned, larger, fit)
    if as_good != 1 or not stay <= best:
        return turned
    if 2 * len(best) <= len(there):
        return replace(turned, mouths=(tuple(sorted(best)),))
    return replace(found, left_out=tuple(sorted(there - best)), reasons=turned.fit.doubts)


def _stays(dentition: Dentition | None, number: int, kept: Collection[int]) -> bool:
    return dentition is not None and (number in kept or is_said(dentition))


def _complete(turned: Turned, there: Set) -> Iterator[Set]:
    """Sets of three that may make a mouth: one of each kind; where one is missing, for a kind may
    be read wrongly, any three."""
    kinds = {k: dentition.kind for k in there if (dentition := turned.dentitions[k]) is not None}
    of_each = [[k for k in sorted(there) if kinds[k] == kind] for kind in COMPLETE]
    if all(of_each):
        yield from map(frozenset, product(*of_each))
    else:
        yield from map(frozenset, combinations(sorted(there), len(COMPLETE)))


def _agreeing(turned: Turned, tried: Iterable[Set], fit: Fit) -> dict[Set, Turned]:
    """Those of some sets of photographs that agree, with their fits."""
    agree = {}
    for some in tried:
        dentitions = [d if k in some else None for k, d in enumerate(turned.dentitions)]
        found = replace(turned, dentitions=dentitions, fit=fit(turned.views, dentitions))
        if not found.fit.doubts:
            agree[some] = found
    return agree
