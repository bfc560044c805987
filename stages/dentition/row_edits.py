"""Other labels of a row of crowns: gaps, parts of one crown, crowns that are none, shifts."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from itertools import pairwise

from stages.dentition.tooth_rows import NO_TOOTH, POSITIONS, Labels


def contiguous(first: int, count: int) -> Labels:
    """Labels of a row without gaps that begins at position `first`; none beyond the ends."""
    return tuple(first + i if 0 <= first + i < POSITIONS else NO_TOOTH for i in range(count))


def bounded(labels: list[int]) -> Labels:
    """Labels with those beyond the row's ends made `NO_TOOTH`."""
    return tuple(label if 0 <= label < POSITIONS else NO_TOOTH for label in labels)


def shifted(labels: Labels, chosen: list[bool], by: int) -> list[int]:
    """Labels with those chosen moved along the row."""
    return [
        label + by if take and label != NO_TOOTH else label
        for label, take in zip(labels, chosen, strict=True)
    ]


def row_edits(labels: Labels, wholes: Collection[int] = ()) -> list[Labels]:
    """Other labels of one row: a gap, a crown that is none or two, no gaps at all, a shift.

    Args:
        labels: of the row.
        wholes: the first of each two neighbours that may be parts of one crown.
    """
    count = len(labels)
    edits = {edit for first in wholes for edit in joining_edits(labels, first)}
    for i, label in enumerate(labels):
        if label == NO_TOOTH:
            continue
        edits.add(contiguous(label - i, count))
        if i in (0, count - 1):
            # A row's end may be the next tooth but one, the one between hidden; or none.
            outward = -1 if i == 0 else 1
            for other in (label + outward, label - outward, NO_TOOTH):
                edits.add(bounded([*labels[:i], other, *labels[i + 1 :]]))
            continue
        for side in (-1, 1):
            beyond = [(k - i) * side > 0 for k in range(count)]
            if any(beyond):
                edits.add(bounded(shifted(labels, beyond, side)))
            for by in (-side, side):
                changed = shifted(labels, beyond, by)
                changed[i] = NO_TOOTH
                edits.add(bounded(changed))
            if 0 < i + side < count - 1:
                changed = shifted(labels, beyond, -side)
                changed[i] = changed[i + side] = NO_TOOTH
                edits.add(bounded(changed))
    for by in (-1, 1):
        edits.add(bounded(shifted(labels, [True] * count, by)))
    edits.discard(labels)
    return sorted(
        edit for edit in edits if is_ordered(edit, wholes) and sum(e != NO_TOOTH for e in edit) >= 2
    )


def joining_edits(labels: Labels, first: int) -> Iterator[Labels]:
    """A crown and the next one as parts of one: the others as they are, or a tooth nearer."""
    before, after = labels[:first], labels[first + 2 :]
    whole = {label for label in labels[first : first + 2] if label != NO_TOOTH}
    whole |= {label + 1 for label in before[-1:] if label != NO_TOOTH}
    whole |= {label - 1 for label in after[:1] if label != NO_TOOTH}
    for label in sorted(whole):
        for back, ahead in ((0, 0), (1, 0), (0, -1)):
            moved = [
                other + step if other != NO_TOOTH else other
                for part, step in ((before, back), (after, ahead))
                for other in part
            ]
            yield bounded([*moved[:first], label, label, *moved[first:]])


def is_ordered(labels: Labels, wholes: Collection[int]) -> bool:
    """Does each crown follow the one before, the two of each pair of parts being one?"""
    parts = [k for k, (a, b) in enumerate(pairwise(labels)) if a == b != NO_TOOTH]
    named = [label for k, label in enumerate(labels) if label != NO_TOOTH and k - 1 not in parts]
    return (
        all(k in wholes and k - 1 not in parts for k in parts)
        and all(b > a for a, b in pairwise(named))
    )  # fmt: skip
