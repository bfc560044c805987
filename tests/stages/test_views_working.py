"""Photographs at their working size, and their masks."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from PIL import Image

from pipeline.untrusted.files import UnusableFile
from stages.views.orientation import make_stored
from stages.views.reading.decode import decode_mask
from stages.views.working import prepare, working_size
from tests.stages.views_pictures import ORIENTATION, encode, scene


def test_shrinking_does_not_alias() -> None:
    # Stripes of one pixel, which picking pixels would turn into broad bands.
    stripes = np.zeros((600, 900, 3), np.uint8)
    stripes[:, ::2] = 255
    small = prepare(stripes, None, 1, None, 512).rgb[:, 5:-5].astype(float)
    blurred = cv2.GaussianBlur(small, (0, 0), 4)[:, 20:-20]
    assert blurred.min() > 110
    assert blurred.max() < 145
    assert prepare(stripes, None, 1, None, 450).rgb.std() < 1


@pytest.mark.parametrize(
    ("size", "expected"),
    [((4000, 3000), (512, 384)), ((3000, 4000), (384, 512)), ((300, 200), (300, 200))],
)
def test_working_size(size: tuple[int, int], expected: tuple[int, int]) -> None:
    assert working_size(*size, 512) == expected


def test_masks_of_all_sorts() -> None:
    truth = np.zeros((40, 60), bool)
    truth[5:20, 10:] = True
    for image in (
        Image.fromarray(truth),
        Image.fromarray(truth.astype(np.uint8)),
        Image.fromarray(truth * np.uint8(255)),
        Image.fromarray(truth.astype(np.uint16) * np.uint16(65535)),
        Image.fromarray(np.repeat(truth[..., None], 3, -1) * np.uint8(255)),
        Image.fromarray(np.dstack([np.full((40, 60, 3), 255, np.uint8), truth * np.uint8(255)])),
    ):
        np.testing.assert_array_equal(decode_mask(encode(image, "PNG")), truth, err_msg=image.mode)


@pytest.mark.parametrize("kind", ["PNG", "TIFF"])
def test_a_mask_is_turned_by_its_own_orientation(kind: str) -> None:
    truth = np.zeros((40, 60), bool)
    truth[5:20, 10:] = True
    exif = Image.Exif()
    exif[ORIENTATION] = 6
    stored = Image.fromarray(make_stored(truth, 6) * np.uint8(255))
    np.testing.assert_array_equal(decode_mask(encode(stored, kind, exif=exif)), truth)


def test_mask_and_alpha_combine_and_fit_by_shape() -> None:
    alpha = np.ones((80, 120), bool)
    alpha[:, :30] = False
    given = np.ones((160, 240), bool)
    given[80:] = False
    mask = prepare(scene(), alpha, 1, None, 60, given).mask
    assert mask is not None
    expected = np.zeros((40, 60), bool)
    expected[:20, 15:] = True
    np.testing.assert_array_equal(mask, expected)
    # Of a picture on its side, the mask may be upright or lie as the picture does.
    upright = np.ones((120, 80), bool)
    upright[:60] = False
    turned = prepare(scene(), None, 6, None, 60, upright).mask
    lying = prepare(scene(), None, 6, None, 60, make_stored(upright, 6)).mask
    assert turned is not None
    assert lying is not None
    np.testing.assert_array_equal(turned, lying)
    assert not turned[:30].any()
    assert turned[30:].all()
    assert prepare(scene(), np.ones((80, 120), bool), 1, None, 60).mask is None
    with pytest.raises(UnusableFile, match="proportions"):
        prepare(scene(), None, 1, None, 60, np.ones((80, 80), bool))
    with pytest.raises(UnusableFile, match="masked completely"):
        prepare(scene(), None, 1, None, 60, np.zeros((80, 120), bool))
