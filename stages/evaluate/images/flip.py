"""FLIP: how different two pictures look to somebody who flips between them.

Andersson et al., "FLIP: A Difference Evaluator for Alternating Images", HPG 2020; the version for
pictures of 8 bits (LDR). The tests hold it against the authors' program, which takes ten times as
long.
"""

from __future__ import annotations

import math

import cv2
import numpy as np
import numpy.typing as npt

from stages.evaluate.images.rows import by_rows
from stages.photographs.srgb import linear

Image = npt.NDArray[np.uint8]
Floats = npt.NDArray[np.float32]
Array = npt.NDArray[np.float64]

#: Pixels per degree: 0.7 m from a screen of 3840 pixels on 0.7 m.
PIXELS_PER_DEGREE = 0.7 * (3840 / 0.7) * math.pi / 180
#: Contrast sensitivity, by channel of YCxCz: weights and widths of Gaussians.
SENSITIVITY = (((1.0, 0.0047),), ((1.0, 0.0053),), ((34.1, 0.04), (13.5, 0.025)))
#: Width of the features that are looked for, degrees.
FEATURE_WIDTH = 0.082
#: What lies farther off than this does not touch a pixel, pixels: the wider of the two filters.
REACH = math.ceil(
    3 * PIXELS_PER_DEGREE * max(
        FEATURE_WIDTH / 2,
        *(math.sqrt(width / (2 * math.pi**2)) for terms in SENSITIVITY for _, width in terms),
    )
)  # fmt: skip
#: Exponents of colour and feature differences, and how colour differences are spread over 0..1.
COLOR_EXPONENT, FEATURE_EXPONENT = 0.7, 0.5
SHARE_OF_LARGEST, SPREAD_TO = 0.4, 0.95

_XYZ_FROM_RGB = np.array(
    [
        [10135552 / 24577794, 8788810 / 24577794, 4435075 / 24577794],
        [2613072 / 12288897, 8788810 / 12288897, 887015 / 12288897],
        [1425312 / 73733382, 8788810 / 73733382, 70074185 / 73733382],
    ]
)
#: XYZ of white, as the sum of the rows above.
_WHITE = _XYZ_FROM_RGB.sum(1)
#: YCxCz is linear in XYZ / white but for a constant, which blurs don't touch.
_OPPONENT = np.array([[0, 116, 0], [500, -500, 0], [0, 200, -200]]) / _WHITE
_OPPONENT_FROM_RGB = _OPPONENT @ _XYZ_FROM_RGB
_RGB_FROM_OPPONENT = np.linalg.inv(_OPPONENT_FROM_RGB)
_LINEAR = linear(np.arange(256) / 255).astype(np.float32)


def flip_map(image: Image, truth: Image) -> Floats:
    """FLIP per pixel at `PIXELS_PER_DEGREE`; 0 is no difference.

    Args:
        image, truth: [H, W, 3] uint8 sRGB.

    Returns:
        [H, W] float32 in 0..1; the usual figure is its mean.
    """
    return by_rows(_flip, REACH, image, truth)


def _flip(image: Image, truth: Image) -> Floats:
    colors, edges, spots = zip(*map(_seen, (truth, image)), strict=True)
    color = _spread(_distance(*colors))
    feature = np.maximum(np.abs(edges[0] - edges[1]), np.abs(spots[0] - spots[1]))
    feature = np.clip(feature * np.float32(1 / math.sqrt(2)), 0, 1) ** np.float32(FEATURE_EXPONENT)
    return np.asarray(color ** (1 - feature), np.float32)


def _seen(picture: Image) -> tuple[Floats, Floats, Floats]:
    """Colours as they are perceived (Hunt-adjusted L*a*b*) and strengths of edges and of spots."""
    opponent = _times(np.asarray(_LINEAR[picture], np.float32), _OPPONENT_FROM_RGB)
    channels = [_sensed(opponent[..., channel], SENSITIVITY[channel]) for channel in range(3)]
    blurred: Floats = np.stack(channels, -1)
    rgb = np.clip(_times(blurred, _RGB_FROM_OPPONENT), 0, 1)
    brightness = np.ascontiguousarray(opponent[..., 0]) / np.float32(116)
    return _hunt_lab(rgb), _strength(brightness, 1), _strength(brightness, 2)


