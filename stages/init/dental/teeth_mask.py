"""Which pixels of a photograph of a mouth are teeth, by colour and by place.

The one feature is the *greenness* ``2 log G - log R - log B``. Enamel has more of it than gum,
lips, gloves and highlights, and a cast of the light (a gain per channel) or an exposure moves it by
a constant for all of them, so that only its modes within a photograph count, never its value.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import cv2
import numpy as np
import numpy.typing as npt

Bool = npt.NDArray[np.bool_]
Float = npt.NDArray[np.float32]

#: Added before logarithms: keeps the noise of dark pixels from being read as colour.
LOG_FLOOR = 0.04
#: Noise and JPEG blocks in the colour are smoothed by this (pixels): less than a gum line is sharp.
GREENNESS_BLUR = 1.2
#: A channel above this is saturated: an overexposed camera pixel is 254 or 255.
SATURATED = 0.97
#: Range and bins of the greenness histogram.
GREENNESS_RANGE = (-2.0, 1.2)
GREENNESS_BINS = 640
#: Standard deviation (greenness) by which the histogram is smoothed before its modes are read: half
#: the least distance between enamel and a glove seen on real photographs (.09).
HISTOGRAM_BLUR = 0.014
#: A valley counts as one if it is this much lower than the lower of its two peaks.
VALLEY_DEPTH = 0.12
#: Modes with less than this share of the (weighted) pixels are no class of their own.
LEAST_MODE = 0.01
#: Gum is at least this much less green than enamel, and redder (log R/G) by this much.
GUM_GREENNESS_GAP = 0.12
GUM_REDNESS_GAP = 0.05


@dataclass(frozen=True)
class MaskOptions:
    """Settings of `find_teeth`. Lengths are shares of the image's width or height.

    Attributes:
        highlight_level: a pixel whose darkest channel exceeds this (sRGB) is taken for a highlight,
            and its colour is filled in from around it.
        largest_highlight: share of the pixels of the largest spot treated so; larger ones are white
            things.
        darkest: pixels darker than this share of the enamel's brightness have no colour to trust.
        least_area, largest_area: share of the image that teeth can cover.
        largest_height: share of the image's height that the band of teeth can cover.
        gum_contact: share of the outline that must border on gum.
        centre_width, centre_height: how far from the centre teeth are expected (Gaussian).
    """

    highlight_level: float = 0.93
    largest_highlight: float = 0.005
    darkest: float = 0.22
    least_area: float = 0.012
    largest_area: float = 0.55
    largest_height: float = 0.62
    gum_contact: float = 0.3
    centre_width: float = 0.4
    centre_height: float = 0.27


@dataclass(frozen=True)
class Channels:
    """What is read of a photograph, [H, W] each.

    Attributes:
        lightness: 0..100 (CIE L), highlights as they are.
        greenness: see the module; highlights filled in.
        redness: log R/G.
        brightness: largest channel, 0..1.
        clipped: share of the middle of the photograph in which all channels are saturated.
        highlight: True on highlights.
        valid: True where the photograph counts.
    """

    lightness: Float
    greenness: Float
    redness: Float
    brightness: Float
    highlight: Bool
    valid: Bool
    clipped: float


@dataclass(frozen=True)
class TeethMask:
    """Teeth as found.

    Attributes:
        mask: [H, W] bool.
        centre: median greenness of enamel.
        gum_gap: median greenness of enamel less that of the gum beside it.
        gum_contact: share of the outline that borders on gum.
        fragments: parts of some size that the mask consists of.
        score: how much it looks like a row of teeth, 0..1.
    """

    mask: Bool
    centre: float
    gum_gap: float
    gum_contact: float
    fragments: int
    score: float


def ellipse(size: int) -> npt.NDArray[np.uint8]:
    """A round structuring element, `size` pixels across."""
    return np.asarray(cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size)), dtype=np.uint8)


def read_channels(image: Float, valid: Bool, options: MaskOptions) -> Channels:
    """Colour features of a photograph [H, W, 3] (sRGB 0..1), edges kept and noise smoothed."""
    eight_bit = np.clip(image * 255 + 0.5, 0, 255).astype(np.uint8)
    smooth = cv2.bilateralFilter(eight_bit, 7, 25, 5)
    lightness = cv2.cvtColor(smooth, cv2.COLOR_RGB2LAB)[..., 0].astype(np.float32) / 2.55
    colour = smooth.astype(np.float32) / 255
    logs = np.log(colour + LOG_FLOOR)
    greenness = 2 * logs[..., 1] - logs[..., 0] - logs[..., 2]
    highlight = _highlights(colour, options)
    weight = central_weight((image.shape[0], image.shape[1]), options)
    low, high = GREENNESS_RANGE
    coded = np.clip((greenness - low) / (high - low) * 255, 0, 255).astype(np.uint8)
    if highlight.any():
        size = (image.shape[1] // 2, image.shape[0] // 2)
        small = cv2.resize(coded, size, interpolation=cv2.INTER_AREA)
        holes = cv2.resize(highlight.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST)
        filled = cv2.inpaint(small, holes, 4, cv2.INPAINT_TELEA)
        filled = cv2.resize(filled, coded.shape[::-1], interpolation=cv2.INTER_LINEAR)
        greenness = np.where(
            highlight, filled.astype(np.float32) / 255 * (high - low) + low, greenness
        )
    greenness = cv2.GaussianBlur(greenness.astype(np.float32), (0, 0), GREENNESS_BLUR)
    return Channels(
        lightness=lightness,
        greenness=np.asarray(greenness, dtype=np.float32),
        redness=(logs[..., 0] - logs[..., 1]).astype(np.float32),
        brightness=colour.max(axis=-1),
        highlight=highlight,
        valid=valid,
        clipped=float((weight * (colour.min(axis=-1) > SATURATED)).sum() / weight.sum()),
    )


def _highlights(colour: Float, options: MaskOptions) -> Bool:
    """Small spots [H, W] in which all channels are near saturation."""
    bright = (colour.min(axis=-1) > options.highlight_level).astype(np.uint8)
    bright = cv2.dilate(bright, np.ones((5, 5), np.uint8))
    _, labels, stats, _ = cv2.connectedComponentsWithStats(bright)
    small = stats[:, cv2.CC_STAT_AREA] <= options.largest_highlight * bright.size
    small[0] = False
    return np.asarray(small[labels])


def central_weight(shape: tuple[int, int], options: MaskOptions) -> Float:
    """[H, W] weight, 1 at the centre of the image, where teeth are expected."""
    height, width = shape
    rows = (np.arange(height, dtype=np.float32) + 0.5) / height - 0.5
    columns = (np.arange(width, dtype=np.float32) + 0.5) / width - 0.5
    vertical = np.exp(-((rows / options.centre_height) ** 2))
    horizontal = np.exp(-((columns / options.centre_width) ** 2))
    return np.asarray(vertical[:, None] * horizontal[None], dtype=np.float32)


def histogram(channels: Channels, weight: Float) -> npt.NDArray[np.float64]:
    """Smoothed, weighted histogram [GREENNESS_BINS] of the greenness of all but dark pixels."""
    used = channels.valid & ~channels.highlight
    floor = 0.3 * float(np.percentile(channels.brightness[used], 90)) if used.any() else 0.0
    used &= channels.brightness > floor
    counts, _ = np.histogram(
        channels.greenness[used], GREENNESS_BINS, GREENNESS_RANGE, weights=weight[used]
    )
    bin_width = (GREENNESS_RANGE[1] - GREENNESS_RANGE[0]) / GREENNESS_BINS
    blurred = cv2.GaussianBlur(
        counts.astype(np.float64)[None],
        (0, 0),
        HISTOGRAM_BLUR / bin_width,
        borderType=cv2.BORDER_CONSTANT,
    )[0]
    return np.asarray(blurred / max(float(blurred.sum()), 1e-12))


def valleys(counts: npt.NDArray[np.float64]) -> list[float]:
    """Greenness values at which a histogram parts into modes, ascending, with both ends."""
    low, high = GREENNESS_RANGE
    edges = np.linspace(low, high, GREENNESS_BINS + 1)
    is_peak = (counts[1:-1] > counts[:-2]) & (counts[1:-1] >= counts[2:]) & (counts[1:-1] > 0)
    peaks = [int(peak) + 1 for peak in np.flatnonzero(is_peak)]
    cuts: list[int] = []  # bin of the valley between each peak and the next
    for before, after in pairwise(peaks):
        cuts.append(before + int(np.argmin(counts[before : after + 1])))
    # The shallowest valley goes first, until every one is deep and every mode has its share.
    while cuts:
        starts, ends = [0, *cuts], [*cuts, GREENNESS_BINS]
        heights = [float(counts[a:b].max()) for a, b in zip(starts, ends, strict=True)]
        masses = [float(counts[a:b].sum()) for a, b in zip(starts, ends, strict=True)]
        depths = []
        for index, cut in enumerate(cuts):
            lower = min(heights[index], heights[index + 1])
            depth = 1 - float(counts[cut]) / lower
            if min(masses[index], masses[index + 1]) < LEAST_MODE:
                depth = min(depth, 0.0)
            depths.append(depth)
        weakest = int(np.argmin(depths))
        if depths[weakest] >= VALLEY_DEPTH:
            break
        del cuts[weakest]
    return [low, *(float(edges[cut]) for cut in cuts), high]


def find_teeth(
    channels: Channels, options: MaskOptions, pooled: list[float] | None = None
) -> TeethMask | None:
    """The row of teeth: the class of greenness whose place and outline are those of teeth.

    Args:
        channels: of the photograph.
        options: settings.
        pooled: borders between classes found on all photographs of the case, tried besides those of
            this photograph.

    Returns:
        None where no class looks like teeth.
    """
    weight = central_weight(channels.greenness.shape, options)
    candidates = set()
    for borders in [valleys(histogram(channels, weight)), pooled or []]:
        for first in range(1, len(borders) - 1):
            for last in range(first + 1, len(borders)):
                candidates.add((borders[first], borders[last]))
    best: TeethMask | None = None
    for span in sorted(candidates):
        found = mask_of_range(channels, span, weight, options)
        if found is not None and (best is None or found.score > best.score):
            best = found
    return best


def mask_of_range(
    channels: Channels, span: tuple[float, float], weight: Float, options: MaskOptions
) -> TeethMask | None:
    """The mask of pixels whose greenness lies in a range, cleaned, and what speaks for it."""
    height, width = channels.greenness.shape
    inside = (channels.greenness > span[0]) & (channels.greenness <= span[1]) & channels.valid
    weighted = weight * inside
    if float(weighted.sum()) < 0.02 * float(weight.sum()):
        return None
    sampled = inside & (weight > 0.3)
    if not sampled.any():
        return None
    level = float(np.percentile(channels.brightness[sampled], 70))
    inside &= channels.brightness > options.darkest * level
    mask = cv2.morphologyEx(inside.astype(np.uint8), cv2.MORPH_OPEN, ellipse(odd(width * 0.007)))
    mask = cv2.morphologyEx(mask, cv2.MORPH_CLOSE, ellipse(odd(width * 0.009)))
    centre = float(np.median(channels.greenness[sampled]))
    redness = float(np.median(channels.redness[sampled]))
    gum = (
        (channels.greenness < centre - GUM_GREENNESS_GAP)
        & (channels.redness > redness + GUM_REDNESS_GAP)
        & (channels.brightness > 0.15 * level)
    )
    near_gum = cv2.dilate(gum.astype(np.uint8), ellipse(odd(width * 0.015))) > 0
    kept, contact, fragments = _parts_like_teeth(mask, near_gum, weight, options)
    if kept is None:
        return None
    kept = _without_holes(kept, channels.lightness)
    area = float(kept.mean())
    rows = kept.sum(axis=0)
    occupied = rows > 0
    tallness = float(np.percentile(rows[occupied], 90)) / height
    if not options.least_area <= area <= options.largest_area or tallness > options.largest_height:
        return None
    around = cv2.dilate(kept.astype(np.uint8), ellipse(odd(width * 0.03))).astype(bool) & ~kept
    beside = around & gum
    if not beside.any():
        return None
    # Nothing beside teeth is greener than they are: what lies between enamel and gum is no tooth.
    greener = float((around & (channels.greenness > span[1]) & channels.valid).sum() / around.sum())
    gap = float(np.median(channels.greenness[kept]) - np.median(channels.greenness[beside]))
    # Teeth are central, bordered by gum, wider than tall, and don't reach the top or bottom edge.
    central = float((weight * kept).sum() / weight.sum())
    border = float(kept[0].mean() + kept[-1].mean())
    wide = float(
        np.clip(occupied.sum() / max(float(np.median(rows[occupied])), 1.0) / 3.0, 0.2, 1.0)
    )
    score = (
        max(0.0, contact - 2 * greener) * min(central / 0.25, 1.0) * wide * max(0.0, 1 - 2 * border)
    )
    return TeethMask(
        kept, float(np.median(channels.greenness[kept])), gap, contact, fragments, score
    )


def _parts_like_teeth(
    mask: npt.NDArray, near_gum: Bool, weight: Float, options: MaskOptions
) -> tuple[Bool | None, float, int]:
    """The connected parts [H, W] that border on gum, the share of their outline that does, and how
    many of some size there are."""
    count, labels, stats, _ = cv2.connectedComponentsWithStats(mask, connectivity=4)
    outline = (mask > 0) & (cv2.erode(mask, np.ones((3, 3), np.uint8)) == 0)
    edge = np.bincount(labels[outline], minlength=count).astype(np.float64)
    touching = np.bincount(labels[outline & near_gum], minlength=count).astype(np.float64)
    centrality = np.bincount(labels.ravel(), weights=weight.ravel(), minlength=count)
    area = stats[:, cv2.CC_STAT_AREA].astype(np.float64)
    mean_weight = centrality / np.maximum(area, 1)
    contact = touching / np.maximum(edge, 1)
    good = (contact > options.gum_contact) & (mean_weight > 0.08) & (area > 0.0005 * mask.size)
    good[0] = False
    if not good.any():
        return None, 0.0, 0
    main = int(np.argmax(np.where(good, centrality, -1)))
    top = stats[main, cv2.CC_STAT_TOP]
    bottom = top + stats[main, cv2.CC_STAT_HEIGHT]
    reach = 0.35 * (bottom - top)
    middle = stats[:, cv2.CC_STAT_TOP] + stats[:, cv2.CC_STAT_HEIGHT] / 2
    good &= (middle > top - reach) & (middle < bottom + reach) & (area > 0.004 * area[main])
    # A small spot above or below the row is a highlight on gum; another jaw would be wide.
    left, part_width = stats[:, cv2.CC_STAT_LEFT], stats[:, cv2.CC_STAT_WIDTH]
    beside = (left + part_width <= left[main] + 2) | (left >= left[main] + part_width[main] - 2)
    between = (middle > top + 0.25 * (bottom - top)) & (middle < bottom - 0.25 * (bottom - top))
    # (and tall: the blurred rim of a glove is a thin strip)
    thickness = area / np.maximum(part_width, 1)
    jaw = (part_width > 0.25 * part_width[main]) & (thickness > 0.25 * thickness[main])
    good &= beside | between | jaw
    good[main] = True
    large = good & (area > 0.02 * area[main])
    share = float(touching[good].sum() / edge[good].sum())
    return np.asarray(good[labels]), share, int(large.sum())


def _without_holes(mask: Bool, lightness: Float) -> Bool:
    """The mask with its small holes filled, but for the dark ones (gaps between the jaws)."""
    count, labels, stats, _ = cv2.connectedComponentsWithStats(
        (~mask).astype(np.uint8), connectivity=4
    )
    area = stats[:, cv2.CC_STAT_AREA].astype(np.float64)
    mean = np.bincount(labels.ravel(), weights=lightness.ravel(), minlength=count) / np.maximum(
        area, 1
    )
    left, top = stats[:, cv2.CC_STAT_LEFT], stats[:, cv2.CC_STAT_TOP]
    right, bottom = left + stats[:, cv2.CC_STAT_WIDTH], top + stats[:, cv2.CC_STAT_HEIGHT]
    inner = (left > 0) & (top > 0) & (right < mask.shape[1]) & (bottom < mask.shape[0])
    filled = inner & (area < 0.004 * mask.size) & (mean > 35)
    filled[0] = False
    return np.asarray(mask | filled[labels])


def odd(size: float) -> int:
    """The nearest odd number from 3 up: sizes of structuring elements."""
    return max(3, 2 * round((size - 1) / 2) + 1)
