"""What COLMAP's database says of the images, and why some of them were not registered."""

from __future__ import annotations

import contextlib
import re
import sqlite3
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from pipeline.geometry.models.colmap import quiet_pycolmap
from pipeline.untrusted.scenes.colmap import read_model

Pair = tuple[str, str]
#: COLMAP numbers a pair of images by id1 * this + id2.
PAIR_BASE = 2147483647
#: Pairs, those with most matches, whose relative pose is looked at.
PAIRS_TRIED = 40


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
    with tempfile.TemporaryDirectory() as scratch:
        copy = Path(scratch) / "database.db"
        source = sqlite3.connect(f"file:{path}?mode=ro", uri=True)
        target = sqlite3.connect(copy)
        try:
            source.backup(target)
            yield target
        finally:
            source.close()
            target.close()


def read_evidence(path: Path) -> Evidence:
    """Read a COLMAP database of any version (by SQL, since pycolmap would convert it in place).

    Raises:
        sqlite3.Error: it is not one, or damaged.
    """
    with _opened(path) as database:
        names = dict(database.execute("SELECT image_id, name FROM images"))
        camera_of = dict(database.execute("SELECT image_id, camera_id FROM images"))
        lenses = {
            number: quiet_pycolmap().Camera(
                camera_id=number,
                model=quiet_pycolmap().CameraModelId(model),
                width=width,
                height=height,
                params=np.frombuffer(parameters, np.float64).tolist(),
            )
            for number, model, width, height, parameters in database.execute(
                "SELECT camera_id, model, width, height, params FROM cameras"
            )
        }
        keypoints = {
            names[number]: _array(data, rows, columns, np.float32)[:, :2].astype(np.float64)
            for number, rows, columns, data in database.execute(
                "SELECT image_id, rows, cols, data FROM keypoints"
            )
        }
        inliers = {}
        for pair, rows, columns, data in database.execute(
            "SELECT pair_id, rows, cols, data FROM two_view_geometries ORDER BY pair_id"
        ):
            second = pair % PAIR_BASE
            first = (pair - second) // PAIR_BASE
            found = _array(data, rows, columns or 2, np.uint32).astype(np.int64)
            inliers[names[first], names[second]] = found
    return Evidence(
        keypoints=keypoints,
        inliers=inliers,
        lenses={name: lenses[camera_of[number]] for number, name in names.items()},
    )


def _array(data: bytes | None, rows: int, columns: int, dtype: type) -> npt.NDArray[Any]:
    return np.frombuffer(data or b"", dtype).reshape(rows, columns)


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
