"""How far cameras and points are from the truth: the figures of `benchmarks/init.py`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt
from scipy import ndimage
from scipy.spatial import cKDTree

from pipeline.artifacts.cameras import Camera
from pipeline.artifacts.points import Points
from pipeline.geometry.rigid import angle_between
from pipeline.geometry.similarity import similarity

Array = npt.NDArray[np.float64]

#: `depth/*.png` of the scan video hold millimetres times this.
DEPTH_UNITS = 200.0
#: Value of teeth in `masks/*.png` of the scan video.
TOOTH = 255
#: Points of no more confidence are fill, not measured.
FILL_CONFIDENCE = 1.25
#: Points that the figures are taken of, at most, drawn evenly.
SAMPLE = 60_000


@dataclass(frozen=True)
class Truth:
    """One true camera.

    Attributes:
        cam_from_world: [4, 4].
        focal: over the long side of the image.
        size: width, height in pixels.
        depth: [H, W] z-depth in mm, or None where there is no truth.
        tooth: [H, W] bool, or None.
    """

    cam_from_world: Array
    focal: float
    size: tuple[int, int]
    depth: npt.NDArray[np.float32] | None = None
    tooth: npt.NDArray[np.bool_] | None = None

    @property
    def camera(self) -> Camera:
        width, height = self.size
        focal = self.focal * max(self.size)
        return Camera(
            "", width, height, focal, focal, width / 2, height / 2, self.cam_from_world
        )  # fmt: skip

    def tooth_points(self) -> Array:
        """[N, 3] world points of the tooth surface that this view sees, mm."""
        assert self.depth is not None
        assert self.tooth is not None
        return self.camera.unproject(self.depth)[self.tooth & (self.depth > 0)]


def read_truth(folder: Path, frame: dict, focal: float) -> Truth:
    """The truth of one frame of a scan video, by its entry in `transforms.json`."""
    depth = cv2.imread(str(folder / frame["depth_file_path"]), cv2.IMREAD_UNCHANGED)
    mask = cv2.imread(str(folder / frame["mask_path"]), cv2.IMREAD_GRAYSCALE)
    if depth is None or mask is None:
        raise FileNotFoundError(f"{folder} has no depth and mask for {frame['file_path']}")
    height, width = mask.shape
    return Truth(
        cam_from_world=np.array(frame["w2c_opencv"], np.float64),
        focal=focal / max(width, height),
        size=(width, height),
        depth=(depth / np.float32(DEPTH_UNITS)).astype(np.float32),
        tooth=mask == TOOTH,
    )


def rotation_errors(found: Sequence[Array], truth: Sequence[Array]) -> Array:
    """[n (n-1) / 2] errors in degrees of the rotations between all pairs of cameras."""
    errors = []
    for a in range(len(found)):
        for b in range(a):
            turn = found[a][:3, :3] @ found[b][:3, :3].T
            right = truth[a][:3, :3] @ truth[b][:3, :3].T
            errors.append(angle_between(turn, right))
    return np.array(errors)


def centres(poses: Sequence[Array]) -> Array:
    """[N, 3] projection centres of [4, 4] cam_from_world."""
    return np.array([-pose[:3, :3].T @ pose[:3, 3] for pose in poses])


def translation_errors(found: Sequence[Array], truth: Sequence[Array]) -> Array:
    """[n] distances of the camera centres after similarity alignment, % of the largest distance."""
    a, b = centres(found), centres(truth)
    if len(a) < 3:
        return np.full(len(a), np.nan)
    scale, rotation, shift = similarity(a, b, np.ones(len(a)))
    extent = np.linalg.norm(b[:, None] - b[None], axis=-1).max()
    missed: Array = np.linalg.norm(scale * a @ rotation.T + shift - b, axis=1)
    return 100 * missed / extent


@dataclass(frozen=True)
class DenseScore:
    """How a cloud covers the teeth.

    Attributes:
        points: measured points on teeth.
        median, p90: distance from the surface in mm.
        far: % of the points more than 2 mm off.
        covered_pair: % of the tooth surface seen by two or more views that has a point within
            .5 mm.
        covered_any: the same of the surface that any view sees.
    """

    points: int
    median: float
    p90: float
    far: float
    covered_pair: float
    covered_any: float


def score_points(
    points: Points, cameras: Sequence[Camera], truth: Sequence[Truth], everything: Sequence[Truth]
) -> DenseScore:
    """Compare a cloud with the teeth, after a similarity found from the cameras and by ICP.

    Args:
        points: the cloud; what is not more confident than fill is left out.
        cameras: the cameras found.
        truth: the true ones, in their order.
        everything: all true views there are: together they show the surface.
    """
    random = np.random.default_rng(0)
    measured = points.positions[points.confidence > FILL_CONFIDENCE].astype(np.float64)
    on_teeth = measured[_projects_on_teeth(measured, cameras, truth)]
    surface = np.concatenate([view.tooth_points() for view in everything])
    tree = cKDTree(surface)
    scale, rotation, shift = similarity(
        np.array([camera.centre for camera in cameras]),
        centres([view.cam_from_world for view in truth]),
        np.ones(len(cameras)),
    )
    start = on_teeth if len(cameras) > 2 else on_teeth[:0]
    cloud = scale * on_teeth @ rotation.T + shift
    sample = cloud[random.permutation(len(cloud))[:SAMPLE]]
    for _ in range(20 if len(start) else 0):
        distance, nearest = tree.query(sample, workers=-1)
        close = distance <= np.quantile(distance, 0.85)
        scale, rotation, shift = similarity(
            sample[close], surface[nearest[close]], np.ones(len(sample[close]))
        )
        sample = scale * sample @ rotation.T + shift
        cloud = scale * cloud @ rotation.T + shift
    distance = tree.query(sample, workers=-1)[0]
    own = cKDTree(cloud)
    covered = []
    for least in (2, 1):
        seen = _seen_by(truth, least)
        seen = seen[random.permutation(len(seen))[:SAMPLE]]
        covered.append(100 * float((own.query(seen, workers=-1)[0] < 0.5).mean()))
    return DenseScore(
        points=len(on_teeth),
        median=float(np.median(distance)),
        p90=float(np.quantile(distance, 0.9)),
        far=100 * float((distance > 2).mean()),
        covered_pair=covered[0],
        covered_any=covered[1],
    )


def _projects_on_teeth(
    points: Array, cameras: Sequence[Camera], truth: Sequence[Truth]
) -> npt.NDArray[np.bool_]:
    """[N] bool: at least half of the views that contain the point show tooth there."""
    inside, tooth = np.zeros(len(points)), np.zeros(len(points))
    for camera, view in zip(cameras, truth, strict=True):
        assert view.tooth is not None
        core = ndimage.binary_erosion(view.tooth)  # the outermost pixels show both
        pixels, depth = camera.project(points)
        column, row = np.floor(pixels).astype(np.int64).T
        within = (depth > 0) & (row >= 0) & (column >= 0)
        within &= (row < core.shape[0]) & (column < core.shape[1])
        inside += within
        tooth[within] += core[row[within], column[within]]
    return (inside > 0) & (2 * tooth >= inside)


def _seen_by(truth: Sequence[Truth], least: int) -> Array:
    """[N, 3] points of the tooth surface that at least so many of the views see, mm."""
    result = []
    for index, view in enumerate(truth):
        points = view.tooth_points()
        count = np.ones(len(points), np.int64)
        for other_index, other in enumerate(truth):
            if other_index == index:
                continue
            assert other.depth is not None
            pixels, depth = other.camera.project(points)
            column, row = np.floor(pixels).astype(np.int64).T
            within = (row >= 0) & (column >= 0) & (depth > 0)
            within &= (row < other.size[1]) & (column < other.size[0])
            there = other.depth[row[within], column[within]]
            count[np.flatnonzero(within)[np.abs(there - depth[within]) < 0.5]] += 1
        result.append(points[count >= least])
    return np.concatenate(result)
