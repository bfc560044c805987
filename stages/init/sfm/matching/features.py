"""Keypoints that survive a turned camera: upright SIFT on the image and on squeezed copies of it.

Seen from the side, a tooth looks narrower. Describing copies of the image that are squeezed
horizontally simulates that one rotation, which is what changes along a dental arch, at a third of
the cost of full affine simulation (Morel & Yu, ASIFT, 2009).
"""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from pipeline.geometry.models.colmap import quiet_pycolmap

#: Keypoints [K, 4] float32 (x, y, scale, orientation) and descriptors [K, 128] float32.
Described = tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]]
#: keypoints this near are one, in pixels: each copy shows a place a little aside
SAME_PLACE = 1.2


@dataclass(frozen=True)
class Features:
    """Keypoints and descriptors of one view.

    Attributes:
        positions: [K, 2] float64 pixels, centres at .5.
        descriptors: [K, 128] float32 RootSIFT; whole numbers 0..255 with an L2 norm of about 512,
            so that sums of products are exact in float32 in whatever order they are added.
        scales: [K] float32, pixels.
        squeezes: [K] float32, the horizontal squeeze of the copy on which it was found, 1 = none.
        points: [K] int64, for each the index of the keypoint that stands for its place: keypoints
            nearer than the merging radius share one.
        roll: degrees, clockwise, that were taken out of the image before describing it.
    """

    positions: npt.NDArray[np.float64]
    descriptors: npt.NDArray[np.float32]
    scales: npt.NDArray[np.float32]
    squeezes: npt.NDArray[np.float32]
    points: npt.NDArray[np.int64]
    roll: float = 0.0

    def __len__(self) -> int:
        return len(self.positions)

    def plain(self) -> Features:
        """Those of the image itself; they must come first, so that indices stay the same."""
        count = int((self.squeezes == 1).sum())
        if count in (0, len(self)) or (self.squeezes[:count] != 1).any():
            return self
        return Features(
            self.positions[:count], self.descriptors[:count], self.scales[:count],
            self.squeezes[:count], self.points[:count], self.roll,
        )  # fmt: skip

    def enlarged(self, factors: tuple[float, float]) -> Features:
        """Those of a reduced image in pixels of one so many times as wide and high."""
        scales = self.scales * np.float32(np.sqrt(factors[0] * factors[1]))
        return replace(self, positions=self.positions * factors, scales=scales)

    def largest(self, count: int) -> npt.NDArray[np.int64]:
        """[<= count] indices of the unsqueezed keypoints of the largest scale, largest first."""
        plain = np.flatnonzero(self.squeezes == 1)
        return plain[np.argsort(-self.scales[plain], kind="stable")[:count]]


def detect_features(
    gray: npt.NDArray[np.uint8],
    valid: npt.NDArray[np.bool_],
    *,
    squeezes: tuple[float, ...] = (1.0, 0.71, 0.5),
    upright: bool = True,
    peak_threshold: float = 0.002,
    max_features: int = 6000,
    roll: float = 0.0,
    described: Sequence[Described] | None = None,
) -> Features:
    """Detect and describe the keypoints of one view.

    Args:
        gray: [H, W] uint8.
        valid: [H, W] bool; keypoints outside are dropped.
        squeezes: horizontal scales of the copies to describe; 1 is the image itself.
        upright: take the vertical as the keypoints' orientation (photographs that are not rolled).
        peak_threshold: contrast below which a keypoint is ignored.
        max_features: per copy, the largest are kept.
        roll: degrees by which the photograph is rolled clockwise; it is turned back first.
        described: what `describe` found on each of `copies_of`, if that has been done.
    """
    positions, descriptors, scales, levels = [], [], [], []
    turned, original_from_turned = turned_back(gray, roll)
    if described is None:
        described = [
            _sift(squeezed(turned, squeeze), upright, peak_threshold, max_features)
            for squeeze in squeezes
        ]
    for squeeze, (keypoints, rows) in zip(squeezes, described, strict=True):
        width = squeezed_width(turned.shape[1], squeeze)
        place = keypoints[:, :2].astype(np.float64) * (turned.shape[1] / width, 1.0)
        place = place @ original_from_turned[:, :2].T + original_from_turned[:, 2]
        within = ((place >= 0) & (place < gray.shape[::-1])).all(1)
        keypoints, rows, place = keypoints[within], rows[within], place[within]
        column = np.clip(place[:, 0].astype(np.int64), 0, gray.shape[1] - 1)
        line = np.clip(place[:, 1].astype(np.int64), 0, gray.shape[0] - 1)
        inside = valid[line, column]
        positions.append(place[inside])
        descriptors.append(rows[inside])
        scales.append(keypoints[inside, 2])
        levels.append(np.full(int(inside.sum()), squeeze, np.float32))
    place = np.concatenate(positions)
    return Features(
        positions=place,
        descriptors=np.concatenate(descriptors),
        scales=np.concatenate(scales),
        squeezes=np.concatenate(levels),
        points=merge_points(place),
        roll=roll,
    )


