"""The line on which the upper and the lower teeth meet in a photograph."""

from __future__ import annotations

import cv2
import numba
import numpy as np
import numpy.typing as npt

from stages.init.dental.teeth_mask import ellipse

Bool = npt.NDArray[np.bool_]
Float = npt.NDArray[np.float32]
Profile = npt.NDArray[np.float64]  # [C] one row coordinate per column

#: Outside the middle of the band the line can't run: cost per pixel there.
FORBIDDEN = np.float32(20.0)
#: Black-hat contrast (CIE L) at which the cost of a pixel has fallen to 1/e.
LINE_CONTRAST = 5.0
#: The line lies a little below the middle of the band, for upper crowns are longer; free within
#: this much around it (shares of the band's height).
USUAL_PLACE = 0.52
FREE_REACH = 0.12
#: Cost per share of the band beyond that.
PULL = 1.2


@numba.njit(
    "void(float32[:, ::1], float32[:, ::1], int8[:, ::1])",
    cache=True,
    error_model="numpy",
    nogil=True,
)
def _accumulate(cost, total, step):  # type: ignore[no-untyped-def]
    """Least cost of a path from column 0 to each pixel; columns run along the first axis.

    step: -1, 0, 1 from the column before, that many rows up or down; 2, 3: along the column,
    from the pixel above or below.
    """
    columns, rows = cost.shape
    for row in range(rows):
        total[0, row] = cost[0, row]
        step[0, row] = 0
    for column in range(1, columns):
        for row in range(rows):
            best = total[column - 1, row]
            came = 0
            if row > 0 and total[column - 1, row - 1] + 0.4 * cost[column, row] < best:
                best = total[column - 1, row - 1] + 0.4 * cost[column, row]
                came = -1
            if row + 1 < rows and total[column - 1, row + 1] + 0.4 * cost[column, row] < best:
                best = total[column - 1, row + 1] + 0.4 * cost[column, row]
                came = 1
            total[column, row] = best + cost[column, row]
            step[column, row] = came
        for row in range(1, rows):
            along = total[column, row - 1] + cost[column, row]
            if along < total[column, row]:
                total[column, row] = along
                step[column, row] = 2
        for row in range(rows - 2, -1, -1):
            along = total[column, row + 1] + cost[column, row]
            if along < total[column, row]:
                total[column, row] = along
                step[column, row] = 3


def cheapest_path(cost: Float) -> tuple[Profile, Profile]:
    """The cheapest path through a [H, C] cost from its left to its right side.

    Returns:
        highest, lowest: [C] float64, the least and the greatest row of the path in each column.
    """
    turned = np.ascontiguousarray(cost.T)
    total = np.empty_like(turned)
    step = np.empty(turned.shape, dtype=np.int8)
    _accumulate(turned, total, step)
    columns, _ = turned.shape
    highest = np.full(columns, np.inf)
    lowest = np.full(columns, -np.inf)
    column, row = columns - 1, int(np.argmin(total[-1]))
    while True:
        highest[column] = min(highest[column], row)
        lowest[column] = max(lowest[column], row)
        came = int(step[column, row])
        if came == 2:
            row -= 1
        elif came == 3:
            row += 1
        elif column == 0:
            break
        else:
            column, row = column - 1, row + came
    return highest, lowest


def dark_lines(lightness: Float, highlight: Bool, reach: int) -> Float:
    """[H, W] by how much a pixel is darker than what lies within `reach` around it (black-hat)."""
    calm = np.where(highlight, np.maximum(lightness, 60), lightness).astype(np.float32)
    blurred = cv2.GaussianBlur(calm, (0, 0), 1.2)
    return np.asarray(cv2.morphologyEx(blurred, cv2.MORPH_BLACKHAT, ellipse(2 * reach + 1)))


def occlusal_line(
    lightness: Float, dark: Float, mask: Bool, top: Profile, bottom: Profile
) -> tuple[Profile, Profile]:
    """Where the jaws meet: the darkest continuous line through the middle of the band.

    Args:
        lightness: [H, C] CIE L of the columns of the row of teeth.
        dark: [H, C] of `dark_lines`, the same columns.
        mask: [H, C] tooth or not.
        top, bottom: [C] smoothed upper and lower gum line.

    Returns:
        highest, lowest: [C], see `cheapest_path`.
    """
    first = max(int(top.min()) - 2, 0)
    last = min(int(bottom.max()) + 3, lightness.shape[0])
    window = slice(first, last)
    rows = np.arange(first, last, dtype=np.float64)[:, None]
    share = ((rows - top) / np.maximum(bottom - top, 1.0)).astype(np.float32)
    cost = np.exp(-dark[window] / LINE_CONTRAST) + 0.06
    cost += PULL * np.clip(np.abs(share - USUAL_PLACE) - FREE_REACH, 0, None)
    gap = ~mask[window] & (share > 0.15) & (share < 0.85) & (lightness[window] < 35)
    cost[gap] = 0.06
    cost[(share < 0.05) | (share > 0.95)] = FORBIDDEN
    highest, lowest = cheapest_path(cost.astype(np.float32))
    return highest + first, lowest + first
