"""Numbers of teeth that a person has said."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

from pipeline.artifacts.dental.fdi import JAWS, permanent_of, teeth_of
from pipeline.artifacts.teeth import Dentition
from pipeline.errors import RequestError
from stages.init.dental.numbering.labellings.edits import Fixed
from stages.init.dental.template import position_of


def said_labels(dentitions: Sequence[Dentition], photos: Sequence[str]) -> Fixed:
    """Crowns whose number a person has said (doubt 0) -> position.

    Args:
        dentitions: of the photographs.
        photos: how the user knows them.

    Raises:
        RequestError: a primary tooth and its successor are said to stand in one place.
    """
    fixed: Fixed = {}
    said: dict[int, tuple[int, str]] = {}
    for view, dentition in enumerate(dentitions):
        for jaw, name in enumerate(JAWS):
            for crown, found in enumerate(dentition.crowns(name)):
                tooth = permanent_of(found.number)
                if found.doubt or tooth not in teeth_of(name):
                    continue
                fixed[view, jaw, crown] = position_of(tooth)
                number, photo = said.setdefault(tooth, (found.number, photos[view]))
                if number != found.number:
                    raise RequestError(
                        f"The tooth numbers given contradict each other: {number} in {photo}, "
                        f"{found.number} in {photos[view]}. A primary tooth and the one that "
                        "follows it have one place in the row: say the same of it everywhere; "
                        "where both stand, give one its number and remove the other."
                    )
    return fixed


def contradiction(photo: str, view: int, fixed: Fixed) -> str:
    """What to say of a photograph with numbers that no labelling has.

    Args:
        photo: how the user knows it.
        view: its index among the photographs.
        fixed: what was said.
    """
    rows = [
        [position for (v, j, _), position in sorted(fixed.items()) if (v, j) == (view, jaw)]
        for jaw in range(len(JAWS))
    ]
    steps = [after - before for row in rows for before, after in pairwise(row)]
    if len(steps) > 1 and max(steps) < 0:
        return (
            f"The tooth numbers given for {photo} run from left to right the wrong way: 11 to 18 "
            "and 41 to 48 are on the patient's right, which a photograph from the front shows on "
            "the left. Give each tooth the number of the other side; or say that the photograph is "
            "a mirror image, if it is one."
        )
    return (
        f"The tooth numbers given for {photo} contradict each other, or the teeth beside and "
        "opposite them: from left to right each crown is the next tooth of its row, and the same "
        "teeth of both jaws stand above each other; only two crowns that touch may have one "
        "number, as parts of one."
    )
