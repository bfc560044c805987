"""Which frames of a film to take: spread evenly by how much they differ, not by time.

A hand that films rests, at the ends above all, and frames that are even in time repeat what it
rests upon: with half a film at rest, unseen views of the scan video lose 5 dB, with a third 2. The
settings were chosen on four films of two generated mouths, with a hand that shakes, and with half a
second of other things at either end.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
import numpy.typing as npt

from stages.views.sampling import uniform_indices

Floats = npt.NDArray[np.float32]

#: Blur of a glance before it is compared, pixels: a hand that shakes is no other view.
BLUR = 1.5
#: A film is even where no two key frames that follow each other differ by more or less than this
#: factor from the usual.
EVEN = 2.0
#: What counts as another view at all: a film that never differs by this stands still.
STILL = 0.1
#: What differs by more from the glances before and after it is the phone's way to the mouth or
#: back, or a cut: nothing that others show too.
HURRIED = 0.5
#: Frames are no nearer to each other in time, and no further apart, than these, times what they
#: would be if even in time: what a glance does not tell may still be new.
NEAREST, FURTHEST = 1 / 3, 2.0


def distances(glances: Sequence[npt.NDArray[np.uint8]]) -> Floats:
    """[K, K] how much K small grey pictures differ: 0 the same, 1.4 nothing in common.

    The length between their values, blurred, without their mean, at length 1: a change of exposure
    counts for nothing. Frames of a mouth differ by .2 at 10 degrees from each other, and by .4 at
    22.
    """
    height, width = glances[0].shape
    looks = []
    for glance in glances:
        fitting = cv2.resize(glance, (width, height)) if glance.shape != (height, width) else glance
        looks.append(cv2.GaussianBlur(fitting.astype(np.float32), (0, 0), BLUR).ravel())
    values: Floats = np.array(looks, np.float32)
    values = values - values.mean(1, keepdims=True)
    values = values / np.maximum(np.linalg.norm(values, axis=1, keepdims=True), np.float32(1e-6))
    return np.sqrt(np.maximum(2 - 2 * values @ values.T, np.float32(0)))


def is_even(apart: Floats) -> bool:
    """Do pictures with these distances [K, K] follow each other at about one pace?"""
    steps = np.diagonal(apart, 1)
    usual = float(np.median(steps))
    return bool(steps.max() <= EVEN * usual and steps.min() * EVEN >= usual)


def spread_indices(places: Sequence[int], apart: Floats, count: int, wanted: int) -> list[int]:
    """Choose frames so that each differs about as much from the next.

    From the first on, the next one is the first that differs by a limit, and the limit is such that
    as many come out as are wanted: a hand that shakes at rest gets nowhere.

    Args:
        places: [K] numbers of the frames that were glanced at, rising.
        apart: [K, K] how much they differ.
        count: frames of the film.
        wanted: frames to choose, the first and the last glance among them.
    """
    if len(places) < wanted or apart.max() < STILL:
        return uniform_indices(count, wanted)
    even = count / (wanted - 1)
    low, high = 0.0, float(apart.max())
    chosen = list(range(len(places)))
    for _ in range(20):
        limit = (low + high) / 2
        found = _by_limit(places, apart, limit, even)
        if len(found) < wanted:
            high = limit
        else:
            low, chosen = limit, found
    while len(chosen) > wanted:
        between = [apart[a, b] for a, b in zip(chosen, chosen[2:], strict=False)]
        del chosen[1 + int(np.argmin(between))]
    return [places[k] for k in chosen]


def _by_limit(places: Sequence[int], apart: Floats, limit: float, even: float) -> list[int]:
    """[M] numbers of glances, each of which differs by the limit from the one before it.

    Args:
        even: frames from one to the next if they were even in time.
    """
    chosen = [0]
    for k in range(1, len(places) - 1):
        passed = places[k] - places[chosen[-1]]
        seen = min(apart[k - 1, k], apart[k, k + 1]) < HURRIED
        new = seen and apart[chosen[-1], k] >= limit
        if passed >= (NEAREST if new else FURTHEST) * even:
            chosen.append(k)
    last = len(places) - 1
    if len(chosen) > 1 and apart[chosen[-1], last] < limit / 2:
        chosen.pop()
    return [*chosen, last]
