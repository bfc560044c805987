"""Cameras from outside: numbers that no camera has are refused by the field's name."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from pipeline.untrusted.files import UnusableFile

Array = npt.NDArray[np.float64]

#: COLMAP's camera models with a focal length: name -> (number, names of the parameters).
LENSES = {
    name: (number, tuple(parameters.split()))
    for name, number, parameters in (
        ("SIMPLE_PINHOLE", 0, "f cx cy"),
        ("PINHOLE", 1, "fx fy cx cy"),
        ("SIMPLE_RADIAL", 2, "f cx cy k"),
        ("RADIAL", 3, "f cx cy k1 k2"),
        ("OPENCV", 4, "fx fy cx cy k1 k2 p1 p2"),
        ("OPENCV_FISHEYE", 5, "fx fy cx cy k1 k2 k3 k4"),
        ("FULL_OPENCV", 6, "fx fy cx cy k1 k2 p1 p2 k3 k4 k5 k6"),
        ("FOV", 7, "fx fy cx cy omega"),
        ("SIMPLE_RADIAL_FISHEYE", 8, "f cx cy k"),
        ("RADIAL_FISHEYE", 9, "f cx cy k1 k2"),
        ("THIN_PRISM_FISHEYE", 10, "fx fy cx cy k1 k2 p1 p2 k3 k4 sx1 sy1"),
        ("RAD_TAN_THIN_PRISM_FISHEYE", 11, "fx fy cx cy k0 k1 k2 k3 k4 k5 p0 p1 s0 s1 s2 s3"),
        ("SIMPLE_DIVISION", 12, "f cx cy k"),
        ("DIVISION", 13, "fx fy cx cy k"),
        ("SIMPLE_FISHEYE", 14, "f cx cy"),
        ("FISHEYE", 15, "fx fy cx cy"),
        ("EUCM", 16, "fx fy cx cy alpha beta"),
    )
}
#: Pixels along a side at most; shares of the longer side that a focal length lies between, and
#: how far outside the image a principal point may be; the largest coefficient of a distortion; the
#: farthest centre; and how far the axes may be from a rotation's.
MOST_PIXELS, FOCAL, ASIDE, MOST_BENT, FARTHEST, SLACK = 100_000, (0.01, 10_000), 5, 1e4, 1e9, 0.01


@dataclass(frozen=True)
class Lens:
    """A camera's inside: COLMAP's name of the model, pixels, parameters in COLMAP's order."""

    model: str
    width: int
    height: int
    parameters: tuple[float, ...]


@dataclass(frozen=True)
class PosedLens:
    """A camera that took an image.

    Attributes:
        name: of the image.
        cam_from_world: [4, 4], OpenCV axes.
    """

    name: str
    lens: Lens
    cam_from_world: Array


def check_lens(lens: Lens, whose: str) -> None:
    """Refuse a lens that no camera has.

    Args:
        whose: the camera or image that it belongs to, for the message.

    Raises:
        UnusableFile: naming the field.
    """
    for field, pixels in (("width", lens.width), ("height", lens.height)):
        if not 1 <= pixels <= MOST_PIXELS:
            raise _wrong(whose, field, pixels, f"from 1 to {MOST_PIXELS} pixels are possible")
    side = max(lens.width, lens.height)
    names = LENSES[lens.model][1]
    for field, value in zip(names, lens.parameters, strict=True):
        if field in ("f", "fx", "fy"):
            low, high = side * FOCAL[0], side * FOCAL[1]
            if not low <= value <= high:
                said = f"the focal length must lie between {low:g} and {high:g} pixels"
                raise _wrong(whose, field, value, said)
        elif field in ("cx", "cy"):
            length = lens.width if field == "cx" else lens.height
            if not -ASIDE * side <= value <= length + ASIDE * side:
                said = f"that is far outside the image of {lens.width} x {lens.height} pixels"
                raise _wrong(whose, field, value, said)
        elif not abs(value) <= MOST_BENT:
            raise _wrong(whose, field, value, f"at most {MOST_BENT:g} is possible")


def check_pose(cam_from_world: Array, whose: str, field: str) -> None:
    """Refuse a pose [4, 4] that is no rotation and shift.

    Args:
        whose: the image that it belongs to, for the message; field: what the file calls the pose.

    Raises:
        UnusableFile: saying what it is instead.
    """
    rotation, shift = cam_from_world[:3, :3], cam_from_world[:3, 3]
    with np.errstate(all="ignore"):
        _check_rigid(rotation, shift, whose, field)


def _check_rigid(rotation: Array, shift: Array, whose: str, field: str) -> None:
    if not (np.isfinite(rotation).all() and np.isfinite(shift).all()):
        raise _wrong(whose, field, "not finite", "each entry must be a number")
    if not np.abs(rotation.T @ shift).max() <= FARTHEST:
        raise _wrong(whose, field, f"{np.abs(shift).max():.3g} away", f"at most {FARTHEST:g}")
    off = np.abs(rotation.T @ rotation - np.eye(3)).max()
    if not off <= SLACK:
        sizes = " ".join(f"{size:.4g}" for size in np.linalg.norm(rotation, axis=0))
        said = f"its axes are {sizes} long, and those of a rotation are 1 and at right angles"
        raise _wrong(whose, field, "no rotation", said)
    if np.linalg.det(rotation) < 0:
        raise _wrong(whose, field, "mirrored", "its determinant is -1, and a rotation's is 1")


def check_quaternion(quat_wxyz: tuple[float, ...], whose: str, field: str) -> None:
    """Refuse a quaternion that is not of length 1.

    Raises:
        UnusableFile: saying its length.
    """
    length = math.hypot(*quat_wxyz)
    if not abs(length - 1) <= SLACK:
        raise _wrong(whose, field, f"a quaternion of length {length:.4g}", "a rotation's has 1")


def _wrong(whose: str, field: str, value: object, why: str) -> UnusableFile:
    shown = f"{value:.6g}" if isinstance(value, float) else value
    return UnusableFile(f"is damaged: {field} of {whose} is {shown}; {why}")
