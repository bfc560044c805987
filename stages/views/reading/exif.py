"""What EXIF says that matters here: which way is up, the focal length, and when it was taken.

Nothing else is read.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from datetime import UTC, datetime
from typing import Any

ORIENTATION = 0x0112
EXIF_IFD = 0x8769
FOCAL_LENGTH = 0x920A
FOCAL_LENGTH_35MM = 0xA405
PIXEL_X_DIMENSION = 0xA002
PIXEL_Y_DIMENSION = 0xA003
FOCAL_PLANE_X_RESOLUTION = 0xA20E
FOCAL_PLANE_UNIT = 0xA210
DATE_TAKEN = 0x9003

DIAGONAL_35MM = math.hypot(36.0, 24.0)
_MM_PER_UNIT = {2: 25.4, 3: 10.0, 4: 1.0, 5: 0.001}
#: A focal length outside this share of the diagonal is a slip of the camera or of an editor.
_PLAUSIBLE = (0.2, 20.0)


def read_orientation(exif: Mapping[int, Any]) -> int:
    """EXIF orientation 1..8; 1 where it is absent or nonsense."""
    value = _number(exif.get(ORIENTATION))
    return int(value) if value is not None and value in range(1, 9) else 1


def focal_in_pixels(details: Mapping[int, Any], width: int, height: int) -> float | None:
    """Focal length in pixels of the stored grid, or None where EXIF doesn't tell.

    Args:
        details: the EXIF sub-directory (tag -> value).
        width, height: of the stored grid.

    From the 35 mm equivalent (by the diagonal), else from the focal length and the sensor's
    resolution. A picture that was cropped after it was taken (its shape differs from the one that
    the camera recorded) has no known focal length.
    """
    sides = [_number(details.get(tag)) for tag in (PIXEL_X_DIMENSION, PIXEL_Y_DIMENSION)]
    taken_long = max(width, height)
    if sides[0] and sides[1]:
        taken_long = round(max(sides[0], sides[1]))
        taken_shape = taken_long / min(sides[0], sides[1])
        shape = max(width, height) / min(width, height)
        if not 0.98 < taken_shape / shape < 1.02:
            return None
    focal = None
    equivalent = _number(details.get(FOCAL_LENGTH_35MM))
    length = _number(details.get(FOCAL_LENGTH))
    resolution = _number(details.get(FOCAL_PLANE_X_RESOLUTION))
    if equivalent:
        focal = equivalent / DIAGONAL_35MM * math.hypot(width, height)
    elif length and resolution:
        unit = _MM_PER_UNIT.get(int(_number(details.get(FOCAL_PLANE_UNIT)) or 2), 25.4)
        focal = length * resolution / unit * max(width, height) / taken_long
    if focal is None:
        return None
    low, high = _PLAUSIBLE
    return focal if low < focal / math.hypot(width, height) < high else None


def taken_at(text: Any) -> float | None:
    """When the camera's clock had it taken, in seconds; None where that is absent or nonsense.

    Clocks say nothing of their zone: good for the time between photographs of one camera.

    Args:
        text: `DATE_TAKEN` as EXIF has it, "2026:11:27 14:05:59".
    """
    try:
        year, month, day, *time = (int(part) for part in re.split("[: ]", str(text).strip("\0 ")))
        hour, minute, second = time
        return datetime(year, month, day, hour, minute, second, tzinfo=UTC).timestamp()
    except (ValueError, OverflowError):
        return None


def _number(value: Any) -> float | None:
    """A positive finite number, or None: EXIF in the wild holds 0/0, text and tuples."""
    if isinstance(value, tuple) and len(value) == 1:
        value = value[0]
    try:
        number = float(value)
    except (TypeError, ValueError, ZeroDivisionError):
        return None
    return number if math.isfinite(number) and number > 0 else None
