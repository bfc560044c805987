"""Brackets and wires: what is fixed to the crowns and stands out before them.

A bracket stands two or three millimetres before its crown, which the smooth surface of the crowns
can't follow, and shows each photograph other sides of itself, so that windows of texture don't
match. What does match is where it is. So the crowns are sought beside it only, and then a height is
looked for, all along the row, at which the metal that the photographs show lies on itself.
"""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt

from stages.init.dental.surface.chart.jaws import ROW_SMOOTHING, Chart, facing, smooth_normals
from stages.init.dental.surface.photos.photo import Photo
from stages.init.dental.surface.photos.tissue import disc

Array32 = npt.NDArray[np.float32]
Array64 = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]

#: Square mm that two photographs show on a jaw with braces: about four brackets. Real patients: 149
#: with braces, 0 to 23 on 25 jaws without (stains, fillings, shade between crowns); generated ones:
#: 69 to 182, and at most 13 without.
_LEAST_AREA = 45.0
#: The crowns' own surface is not sought this near to it (mm): more than half a window of the sweep.
_NEAR = 0.8
#: Heights that are tried, mm; bracket and slot are 2 to 3 mm high.
_HEIGHTS = np.arange(0, 3.76, 0.25)
#: The height is one for stretches of so many mm, by what is within so many mm to either side.
_STRETCH, _REACH = 1.0, 2.0
#: Cost of a step of one mm from one stretch to the next, against all hardware there.
_STEP_COST = 0.25
#: Heights at which at least that share of the most lies on itself are as good: from a bracket's
#: back to its front they nearly are, as photographs from the side show its flanks too. Of these
#: the highest is taken, being better by so much per mm. .8 and .88 serve real views alike.
_AS_GOOD, _HIGHER = 0.8, 0.02
#: Share of it that has to lie on itself at the heights taken: .50 to .64 with braces; without, .3
#: at most of what little there is, even at the heights where most does.
_LEAST_OVERLAP = 0.4
#: A sample is raised where two photographs are so sure of it.
_SURE = 0.5
#: From this cosine down a bracket, 3 to 3.5 mm wide and 2 to 2.5 mm high, shows more of its flank
#: than of its front, and hides as much of what is behind it.
_FLANKS = 0.55
#: Gaps in it up to this wide to either side (mm) go with it: what shines.
_GAP = 0.5
#: The raised part's rim is smoothed over this length (mm).
_RIM = 0.2


def shows_hardware(
    chart: Chart, photos: list[Photo], seen: npt.NDArray[np.bool_], pairs: list[list[int]]
) -> bool:
    """Whether two photographs show so much of it that it is worth looking for.

    Args:
        chart: of a jaw, its crowns about in place.
        photos: the photographs.
        seen: [V, H, W] bool: the photograph shows this sample.
        pairs: photographs to compare.
    """
    shown = _scores(chart.points, photos)
    area = sum(((shown[a] + shown[b]) * (seen[a] & seen[b])).sum() / 2 for a, b in pairs)
    return bool(area > _LEAST_AREA * chart.grid.density**2)


def free_of_hardware(chart: Chart, photos: list[Photo], seen: npt.NDArray[np.bool_]) -> Array32:
    """[H, W] float32: 1, and 0 where some photograph that shows a sample shows it near metal."""
    near = np.zeros(chart.grid.shape, np.float32)
    for score, mask in zip(_scores(chart.points, photos), seen, strict=True):
        near = np.maximum(near, score * mask)
    return 1 - np.asarray(cv2.dilate(near, disc(_NEAR * chart.grid.density)), np.float32)


