"""Where a photograph shows the dark around the jaws, brackets and wires: by colour."""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt

Array32 = npt.NDArray[np.float32]
Mask = npt.NDArray[np.bool_]

#: Notches narrower than twice this (mm), and enclosed holes up to this size (square mm), in what is
#: tooth or gum are wet highlights, or the shade between crowns; fringes so narrow are neither.
_NOTCH, _HOLE = 1.0, 30.0
#: Darker than so much of the median of the teeth, over at least so many mm: nothing is there that a
#: light beside the lens could reach.
_VOID, _VOID_SIZE = 0.2, 1.0
#: Enamel around a place is what it is in the mean up to so far to either side (mm).
_AROUND = 5.0
#: Hardware is darker than so much of the enamel around it, for sure with so much less again.
_DARK, _DARK_SURE = 0.8, 0.3
#: Or it is no lighter than enamel and less yellow by so much (CIE b), for sure with so much more.
_GREY, _GREY_SURE = 7.0, 5.0
#: It is no redder than enamel by so much (CIE a); gum and the shade between crowns are.
_RED, _RED_SURE = 12.0, 6.0
#: Brackets part a crown in the outline that was read; so much is closed (mm).
_PARTED = 1.5


def eight_bit_lab(image: Array32) -> Array32:
    """CIE Lab [H, W, 3] float32, each channel scaled as in 8-bit images (L 0..255)."""
    lab = np.asarray(cv2.cvtColor(np.ascontiguousarray(image, np.float32), cv2.COLOR_RGB2Lab))
    return np.asarray(lab * np.array([2.55, 1, 1], np.float32), np.float32)


def disc(radius: float) -> npt.NDArray[np.uint8]:
    """A disc of so many whole pixels, at least one, to erode and dilate with."""
    size = max(int(radius), 1)
    shape = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * size + 1, 2 * size + 1))
    return np.asarray(shape, np.uint8)


def joined_to(mask: Mask, seeds: Mask) -> Mask:
    """[H, W] bool: the pieces of a mask [H, W] that hold one of the seeds [H, W]."""
    count, label = cv2.connectedComponents(mask.astype(np.uint8), connectivity=4)
    held = np.zeros(count, bool)
    held[np.unique(label[seeds])] = True
    held[0] = False
    return held[label]


def without_small_holes(mask: Mask, density: float) -> Mask:
    """A mask [H, W] with the holes and notches filled that are too small for anything to be in.

    Args:
        mask: [H, W] bool.
        density: pixels per mm.
    """
    height, width = mask.shape
    margin = int(_NOTCH * density) + 1
    wide = np.pad(mask, margin, mode="edge").astype(np.uint8)
    closed = cv2.morphologyEx(wide, cv2.MORPH_CLOSE, disc(_NOTCH * density))
    closed = closed[margin : margin + height, margin : margin + width]
    _, label, stats, _ = cv2.connectedComponentsWithStats(
        (closed == 0).astype(np.uint8), connectivity=4
    )
    x, y, w, h = stats[:, :4].T
    enclosed = (x > 0) & (y > 0) & (x + w < width) & (y + h < height)
    hole = enclosed & (stats[:, 4] <= _HOLE * density**2)
    hole[0] = False
    return (closed > 0) | hole[label]


def without_fringes(mask: Mask, density: float) -> Mask:
    """A mask [H, W] bool, so many samples per mm, without the fringes and notches of its rim."""
    narrow = disc(_NOTCH * density)
    closed = cv2.morphologyEx(mask.astype(np.uint8), cv2.MORPH_CLOSE, narrow)
    return np.asarray(cv2.morphologyEx(closed, cv2.MORPH_OPEN, narrow) > 0)


def find_void(lightness: Array32, tooth: Mask, density: float) -> Mask:
    """Where a photograph shows nothing but the dark around the jaws.

    Args:
        lightness: [H, W] float32, CIE L as in 8-bit images.
        tooth: [H, W] bool.
        density: pixels per mm.

    Returns:
        [H, W] bool; all False where no tooth is there to compare with.
    """
    if not tooth.any():
        return np.zeros(tooth.shape, bool)
    smooth = np.asarray(cv2.GaussianBlur(lightness, (0, 0), max(0.1 * density, 0.6)))
    dark = (smooth < _VOID * np.median(smooth[tooth])) & ~tooth
    narrow = disc(round(_VOID_SIZE / 2 * density))
    return np.asarray(cv2.morphologyEx(dark.astype(np.uint8), cv2.MORPH_OPEN, narrow) > 0)


def find_hardware(lab: Array32, tooth: Mask, density: float) -> Array32:
    """How sure a pixel on or between the crowns is a bracket or a wire, by its colour.

    Args:
        lab: [H, W, 3] float32, 8-bit scaling.
        tooth: [H, W] bool.
        density: pixels per mm.

    Returns:
        [H, W] float32 0..1.
    """
    crowns = tooth.astype(np.float32)
    closed = cv2.morphologyEx(crowns, cv2.MORPH_CLOSE, disc(_PARTED * density)) > 0
    smooth = np.asarray(cv2.GaussianBlur(lab, (0, 0), max(0.12 * density, 0.6)), np.float32)

    def around(values: Array32, weight: Array32) -> Array32:
        size = (2 * int(_AROUND * density) + 1,) * 2
        mass = cv2.blur(weight, size)
        return np.asarray(cv2.blur(values * weight, size) / np.maximum(mass, 1e-3), np.float32)

    # The mean of what is not darker than the mean: enamel, without most of the hardware.
    light = around(smooth[..., 0], crowns)
    enamel = crowns * (smooth[..., 0] > _DARK * light)
    light, red, yellow = (around(smooth[..., c], enamel) for c in range(3))
    share = smooth[..., 0] / np.maximum(light, 1)
    dark = (_DARK - share) / _DARK_SURE
    grey = np.minimum((yellow - smooth[..., 2] - _GREY) / _GREY_SURE, (1 - share) / 0.1)
    pale = (_RED - (smooth[..., 1] - red)) / _RED_SURE
    score = np.minimum(np.maximum(dark, grey), pale)
    return np.where(closed, np.clip(score, 0, 1), 0).astype(np.float32)