def oriented_features(
    gray: npt.NDArray[np.uint8], valid: npt.NDArray[np.bool_], peak_threshold: float, count: int
) -> tuple[Features, npt.NDArray[np.float64]]:
    """Features that don't care how the photograph is rolled, and their orientations.

    Args:
        gray: [H, W] uint8.
        valid: [H, W] bool; keypoints outside are dropped.
        peak_threshold: contrast below which a keypoint is ignored.
        count: the largest are kept.

    Returns:
        The features, and [K] radians from the x axis towards the y axis.
    """
    keypoints, described = _sift(gray, False, peak_threshold, count)
    column = np.clip(keypoints[:, 0].astype(np.int64), 0, gray.shape[1] - 1)
    row = np.clip(keypoints[:, 1].astype(np.int64), 0, gray.shape[0] - 1)
    inside = valid[row, column]
    keypoints, described = keypoints[inside], described[inside]
    features = Features(
        positions=keypoints[:, :2].astype(np.float64),
        descriptors=described,
        scales=keypoints[:, 2],
        squeezes=np.ones(len(keypoints), np.float32),
        points=np.arange(len(keypoints)),
    )
    return features, keypoints[:, 3].astype(np.float64)


def turned_back(
    gray: npt.NDArray[np.uint8], roll: float
) -> tuple[npt.NDArray[np.uint8], npt.NDArray[np.float64]]:
    """An image without its roll, on a canvas that holds all of it.

    Args:
        gray: [H, W] uint8.
        roll: degrees, clockwise.

    Returns:
        The image, and [2, 3] the map of its pixels (centres at .5) to those of the original.
    """
    if not roll:
        return gray, np.eye(2, 3)
    cosine, sine = np.cos(np.radians(roll)), np.sin(np.radians(roll))
    turn = np.array([[cosine, -sine], [sine, cosine]])  # original from turned
    height, width = gray.shape
    size = np.ceil(np.abs(turn.T) @ (width, height) - 1e-6).astype(int)
    shift = np.array([width, height]) / 2 - turn @ (size / 2)
    original_from_turned = np.column_stack([turn, shift])
    # OpenCV counts pixels from their centres.
    centred = np.column_stack([turn, shift + turn @ (0.5, 0.5) - 0.5])
    image = cv2.warpAffine(
        gray, centred, (int(size[0]), int(size[1])),
        flags=cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP, borderMode=cv2.BORDER_REPLICATE,
    )  # fmt: skip
    return np.ascontiguousarray(image, np.uint8), original_from_turned


def reduced(
    gray: npt.NDArray[np.uint8], valid: npt.NDArray[np.bool_], side: float
) -> tuple[npt.NDArray[np.uint8], npt.NDArray[np.bool_]]:
    """An image [H, W] uint8 and its mask [H, W] with a long side of at most `side` pixels."""
    height, width = gray.shape
    scale = side / max(height, width)
    if scale >= 1:
        return gray, valid
    size = max(round(width * scale), 1), max(round(height * scale), 1)
    inside = cv2.resize(valid.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST) > 0
    return np.asarray(cv2.resize(gray, size, interpolation=cv2.INTER_AREA), np.uint8), inside


def squeezed(gray: npt.NDArray[np.uint8], squeeze: float) -> npt.NDArray[np.uint8]:
    """Scale an image [H, W] horizontally by `squeeze` <= 1, blurred first so as not to alias."""
    if squeeze >= 1:
        return np.ascontiguousarray(gray)
    # .8 pixels is the blur that SIFT takes an image to have (as in ASIFT).
    sigma = 0.8 * np.sqrt(1 / squeeze**2 - 1)
    blurred = cv2.GaussianBlur(gray, (0, 0), sigmaX=sigma, sigmaY=0.01)
    width = squeezed_width(gray.shape[1], squeeze)
    small = cv2.resize(blurred, (width, gray.shape[0]), interpolation=cv2.INTER_LINEAR)
    return np.ascontiguousarray(small, np.uint8)


def squeezed_width(width: int, squeeze: float) -> int:
    """Pixels of a squeezed copy."""
    return width if squeeze >= 1 else max(round(width * squeeze), 1)


def copies_of(
    gray: npt.NDArray[np.uint8], squeezes: Sequence[float], roll: float
) -> list[npt.NDArray[np.uint8]]:
    """The copies of an image [H, W] uint8, without its roll, that `detect_features` describes."""
    turned, _ = turned_back(gray, roll)
    return [squeezed(turned, squeeze) for squeeze in squeezes]