def raise_hardware(
    chart: Chart,
    photos: list[Photo],
    seen: npt.NDArray[np.bool_],
    pairs: list[list[int]],
) -> None:
    """Raise what is fixed to the crowns to where it stands, in place.

    Arguments as for `shows_hardware`, with the crowns in place. What one photograph alone shows of
    it stays where it is: nothing tells how high it stands.
    """
    rows, columns = chart.grid.shape
    both = np.zeros((len(_HEIGHTS), rows, columns), np.float32)
    overlap, most = np.zeros((2, len(_HEIGHTS), columns))
    for k, height in enumerate(_HEIGHTS):
        shown = _scores(chart.grid.points(chart.radius + np.float32(height)), photos)
        for a, b in pairs:
            common = seen[a] & seen[b]
            least = np.minimum(shown[a], shown[b]) * common
            both[k] = np.maximum(both[k], least)
            overlap[k] += least.sum(0)
            most[k] += ((shown[a] + shown[b]) * common).sum(0) / 2
    height, share = _heights(overlap, most.mean(0), chart.grid.density)
    if share < _LEAST_OVERLAP:
        return
    below = np.clip(np.searchsorted(_HEIGHTS, height, "right") - 1, 0, len(_HEIGHTS) - 1)
    sure = both[below, :, np.arange(columns)].T > _SURE
    whole = cv2.morphologyEx(
        sure.astype(np.uint8), cv2.MORPH_CLOSE, disc(_GAP * chart.grid.density)
    )
    raised = (whole * height[None]).astype(np.float32)
    chart.radius = chart.radius + cv2.GaussianBlur(raised, (0, 0), _RIM * chart.grid.density)


def behind_flanks(chart: Chart, photos: list[Photo], seen: npt.NDArray[np.bool_]) -> list[Mask]:
    """Per photograph [H, W] bool: where metal in it is the flank of a bracket that stands before.

    Another photograph shows these samples from their front. What a photograph shows at such a slant
    would be laid on the crowns and the gum behind, and stay there when the view turns.

    Args:
        chart: of a jaw with braces; photos: the photographs.
        seen: [V, H, W] bool: the photograph shows this sample.
    """
    normals = smooth_normals(chart.radius, chart.grid, ROW_SMOOTHING)
    faces = np.stack([facing(photo, chart.points, normals) for photo in photos])
    front = (seen & (faces > _FLANKS)).any(axis=0)
    return [front & (cosine <= _FLANKS) for cosine in faces]


def metal(photo: Photo) -> Mask:
    """[h, w] bool: metal in a photograph, with what shines in it and beside it."""
    wide = cv2.dilate(photo.hardware, disc(_GAP * photo.density))
    return np.asarray(wide > _SURE)


def _scores(points: Array32, photos: list[Photo]) -> list[Array32]:
    """Per photograph [H, W] float32 0..1: how sure it shows metal at points [H, W, 3]."""
    return [photo.sample(photo.hardware, photo.project(points)[0]) for photo in photos]


def _heights(overlap: Array64, most: Array64, density: float) -> tuple[Array32, float]:
    """The height of each column [W], and the share of all hardware that lies on itself there.

    A shortest path over stretches of columns (Viterbi): what doesn't lie on itself costs, and so
    does a step.

    Args:
        overlap: [D, W] of each height what lies on itself; most: [W] all of it.
        density: columns per mm.
    """
    width = max(round(_STRETCH * density), 1)
    starts = np.arange(0, overlap.shape[1], width)
    found = np.add.reduceat(overlap, starts, axis=1)
    all_of_it = np.add.reduceat(most, starts)
    near = 2 * round(_REACH / _STRETCH) + 1
    around = cv2.blur(found, (near, 1), borderType=cv2.BORDER_CONSTANT) * near
    total = cv2.blur(all_of_it[None], (near, 1), borderType=cv2.BORDER_CONSTANT)[0] * near
    typical = np.median(total[total > 0]) if (total > 0).any() else 1.0
    lost = np.maximum(_AS_GOOD * around.max(0) - around, 0)
    cost = (lost - _HIGHER * _HEIGHTS[:, None] * total) / typical
    step = _STEP_COST * np.abs(_HEIGHTS[:, None] - _HEIGHTS[None])
    best, came = cost[:, 0], []
    for column in range(1, cost.shape[1]):
        way = best[:, None] + step
        came.append(way.argmin(0))
        best = way.min(0) + cost[:, column]
    path = [int(best.argmin())]
    for back in reversed(came):
        path.append(int(back[path[-1]]))
    chosen = np.array(path[::-1])
    share = found[chosen, np.arange(len(chosen))].sum() / max(all_of_it.sum(), 1e-9)
    middle = np.minimum(starts + width / 2, overlap.shape[1] - 1)
    height = np.interp(np.arange(overlap.shape[1]), middle, _HEIGHTS[chosen])
    return height.astype(np.float32), float(share)
