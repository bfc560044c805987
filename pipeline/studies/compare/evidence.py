"""What COLMAP's database says of the images, and why some of them were not registered."""

from __future__ import annotations

import contextlib
import re
import sqlite3
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from pipeline.geometry.models.colmap import quiet_pycolmap
from pipeline.untrusted.files import Kind, UnusableFile, opened
from pipeline.untrusted.scenes.cameras import LENSES, Lens, check_lens
from pipeline.untrusted.scenes.colmap import read_model

Pair = tuple[str, str]
#: COLMAP numbers a pair of images by id1 * this + id2.
PAIR_BASE = 2147483647
#: Pairs, those with most matches, whose relative pose is looked at.
PAIRS_TRIED = 40
#: A database with the descriptors of 10,000 photographs; the longest blob, of 10 million keypoints.
DATABASE, _LONGEST_VALUE = Kind("a database of COLMAP's", 1 << 37), 1 << 28
_TABLES = "SELECT name FROM sqlite_master WHERE type = 'table' AND sql NOT LIKE 'CREATE VIRTUAL%'"


@dataclass(frozen=True)
class Evidence:
    """What COLMAP knew before mapping.

    Attributes:
        keypoints: image name -> [K, 2] pixels.
        inliers: pair of image names -> [M, 2] indices of keypoints whose matches were verified;
            all pairs that had any match.
        lenses: image name -> `pycolmap.Camera` before mapping.
    """

    keypoints: dict[str, npt.NDArray[np.float64]]
    inliers: dict[Pair, npt.NDArray[np.int64]]
    lenses: dict[str, Any]


def database_beside(model: Path) -> Path | None:
    """The database that a model was made from, if it lies where COLMAP's users put it."""
    for folder in (model, *model.resolve().parents[:2]):
        if (folder / "database.db").is_file():
            return folder / "database.db"
    return None


@contextlib.contextmanager
def _opened(path: Path) -> Iterator[sqlite3.Connection]:
    """A copy of the database without its write-ahead files: the user's stays as it is."""
    try:
        with opened(path, DATABASE):
            pass
    except UnusableFile as error:
        raise sqlite3.DatabaseError(f"it {error}") from error
    source = sqlite3.connect(f"{path.absolute().as_uri()}?mode=ro", uri=True)
    target = sqlite3.connect("")  # a database without a name: nothing of it is left on the disk
    try:
        source.backup(target)
        target.text_factory = lambda text: text.decode(errors="replace")
        # A schema is a program too: views and expressions of others are not run for long.
        target.execute("PRAGMA trusted_schema = OFF")
        target.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, _LONGEST_VALUE)
        tables = {name for (name,) in target.execute(_TABLES)}
        for name in ("images", "cameras", "keypoints", "two_view_geometries"):
            if name not in tables:
                raise sqlite3.DatabaseError(f"it has no table {name}")
        yield target
    except UnicodeDecodeError as error:  # also of SQLite's own message about the schema
        raise sqlite3.DatabaseError("it holds names that are no text") from error
    finally:
        source.close()
        target.close()


