"""COLMAP's models from outside, text or binary, of any version.

COLMAP's own reader waits for ever, aborts the process or takes the memory that a count says where a
file is cut off or lies. This one believes no count before the bytes are there, and holds no more
than a few times the file's size.
"""

from __future__ import annotations

from array import array
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from pipeline.untrusted.files import UnusableFile
from pipeline.untrusted.scenes.cameras import (
    FARTHEST,
    LENSES,
    Lens,
    check_lens,
    check_quaternion,
)
from pipeline.untrusted.scenes.colmap_rows import Row, rows_of, shown

Array = npt.NDArray[np.float64]
Sensor = tuple[int, int]  # type (0 is a camera) and number

_SENSORS = {"CAMERA": 0, "IMU": 1}
#: Cameras, images, rigs and frames of a model at most: an object is made of each.
_MOST = 100_000


@dataclass(frozen=True)
class Pose:
    """A rotation as quaternion (not yet at length 1) and a translation."""

    quat_wxyz: tuple[float, float, float, float]
    translation: tuple[float, float, float]


@dataclass(frozen=True)
class Photograph:
    """An image of the model.

    Attributes:
        name: as the file has it.
        camera: number of its lens.
        cam_from_world: as `images` says it; where there are frames, they say it too.
        has_point: [K] bool, keypoints that observe a point of the model.
    """

    name: str
    camera: int
    cam_from_world: Pose
    has_point: npt.NDArray[np.bool_]


@dataclass(frozen=True)
class Frame:
    """What a rig's sensors saw at once."""

    rig: int
    rig_from_world: Pose
    images: tuple[tuple[Sensor, int], ...]


@dataclass(frozen=True)
class Cloud:
    """The points of a model.

    Attributes:
        numbers: [P] uint64 as the model counts them.
        positions: [P, 3]; colors: [P, 3] uint8.
        lengths: [P] of the tracks; images: [sum of lengths] numbers of the images in them.
    """

    numbers: npt.NDArray[np.uint64]
    positions: Array
    colors: npt.NDArray[np.uint8]
    lengths: npt.NDArray[np.int64]
    images: npt.NDArray[np.uint32]


@dataclass(frozen=True)
class ColmapModel:
    """Attributes:
    lenses, images: by their numbers.
    rigs: number -> sensor -> sensor_from_rig; None for the one that the rig is named after, or
        where it isn't known. Empty in models of before COLMAP 3.12, as `frames` are.
    frame_numbers: image -> its frame.
    has_points: there is a points3D.
    """

    lenses: Mapping[int, Lens]
    images: Mapping[int, Photograph]
    rigs: Mapping[int, Mapping[Sensor, Pose | None]]
    frames: Mapping[int, Frame]
    frame_numbers: Mapping[int, int]
    has_points: bool

    def frame_of(self, image: int) -> tuple[Frame, Pose | None]:
        """The frame of an image, and its sensor_from_rig: None where that is the rig itself."""
        frame = self.frames[self.frame_numbers[image]]
        return frame, self.rigs[frame.rig][0, self.images[image].camera]


def read_model(folder: Path) -> ColmapModel:
    """Cameras, images and, where they are there, rigs and frames of a model.

    Raises:
        UnusableFile: a file is missing, cut off or damaged; the message names it.
    """
    suffix = _suffix(folder)
    lenses = _table(folder / f"cameras{suffix}", _lens)
    images = _table(folder / f"images{suffix}", _image)
    rigs: Mapping[int, Mapping[Sensor, Pose | None]] = {}
    frames: Mapping[int, Frame] = {}
    there = [name for name in ("rigs", "frames") if (folder / f"{name}{suffix}").exists()]
    if len(there) == 1:
        raise UnusableFile(f"holds {there[0]}{suffix}, but not what belongs to it")
    if there:
        rigs = _table(folder / f"rigs{suffix}", _rig)
        frames = _table(folder / f"frames{suffix}", _frame)
    for number, image in images.items():
        if image.camera not in lenses:
            raise UnusableFile(
                f"holds an image {shown(image.name)} ({number}) whose camera {image.camera} is "
                f"not in cameras{suffix}"
            )
    has_points = (folder / f"points3D{suffix}").exists()
    return ColmapModel(lenses, images, rigs, frames, _framed(images, rigs, frames), has_points)


