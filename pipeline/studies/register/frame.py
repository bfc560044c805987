"""A first common frame: teeth of the same number, whatever some of them have done since."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import numpy.typing as npt

from pipeline.geometry.similarity import robust_similarity, similarity

Array = npt.NDArray[np.float64]

#: Sets of teeth that are tried, and teeth of each.
TRIES, SAMPLE = 400, 4
#: A tooth agrees with a frame if its centre is met within this, mm.
NEAR = 1.2
#: Two visits of a patient differ at most so much in scale (each may be off by 15 %).
MOST_SCALE = 1.4


def first_frame(
    source: Mapping[int, Array], target: Mapping[int, Array], seed: int = 0
) -> tuple[Array, list[int]]:
    """The similarity that brings most teeth of one visit onto the same teeth of the other.

    RANSAC over sets of four teeth, then least squares of the distances over those that agree.

    Args:
        source, target: FDI number -> [3] centre of the crown, mm.
        seed: of the sets.

    Returns:
        [4, 4] target_from_source, and the numbers of the teeth that agree with it.

    Raises:
        ValueError: fewer than four teeth in common, or none that agree.
    """
    numbers = sorted(set(source) & set(target))
    if len(numbers) < SAMPLE:
        raise ValueError(f"{len(numbers)} teeth in common")
    a = np.array([source[n] for n in numbers])
    b = np.array([target[n] for n in numbers])
    rng = np.random.default_rng(seed)
    best, found = -np.inf, None
    for _ in range(TRIES):
        sample = rng.choice(len(numbers), SAMPLE, replace=False)
        weight = np.zeros(len(numbers))
        weight[sample] = 1
        scale, rotation, shift = similarity(a, b, weight)
        if not 1 / MOST_SCALE < scale < MOST_SCALE:
            continue
        off = np.linalg.norm(b - scale * a @ rotation.T - shift, axis=1)
        score = float(np.maximum(1 - (off / NEAR) ** 2, 0).sum())
        if score > best:
            best, found = score, off < NEAR
    if found is None or found.sum() < 3:
        raise ValueError("no frame agrees with three teeth")
    weight = found.astype(float)
    scale, rotation, shift = robust_similarity(a, b, weight)
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = scale * rotation, shift
    return matrix, [n for n, agrees in zip(numbers, found, strict=True) if agrees]