def read_evidence(path: Path) -> Evidence:
    """Read a COLMAP database of any version (by SQL, since pycolmap would convert it in place).

    Raises:
        sqlite3.Error: it is not one, or damaged; the message names the table.
    """
    with _opened(path) as database:
        names: dict[int, str] = {}
        camera_of: dict[int, int] = {}
        for number, name, camera in _rows(database, "images", "image_id, name, camera_id"):
            if not isinstance(name, str) or not isinstance(camera, int):
                raise _damaged("images", number)
            names[number], camera_of[number] = name, camera
        lenses = {
            row[0]: _lens(*row)
            for row in _rows(database, "cameras", "camera_id, model, width, height, params")
        }
        keypoints = {}
        for number, rows, columns, data in _rows(
            database, "keypoints", "image_id, rows, cols, data"
        ):
            found = _array("keypoints", number, data, rows, columns, np.float32)
            if number not in names or found.shape[1] < 2 or not np.isfinite(found).all():
                raise _damaged("keypoints", number)
            keypoints[names[number]] = found[:, :2].astype(np.float64)
        inliers = {}
        for pair, rows, columns, data in _rows(
            database, "two_view_geometries", "pair_id, rows, cols, data", "ORDER BY pair_id"
        ):
            second = pair % PAIR_BASE
            first = (pair - second) // PAIR_BASE
            if first not in names or second not in names:
                raise _damaged("two_view_geometries", pair)
            table = "two_view_geometries"
            matched = _array(table, pair, data, rows, columns or 2, np.uint32).astype(np.int64)
            counts = [len(keypoints.get(names[number], ())) for number in (first, second)]
            if matched.shape[1] != 2 or (len(matched) and (matched.max(0) >= counts).any()):
                raise sqlite3.DatabaseError(
                    f"a match of {names[first]} and {names[second]} is of a keypoint that there "
                    "isn't"
                    if matched.shape[1] == 2
                    else str(_damaged(table, pair))
                )
            inliers[names[first], names[second]] = matched
        strangers = sorted(set(camera_of.values()) - set(lenses))
        if strangers:
            raise sqlite3.DatabaseError(
                f"its images name the camera {strangers[0]}, which it lacks"
            )
    return Evidence(
        keypoints=keypoints,
        inliers=inliers,
        lenses={name: lenses[camera_of[number]] for number, name in names.items()},
    )


def _rows(
    database: sqlite3.Connection, table: str, columns: str, order: str = ""
) -> Iterator[tuple[Any, ...]]:
    """The rows of a table, whose first column is a whole number."""
    for row in database.execute(f"SELECT {columns} FROM {table} {order}"):
        if not isinstance(row[0], int) or row[0] < 0:
            raise _damaged(table, row[0])
        yield row


def _lens(number: int, model: object, width: object, height: object, parameters: object) -> Any:
    names = {lens: name for name, (lens, _) in LENSES.items()}
    whole = isinstance(model, int) and isinstance(width, int) and isinstance(height, int)
    if not whole or model not in names or not isinstance(parameters, bytes):
        raise _damaged("cameras", number)
    name = names[model]
    if len(parameters) != 8 * len(LENSES[name][1]):
        raise _damaged("cameras", number)
    assert isinstance(width, int) and isinstance(height, int)
    lens = Lens(name, width, height, tuple(np.frombuffer(parameters, np.float64).tolist()))
    try:
        check_lens(lens, f"camera {number}")
    except UnusableFile as error:
        raise sqlite3.DatabaseError(f"it {error}") from error
    return quiet_pycolmap().Camera(
        camera_id=number, model=name, width=width, height=height, params=lens.parameters
    )


def _array(
    table: str, number: int, data: object, rows: object, columns: object, dtype: type
) -> npt.NDArray[Any]:
    data = b"" if data is None and rows == 0 else data
    if not (isinstance(data, bytes) and isinstance(rows, int) and isinstance(columns, int)):
        raise _damaged(table, number)
    if rows < 0 or columns < 0 or rows * columns * np.dtype(dtype).itemsize != len(data):
        raise _damaged(table, number)
    return np.frombuffer(data, dtype).reshape(rows, columns)


def _damaged(table: str, number: object) -> sqlite3.DatabaseError:
    return sqlite3.DatabaseError(f"entry {str(number)[:40]!r} of its table {table} is damaged")


def pair_table(evidence: Evidence) -> list[dict[str, Any]]:
    """Verified matches of each pair, most first."""
    pairs = sorted(evidence.inliers, key=lambda pair: (-len(evidence.inliers[pair]), pair))
    return [{"images": list(pair), "inliers": len(evidence.inliers[pair])} for pair in pairs]


def triangulation_angle(evidence: Evidence, pair: Pair) -> float | None:
    """Median angle in degrees between the rays of a pair's matches, as COLMAP would start with.

    The relative pose is estimated anew from the verified matches, with the lenses as COLMAP knew
    them before mapping. None where there is no pose.
    """
    inliers = evidence.inliers[pair]
    if len(inliers) < 8:
        return None
    pycolmap = quiet_pycolmap()
    first, second = pair
    points = [evidence.keypoints[name] for name in pair]
    options = pycolmap.TwoViewGeometryOptions()
    options.compute_relative_pose = True
    options.min_num_inliers = 8
    options.ransac.random_seed = 0
    geometry = pycolmap.estimate_calibrated_two_view_geometry(
        evidence.lenses[first], points[0], evidence.lenses[second], points[1],
        inliers.astype(np.uint32), options,
    )  # fmt: skip
    if geometry.cam2_from_cam1 is None or geometry.tri_angle < 0:
        return None
    return float(np.degrees(geometry.tri_angle))


