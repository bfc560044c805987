"""A photograph with the teeth found in it, made to be checked by a clinician at a glance."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
import numpy.typing as npt

from pipeline.artifacts.dental.fdi import permanent_of
from pipeline.artifacts.teeth import Crown, Dentition, Point

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
#: Numbers with more doubt than this are marked.
DOUBT_SHOWN = 0.1
#: Fixed-point bits of OpenCV's drawing coordinates.
SHIFT = 4


def labelled_overlay(image: npt.NDArray[np.float32], dentition: Dentition) -> Picture:
    """The photograph with its crowns outlined and numbered.

    Each crown is outlined in the colour of its quadrant, its number in a box above (below, in the
    lower jaw) its gum line. Dots: white, zenith; black, tip. Red boxes with a question mark:
    doubtful numbers; "?" alone: taken for no tooth. A photograph that is set aside says why.

    Args:
        image: [H, W, 3] float32 sRGB in 0..1.
        dentition: what was found in it.

    Returns:
        [H', 1024, 3] uint8.
    """
    scale = WIDTH / image.shape[1]
    size = (WIDTH, max(1, round(image.shape[0] * scale)))
    shown = cv2.resize(image, size, interpolation=cv2.INTER_AREA if scale < 1 else cv2.INTER_CUBIC)
    picture = np.ascontiguousarray(np.clip(shown * 255 + 0.5, 0, 255).astype(np.uint8))
    for crown in dentition.all_crowns:
        outline = [np.round((crown.outline * scale - 0.5) * (1 << SHIFT)).astype(np.int32)]
        colour = _colour(crown.number)
        cv2.polylines(picture, outline, True, WHITE, 4, cv2.LINE_AA, SHIFT)
        cv2.polylines(picture, outline, True, colour, 2, cv2.LINE_AA, SHIFT)
    for crown in dentition.all_crowns:
        _dots(picture, crown, scale)
        _number(picture, crown, scale)
    if dentition.set_aside:
        text = f"not used: {dentition.set_aside}"
        _box(picture, text, np.array([size[0] / 2, size[1] - 24.0]), DOUBTFUL, 0.6)
    elif not dentition.all_crowns:
        _box(picture, "no teeth found", np.array([size[0] / 2, size[1] / 2]), DOUBTFUL, 1.0)
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
    return QUADRANTS.get(permanent_of(label) // 10, UNNAMED)


def _dots(picture: Picture, crown: Crown, scale: float) -> None:
    for place, inner, outer in ((crown.zenith, WHITE, (0, 0, 0)), (crown.tip, (0, 0, 0), WHITE)):
        cv2.circle(picture, _fixed(place * scale), 5 << SHIFT, outer, -1, cv2.LINE_AA, SHIFT)
        cv2.circle(picture, _fixed(place * scale), 3 << SHIFT, inner, -1, cv2.LINE_AA, SHIFT)


def _number(picture: Picture, crown: Crown, scale: float) -> None:
    """The tooth's number on the gum side of its zenith, where it hides nothing of the crown."""
    doubtful = crown.doubt > DOUBT_SHOWN or not crown.number
    text = (str(crown.number) if crown.number else "") + ("?" if doubtful else "")
    outward = crown.zenith - crown.tip
    outward = outward / max(float(np.linalg.norm(outward)), 1e-9)
    size = float(np.clip(crown.width * scale / 62, 0.55, 0.9))
    place = crown.zenith * scale + outward * (14 + 16 * size)
    _box(picture, text, place, DOUBTFUL if doubtful else _colour(crown.number), size)


def _box(picture: Picture, text: str, place: Point, colour: Colour, size: float) -> None:
    """White text on a coloured box around a place, kept inside the picture; small if it is long."""
    room = picture.shape[1] - 9
    size *= min(1.0, room / cv2.getTextSize(text, FONT, size, 2)[0][0])
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
