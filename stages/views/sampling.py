"""Order and choice of photographs: natural sorting, uniform sampling, numbered sequences."""

from __future__ import annotations

import re
from collections.abc import Sequence

import numpy as np

#: Fewer numbered photographs are as likely a clinic's protocol (frontal, right, left) as a sweep.
SHORTEST_SEQUENCE = 6


def natural_key(name: str) -> tuple[tuple[tuple[int, int, str], ...], str]:
    """Sort key under which ``img.png`` < ``img2.png`` < ``img10.png``; ties by the name itself.

    What comes last counts where it is a number, as in DICOM's ``1.2.840.9`` < ``1.2.840.10``.
    """
    stem, dot, suffix = name.casefold().rpartition(".")
    named = dot and not suffix.isdigit()
    parts = re.findall(r"[0-9]+|[^0-9]+", stem if named else name.casefold())
    return tuple((0, int(p), "") if p[0] in "0123456789" else (1, 0, p) for p in parts), name


def uniform_indices(count: int, wanted: int | None) -> list[int]:
    """Choose `wanted` of `count` uniformly, the first and the last among them (paper, section 4.1).

    All of them where `wanted` is None or at least `count`.
    """
    if wanted is None or wanted >= count:
        return list(range(count))
    return sorted({int(i) for i in np.linspace(0, count - 1, wanted).round()})


def even_in_time(times: Sequence[int], wanted: int) -> list[int]:
    """Choose `wanted` of frames that are shown at these times, rising, evenly in time.

    The first and the last are among them, and none is taken twice.
    """
    count = len(times)
    if wanted >= count:
        return list(range(count))
    aims = np.linspace(times[0], times[-1], wanted)
    nearest = np.interp(aims, times, np.arange(count)).round()
    chosen: list[int] = []
    for k, frame in enumerate(nearest):  # as near as those before it and after it leave room for
        least = chosen[-1] + 1 if chosen else 0
        chosen.append(min(max(int(frame), least), count - wanted + k))
    return chosen


def is_sequence(names: Sequence[str]) -> bool:
    """Do the names say that the photographs were taken in this order, as frames of a film are?

    True for at least six names that are the same but for one number, which grows from each to the
    next by the same step, or (after uniform sampling) by steps that differ by one at most.
    """
    if len(names) < SHORTEST_SEQUENCE:
        return False
    split = [re.split(r"([0-9]+)", name) for name in names]
    if len({len(parts) for parts in split}) != 1:
        return False
    changing = [n for n in range(len(split[0])) if len({parts[n] for parts in split}) > 1]
    if len(changing) != 1 or changing[0] % 2 == 0:  # odd places hold the numbers
        return False
    steps = np.diff([int(parts[changing[0]]) for parts in split])
    return bool(steps.min() >= 1 and steps.max() - steps.min() <= 1)