def why_no_model(evidence: Evidence, thresholds: Mapping[str, float], log: str = "") -> str:
    """Why the mapper made no model: what its log says, and the pairs that it could start from.

    Args:
        thresholds: what the mapper asks of the first pair (`colmap_run.thresholds`).
        log: of the run.
    """
    table = [entry for entry in pair_table(evidence) if entry["inliers"]]
    said = _discarded(log)
    if not table:
        return (
            "no two images have verified matches (keypoints per image: "
            f"{_span([len(points) for points in evidence.keypoints.values()])})"
        )
    angles = {}
    for entry in table[:PAIRS_TRIED]:
        pair = (entry["images"][0], entry["images"][1])
        angle = triangulation_angle(evidence, pair)
        if angle is not None:
            angles[pair] = angle
    first, second = table[0]["images"]
    angle = angles.get((first, second))
    parts = [
        f"the pair with most verified matches, {first} and {second}, has {table[0]['inliers']}"
        + (f", {angle:.1f}° between their rays" if angle is not None else ", but no relative pose")
    ]
    wide = [pair for pair in angles if angles[pair] >= thresholds["init_angle"]]
    if wide and wide[0] != (first, second):  # in the order of their matches
        parts.append(
            f"of those with wide enough rays {wide[0][0]} and {wide[0][1]} has most: "
            f"{len(evidence.inliers[wide[0]])} at {angles[wide[0]]:.1f}°"
        )
    asked = (
        f"COLMAP begins by asking for {thresholds['init_inliers']:g} and "
        f"{thresholds['init_angle']:g}°"
    )
    return f"{said or 'no good initial pair'}: {'; '.join(parts)} ({asked})"


def _discarded(log: str) -> str:
    """What the mapper's log says of the models that it gave up."""
    reasons = re.findall(r"Discarding reconstruction due to (.+)", log)
    counted = [f"{reason.strip()} ({reasons.count(reason)}x)" for reason in dict.fromkeys(reasons)]
    return f"models begun and discarded: {', '.join(counted)}" if counted else ""


def why_left_out(
    evidence: Evidence, mapped: Mapping[str, npt.NDArray[np.bool_]], asked: float
) -> str:
    """Why images were not added to a model.

    Args:
        mapped: name of each registered image -> [K] bool, keypoints that observe a point.
        asked: how many of the model's points the mapper wants to see in an image.
    """
    parts = []
    for name in sorted(set(evidence.lenses) - set(mapped)):
        seen: set[int] = set()
        matches = 0
        for (first, second), found in evidence.inliers.items():
            if name not in (first, second):
                continue
            other = second if name == first else first
            mine, theirs = found.T if name == first else found.T[::-1]
            if other in mapped:
                matches += len(found)
                seen.update(mine[mapped[other][theirs]].tolist())
        parts.append(
            f"{name} sees {len(seen)} of the model's points by {matches} verified matches"
            if matches
            else f"{name} has no verified match with an image of the model"
        )
    return f"{'; '.join(parts)} (COLMAP asks for {asked:g} points)"


def mapped_keypoints(model: Path) -> dict[str, npt.NDArray[np.bool_]]:
    """For each registered image of a model: which of its keypoints observe a point."""
    return {image.name: image.has_point for image in read_model(model).images.values()}


def renamed(evidence: Evidence, labels: Mapping[str, str]) -> Evidence:
    """The same with other names of images, for people; names without a label stay."""

    def label(name: str) -> str:
        return labels.get(name, name)

    return Evidence(
        keypoints={label(name): value for name, value in evidence.keypoints.items()},
        inliers={(label(a), label(b)): value for (a, b), value in evidence.inliers.items()},
        lenses={label(name): value for name, value in evidence.lenses.items()},
    )


def _span(counts: Sequence[int]) -> str:
    if not counts:
        return "none"
    low, high = min(counts), max(counts)
    return str(low) if low == high else f"{low} to {high}"
