"""The teeth in each photograph of a case: mask, crowns, landmarks, doubts."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import cv2
import numpy as np
import numpy.typing as npt

from stages.init.dental.crowns import CrownOptions, UprightRow, find_crowns
from stages.init.dental.observation import Crown, Dentition, Point
from stages.init.dental.teeth_mask import (
    Channels,
    MaskOptions,
    TeethMask,
    central_weight,
    find_teeth,
    histogram,
    read_channels,
    valleys,
)
from stages.init.parallel import in_threads

Bool = npt.NDArray[np.bool_]
Float = npt.NDArray[np.float32]
Transform = npt.NDArray[np.float64]  # [2, 3] of points whose pixel centres are at .5

#: More than this share of the photographs looked at must show teeth for a case to be one of teeth.
SURE_SHARE = 0.6


@dataclass(frozen=True)
class PhotoOptions:
    """Settings of `read_dentitions`.

    Attributes:
        analysis_width: pixels; every photograph is brought to this width first, for all lengths
            were measured at it. Coordinates returned are those of the photograph given.
        natural_tilt: degrees; a row of teeth that lies this flat is not turned, for a view from
            above or below tilts it as much.
        least_score: a mask scoring less is no row of teeth.
        least_crowns: with fewer crowns in both jaws together, no teeth were found.
        sure_score, sure_contact, sure_gap, sure_crowns: what `teeth_likely` asks of a
            photograph: the mask's score, the share of its outline that borders on gum, by how much
            enamel is greener than gum (log units), and crowns in both jaws together.
        sure_photos: `teeth_likely` looks at so many photographs at most.
        uneven: doubts are raised when one jaw has more than this many times the other's crowns.
        overexposed: a doubt is raised when this share of the middle of the photograph is white.
        mask: of the tooth mask.
        crowns: of the crowns.
    """

    analysis_width: int = 1024
    natural_tilt: float = 5.0
    least_score: float = 0.25
    least_crowns: int = 5
    sure_score: float = 0.5
    sure_contact: float = 0.6
    sure_gap: float = 0.17
    sure_crowns: int = 7
    sure_photos: int = 5
    uneven: float = 1.6
    overexposed: float = 0.06
    mask: MaskOptions = field(default_factory=MaskOptions)
    crowns: CrownOptions = field(default_factory=CrownOptions)


def read_dentitions(
    images: list[Float], valid: list[Bool], options: PhotoOptions | None = None, threads: int = 1
) -> list[Dentition | None]:
    """Find the teeth in the photographs of one case.

    Args:
        images: [H, W, 3] float32 each, sRGB in 0..1; sizes may differ.
        valid: [H, W] bool each; nothing is read outside.
        options: settings.
        threads: they change only the time.

    Returns:
        What each photograph shows, in its own pixels (centres at .5); None where no row of teeth
        was found.

    Raises:
        ValueError: images and masks don't fit each other.
    """
    options = options or PhotoOptions()
    _check(images, valid)
    channels = in_threads(
        lambda index: _channels(images[index], valid[index], options), range(len(images)), threads
    )
    pooled = _pooled_borders(channels, options)
    found = in_threads(
        lambda index: _read(images[index], channels[index], pooled, options),
        range(len(images)),
        threads,
    )
    return [None if one is None else one[0] for one in found]


def teeth_likely(
    images: list[Float], valid: list[Bool], options: PhotoOptions | None = None, threads: int = 1
) -> bool:
    """Are these photographs of teeth? Strict: a doubtful case is none.

    Looks at a few photographs, evenly chosen; nearly all of them must show a row of crowns between
    gums.

    Args:
        images, valid, options, threads: as for `read_dentitions`.
    """
    options = options or PhotoOptions()
    _check(images, valid)
    if not images:
        return False
    chosen = np.unique(
        np.linspace(0, len(images) - 1, min(len(images), options.sure_photos)).round()
    )

    def sure(index: int) -> bool:
        channels = _channels(images[index], valid[index], options)
        found = _read(images[index], channels, [], options)
        if found is None:
            return False
        dentition, mask = found
        crowns = (*dentition.upper, *dentition.lower)
        return (
            mask.score >= options.sure_score
            and mask.gum_contact >= options.sure_contact
            and mask.gum_gap >= options.sure_gap
            and len(crowns) >= options.sure_crowns
            and sum(crown.doubtful for crown in crowns) <= len(crowns) / 2
        )

    votes = in_threads(sure, [int(index) for index in chosen], threads)
    return sum(votes) > SURE_SHARE * len(votes)


def _check(images: list[Float], valid: list[Bool]) -> None:
    if len(images) != len(valid):
        raise ValueError(f"{len(images)} images but {len(valid)} masks; give one mask per image")
    for index, (image, mask) in enumerate(zip(images, valid, strict=True)):
        if image.ndim != 3 or image.shape[2] != 3 or image.shape[:2] != mask.shape:
            raise ValueError(
                f"image {index} has shape {image.shape} and its mask {mask.shape}; "
                "expected [H, W, 3] and [H, W]"
            )


def _channels(image: Float, valid: Bool, options: PhotoOptions) -> Channels:
    """Features of the photograph at the width of the analysis."""
    height, width = image.shape[:2]
    size = (options.analysis_width, max(round(height * options.analysis_width / width), 8))
    if size != (width, height):
        shrinks = size[0] < width
        kernel = cv2.INTER_AREA if shrinks else cv2.INTER_CUBIC
        image = np.asarray(cv2.resize(image, size, interpolation=kernel), dtype=np.float32)
        valid = cv2.resize(valid.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST) > 0
    return read_channels(np.clip(image, 0, 1), valid, options.mask)


def _pooled_borders(channels: list[Channels], options: PhotoOptions) -> list[float]:
    """Borders between the colour classes of all photographs of the case together."""
    total = sum(
        (histogram(one, central_weight(_shape(one), options.mask)) for one in channels),
        start=np.zeros(1),
    )
    return valleys(np.asarray(total)) if len(channels) > 1 else []


def _shape(channels: Channels) -> tuple[int, int]:
    height, width = channels.greenness.shape
    return height, width


def _read(
    image: Float, channels: Channels, pooled: list[float], options: PhotoOptions
) -> tuple[Dentition, TeethMask] | None:
    """What one photograph shows, and the mask at the width of the analysis."""
    found = find_teeth(channels, options.mask, pooled)
    if found is None or found.score < options.least_score:
        return None
    tilt = row_tilt(found.mask)
    roll = tilt if abs(tilt) > math.radians(options.natural_tilt) else 0.0
    turned, mask, upright_from_analysis = _upright(channels, found.mask, roll)
    row = find_crowns(turned, mask, options.crowns)
    if row is None or len(row.upper) + len(row.lower) < options.least_crowns:
        return None
    height, width = image.shape[:2]
    analysis_from_image = np.array(
        [[channels.greenness.shape[1] / width, 0, 0], [0, channels.greenness.shape[0] / height, 0]]
    )
    upright_from_image = _chained(upright_from_analysis, analysis_from_image)
    dentition = _mapped_back(row, found, upright_from_image, roll, (height, width), options)
    if channels.clipped > options.overexposed:
        doubt = (
            f"{channels.clipped:.0%} of the middle of the photograph is overexposed to white, "
            "where enamel can't be told from gum and gloves"
        )
        dentition = replace(dentition, doubts=(*dentition.doubts, doubt))
    return dentition, found


def row_tilt(mask: Bool) -> float:
    """Radians by which the longer axis of a mask [H, W] is turned clockwise from the horizontal."""
    rows, columns = np.nonzero(mask)
    spread = np.cov(np.stack([columns, rows]).astype(np.float64))
    return 0.5 * math.atan2(2 * spread[0, 1], spread[0, 0] - spread[1, 1])


def _upright(channels: Channels, mask: Bool, roll: float) -> tuple[Channels, Bool, Transform]:
    """The features turned so that the row lies flat, on a canvas that holds it all."""
    height, width = mask.shape
    if roll == 0.0:
        return channels, mask, np.eye(2, 3)
    cosine, sine = math.cos(-roll), math.sin(-roll)
    rotation = np.array([[cosine, -sine], [sine, cosine]])
    corners = np.array([[0, 0], [width, 0], [0, height], [width, height]]) @ rotation.T
    low, high = corners.min(axis=0), corners.max(axis=0)
    size = (math.ceil(high[0] - low[0]), math.ceil(high[1] - low[1]))
    transform = np.column_stack([rotation, -low])
    # OpenCV counts pixel centres as whole numbers.
    half = np.array([0.5, 0.5])
    whole = np.column_stack([rotation, rotation @ half - low - half])

    def turn(image: npt.NDArray, smooth: bool) -> npt.NDArray:
        flags = cv2.INTER_LINEAR if smooth else cv2.INTER_NEAREST
        return np.asarray(cv2.warpAffine(image, whole, size, flags=flags, borderValue=0))

    turned = replace(
        channels,
        lightness=turn(channels.lightness, True),
        greenness=turn(channels.greenness, True),
        redness=turn(channels.redness, True),
        brightness=turn(channels.brightness, True),
        highlight=turn(channels.highlight.astype(np.uint8), False) > 0,
        valid=turn(channels.valid.astype(np.uint8), False) > 0,
    )
    return turned, turn(mask.astype(np.float32), True) > 0.5, transform


def _chained(after: Transform, before: Transform) -> Transform:
    """The transform that does `before`, then `after`."""
    return np.column_stack(
        [after[:, :2] @ before[:, :2], after[:, :2] @ before[:, 2] + after[:, 2]]
    )


def _inverse(transform: Transform) -> Transform:
    linear = np.linalg.inv(transform[:, :2])
    return np.column_stack([linear, -linear @ transform[:, 2]])


def _mapped_back(
    row: UprightRow,
    found: TeethMask,
    upright_from_image: Transform,
    roll: float,
    shape: tuple[int, int],
    options: PhotoOptions,
) -> Dentition:
    """The row in pixels of the photograph."""
    image_from_upright = _inverse(upright_from_image)
    height, width = shape
    columns, rows = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    x = (
        upright_from_image[0, 0] * columns
        + upright_from_image[0, 1] * rows
        + upright_from_image[0, 2]
    )
    y = (
        upright_from_image[1, 0] * columns
        + upright_from_image[1, 1] * rows
        + upright_from_image[1, 2]
    )
    above = y < np.interp(x, row.columns + 0.5, row.meet + 0.5)
    mask = cv2.remap(
        row.mask.astype(np.float32),
        (x - 0.5).astype(np.float32),
        (y - 0.5).astype(np.float32),
        cv2.INTER_LINEAR,
        borderValue=0,
    )
    scale = math.sqrt(abs(np.linalg.det(image_from_upright[:, :2])))

    def back(point: Point | None) -> Point | None:
        return (
            None if point is None else image_from_upright[:, :2] @ point + image_from_upright[:, 2]
        )

    def moved(crown: Crown) -> Crown:
        zenith, tip = back(crown.zenith), back(crown.tip)
        assert zenith is not None and tip is not None
        return replace(
            crown,
            zenith=zenith,
            tip=tip,
            papilla_left=back(crown.papilla_left),
            papilla_right=back(crown.papilla_right),
            embrasure_left=back(crown.embrasure_left),
            embrasure_right=back(crown.embrasure_right),
            width=crown.width * scale,
            height=crown.height * scale,
            doubtful=crown.doubtful or _at_border(crown, image_from_upright, shape),
        )

    return Dentition(
        upper=tuple(moved(crown) for crown in row.upper),
        lower=tuple(moved(crown) for crown in row.lower),
        mask=mask > 0.5,
        above=above,
        roll=roll,
        band_height=row.band_height * scale,
        doubts=_doubts(row, found, options),
    )


def _at_border(crown: Crown, image_from_upright: Transform, shape: tuple[int, int]) -> bool:
    """Does a crown at the end of its row reach the border of the photograph?"""
    if not (crown.cut_left or crown.cut_right):
        return False
    middle = (crown.zenith + crown.tip) / 2
    height, width = shape
    sides = [-1.0] * crown.cut_left + [1.0] * crown.cut_right
    for side in sides:
        reach = np.array([side * 0.6 * crown.width, 0.0])
        x, y = image_from_upright[:, :2] @ (middle + reach) + image_from_upright[:, 2]
        if not (0.01 * width < x < 0.99 * width and 0.01 * height < y < 0.99 * height):
            return True
    return False


def _doubts(row: UprightRow, found: TeethMask, options: PhotoOptions) -> tuple[str, ...]:
    """What is not as it should be, for the user."""
    doubts = []
    upper, lower = len(row.upper), len(row.lower)
    if max(upper, lower) > options.uneven * max(min(upper, lower), 1):
        doubts.append(
            f"{upper} upper but {lower} lower crowns were found: one jaw's outline may be wrong, "
            "or the photograph shows little of it"
        )
    if found.fragments > 2:
        doubts.append(f"the teeth were found in {found.fragments} separate pieces")
    if found.gum_contact < 0.6:
        doubts.append(
            f"only {found.gum_contact:.0%} of the outline of the teeth borders on gum: lips, "
            "gloves or retractors may have been taken for teeth"
        )
    doubtful = sum(crown.doubtful for crown in (*row.upper, *row.lower))
    if doubtful > 0.3 * (upper + lower):
        doubts.append(f"{doubtful} of {upper + lower} crowns have an unusual width")
    return tuple(doubts)
