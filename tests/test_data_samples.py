"""The committed sample cases: cameras, depth and colours agree, and the script repeats itself."""

from __future__ import annotations

import importlib.util
import itertools
import json
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
import pytest

SAMPLES = Path(__file__).resolve().parents[1] / "data_samples"
CASES = ("three_photos", "twelve_frames")


def read_case(case: str) -> dict[str, Any]:
    loaded: dict[str, Any] = json.loads((SAMPLES / case / "transforms.json").read_text())
    return loaded


def read_depth(case: str, about: dict[str, Any], frame: dict[str, Any]) -> npt.NDArray[np.float64]:
    path = SAMPLES / case / frame["depth_file_path"]
    pixels = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    assert pixels is not None
    assert pixels.dtype == np.uint16
    assert pixels.shape == (about["depth_h"], about["depth_w"])
    return np.asarray(pixels / about["depth_per_mm"], np.float64)


@pytest.fixture(scope="module")
def generator() -> ModuleType:
    spec = importlib.util.spec_from_file_location("make_samples", SAMPLES / "make_samples.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules["make_samples"] = module
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize("case", CASES)
def test_every_photograph_has_a_camera_and_the_reverse(case: str) -> None:
    about = read_case(case)
    named = {frame["file_path"] for frame in about["frames"]}
    assert named == {path.name for path in (SAMPLES / case).glob("*.jpg")}
    assert len(named) == {"three_photos": 3, "twelve_frames": 12}[case]
    for frame in about["frames"]:
        image = cv2.imread(str(SAMPLES / case / frame["file_path"]))
        assert image is not None
        assert image.shape == (384, 512, 3)
        w2c = np.array(frame["w2c_opencv"])
        np.testing.assert_allclose(w2c[:3, :3] @ w2c[:3, :3].T, np.eye(3), atol=1e-12)
        assert np.linalg.det(w2c[:3, :3]) > 0.99
        opengl = np.array(frame["transform_matrix"]) @ np.diag([1, -1, -1, 1])
        np.testing.assert_allclose(w2c @ opengl, np.eye(4), atol=1e-9)


def reproject(
    case: str, about: dict[str, Any], first: dict[str, Any], second: dict[str, Any]
) -> tuple[npt.NDArray[Any], ...]:
    """Carry the depth of one frame into another.

    Returns the pixels there [N, 2] and here [N, 2] (at depth size), the depth carried [N] and the
    depth found there [N].
    """
    depth, other = (read_depth(case, about, frame) for frame in (first, second))
    scale = about["depth_w"] / about["w"]
    focal, cx, cy = (about[key] * scale for key in ("fl_x", "cx", "cy"))
    v, u = np.nonzero(depth)
    z = depth[v, u]
    local = np.stack([(u + 0.5 - cx) / focal * z, (v + 0.5 - cy) / focal * z, z, np.ones(len(z))])
    moved = np.array(second["w2c_opencv"]) @ np.linalg.inv(first["w2c_opencv"]) @ local
    column = np.floor(focal * moved[0] / moved[2] + cx).astype(int)
    row = np.floor(focal * moved[1] / moved[2] + cy).astype(int)
    inside = (column >= 0) & (row >= 0) & (column < depth.shape[1]) & (row < depth.shape[0])
    there = np.stack([column, row], -1)[inside]
    here = np.stack([u, v], -1)[inside]
    return there, here, moved[2][inside], other[there[:, 1], there[:, 0]]


@pytest.mark.parametrize(("case", "step"), [("three_photos", 1), ("twelve_frames", 2)])
def test_depth_and_colour_of_neighbours_agree(case: str, step: int) -> None:
    about = read_case(case)
    frames = about["frames"]
    size = (about["depth_w"], about["depth_h"])
    for first, second in zip(frames, frames[step:], strict=False):
        there, here, carried, found = reproject(case, about, first, second)
        same = np.abs(carried - found) < 0.5
        # What one of the two does not see (behind a tooth, outside) can't agree; most of it must.
        assert same.mean() > 0.65, (first["file_path"], second["file_path"])
        assert np.median(np.abs(carried - found)[same]) < 0.05  # a third of a degree would show
        colours = [
            cv2.resize(
                cv2.cvtColor(cv2.imread(str(SAMPLES / case / f["file_path"])), cv2.COLOR_BGR2LAB),
                size,
                interpolation=cv2.INTER_AREA,
            ).astype(float)
            for f in (first, second)
        ]
        a = colours[0][here[same][:, 1], here[same][:, 0]][:, 1:]
        b = colours[1][there[same][:, 1], there[same][:, 0]][:, 1:]
        # Hue is the tissue's own; brightness moves with the flash.
        right = np.abs(a - b).mean()
        shuffled = np.abs(a - np.random.default_rng(0).permutation(b)).mean()
        assert right < 0.5 * shuffled, (first["file_path"], second["file_path"])


def test_the_photographs_can_be_matched() -> None:
    about = read_case("three_photos")
    sift = cv2.SIFT_create(4000, contrastThreshold=0.006)
    found = []
    for frame in about["frames"]:
        gray = cv2.imread(str(SAMPLES / "three_photos" / frame["file_path"]), cv2.IMREAD_GRAYSCALE)
        assert gray is not None
        found.append(sift.detectAndCompute(gray, None))
    camera = np.array([[about["fl_x"], 0, 256], [0, about["fl_x"], 192], [0, 0, 1]])
    for (points_a, a), (points_b, b) in itertools.pairwise(found):
        matches = cv2.BFMatcher(crossCheck=False).knnMatch(a, b, k=2)
        good = [m for m, n in matches if m.distance < 0.85 * n.distance]
        p = np.array([points_a[m.queryIdx].pt for m in good])
        q = np.array([points_b[m.trainIdx].pt for m in good])
        cv2.setRNGSeed(0)
        _, inliers = cv2.findEssentialMat(p, q, camera, cv2.RANSAC, 0.9999, 2.0)
        assert inliers is not None
        assert np.count_nonzero(inliers) >= 120


def test_they_are_small_and_free_of_metadata() -> None:
    files = [path for case in CASES for path in (SAMPLES / case).rglob("*") if path.is_file()]
    assert sum(path.stat().st_size for path in files) < 3_000_000
    for path in (path for path in files if path.suffix == ".jpg"):
        assert b"Exif" not in path.read_bytes()


def test_the_generator_repeats_itself(generator: ModuleType, tmp_path: Path) -> None:
    written = []
    for attempt, seed in enumerate((3, 3, 4)):
        mouth = generator.build_mouth(seed, detail=14, step=0.8, rays=4)
        folder = tmp_path / str(attempt)
        shots = generator.three_photos()[:2]
        noise = generator.Noise(seed, size=16)
        generator.write_case(folder, ".png", shots, mouth, noise, 64, 48, seed, 92)
        written.append({p.name: p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()})
    assert written[0] == written[1]
    assert written[0]["frontal.png"] != written[2]["frontal.png"]