def _times(picture: Floats, matrix: Array) -> Floats:
    """A matrix [3, 3] times each pixel of [H, W, 3]."""
    return np.asarray(cv2.transform(picture, matrix.astype(np.float32)), np.float32)


def _sensed(channel: Floats, gaussians: tuple[tuple[float, float], ...]) -> Floats:
    """A channel through the contrast sensitivity of the eye."""
    widest = max(width for terms in SENSITIVITY for _, width in terms)
    radius = math.ceil(3 * math.sqrt(widest / (2 * math.pi**2)) * PIXELS_PER_DEGREE)
    degrees = np.arange(-radius, radius + 1) / PIXELS_PER_DEGREE
    channel = np.ascontiguousarray(channel)
    total, mass = np.zeros_like(channel), 0.0
    for weight, width in gaussians:
        taps = np.exp(-(math.pi**2) / width * degrees**2)
        share = weight * math.sqrt(math.pi / width) * float(taps.sum()) ** 2
        taps = (taps / taps.sum()).astype(np.float32)
        total += np.float32(share) * _filtered(channel, taps, taps)
        mass += share
    return total / np.float32(mass)


def _strength(brightness: Floats, order: int) -> Floats:
    """Length of the gradient (order 1: edges) or of the second derivatives (2: spots)."""
    sigma = 0.5 * FEATURE_WIDTH * PIXELS_PER_DEGREE
    x = np.arange(-math.ceil(3 * sigma), math.ceil(3 * sigma) + 1)
    gaussian = np.exp(-(x**2) / (2 * sigma**2))
    derived = -x * gaussian if order == 1 else (x**2 / sigma**2 - 1) * gaussian
    # over the plane, what is positive sums to 1 and what is negative to -1
    derived = np.where(
        derived > 0, derived / derived[derived > 0].sum(), derived / -derived[derived < 0].sum()
    ).astype(np.float32)
    flat = (gaussian / gaussian.sum()).astype(np.float32)
    across, down = _filtered(brightness, derived, flat), _filtered(brightness, flat, derived)
    return np.sqrt(across * across + down * down)  # cv2.magnitude differs by where arrays lie


def _filtered(channel: Floats, across: Floats, down: Floats) -> Floats:
    blurred = cv2.sepFilter2D(channel, cv2.CV_32F, across, down, borderType=cv2.BORDER_REPLICATE)
    return np.asarray(blurred)


def _hunt_lab(rgb: npt.NDArray[np.floating]) -> Floats:
    """L*a*b* of linear RGB [..., 3]; dark colours look less colourful (Hunt)."""
    ratio = _times(rgb.astype(np.float32), _XYZ_FROM_RGB / _WHITE[:, None])
    delta = 6 / 29
    low = ratio * np.float32(1 / (3 * delta**2)) + np.float32(4 / 29)
    root = np.where(ratio > delta**3, np.cbrt(ratio), low)
    lightness = 116 * root[..., 1] - 16
    hunt = np.float32(0.01) * lightness
    a, b = 500 * (root[..., 0] - root[..., 1]), 200 * (root[..., 1] - root[..., 2])
    return np.stack([lightness, hunt * a, hunt * b], -1)


def _distance(first: Floats, second: Floats) -> Floats:
    """HyAB distance to the power of `COLOR_EXPONENT`."""
    difference = first - second
    chroma = np.sqrt(difference[..., 1] ** 2 + difference[..., 2] ** 2)
    return (np.abs(difference[..., 0]) + chroma) ** np.float32(COLOR_EXPONENT)


def _spread(distance: Floats) -> Floats:
    """Distances to 0..1: the smaller ones get most of the range."""
    largest = float(_distance(*_hunt_lab(np.eye(3)[None, [1, 2]])[0]))
    bend = SHARE_OF_LARGEST * largest
    above = SPREAD_TO + (distance - bend) / (largest - bend) * (1 - SPREAD_TO)
    return np.asarray(np.where(distance < bend, distance * (SPREAD_TO / bend), above), np.float32)
