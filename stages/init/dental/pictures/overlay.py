"""A photograph with the teeth found in it, made to be checked by a clinician at a glance."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import cv2
import numpy as np
import numpy.typing as npt

from stages.init.dental.observation import Crown, Dentition, Point

Picture = npt.NDArray[np.uint8]  # [H, W, 3] sRGB
Colour = tuple[int, int, int]

#: Width of the overlay in pixels: numbers stay readable on crowns of the lower incisors.
WIDTH = 1024
#: One colour per quadrant (FDI 1 to 4), told apart by people who see no red or no green.
QUADRANTS: dict[int, Colour] = {
    1: (0, 114, 178),
    2: (0, 158, 115),
    3: (204, 121, 167),
    4: (230, 159, 0),
}
UNNAMED: Colour = (110, 110, 110)
DOUBTFUL: Colour = (200, 0, 0)
WHITE: Colour = (255, 255, 255)
FONT = cv2.FONT_HERSHEY_SIMPLEX
#: Fixed-point bits of OpenCV's drawing coordinates.
SHIFT = 4


def labelled_overlay(
    image: npt.NDArray[np.float32],
    dentition: Dentition | None,
    upper_labels: Sequence[int],
    lower_labels: Sequence[int],
) -> Picture:
    """The photograph with its crowns outlined and numbered.

    Each crown is outlined in the colour of its quadrant, its number in a box above (below, in the
    lower jaw) its gum line. Dots: white, zenith; black, tip. Dashed bars: ends of the row. Red
    boxes with a question mark: doubtful crowns; "?" alone: taken for no tooth.

    Args:
        image: [H, W, 3] float32 sRGB in 0..1.
        dentition: what was found in it; None writes that no teeth were found.
        upper_labels, lower_labels: FDI number of each crown in the dentition's order; 0 where none.

    Returns:
        [H', 1024, 3] uint8.

    Raises:
        ValueError: as many labels as crowns are needed.
    """
    scale = WIDTH / image.shape[1]
    size = (WIDTH, max(1, round(image.shape[0] * scale)))
    shown = cv2.resize(image, size, interpolation=cv2.INTER_AREA if scale < 1 else cv2.INTER_CUBIC)
    picture = np.ascontiguousarray(np.clip(shown * 255 + 0.5, 0, 255).astype(np.uint8))
    if dentition is None:
        _box(picture, "no teeth found", np.array([size[0] / 2, size[1] / 2]), DOUBTFUL, 1.0)
        return picture
    for crowns, labels in ((dentition.upper, upper_labels), (dentition.lower, lower_labels)):
        if len(crowns) != len(labels):
            raise ValueError(f"{len(labels)} labels for {len(crowns)} crowns; give one per crown")
    mask = cv2.resize(dentition.mask.astype(np.float32), size, interpolation=cv2.INTER_LINEAR) > 0.5
    above = (
        cv2.resize(dentition.above.astype(np.float32), size, interpolation=cv2.INTER_LINEAR) > 0.5
    )
    across = np.array([np.cos(dentition.roll), np.sin(dentition.roll)])
    for crowns, labels, side in (
        (dentition.upper, upper_labels, above),
        (dentition.lower, lower_labels, ~above),
    ):
        _outline_jaw(picture, crowns, labels, mask & side, across, scale)
    for crowns, labels in ((dentition.upper, upper_labels), (dentition.lower, lower_labels)):
        for crown, label in zip(crowns, labels, strict=True):
            _dots(picture, crown, scale)
            _number(picture, crown, label, scale)
    return picture


def sheet(overlays: Sequence[Picture]) -> Picture:
    """Overlays [H, W, 3] side by side in one [H', W', 3] picture, the lower ones padded with white.

    Raises:
        ValueError: nothing to show.
    """
    if not overlays:
        raise ValueError("a sheet needs at least one overlay")
    height = max(overlay.shape[0] for overlay in overlays)
    gap = np.full((height, 8, 3), 255, np.uint8)
    parts: list[Picture] = []
    for overlay in overlays:
        below = np.full((height - overlay.shape[0], overlay.shape[1], 3), 255, np.uint8)
        parts += [np.vstack([overlay, below]), gap]
    return np.ascontiguousarray(np.hstack(parts[:-1]))


def _colour(label: int) -> Colour:
    return QUADRANTS.get(label // 10, UNNAMED)


def _outline_jaw(
    picture: Picture,
    crowns: Sequence[Crown],
    labels: Sequence[int],
    region: npt.NDArray[np.bool_],
    across: Point,
    scale: float,
) -> None:
    """The outline of each crown: the part of the region between its papillae."""
    if not crowns:
        return
    rows, columns = np.nonzero(region)
    along = (columns + 0.5) * across[0] + (rows + 0.5) * across[1]
    borders = [float(_parting(before, after, across) * scale) for before, after in pairwise(crowns)]
    owner = np.searchsorted(np.array(borders), along)
    for index, (crown, label) in enumerate(zip(crowns, labels, strict=True)):
        own = np.zeros(region.shape, np.uint8)
        mine = owner == index
        own[rows[mine], columns[mine]] = 1
        contours, _ = cv2.findContours(own, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
        large = [contour for contour in contours if cv2.contourArea(contour) > 40]
        cv2.drawContours(picture, large, -1, WHITE, 4, cv2.LINE_AA)
        cv2.drawContours(picture, large, -1, _colour(label), 2, cv2.LINE_AA)
        for is_cut, side in ((crown.cut_left, -1.0), (crown.cut_right, 1.0)):
            if is_cut and mine.any():
                _end_bar(picture, crown, along[mine], side, across, scale)


def _parting(before: Crown, after: Crown, across: Point) -> float:
    """Place along the row at which two neighbouring crowns part."""
    papilla = before.papilla_right if before.papilla_right is not None else after.papilla_left
    place = (before.zenith + after.zenith) / 2 if papilla is None else papilla
    return float(place @ across)


def _end_bar(
    picture: Picture,
    crown: Crown,
    along: npt.NDArray[np.float64],
    side: float,
    across: Point,
    scale: float,
) -> None:
    """A dashed bar beside the last crown of a row."""
    end = float(along.min() if side < 0 else along.max()) + 6 * side
    up = np.array([-across[1], across[0]])
    for share in np.linspace(-0.1, 1.0, 7):
        place = (crown.zenith + share * (crown.tip - crown.zenith)) * scale
        foot = across * end + up * float(place @ up)
        half = up * 0.05 * crown.height * scale
        cv2.line(picture, _fixed(foot - half), _fixed(foot + half), WHITE, 5, cv2.LINE_AA, SHIFT)
        cv2.line(
            picture, _fixed(foot - half), _fixed(foot + half), (0, 0, 0), 2, cv2.LINE_AA, SHIFT
        )


def _dots(picture: Picture, crown: Crown, scale: float) -> None:
    for place, inner, outer in ((crown.zenith, WHITE, (0, 0, 0)), (crown.tip, (0, 0, 0), WHITE)):
        cv2.circle(picture, _fixed(place * scale), 5 << SHIFT, outer, -1, cv2.LINE_AA, SHIFT)
        cv2.circle(picture, _fixed(place * scale), 3 << SHIFT, inner, -1, cv2.LINE_AA, SHIFT)


def _number(picture: Picture, crown: Crown, label: int, scale: float) -> None:
    """The tooth's number on the gum side of its zenith, where it hides nothing of the crown."""
    text = (str(label) if label else "") + ("?" if crown.doubtful or not label else "")
    outward = crown.zenith - crown.tip
    outward = outward / max(float(np.linalg.norm(outward)), 1e-9)
    size = float(np.clip(crown.width * scale / 62, 0.55, 0.9))
    place = crown.zenith * scale + outward * (14 + 16 * size)
    _box(picture, text, place, DOUBTFUL if crown.doubtful else _colour(label), size)


def _box(picture: Picture, text: str, place: Point, colour: Colour, size: float) -> None:
    """White text on a coloured box around a place, kept inside the picture."""
    (width, height), base = cv2.getTextSize(text, FONT, size, 2)
    x = int(np.clip(place[0] - width / 2, 4, picture.shape[1] - width - 5))
    y = int(np.clip(place[1] + height / 2, height + 4, picture.shape[0] - base - 4))
    cv2.rectangle(picture, (x - 4, y - height - 4), (x + width + 3, y + 5), colour, -1)
    cv2.rectangle(picture, (x - 4, y - height - 4), (x + width + 3, y + 5), WHITE, 1)
    cv2.putText(picture, text, (x, y), FONT, size, WHITE, 2, cv2.LINE_AA)


def _fixed(point: Point) -> tuple[int, int]:
    """A place (pixel centres at .5) as OpenCV draws it: centres whole, in fixed point."""
    return round((float(point[0]) - 0.5) * (1 << SHIFT)), round(
        (float(point[1]) - 0.5) * (1 << SHIFT)
    )
