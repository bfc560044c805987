"""Bring a decoded picture to its working size: upright, small, with the pixel transform kept."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import cv2
import numpy as np
import numpy.typing as npt

from pipeline.untrusted.files import UnusableFile
from pipeline.untrusted.pictures import same_shape
from stages.views.orientation import make_stored, make_upright, upright_from_stored

Mask = npt.NDArray[np.bool_]


class UnusableMask(UnusableFile):
    """A photograph can't be used because of the mask that was given for it."""


class TooSmall(UnusableFile):
    """A photograph is too small.

    Attributes:
        advice: a sentence that goes for all that are.
    """

    def __init__(self, why: str, advice: str) -> None:
        super().__init__(why)
        self.advice = advice


class Box(NamedTuple):
    """Rows top to bottom and columns left to right of a picture, the ends not among them."""

    top: int
    left: int
    bottom: int
    right: int

    @property
    def short_side(self) -> int:
        return min(self.bottom - self.top, self.right - self.left)

    def of(self, pixels: npt.NDArray[Any]) -> npt.NDArray[Any]:
        """The part of [H, W, ...]."""
        return pixels[self.top : self.bottom, self.left : self.right]


@dataclass(frozen=True)
class Prepared:
    """A picture at working size.

    Attributes:
        rgb: [H, W, 3] uint8 sRGB, upright.
        mask: [H, W] bool, or None for all.
        working_from_source: [3, 3] from the stored grid, pixel centres at .5.
        source_size: (width, height) of that grid.
        focal_px: focal length in working pixels, or None.
    """

    rgb: npt.NDArray[np.uint8]
    mask: Mask | None
    working_from_source: npt.NDArray[np.float64]
    source_size: tuple[int, int]
    focal_px: float | None


def working_size(width: int, height: int, long_side: int) -> tuple[int, int]:
    """Size with the long side at most `long_side`; smaller pictures keep theirs."""
    scale = min(1.0, long_side / max(width, height))
    return max(1, round(width * scale)), max(1, round(height * scale))


def check_size(width: int, height: int, long_side: int | None, min_side: int) -> None:
    """Raise TooSmall where the short side would come out below `min_side`.

    Args:
        long_side: of the result; None as it is stored.
    """
    across, down = working_size(width, height, long_side or max(width, height))
    if min(across, down) < min_side:
        reduced = f", at the working size {across} x {down}" * ((across, down) != (width, height))
        raise TooSmall(
            f"is {width} x {height} pixels{reduced}",
            f"The short side must have {min_side} pixels at least (views.min_side): scan lines "
            "and thumbnails are no use.",
        )


def prepare(
    rgb: npt.NDArray[np.uint8], valid: Mask | None, orientation: int, focal_px: float | None,
    long_side: int, given_mask: Mask | None = None, box: Box | None = None,
) -> Prepared:  # fmt: skip
    """Cut, resize (area-averaged, so that fine detail can't alias), then turn upright.

    Args:
        rgb: [H, W, 3] on the stored grid.
        valid: [H, W] on the stored grid, or None.
        orientation: EXIF orientation to apply.
        focal_px: in stored pixels, or None.
        long_side: of the result, at most.
        given_mask: a mask file: upright or stored size, or either's shape at another size.
        box: the part of the stored grid that becomes the picture; None for all.

    Raises:
        UnusableMask: the mask has another shape than the picture, or leaves nothing of it.
        UnusableFile: the picture is transparent all over.
    """
    height, width = rgb.shape[:2]
    whole = Box(0, 0, height, width)
    box = whole if box is None else box
    cut = np.array([[1.0, 0, -box.left], [0, 1, -box.top], [0, 0, 1]])
    across, down = box.right - box.left, box.bottom - box.top
    small = working_size(across, down, long_side)
    scale = np.diag([small[0] / across, small[1] / down, 1.0])
    picture = make_upright(_shrink(box.of(rgb), small), orientation)
    share = None if valid is None else make_upright(_share(box.of(valid), small), orientation)
    if given_mask is not None:
        given_mask = _fit_mask(given_mask, width, height, orientation)
        if box != whole:
            full = cv2.resize(
                make_stored(given_mask, orientation).view(np.uint8), (width, height),
                interpolation=cv2.INTER_NEAREST,
            )  # fmt: skip
            given_mask = make_upright(box.of(full) > 0, orientation)
        given = _share(given_mask, picture.shape[1::-1])
        share = given if share is None else np.minimum(share, given)
    mask = None if share is None else share >= 0.5
    if mask is not None and not mask.any():
        if given_mask is None:
            raise UnusableFile("is transparent all over")
        raise UnusableMask("is masked completely (by its mask file, or that and its transparency)")
    if mask is not None and mask.all():
        mask = None
    return Prepared(
        rgb=picture,
        mask=mask,
        working_from_source=upright_from_stored(orientation, *small) @ scale @ cut,
        source_size=(width, height),
        focal_px=None if focal_px is None else focal_px * float(scale[0, 0] + scale[1, 1]) / 2,
    )


def _shrink(pixels: npt.NDArray[Any], size: tuple[int, int]) -> npt.NDArray[Any]:
    if pixels.shape[1::-1] == size:
        return pixels
    return np.asarray(cv2.resize(pixels, size, interpolation=cv2.INTER_AREA))


def _share(mask: Mask, size: Any) -> npt.NDArray[np.float32]:
    """[H, W] share of each pixel of the new size that is valid."""
    return np.asarray(_shrink(mask.astype(np.float32), (int(size[0]), int(size[1]))))


def _fit_mask(mask: Mask, width: int, height: int, orientation: int) -> Mask:
    """The mask, upright: as it is if it has the upright shape, else turned like the picture."""
    upright = (height, width) if orientation >= 5 else (width, height)
    size = mask.shape[1::-1]
    if same_shape(size, upright):
        return mask
    if same_shape(size, (width, height)):
        return make_upright(mask, orientation)
    raise UnusableMask(
        f"has {upright[0]} x {upright[1]} pixels, but its mask {size[0]} x {size[1]}: the mask "
        "must have the picture's proportions"
    )