def _framed(
    images: Mapping[int, Photograph],
    rigs: Mapping[int, Mapping[Sensor, Pose | None]],
    frames: Mapping[int, Frame],
) -> dict[int, int]:
    """Image -> its frame, where there are frames: each image must be in one that can pose it."""
    found: dict[int, int] = {}
    for number, frame in frames.items():
        if frame.rig not in rigs:
            raise UnusableFile(f"holds a frame {number} of the rig {frame.rig}, which is not there")
        for sensor, taken in frame.images:
            if sensor[0] != _SENSORS["CAMERA"]:
                continue
            if taken in found:
                raise UnusableFile(f"holds two frames ({found[taken]}, {number}) of image {taken}")
            found[taken] = number
            if taken in images and images[taken].camera != sensor[1]:
                raise UnusableFile(
                    f"holds a frame {number} in which image {taken} is by camera {sensor[1]}, and "
                    f"images say {images[taken].camera}"
                )
    for number, image in images.items() if frames or rigs else ():
        if number not in found:
            raise UnusableFile(f"holds an image {shown(image.name)} ({number}) without a frame")
        sensors = rigs[frames[found[number]].rig]
        sensor = (_SENSORS["CAMERA"], image.camera)
        reference = next(iter(sensors), None)
        if sensor not in sensors or (sensors[sensor] is None and sensor != reference):
            raise UnusableFile(
                f"holds an image {shown(image.name)} ({number}) whose camera {image.camera} has "
                "no place in its rig"
            )
    return found


def _suffix(folder: Path) -> str:
    whole = all((folder / f"{name}.bin").is_file() for name in ("cameras", "images"))
    return ".bin" if whole else ".txt"


def read_cloud(folder: Path) -> Cloud:
    """The points of a model.

    Raises:
        UnusableFile: points3D is missing, cut off or damaged.
    """
    suffix = _suffix(folder)
    numbers, positions, colors = array("Q"), array("d"), bytearray()
    lengths, images = array("q"), array("I")
    for row in rows_of(folder / f"points3D{suffix}", at_least=51):
        numbers.append(row.take("Q")[0])
        positions.extend(row.take("3d"))
        colors += bytes(row.take("3B"))
        row.take("d")
        track = row.track()
        lengths.append(len(track))
        images.frombytes(track.tobytes())
    found = Cloud(
        np.array(numbers, np.uint64),
        np.array(positions, np.float64).reshape(-1, 3),
        np.frombuffer(bytes(colors), np.uint8).reshape(-1, 3),
        np.array(lengths, np.int64),
        np.array(images, np.uint32),
    )
    if len(np.unique(found.numbers)) < len(found.numbers):
        raise UnusableFile(f"holds a points3D{suffix} in which a point stands twice")
    wrong = ~np.isfinite(found.positions).all(1)
    if wrong.any():
        number = found.numbers[int(np.argmax(wrong))]
        raise UnusableFile(f"holds a points3D{suffix} whose point {number} has no finite position")
    return found


def _lens(row: Row) -> Lens:
    name = row.word(_MODELS)
    width, height = row.take("2Q")
    lens = Lens(name, width, height, row.take(f"{len(LENSES[name][1])}d"))
    _checked(row, check_lens, lens, f"camera {row.number}")
    return lens


def _image(row: Row) -> Photograph:
    pose = _pose(row)
    (camera,) = row.take("I")
    return Photograph(row.name(), camera, pose, row.keypoints())


def _rig(row: Row) -> dict[Sensor, Pose | None]:
    (count,) = row.take("I")
    found: dict[Sensor, Pose | None] = {}
    for k in range(count):
        sensor = _sensor(row)
        if sensor in found:
            raise row.wrong(f"a rig with the sensor {sensor[1]} twice")
        found[sensor] = _pose(row) if k and row.take("B")[0] else None
    return found


def _frame(row: Row) -> Frame:
    (rig,) = row.take("I")
    pose = _pose(row)
    (count,) = row.take("I")
    return Frame(rig, pose, tuple((_sensor(row), row.take("Q")[0]) for _ in range(count)))


def _sensor(row: Row) -> Sensor:
    return _SENSORS[row.word(_SENSOR_WORDS)], row.take("I")[0]


def _pose(row: Row) -> Pose:
    values = row.take("7d")
    whose = f"{row.file.partition('.')[0].removesuffix('s')} {row.number}"
    _checked(row, check_quaternion, values[:4], whose, "QW QX QY QZ")
    if not all(abs(value) <= FARTHEST for value in values[4:]):
        raise row.wrong(f"TX TY TZ of {whose} is {' '.join(f'{v:.4g}' for v in values[4:])}")
    return Pose(values[:4], values[4:])


#: Numbers of words in binary files.
_MODELS = {number: name for name, (number, _) in LENSES.items()}
_SENSOR_WORDS = {number: name for name, number in _SENSORS.items()}


def _checked(row: Row, check: Callable[..., None], *values: Any) -> None:
    """Say the file's name where a check fails."""
    try:
        check(*values)
    except UnusableFile as error:
        raise UnusableFile(f"can't be read: {row.file} {error}") from None


def _table(path: Path, parse: Callable[[Row], Any]) -> dict[int, Any]:
    """Number -> what a file says of it."""
    least = {"cameras": 48, "images": 73, "rigs": 8, "frames": 68}[path.stem]
    found: dict[int, Any] = {}
    for row in rows_of(path, least):
        if len(found) >= _MOST:
            raise UnusableFile(f"can't be read: {path.name} has more than {_MOST} entries")
        (number,) = row.take("I")
        row.number = number
        if number in found:
            raise row.wrong(f"the number {number} twice")
        found[number] = parse(row)
    return found
