"""`transforms.json` from outside, as nerfstudio writes it: every field of the type that it has."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.artifacts.space.scale import NO_SCALE, Scale, said_by_cameras
from pipeline.untrusted.files import CAMERA_LIST, UnusableFile
from pipeline.untrusted.plain_json import read_plain_json
from pipeline.untrusted.scenes.cameras import (
    MOST_PIXELS,
    Array,
    Lens,
    PosedLens,
    check_lens,
    check_pose,
)

#: OpenGL cameras (y up, z back), which `transforms.json` holds, to OpenCV cameras.
OPENCV_FROM_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
_FISHEYE = ("FISHEYE", "OPENCV_FISHEYE")
_STRAIGHT = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "PERSPECTIVE", "SIMPLE_RADIAL", "RADIAL")
_LONGEST_NAME = 4096
#: What our own files say of their millimetres beside the units: a record as `Scale.as_dict` has it.
SCALE = "dentalsplat_scale"
_MOST_PERCENT = 1000


def read_transforms(path: Path) -> tuple[list[PosedLens], Scale]:
    """The cameras of a `transforms.json`, in its order, and the scale of their world.

    Raises:
        UnusableFile: it can't be read, or says what no camera has; the message names the frame and
            the field.
    """
    data = read_plain_json(path, CAMERA_LIST)
    if not isinstance(data, dict) or not isinstance(data.get("frames"), list):
        raise UnusableFile("holds no list 'frames'")
    cameras = [
        _camera(frame, data, f"frame {number}") for number, frame in enumerate(data["frames"])
    ]
    first: dict[str, int] = {}
    for number, camera in enumerate(cameras):
        if camera.name in first:
            raise UnusableFile(
                f"says file_path {_shown(camera.name)} twice, in frames {first[camera.name]} and "
                f"{number}"
            )
        first[camera.name] = number
    return cameras, _scale(data)


def _scale(data: Mapping[str, Any]) -> Scale:
    """Millimetres where `units` says so, and what our own files hold beside (`SCALE`)."""
    record = data.get(SCALE)
    if data.get("units") != "mm":
        return NO_SCALE
    if not isinstance(record, dict) or record.get("unit") != "mm":
        return said_by_cameras("mm")
    percent = record.get("uncertainty_percent")
    number = isinstance(percent, int | float) and not isinstance(percent, bool)
    if percent is not None and not (number and 0 <= percent <= _MOST_PERCENT):
        raise UnusableFile(
            f"has uncertainty_percent {_shown(percent)} in {SCALE}, not a number from 0 to "
            f"{_MOST_PERCENT}"
        )
    return Scale.from_dict(record)


def _camera(frame: object, common: Mapping[str, Any], where: str) -> PosedLens:
    if not isinstance(frame, dict):
        raise UnusableFile(f"has a {where} that is {_shown(frame)}, not a mapping")
    name = frame.get("file_path")
    if not isinstance(name, str) or not 0 < len(name) <= _LONGEST_NAME:
        raise UnusableFile(f"has a {where} whose file_path is {_shown(name)}, not a file's name")
    if any(ord(character) < 32 for character in name):
        raise UnusableFile(f"has a {where} whose file_path {_shown(name)} can't be printed")
    where = f"{where} ({_shown(name)})"
    said = _Fields(common, frame, name, where)
    lens = _lens(said)
    check_lens(lens, where)
    pose = _matrix(frame.get("transform_matrix"), where)
    check_pose(pose, where, "transform_matrix")
    return PosedLens(name, lens, np.asarray(np.linalg.inv(pose @ OPENCV_FROM_OPENGL), np.float64))


class _Fields:
    """What is said of a camera: by its frame, or for all."""

    def __init__(
        self, common: Mapping[str, Any], frame: Mapping[str, Any], name: str, where: str
    ) -> None:
        self.common, self.frame, self.name, self.where = common, frame, name, where

    def get(self, field: str) -> Any:
        return self.frame.get(field, self.common.get(field))

    def number(self, field: str, default: float | None = None) -> float:
        """A field that is a number, as the file has it.

        Raises:
            UnusableFile: it is something else, or is missing and has no default.
        """
        value = self.get(field)
        if value is None and default is not None:
            return default
        if value is None:
            raise UnusableFile(
                f"gives no {field!r} for {self.name}. It needs w, h and fl_x (or camera_angle_x), "
                "for all frames or for each"
            )
        if isinstance(value, bool) or not isinstance(value, int | float) or abs(value) > 1e300:
            raise UnusableFile(f"has {field} {_shown(value)} in {self.where}, not a number")
        return value

    def whole(self, field: str) -> int:
        value = self.number(field)
        if value != int(value) or not 1 <= value <= MOST_PIXELS:
            raise UnusableFile(
                f"has {field} {_shown(value)} in {self.where}, not a count of pixels from 1 to "
                f"{MOST_PIXELS}"
            )
        return int(value)


def _lens(said: _Fields) -> Lens:
    width, height = said.whole("w"), said.whole("h")
    if said.get("fl_x") is not None:
        fx = float(said.number("fl_x"))
    else:
        angle = said.number("camera_angle_x")
        if not 0 < angle < math.pi:
            raise UnusableFile(
                f"has camera_angle_x {angle:g} in {said.where}; it is an angle in radians between "
                "0 and pi"
            )
        fx = float(0.5 * width / np.tan(0.5 * angle))
    model = said.get("camera_model") or "OPENCV"
    if not isinstance(model, str) or model not in _FISHEYE + _STRAIGHT:
        raise UnusableFile(
            f"has camera_model {_shown(model)} in {said.where}; those that can be used are "
            f"{', '.join(_STRAIGHT + _FISHEYE)}"
        )
    fisheye = model in _FISHEYE or said.get("is_fisheye") is True  # as instant-ngp has it
    bent = ("k1", "k2", "k3", "k4") if fisheye else ("k1", "k2", "p1", "p2")
    parameters = (
        fx, float(said.number("fl_y", fx)), float(said.number("cx", width / 2)),
        float(said.number("cy", height / 2)), *(float(said.number(name, 0)) for name in bent),
    )  # fmt: skip
    if fisheye:
        return Lens("OPENCV_FISHEYE", width, height, parameters)
    if said.number("k4", 0) != 0:
        raise UnusableFile(
            f"has k4 {_shown(said.get('k4'))} in {said.where}, which programs do not agree upon "
            f"for {model}: find the cameras with k1, k2, k3, p1 and p2 only"
        )
    k3 = float(said.number("k3", 0))
    if k3 == 0:
        return Lens("OPENCV", width, height, parameters)
    return Lens("FULL_OPENCV", width, height, (*parameters, k3, 0.0, 0.0, 0.0))


def _matrix(value: object, where: str) -> Array:
    """[4, 4] the transform of a frame."""
    rows = value if isinstance(value, list) else []
    shape = [len(row) if isinstance(row, list) else 0 for row in rows]
    if shape not in ([4] * 3, [4] * 4):
        said = "x".join(map(str, (len(shape), shape[0]))) if shape else _shown(value)
        raise UnusableFile(f"has a transform_matrix of shape {said} in {where}, not 4x4")
    for row in rows:
        for entry in row:
            if isinstance(entry, bool) or not isinstance(entry, int | float) or abs(entry) > 1e300:
                raise UnusableFile(
                    f"has {_shown(entry)} in the transform_matrix of {where}, not a number"
                )
    matrix = np.array([*rows[:3], [0, 0, 0, 1]], np.float64)
    if rows[3:] and not np.allclose(rows[3], [0, 0, 0, 1], atol=1e-6):
        last = " ".join(f"{entry:.6g}" for entry in rows[3])
        raise UnusableFile(
            f"has a transform_matrix whose last row is {last} in {where}, not 0 0 0 1"
        )
    return matrix


def _shown(value: object) -> str:
    """A value as short text for a message."""
    if isinstance(value, list | dict):
        return "a list" if isinstance(value, list) else "a mapping"
    if isinstance(value, int) and abs(value) > 10**20:
        return "a number of many digits"
    text = ascii(value)
    return text if len(text) <= 60 else f"{text[:60]}..."
