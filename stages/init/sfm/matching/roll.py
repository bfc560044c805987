"""Photographs rolled about the viewing axis: by how much, told by oriented features.

Upright features stand up to about 20 degrees of roll. Where they leave photographs without a link,
oriented ones, weaker but blind to roll, say how each photograph is turned against the others;
upright features of the photograph turned back then do the work.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
import numpy.typing as npt
from threadpoolctl import threadpool_limits

from pipeline.artifacts.cameras import Camera
from pipeline.geometry.graph import Pair
from pipeline.kernels.threads import in_threads
from stages.init.sfm.matching.features import Features, oriented_features
from stages.init.sfm.matching.match import match_features
from stages.init.sfm.matching.two_view import coherent_matches, unrolled
from stages.init.sfm.options import COHERENCE_RADIUS

#: Rolls smaller than this are no reason to try again: upright features stand them.
SMALLEST_ROLL = 12.0
#: Width in degrees of the window in which matches say the same roll.
AGREEMENT = 30.0
#: Coherent matches that must agree on a roll.
LEAST_VOTES = 15
#: Oriented features of a view: rolled photographs that overlap match by a few hundred of them.
ORIENTED_FEATURES = 2500


@dataclass(frozen=True)
class RelativeRoll:
    """How much clockwise (in the image, degrees) the second of two views is rolled against the
    first, and how many coherent matches say so."""

    degrees: float
    votes: int


def find_rolls(
    grays: list[npt.NDArray[np.uint8]],
    valid: list[npt.NDArray[np.bool_]],
    linked: list[Pair],
    peak_threshold: float,
    pixel: float,
    threads: int,
    progress: Callable[[str, int, int], None],
) -> list[float]:
    """The roll of every view against the largest group of linked ones.

    Args:
        grays: N images [H, W] uint8.
        valid: N masks [H, W].
        linked: the pairs that upright features link.
        peak_threshold: of SIFT.
        pixel: size of the images relative to the reference size.
        threads: change nothing but the time.
        progress: called with (step, done, total).

    Returns:
        N angles in degrees, clockwise; 0 where nothing is known or nothing is to be done.
    """
    count = len(grays)
    group = groups(linked, count)
    if len(set(group)) == 1:
        return [0.0] * count

    def detect(view: int) -> tuple[Features, npt.NDArray[np.float64]]:
        return oriented_features(grays[view], valid[view], peak_threshold, ORIENTED_FEATURES)

    features = in_threads(detect, range(count), threads)
    pairs = [(i, j) for i, j in combinations(range(count), 2) if group[i] != group[j]]

    def compare(pair: Pair) -> RelativeRoll:
        (first, turns_i), (second, turns_j) = features[pair[0]], features[pair[1]]
        found = match_features(first, second, ratio=0.85)
        return relative_roll(
            first.positions[found[:, 0]], second.positions[found[:, 1]],
            turns_j[found[:, 1]] - turns_i[found[:, 0]], COHERENCE_RADIUS * pixel,
        )  # fmt: skip

    with threadpool_limits(1, "blas"):
        answers = in_threads(
            compare, pairs, threads, lambda done: progress("rolled photographs", done, len(pairs))
        )
    return _rolls_across(group, dict(zip(pairs, answers, strict=True)))


def rolls_of_cameras(cameras: Sequence[Camera], linked: list[Pair]) -> list[float]:
    """As `find_rolls`, for N cameras that are known; those that look alike say it."""
    group = groups(linked, len(cameras))
    told = {}
    for i, j in combinations(range(len(cameras)), 2):
        if group[i] == group[j]:
            continue
        turn = cameras[j].rotation @ cameras[i].rotation.T
        roll = np.degrees(np.arctan2(turn[1, 0] - turn[0, 1], turn[0, 0] + turn[1, 1]))
        away = np.degrees(np.arccos(np.clip(turn[2, 2], -1, 1)))
        told[i, j] = RelativeRoll(float(roll), round(180 - float(away)))
    return _rolls_across(group, told)


def _rolls_across(group: list[int], told: dict[Pair, RelativeRoll]) -> list[float]:
    """Rolls [N] of views against their largest group, by what pairs of different groups say."""
    rolls = [0.0] * len(group)
    sizes = {number: group.count(number) for number in group}
    known = {max(sizes, key=lambda number: (sizes[number], -number))}
    while True:
        open_pairs = [
            (i, j) for i, j in told
            if (group[i] in known) != (group[j] in known) and told[i, j].votes >= LEAST_VOTES
        ]  # fmt: skip
        if not open_pairs:
            break
        i, j = max(open_pairs, key=lambda pair: (told[pair].votes, (-pair[0], -pair[1])))
        forward = group[i] in known
        joined = group[j] if forward else group[i]
        roll = rolls[i] + told[i, j].degrees if forward else rolls[j] - told[i, j].degrees
        for view in range(len(group)):
            if group[view] == joined:
                rolls[view] = roll
        known.add(joined)
    rolls = [(roll + 180) % 360 - 180 for roll in rolls]
    return [roll if abs(roll) >= SMALLEST_ROLL else 0.0 for roll in rolls]


def groups(linked: list[Pair], count: int) -> list[int]:
    """[N] for each view the lowest view that links lead to."""
    group = list(range(count))
    for _ in range(count):
        for i, j in linked:
            group[i] = group[j] = min(group[i], group[j])
    return group


def relative_roll(
    positions_i: npt.NDArray[np.float64],
    positions_j: npt.NDArray[np.float64],
    turns: npt.NDArray[np.float64],
    radius: float,
) -> RelativeRoll:
    """The roll on which most matches agree.

    Args:
        positions_i, positions_j: [M, 2] matches in pixels.
        turns: [M] by how many radians each match's orientation turns.
        radius: pixels in which neighbours must move along once the roll is taken out.
    """
    if not len(turns):
        return RelativeRoll(0.0, 0)
    degrees = np.degrees(turns) % 360
    apart = np.abs((degrees[:, None] - degrees[None] + 180) % 360 - 180) <= AGREEMENT / 2
    best = int(apart.sum(1).argmax())
    inside = apart[best]
    mean = float(np.degrees(np.angle(np.exp(1j * np.radians(degrees[inside])).mean())))
    coherent = coherent_matches(
        positions_i[inside], unrolled(positions_j[inside], mean), radius
    )  # fmt: skip
    return RelativeRoll(mean, int(coherent.sum()))
