"""Descriptor matching that is exact, hence the same on any number of threads."""

from __future__ import annotations

from itertools import combinations

import numpy as np
import numpy.typing as npt

from pipeline.kernels import kernel
from stages.init.sfm.matching.features import Features

Pair = tuple[int, int]

#: Rows of the similarity matrix in memory at a time: 512 x 18,000 float32 are 37 MB.
BLOCK_ROWS = 512


def match_features(
    first: Features,
    second: Features,
    *,
    ratio: float = 0.88,
    distinct_radius: float = 4.0,
    cell: float = 2.0,
    use_first: npt.NDArray[np.int64] | None = None,
    use_second: npt.NDArray[np.int64] | None = None,
) -> npt.NDArray[np.int64]:
    """Match two views' features: mutual nearest neighbours that no other place comes near.

    The ratio test compares with the best candidate at another place, because the squeezed copies
    describe most places several times.

    Args:
        ratio: distance to the match over distance to the best candidate elsewhere, at most.
        distinct_radius: pixels beyond which a candidate counts as elsewhere; the match back must
            come to within half of it.
        cell: pixels; of several matches between the same two cells the most similar is kept.
        use_first, use_second: indices of the features to use, or None for all.

    Returns:
        [M, 2] feature indices, most similar first.
    """
    index_a = np.arange(len(first)) if use_first is None else use_first
    index_b = np.arange(len(second)) if use_second is None else use_second
    if not len(index_a) or not len(index_b):
        return np.zeros((0, 2), np.int64)
    place_a = np.ascontiguousarray(first.positions[index_a], np.float32)
    place_b = np.ascontiguousarray(second.positions[index_b], np.float32)
    descriptors_a = first.descriptors[index_a]
    descriptors_b = second.descriptors[index_b]
    norms_a, norms_b = ((d * d).sum(1) for d in (descriptors_a, descriptors_b))

    best_b = np.zeros(len(index_a), np.int32)  # for each row the most similar column
    similarity = np.zeros(len(index_a), np.float32)
    alone = np.zeros(len(index_a), np.bool_)
    best_a = np.zeros(len(index_b), np.int32)  # for each column the most similar row
    best_a_similarity = np.full(len(index_b), -1, np.float32)
    for start in range(0, len(index_a), BLOCK_ROWS):
        rows = slice(start, start + BLOCK_ROWS)
        block = descriptors_a[rows] @ descriptors_b.T
        best_b[rows] = block.argmax(1)
        similarity[rows] = np.take_along_axis(block, best_b[rows, None].astype(np.int64), 1)[:, 0]
        _update_columns(block, start, best_a, best_a_similarity)
        _stand_alone(
            block, best_b[rows], norms_a[rows], norms_b, place_b, float(ratio),
            float(distinct_radius), alone[rows],
        )  # fmt: skip

    back = place_a[best_a[best_b]]
    mutual = np.linalg.norm(back - place_a, axis=1) < distinct_radius / 2
    kept = np.flatnonzero(alone & mutual)
    kept = kept[np.argsort(-similarity[kept], kind="stable")]
    cells = np.concatenate([place_a[kept], place_b[best_b[kept]]], 1)
    _, representative = np.unique(np.rint(cells / cell), axis=0, return_index=True)
    kept = kept[np.sort(representative)]
    return np.stack([index_a[kept], index_b[best_b[kept]]], 1)


def overlap_counts(features: list[Features], pairs: list[Pair], count: int) -> dict[Pair, int]:
    """Count the matches among the `count` largest keypoints of each pair: do the views overlap?

    Large keypoints are few and the most likely to be seen again (preemptive matching: Wu, Towards
    linear-time incremental structure from motion, 2013).
    """
    largest = [feature.largest(count) for feature in features]
    return {
        (i, j): len(
            match_features(
                features[i], features[j], ratio=0.8, use_first=largest[i], use_second=largest[j]
            )
        )
        for i, j in pairs
    }


def candidate_pairs(count: int, ordered: bool, window: int) -> list[Pair]:
    """The pairs worth an overlap test.

    All of them, or for an ordered sequence of more than `window` views the neighbours up to
    `window` apart and pairs 2, 4, 8... times as far, so that a camera that comes back is noticed.
    """
    if not ordered or count <= window:
        return list(combinations(range(count), 2))
    steps = list(range(1, window + 1))
    while steps[-1] * 2 < count:
        steps.append(steps[-1] * 2)
    return sorted((i, i + step) for step in steps for i in range(count - step))


def select_pairs(counts: dict[Pair, int], view_count: int, best: int) -> list[Pair]:
    """Keep the pairs that are among the `best` of either of their views by the counts given.

    Ties go to the views nearest in order, which in a folder of photographs is often right.
    """
    kept: set[Pair] = set()
    for view in range(view_count):
        mine = [pair for pair in counts if view in pair]
        mine.sort(key=lambda pair: (-counts[pair], pair[1] - pair[0], pair))
        kept.update(mine[:best])
    return sorted(kept)


@kernel()
def _update_columns(block, start, best_row, best_value):  # type: ignore[no-untyped-def]
    """Fold a block [R, C] of rows from `start` on into each column's best row so far."""
    for row in range(block.shape[0]):
        for column in range(block.shape[1]):
            value = block[row, column]
            better = value > best_value[column]
            best_value[column] = value if better else best_value[column]
            best_row[column] = np.int32(start + row) if better else best_row[column]


@kernel()
def _stand_alone(  # type: ignore[no-untyped-def]
    block, best, row_norms, column_norms, places, ratio, radius, result
):
    """Ratio test of each row of a block of products [R, C]; the norms are squared."""
    for row in range(block.shape[0]):
        winner = best[row]
        distance = row_norms[row] + column_norms[winner] - np.float32(2) * block[row, winner]
        # A rival is nearer than distance / ratio: |a|^2 + |b|^2 - 2ab <= distance / ratio^2.
        limit = row_norms[row] - distance / np.float32(ratio * ratio)
        alone = True
        for column in range(block.shape[1]):
            if np.float32(2) * block[row, column] - column_norms[column] >= limit:
                dx = places[column, 0] - places[winner, 0]
                dy = places[column, 1] - places[winner, 1]
                if dx * dx + dy * dy > radius * radius:
                    alone = False
                    break
        result[row] = alone