def describe(
    images: Sequence[npt.NDArray[np.uint8]], upright: bool, peak_threshold: float,
    max_features: int, threads: int, scratch: Path | None,
) -> list[Described]:  # fmt: skip
    """What `detect_features` finds on images, on several threads.

    Through files: COLMAP's extractor in memory lets no other thread of Python run meanwhile.

    Args:
        images: arrays [H, W] uint8; sizes may differ.
        upright, peak_threshold, max_features: as for `detect_features`.
        threads: change nothing but the time.
        scratch: folder for the files; None: the system's.

    Returns:
        For each image keypoints [K, 4] float32 (x, y, scale, orientation) and RootSIFT descriptors
        [K, 128] float32 in 0..255.
    """
    pycolmap = quiet_pycolmap()
    result = []
    with tempfile.TemporaryDirectory(dir=scratch) as name:
        folder, database_path = Path(name) / "images", str(Path(name) / "features.db")
        folder.mkdir()
        for number, image in enumerate(images):
            # quickly packed: the file lives for a second
            cv2.imwrite(str(folder / f"{number:06d}.png"), image, [cv2.IMWRITE_PNG_COMPRESSION, 0])
        pycolmap.extract_features(
            database_path, str(folder), camera_mode=pycolmap.CameraMode.PER_IMAGE,
            extraction_options=_sift_options(upright, peak_threshold, max_features, threads),
            device=pycolmap.Device.cpu,
        )  # fmt: skip
        database = pycolmap.Database.open(database_path)
        try:
            numbers = {image.name: image.image_id for image in database.read_all_images()}
            for number in range(len(images)):
                image_id = numbers[f"{number:06d}.png"]
                x, y, a, b, c, d = (
                    np.asarray(database.read_keypoints(image_id), np.float32).reshape(-1, 6).T
                )
                rows = np.array(database.read_descriptors(image_id).data, np.float32)
                scale = (np.hypot(a, c) + np.hypot(b, d)) / 2
                keypoints = np.stack([x, y, scale, np.arctan2(c, a)], 1).astype(np.float32)
                result.append((keypoints, rows.reshape(len(keypoints), 128)))
        finally:
            database.close()
    return result


def merge_points(positions: npt.NDArray[np.float64]) -> npt.NDArray[np.int64]:
    """For each of the positions [K, 2], the index of the first one at the same place, which leads.

    Greedy in the order given: a position that no earlier leader has taken leads all that are free
    around it.
    """
    leader = np.full(len(positions), -1, np.int64)
    if len(positions) < 2:
        return np.arange(len(positions))
    near = cKDTree(positions).query_pairs(SAME_PLACE, output_type="ndarray")
    near = near[np.lexsort((near[:, 1], near[:, 0]))]
    for first, second in near.tolist():
        if leader[first] < 0:
            leader[first] = first
        if leader[first] == first and leader[second] < 0:
            leader[second] = first
    return np.where(leader < 0, np.arange(len(positions)), leader)


def joined(first: Features, second: Features) -> Features:
    """The features of one view with further ones behind them; those keep their indices."""
    positions = np.concatenate([first.positions, second.positions])
    return Features(
        positions=positions,
        descriptors=np.concatenate([first.descriptors, second.descriptors]),
        scales=np.concatenate([first.scales, second.scales]),
        squeezes=np.concatenate([first.squeezes, second.squeezes]),
        points=merge_points(positions),
        roll=first.roll,
    )


def _sift(
    gray: npt.NDArray[np.uint8], upright: bool, peak_threshold: float, max_features: int
) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]]:
    """Keypoints [K, 4] (x, y, scale, orientation) and RootSIFT descriptors [K, 128] in 0..255."""
    pycolmap = quiet_pycolmap()
    options = _sift_options(upright, peak_threshold, max_features, 1)
    extractor = pycolmap.FeatureExtractor.create(options, pycolmap.Device.cpu)
    keypoints, described = extractor.extract_from_uint8_array(gray)
    rows = [
        (point.x, point.y, point.compute_scale(), point.compute_orientation())
        for point in keypoints
    ]
    return (
        np.array(rows, np.float32).reshape(-1, 4),
        np.array(described.data, np.float32).reshape(len(rows), 128),
    )


def _sift_options(upright: bool, peak_threshold: float, max_features: int, threads: int) -> Any:
    options = quiet_pycolmap().FeatureExtractionOptions()
    options.use_gpu = False
    options.num_threads = threads
    options.sift.max_num_features = max_features
    options.sift.peak_threshold = peak_threshold
    options.sift.upright = upright
    return options
