"""Figures of each pixel by its surroundings, some rows at a time: large pictures take no more."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[Any]

#: So many rows are looked at in one go: a dozen arrays of them are still near the processor.
ROWS = 128


def by_rows(figure: Callable[..., Array], reach: int, *pictures: Array | None) -> Array:
    """What `figure` makes of whole pictures, from strips of them.

    Args:
        figure: pictures [h, W, ...] -> [h, W, ...]; a row of what it returns comes from the rows
            within `reach` of it, and borders are made up from the rows there.
        reach: pixels.
        pictures: [H, W, ...] each; None is passed on.

    Returns:
        [H, W, ...], what `figure` returns for the whole pictures (float32 may round otherwise).
    """
    height = next(len(picture) for picture in pictures if picture is not None)
    strips = []
    for top in range(0, height, ROWS):
        above = max(top - reach, 0)
        rows = slice(above, top + ROWS + reach)
        strip = figure(*(None if picture is None else picture[rows] for picture in pictures))
        strips.append(strip[top - above :][:ROWS])
    return np.concatenate(strips)
