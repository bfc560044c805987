"""Matches drawn for people: pairs of photographs side by side, and a table of all pairs."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from pipeline.artifacts.views import View, to_uint8
from pipeline.geometry.graph import Pair, spanning_pairs
from stages.init.sfm.matching.two_view import Correspondences

Picture = npt.NDArray[np.uint8]
Integers = npt.NDArray[np.int64]

#: Size in pixels to which each photograph of a pair is scaled down.
LONG_SIDE = 480
#: Width in pixels of the gap between the two photographs.
GAP = 8
#: Lines drawn of each sort, and spots: more only hide each other.
MOST_LINES, MOST_SPOTS = 60, 600
#: Opacity of the lines.
LINE_OPACITY = 0.6
#: RGB of matches that agree on where the cameras stood, and of those that do not.
VERIFIED, REJECTED = (40, 220, 160), (235, 80, 60)
#: Fractional bits of OpenCV's drawing coordinates.
FRACTION = 4
#: Brightness of the photographs under the lines.
DIMMED = 0.75


@dataclass(frozen=True)
class Links:
    """What links the photographs to each other.

    Attributes:
        views: all photographs, as the features were found in them.
        matches: pairs of them by position -> their matches.
        verified: pair -> [I] int64 indices of the matches that fit the cameras' geometry.
        weights: pair -> how well it links.
        used: the pairs that the cameras were made from.
    """

    views: tuple[View, ...]
    matches: Mapping[Pair, Correspondences]
    verified: Mapping[Pair, Integers]
    weights: Mapping[Pair, float]
    used: frozenset[Pair] = frozenset()


def match_table(links: Links) -> dict[str, Any]:
    """Every pair with its counts, as JSON values.

    Returns:
        {"views": names, "pairs": [{"views": [name, name], "matches", "verified", "evidence",
        "used"}]}, in the order of the pairs.
    """
    names = [view.name for view in links.views]
    return {
        "views": names,
        "pairs": [
            {
                "views": [names[i], names[j]],
                "matches": len(links.matches[i, j]),
                "verified": len(links.verified.get((i, j), ())),
                "evidence": round(float(links.weights.get((i, j), 0.0)), 2),
                "used": (i, j) in links.used,
            }
            for i, j in sorted(links.matches)
        ],
    }


def pairs_to_draw(links: Links, most: int) -> list[Pair]:
    """The pairs that hold the photographs together (a spanning tree), then the strongest others.

    Each sort comes strongest first; at most `most` altogether.
    """
    there = {pair: weight for pair, weight in links.weights.items() if pair in links.matches}
    chosen = {pair: weight for pair, weight in there.items() if pair in links.used} or there
    tree = spanning_pairs(chosen)
    others = sorted(set(chosen) - set(tree), key=lambda pair: (-chosen[pair], pair))
    return [*tree, *others][:most]


def match_pictures(links: Links, most: int) -> dict[str, Picture]:
    """Draw pairs: name (``matches_000_001``) -> [H, W, 3] uint8, verified matches green."""
    return {
        f"matches_{links.views[i].name}_{links.views[j].name}": side_by_side(
            links.views[i], links.views[j], links.matches[i, j],
            links.verified.get((i, j), np.zeros(0, np.int64)),
        )
        for i, j in pairs_to_draw(links, most)
    }  # fmt: skip


def side_by_side(
    first: View, second: View, matches: Correspondences, verified: Integers
) -> Picture:
    """Two photographs with lines between their matches: first the rejected, above them the others.

    Args:
        matches: of the two, in their pixels.
        verified: [I] indices of those that fit the geometry.
    """
    scales = [min(1.0, LONG_SIDE / max(view.width, view.height)) for view in (first, second)]
    tiles = [_tile(view, scale) for view, scale in zip((first, second), scales, strict=True)]
    height = max(tile.shape[0] for tile in tiles)
    width = tiles[0].shape[1] + GAP + tiles[1].shape[1]
    canvas = np.full((height, width, 3), 255, np.uint8)
    canvas[: tiles[0].shape[0], : tiles[0].shape[1]] = tiles[0]
    canvas[: tiles[1].shape[0], tiles[0].shape[1] + GAP :] = tiles[1]
    shift = np.array([tiles[0].shape[1] + GAP, 0.0])
    starts = matches.positions_i * scales[0]
    ends = matches.positions_j * scales[1] + shift
    rejected = np.setdiff1d(np.arange(len(matches)), verified)
    sorts = ((rejected, REJECTED), (np.asarray(verified, np.int64), VERIFIED))
    lines = canvas.copy()
    for chosen, color in sorts:
        for number in chosen[:: max(1, -(-len(chosen) // MOST_LINES))]:
            ends_of = _fixed(starts[number]), _fixed(ends[number])
            cv2.line(lines, *ends_of, color, 1, cv2.LINE_AA, FRACTION)
    canvas = np.asarray(cv2.addWeighted(lines, LINE_OPACITY, canvas, 1 - LINE_OPACITY, 0))
    for chosen, color in sorts:
        spots = chosen[:: max(1, -(-len(chosen) // MOST_SPOTS))]
        for point in (*starts[spots], *ends[spots]):
            cv2.circle(canvas, _fixed(point), 24, color, -1, cv2.LINE_AA, FRACTION)
    return np.asarray(canvas, np.uint8)


def _fixed(point: npt.NDArray[np.float64]) -> tuple[int, int]:
    """A pixel position in OpenCV's fixed point, whose pixel centres are whole numbers."""
    x, y = np.rint((point - 0.5) * 2**FRACTION).astype(int).tolist()
    return x, y


def _tile(view: View, scale: float) -> Picture:
    size = (max(1, round(view.width * scale)), max(1, round(view.height * scale)))
    shown = np.where(view.valid()[..., None], view.image, view.image * np.float32(0.4))
    small = cv2.resize(shown, size, interpolation=cv2.INTER_AREA)
    return to_uint8(small * np.float32(DIMMED))
