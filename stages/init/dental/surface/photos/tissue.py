"""Where a photograph shows gum, the dark around the jaws, brackets and wires: by colour."""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt

from pipeline.artifacts.teeth import Dentition

Array32 = npt.NDArray[np.float32]
Mask = npt.NDArray[np.bool_]

#: Gum is learnt in a ring beside the crowns (mm) on the gums' side.
_RING = (0.4, 2.2)
#: Least standard deviations of the gum's colour (8-bit L, a, b).
_GUM_SPREAD = (14.0, 4.0, 4.5)
#: Lighter and less red than the gum by more than so many standard deviations: not gum.
_PALE = 1.8
#: Holes in tooth and gum up to this size (square mm) that are not dark are wet highlights, or
#: crowns of another colour.
_BRIGHT_HOLE = 30.0
#: Highlights that tissue encloses may be so large (square mm; the largest of 48 photographs: 73).
#: Most of one is lighter than the gum by more than shade makes it darker, and of what is not white
#: at least so much is red: retractors are grey, lips and cheeks that look like a hole are darker.
_HIGHLIGHT, _RED_SHARE = 80.0, 0.85
#: Not dark: lighter than so much of the gum.
_LIT = 0.6
#: Share of that size up to which a hole is a speck, bright or not.
_SPECK = 0.02
#: Darker than so much of the median of the teeth, over at least so many mm: nothing is there that a
#: light beside the lens could reach.
_VOID, _VOID_SIZE = 0.2, 1.0
#: Gum in shade: that much darker (8-bit L) is no reason to call it something else.
_GUM_SHADE = 25.0
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


def find_gum(
    lab: Array32,
    tooth: Mask,
    shiny: Mask,
    dentition: Dentition,
    density: float,
    deviations: float,
) -> Mask:
    """Gum around the teeth, told from gloves, lips, retractors and the dark by its colour.

    The ring just beyond the crowns is gum nearly everywhere: its median colour and spread are those
    of this patient's gum in this light.

    Args:
        lab: [H, W, 3] float32, 8-bit scaling.
        tooth: [H, W] bool.
        shiny: [H, W] bool, highlights.
        dentition: the teeth.
        density: pixels per mm.
        deviations: furthest colour, in standard deviations.

    Returns:
        [H, W] bool; all False where nothing red is beside the crowns.
    """
    distance = cv2.distanceTransform((~tooth).astype(np.uint8), cv2.DIST_L2, 5) / density
    ring = (distance > _RING[0]) & (distance < _RING[1]) & _gumwards(tooth, dentition)
    red = lab[..., 1] > (np.median(lab[tooth, 1]) if tooth.any() else 0) + 6
    seed = lab[ring & red]
    if len(seed) < 50:
        return np.zeros(tooth.shape, bool)
    middle = np.median(seed, axis=0)
    spread = np.maximum(1.4826 * np.median(np.abs(seed - middle), axis=0), _GUM_SPREAD)
    smooth = np.asarray(cv2.GaussianBlur(lab, (0, 0), max(0.1 * density, 0.6)), np.float32)
    away = (smooth - middle.astype(np.float32)) / spread.astype(np.float32)
    away[..., 0] = np.where(
        away[..., 0] < 0, np.minimum(away[..., 0] + _GUM_SHADE / spread[0], 0), away[..., 0]
    )
    # Gloves and lips under them are both lighter and less red than gum.
    pale = (away[..., 0] - away[..., 1]) / np.float32(np.sqrt(2))
    like = ((away**2).sum(-1) < deviations**2) & (pale < _PALE) & ~tooth
    small = disc(0.35 * density)
    # Small wet highlights on the gum are gum; thin red seams of a glove are not.
    closed = cv2.morphologyEx((like | tooth).astype(np.uint8), cv2.MORPH_CLOSE, small)
    opened = cv2.morphologyEx(closed, cv2.MORPH_OPEN, small) > 0
    tissue = opened | tooth
    lit, light = (smooth[..., 0] > level for level in (_LIT * middle[0], middle[0] + _GUM_SHADE))
    tissue = tissue | _bright_holes(tissue, lit, _BRIGHT_HOLE * density**2)
    tissue = tissue | _highlights_within(tissue, light, red, shiny, _HIGHLIGHT * density**2)
    return joined_to(tissue, tooth) & ~tooth


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


def _bright_holes(tissue: Mask, bright: Mask, most: float) -> Mask:
    """Holes of at most `most` pixels, most of which are bright."""
    count, label = cv2.connectedComponents((~tissue).astype(np.uint8), connectivity=4)
    area = np.bincount(label.ravel(), minlength=count)
    lit = np.bincount(label[bright], minlength=count)
    hole = ((area <= most) & (lit > 0.7 * area)) | (area <= most * _SPECK)
    hole[0] = False
    return hole[label]


def _highlights_within(tissue: Mask, light: Mask, red: Mask, shiny: Mask, most: float) -> Mask:
    """Holes of at most `most` pixels that tissue encloses, lighter than it and as red."""
    count, label = cv2.connectedComponents((~tissue).astype(np.uint8), connectivity=4)

    def pixels(mask: Mask) -> npt.NDArray[np.int64]:
        return np.bincount(label[mask], minlength=count)

    area = pixels(~tissue)
    hole = (area <= most) & (pixels(light) > area / 2)
    hole &= pixels(red & ~shiny) >= _RED_SHARE * pixels(~shiny)
    hole[np.concatenate([label[0], label[-1], label[:, 0], label[:, -1]])] = False
    hole[0] = False
    return hole[label]


def _gumwards(tooth: Mask, dentition: Dentition) -> Mask:
    """[H, W] bool: beyond the row of teeth, not between the jaws."""
    y, x = np.mgrid[: tooth.shape[0], : tooth.shape[1]]
    places, across = dentition.levelled(x, y)
    along = np.rint(places).astype(np.int64)
    along -= along.min()
    size = int(along.max()) + 1
    highest = np.full(size, np.inf)
    lowest = np.full(size, -np.inf)
    np.minimum.at(highest, along[tooth], across[tooth])
    np.maximum.at(lowest, along[tooth], across[tooth])
    return (across < highest[along]) | (across > lowest[along])
