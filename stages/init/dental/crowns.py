"""The crowns in an upright photograph: where the gum line dips, and where the jaws meet."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise

import cv2
import numpy as np
import numpy.typing as npt
from scipy.ndimage import gaussian_filter1d
from scipy.signal import find_peaks

from stages.init.dental.anatomy import Jaw
from stages.init.dental.observation import Crown
from stages.init.dental.occlusal import dark_lines, occlusal_line
from stages.init.dental.teeth_mask import Bool, Channels, Float, ellipse

Profile = npt.NDArray[np.float64]  # [C] one row coordinate per column
Point = npt.NDArray[np.float64]

#: Shares of the band's height within which the gum line or biting edge counts as its extremum: the
#: landmark is the middle of that stretch, for crowns end flat.
ZENITH_FLATNESS = 0.035
TIP_FLATNESS = 0.03
EMBRASURE_FLATNESS = 0.015
#: The climb of the gum line is its average over this standard deviation (share of the band), and a
#: shoulder of it parts two crowns if a dark line is this near.
SHOULDER_TREND = 0.4
SHOULDER_REACH = 0.08
#: Half width, in crown widths, of the stretch beside a papilla in which its embrasure is sought.
EMBRASURE_REACH = 0.3


@dataclass(frozen=True)
class CrownOptions:
    """Settings of `find_crowns`. Heights and widths in shares of the band's height (gum to gum).

    Attributes:
        least_papilla: least height of the gum between two crowns over the lower of their zeniths.
        least_shoulder: the same once the climb of the gum line is taken out, where a dark line
            between the crowns agrees.
        least_width: narrower dips of the gum line are no crowns.
        least_height: what is lower than this at the ends of a row is no crown.
        least_column: columns in which the band is lower than this share of its median are left out.
        narrow, wide: a crown is doubtful if its width is less or more than this many times what its
            neighbours suggest.
        split_contrast: CIE L by which a line between two crowns must be darker than they are for a
            wide crown to be split there.
    """

    least_papilla: float = 0.035
    least_shoulder: float = 0.02
    least_width: float = 0.1
    least_height: float = 0.05
    least_column: float = 0.35
    narrow: float = 0.5
    wide: float = 1.6
    split_contrast: float = 4.0


@dataclass(frozen=True)
class UprightRow:
    """A row of teeth in an upright image. Rows and columns are those of the image's pixels.

    Attributes:
        upper, lower: crowns from left to right.
        mask: [H, W] the mask, without what stands out from the row.
        columns: [C] the columns of the row.
        meet: [C] row in which the jaws meet.
        band_height: median of the distance between the gum lines.
    """

    upper: tuple[Crown, ...]
    lower: tuple[Crown, ...]
    mask: Bool
    columns: npt.NDArray[np.int64]
    meet: Profile
    band_height: float


@dataclass(frozen=True)
class _Stretch:
    """A crown between two papillae: columns (indices into the row's), and what is known of it."""

    left: int
    right: int
    doubtful: bool = False

    @property
    def width(self) -> int:
        return self.right - self.left


def find_crowns(channels: Channels, mask: Bool, options: CrownOptions) -> UprightRow | None:
    """Crowns and their landmarks in an upright image.

    Args:
        channels: of the image.
        mask: [H, W] True on teeth.

    Returns:
        None where the mask is no row (fewer than a few columns, or no height).
    """
    height, _ = mask.shape
    band = _typical_height(mask)
    if band < 20:  # pixels of an image 1024 px wide: nothing can be told apart
        return None
    size = max(3, round(0.04 * band) * 2 + 1)
    mask = cv2.morphologyEx(mask.astype(np.uint8), cv2.MORPH_OPEN, ellipse(size)) > 0
    found = _row_columns(mask, options)
    if found is None:
        return None
    columns, top, bottom = found
    band = float(np.median(bottom - top))
    dark = dark_lines(channels.lightness, channels.highlight, max(int(0.09 * band), 2))
    smooth_top = gaussian_filter1d(top, 0.25 * band)
    smooth_bottom = gaussian_filter1d(bottom, 0.25 * band)
    highest, lowest = occlusal_line(
        np.ascontiguousarray(channels.lightness[:, columns]),
        np.ascontiguousarray(dark[:, columns]),
        mask[:, columns],
        smooth_top,
        np.maximum(smooth_bottom, smooth_top + 0.3 * band),
    )
    meet = (highest + lowest) / 2
    upper = _jaw_crowns("upper", columns, top, highest, lowest, meet, dark, band, options)
    lower = _jaw_crowns("lower", columns, bottom, highest, lowest, meet, dark, band, options)
    rows = np.arange(height)[:, None]
    row_mask = np.zeros_like(mask)
    row_mask[:, columns] = mask[:, columns] & (rows >= top) & (rows <= bottom)
    return UprightRow(upper, lower, row_mask, columns, meet, band)


def _typical_height(mask: Bool) -> float:
    count = mask.sum(axis=0)
    return float(np.median(count[count > 0])) if count.any() else 0.0


def _row_columns(
    mask: Bool, options: CrownOptions
) -> tuple[npt.NDArray[np.int64], Profile, Profile] | None:
    """Columns of the row, and the upper and lower end of the mask in each (pixel centres)."""
    height = mask.shape[0]
    occupied = np.flatnonzero(mask.any(axis=0))
    if len(occupied) < 40:
        return None
    columns = np.arange(occupied[0], occupied[-1] + 1)
    chosen = mask[:, columns]
    some = chosen.any(axis=0)
    top = np.where(some, chosen.argmax(axis=0), np.nan).astype(np.float64)
    bottom = np.where(some, height - 1 - chosen[::-1].argmax(axis=0), np.nan).astype(np.float64)
    tall = bottom - top
    good = np.flatnonzero(some & (tall > options.least_column * np.nanmedian(tall)))
    if len(good) < 40:
        return None
    first, last = good[0], good[-1]
    inside = np.arange(first, last + 1)
    top = np.interp(inside, np.flatnonzero(some), top[some])
    bottom = np.interp(inside, np.flatnonzero(some), bottom[some])
    return columns[first : last + 1], top, bottom


def _jaw_crowns(
    jaw: Jaw,
    columns: npt.NDArray[np.int64],
    gum_line: Profile,
    highest: Profile,
    lowest: Profile,
    meet: Profile,
    dark: Float,
    band: float,
    options: CrownOptions,
) -> tuple[Crown, ...]:
    """Crowns of one jaw from left to right."""
    sign = 1.0 if jaw == "upper" else -1.0  # so that the gum is always towards smaller values
    gum = gaussian_filter1d(sign * gum_line, max(1.5, 0.012 * band))
    between = _dark_between(columns, gum_line, meet, dark)
    papillae = _papillae(gum, between, band, options)
    ends = [0, *papillae, len(gum) - 1]
    stretches = [
        _Stretch(left, right)
        for left, right in pairwise(ends)
        if right - left >= options.least_width * band
    ]
    stretches = _shown(stretches, sign * meet - gum, options.least_height * band)
    stretches = _split_wide(stretches, between, band, options)
    stretches = _marked(stretches, options)
    biting = (lowest if jaw == "upper" else -highest).astype(np.float64)
    parting = (highest if jaw == "upper" else -lowest).astype(np.float64)
    embrasures = [_embrasure(before, after, parting) for before, after in pairwise(stretches)]

    def point(column: float, value: float) -> Point:
        return np.array([columns[0] + column + 0.5, sign * value + 0.5])

    crowns = []
    for index, stretch in enumerate(stretches):
        part = gum[stretch.left : stretch.right + 1]
        zenith = stretch.left + float(
            np.flatnonzero(part <= part.min() + ZENITH_FLATNESS * band).mean()
        )
        start = stretch.left if index == 0 else embrasures[index - 1][0]
        end = stretch.right if index == len(stretches) - 1 else embrasures[index][0]
        tip, tip_row = _tip(biting, start, end, TIP_FLATNESS * band)
        first, last = index == 0, index == len(stretches) - 1
        crowns.append(
            Crown(
                jaw=jaw,
                zenith=point(zenith, float(part.min())),
                tip=point(tip, tip_row),
                papilla_left=None if first else point(stretch.left, float(gum[stretch.left])),
                papilla_right=None if last else point(stretch.right, float(gum[stretch.right])),
                embrasure_left=None if first else point(*embrasures[index - 1]),
                embrasure_right=None if last else point(*embrasures[index]),
                width=float(stretch.width),
                height=max(tip_row - float(part.min()), 1.0),
                cut_left=first,
                cut_right=last,
                doubtful=stretch.doubtful,
            )
        )
    return tuple(crowns)


def _shown(stretches: list[_Stretch], tallness: Profile, least: float) -> list[_Stretch]:
    """Without what at the ends of the row is no crown: there the photograph shows the other jaw."""

    def too_flat(stretch: _Stretch) -> bool:
        return float(np.median(tallness[stretch.left : stretch.right + 1])) < least

    while stretches and too_flat(stretches[0]):
        stretches = stretches[1:]
    while stretches and too_flat(stretches[-1]):
        stretches = stretches[:-1]
    return stretches


def _papillae(gum: Profile, between: Profile, band: float, options: CrownOptions) -> list[int]:
    """Columns in which two crowns part at the gum.

    They are the peaks of the gum line. Far back, where the row is seen obliquely, the gum line
    climbs from crown to crown and a papilla is but a shoulder of it: a peak once the climb is taken
    out, believed where a dark line runs between the crowns.
    """
    clear, _ = find_peaks(gum, prominence=max(4.0, options.least_papilla * band))
    level = gum - gaussian_filter1d(gum, SHOULDER_TREND * band)
    shoulders, _ = find_peaks(level, prominence=max(3.0, options.least_shoulder * band))
    lines, _ = find_peaks(
        gaussian_filter1d(between, max(1.5, 0.01 * band)), prominence=options.split_contrast
    )
    chosen = [int(column) for column in clear]
    for shoulder in shoulders:
        dark_here = len(lines) > 0 and np.abs(lines - shoulder).min() <= SHOULDER_REACH * band
        if dark_here and all(
            abs(int(shoulder) - column) > options.least_width * band for column in chosen
        ):
            chosen.append(int(shoulder))
    return sorted(chosen)


def _embrasure(before: _Stretch, after: _Stretch, parting: Profile) -> tuple[float, float]:
    """Column and (signed) row at which two neighbouring crowns part at the biting edge."""
    reach = int(EMBRASURE_REACH * min(before.width, after.width)) + 2
    start = max(0, before.right - reach)
    part = parting[start : min(len(parting), before.right + reach + 1)]
    level = EMBRASURE_FLATNESS * max(before.width, after.width)
    return start + float(np.flatnonzero(part <= part.min() + level).mean()), float(part.min())


def _tip(biting: Profile, start: float, end: float, flatness: float) -> tuple[float, float]:
    """Column and (signed) row of the middle of the biting edge between two embrasures."""
    first, last = int(start), max(int(start) + 1, int(np.ceil(end)) + 1)
    part = biting[first:last]
    return first + float(np.flatnonzero(part >= part.max() - flatness).mean()), float(part.max())


def _dark_between(
    columns: npt.NDArray[np.int64], gum_line: Profile, meet: Profile, dark: Float
) -> Profile:
    """[C] mean darkness of a column between gum line and biting edge: high between two crowns."""
    rows = np.arange(dark.shape[0])[:, None]
    near, far = gum_line + 0.15 * (meet - gum_line), gum_line + 0.75 * (meet - gum_line)
    inside = (rows >= np.minimum(near, far)) & (rows <= np.maximum(near, far))
    total = np.where(inside, dark[:, columns], 0).sum(axis=0, dtype=np.float64)
    return np.asarray(total / np.maximum(inside.sum(axis=0), 1))


def _expected_widths(stretches: list[_Stretch]) -> list[float]:
    """What the neighbours of each crown (two on either side) suggest for its width."""
    expected = []
    for index in range(len(stretches)):
        neighbours = [
            float(stretches[other].width)
            for other in range(max(0, index - 2), min(len(stretches), index + 3))
            if other != index
        ]
        expected.append(
            float(np.median(neighbours)) if neighbours else float(stretches[index].width)
        )
    return expected


def _split_wide(
    stretches: list[_Stretch], between: Profile, band: float, options: CrownOptions
) -> list[_Stretch]:
    """Crowns much wider than their neighbours are split where a dark line runs through them."""
    smooth = gaussian_filter1d(between, max(1.5, 0.01 * band))
    result = []
    for stretch, expected in zip(stretches, _expected_widths(stretches), strict=True):
        if stretch.width <= options.wide * expected:
            result.append(stretch)
            continue
        margin = stretch.width // 4
        part = smooth[stretch.left + margin : stretch.right - margin + 1]
        cut = stretch.left + margin + int(np.argmax(part))
        if float(part.max()) - float(np.median(part)) < options.split_contrast:
            result.append(stretch)
            continue
        result += [_Stretch(stretch.left, cut, True), _Stretch(cut, stretch.right, True)]
    return result


def _marked(stretches: list[_Stretch], options: CrownOptions) -> list[_Stretch]:
    """Crowns whose width their neighbours don't suggest are marked doubtful."""
    return [
        replace(stretch, doubtful=True)
        if not options.narrow * expected <= stretch.width <= options.wide * expected
        else stretch
        for stretch, expected in zip(stretches, _expected_widths(stretches), strict=True)
    ]
