"""Photographs that are mirror images: found, and turned back where it is certain."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

from pipeline.artifacts.teeth import Dentition
from pipeline.artifacts.views import View
from stages.dentition.corrections import SIDES, says_side
from stages.dentition.crowns import mirrored_dentition
from stages.dentition.tooth_rows import number_is_said
from stages.init.dental.solution import ArchFit

#: Places the photographs, with their teeth.
Fit = Callable[[list[View], list[Dentition | None]], ArchFit]
#: Of so many photographs at least one from the front may be turned back. Of 24 pairs of it and one
#: side (twelve patients) two look as if it were a mirror image, and pass, turned over, with numbers
#: that are wrong.
FRONT_TURNED = 3


@dataclass(frozen=True)
class Turned:
    """Photographs as they should have been given.

    Attributes:
        views, dentitions: with mirror images turned back.
        fit: what was found with them.
        mirrored: which were turned back.
        left_out: which take no part, for the others agree without them (`odd_ones`).
        reasons: the doubts about a fit with those that were left out.
        mouths: one or two sets of photographs that agree each by itself, but not with the others.
    """

    views: list[View]
    dentitions: list[Dentition | None]
    fit: ArchFit
    mirrored: tuple[int, ...] = ()
    left_out: tuple[int, ...] = ()
    reasons: tuple[str, ...] = ()
    mouths: tuple[tuple[int, ...], ...] = ()


def fit_turned(
    views: list[View], dentitions: list[Dentition | None], names: Sequence[str], fit: Fit
) -> Turned:
    """Place the photographs; where some seem to be mirror images, turn those back and try again.

    Turned back are those with which nothing is doubtful any more, if only one way leads there;
    never those of which a person has said what they are, or a tooth's number: it would be that of
    the other side.

    Args:
        views, dentitions: photographs and the crowns in them (None: it takes no part).
        names: how the user knows them; one that says right or left tells which side was meant.
        fit: places them.
    """
    first = fit(views, dentitions)
    good = []
    asked = {k for k, dentition in enumerate(dentitions) if dentition and is_said(dentition)}
    for mirrored in turnings(first, names) if first.doubts else []:
        if asked & set(mirrored):
            continue
        turned = Turned(
            [view.mirrored() if k in mirrored else view for k, view in enumerate(views)],
            [
                mirrored_dentition(dentition) if dentition and k in mirrored else dentition
                for k, dentition in enumerate(dentitions)
            ],
            first,
            mirrored,
        )
        turned = replace(turned, fit=fit(turned.views, turned.dentitions))
        if not turned.fit.doubts and turned.fit.confidence > first.confidence:
            good.append(turned)
    return good[0] if len(good) == 1 else Turned(views, dentitions, first)


def turnings(fit: ArchFit, names: Sequence[str]) -> list[tuple[int, ...]]:
    """Sets of photographs that may be mirror images, those alone that their names speak for.

    A photograph from the front fits those of the sides better turned over if it is a mirror image
    or if both of them are: only their names tell. Of two photographs of one side one may be a
    mirror image of the other side.
    """
    roles = [placed.role if placed else "" for placed in fit.views]
    sides = [k for k, role in enumerate(roles) if role in SIDES]
    wrong = [k for k in sides if says_side(names[k]) == SIDES[roles[k]]]
    right = [k for k in sides if says_side(names[k]) == roles[k]]
    if len(sides) > 1 and len({roles[k] for k in sides}) == 1:
        return [(k,) for k in wrong] or [(k,) for k in sides if k not in right]
    if not fit.mirrored:
        return []
    if right and not wrong:
        return [fit.mirrored] if sum(map(bool, roles)) >= FRONT_TURNED else []
    return [tuple(sides)] if wrong and not right else []


def is_said(dentition: Dentition) -> bool:
    """Has a person said how the photograph shows the patient's sides?"""
    numbered = any(map(number_is_said, dentition.all_crowns))
    return dentition.mirrored is not None or numbered
