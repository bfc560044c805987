"""Refinement of aligned cameras by bundle adjustment of sparse matches.

Pointmaps say roughly where a feature lies in another photograph; which pixel it is, its descriptor
says. The search is thus small, and repetitive texture does no harm.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from pipeline.artifacts.cameras import Camera
from pipeline.geometry.depths import ViewDepth
from pipeline.geometry.world import move_camera, similarity_between

Array = npt.NDArray[np.float64]
Feature = tuple[int, int]

#: Pixel settings are given for images of this long side and scale with it.
_REFERENCE_SIDE = 512.0
#: Candidates nearer to each other than this are one feature, for the ratio test; pixels.
_SAME_FEATURE = 3.0
#: Matched points that are used at most (no `min_matches` can ask for more); those in most views
#: come first.
_MOST_TRACKS = 3000
#: SIFT's contrast threshold.
_CONTRAST = 0.01
#: How far from where the pointmaps say a match may lie, and the ratio test against the next
#: candidate in that area.
_SEARCH, _RATIO = 20.0, 0.85
#: Pairs of views whose axes differ by more are not matched, degrees.
_MAX_ANGLE = 45.0
#: Larger reprojection errors are dropped after the first round.
_MAX_ERROR = 3.0
#: Scale of Cauchy's loss, pixels of the image.
_LOSS = 1.0
#: Nothing is changed unless the median reprojection error falls by this factor. Noise of the
#: pointmaps alone leaves matches a factor 1.2 to 1.8; where they are bent by 2 % it is 2.2 to 4.5,
#: and matches are worth more than they.
_MIN_GAIN = 2.0


@dataclass(frozen=True)
class BundleOptions:
    """Settings of `refine_with_matches`.

    Attributes:
        features: per view at most.
        min_matches: with fewer matched features in any view nothing is changed.
        free_focals: matches tell focal lengths worse than pointmaps do where views are few.
        shared_focal: views of one size and principal point have one lens; where focal lengths
            stay, of one focal length too.
    """

    features: int = 3000
    min_matches: int = 80
    free_focals: bool = False
    shared_focal: bool = False


@dataclass(frozen=True)
class Bundle:
    """What came out.

    Attributes:
        cameras: refined, in the world of those given; the given ones where nothing was changed.
        tracks: points that were used.
        before, after: median reprojection error, pixels; nan if it was not asked.
        reason: why nothing was changed; empty if something was.
        view: name of the one that the reason ends with, if any.
    """

    cameras: dict[str, Camera]
    tracks: int
    before: float
    after: float
    reason: str = ""
    view: str = ""


@dataclass(frozen=True)
class _Features:
    """Keypoints [N, 2], unit descriptors [N, 128], world points [N, 3] (nan without depth)."""

    positions: Array
    descriptors: npt.NDArray[np.float32]
    world: Array


def refine_with_matches(
    grays: Mapping[str, npt.NDArray[np.uint8]],
    masks: Mapping[str, npt.NDArray[np.bool_]],
    cameras: Mapping[str, Camera],
    depths: Mapping[str, ViewDepth],
    options: BundleOptions,
) -> Bundle:
    """Refine cameras whose views have depth.

    Args:
        grays: [H, W] photographs by name of the view.
        masks: [H, W] where features may lie.
        cameras: aligned.
        depths: of the views, in the cameras' world.
        options: see `BundleOptions`.
    """
    names = [name for name in sorted(cameras) if name in depths]
    unit = max(max(cameras[n].width, cameras[n].height) for n in names) / _REFERENCE_SIDE
    found = [
        _features(grays[n], masks[n] & (depths[n].confidence > 1), cameras[n], depths[n], options)
        for n in names
    ]
    matches = []
    for i, j in combinations(range(len(names)), 2):
        first, second = cameras[names[i]], cameras[names[j]]
        cosine = float(first.rotation[2] @ second.rotation[2])
        if np.degrees(np.arccos(np.clip(cosine, -1, 1))) > _MAX_ANGLE:
            continue
        forth = _guided(found[i], found[j], second, unit)
        back = _guided(found[j], found[i], first, unit)
        matches += [((i, a), (j, b)) for a, b in sorted(forth.items()) if back.get(b) == a]
    tracks = sorted(_tracks(matches), key=lambda track: -len(track))[:_MOST_TRACKS]
    kept = dict(cameras)
    seen = [sum(any(view == v for view, _ in track) for track in tracks) for v in range(len(names))]
    unknown = float("nan")
    if min(seen) < options.min_matches:
        worst = names[int(np.argmin(seen))]
        return Bundle(kept, len(tracks), unknown, unknown, f"only {min(seen)} are in", worst)
    placed = [cameras[name] for name in names]
    model = _model(placed, found, tracks, options)
    before = float(np.median(_errors(model)))
    _adjust(model, options)
    _drop(model, _MAX_ERROR * unit)
    left = [sum(p.has_point3D() for p in model.images[k].points2D) for k in model.images]
    if min(left) < options.min_matches:
        return Bundle(kept, len(tracks), before, unknown, "they contradict each other")
    _adjust(model, options)
    refined = [_read(model, k, cameras[name]) for k, name in enumerate(names, start=1)]
    motion = similarity_between(refined, [cameras[name] for name in names])
    kept |= {camera.name: move_camera(camera, motion) for camera in refined}
    after = float(np.median(_errors(model)))
    if before < _MIN_GAIN * after:
        return Bundle(dict(cameras), len(tracks), before, after, "they agree with the pointmaps")
    return Bundle(kept, int(model.num_points3D()), before, after)


def _features(
    gray: npt.NDArray[np.uint8],
    usable: npt.NDArray[np.bool_],
    camera: Camera,
    depth: ViewDepth,
    options: BundleOptions,
) -> _Features:
    sift = cv2.SIFT.create(nfeatures=options.features, contrastThreshold=_CONTRAST)
    keypoints, descriptors = sift.detectAndCompute(gray, usable.astype(np.uint8))
    if not keypoints:
        return _Features(np.zeros((0, 2)), np.zeros((0, 128), np.float32), np.zeros((0, 3)))
    # OpenCV's pixel centres are whole numbers, ours are at .5.
    positions = np.array([keypoint.pt for keypoint in keypoints], np.float64) + 0.5
    column, row = np.floor(positions).astype(np.int64).T
    column, row = np.clip(column, 0, camera.width - 1), np.clip(row, 0, camera.height - 1)
    z = np.where(depth.depth > 0, depth.depth, np.nan)[row, column].astype(np.float64)
    rays = (positions - (camera.cx, camera.cy)) / (camera.fx, camera.fy)
    local = np.column_stack([rays * z[:, None], z])
    roots = np.sqrt(descriptors / np.maximum(descriptors.sum(1, keepdims=True), 1e-9))
    return _Features(
        positions, roots.astype(np.float32), (local - camera.translation) @ camera.rotation
    )


def _guided(source: _Features, target: _Features, camera: Camera, unit: float) -> dict[int, int]:
    """Best feature of the target's near where each of the source's is expected."""
    known = np.flatnonzero(np.isfinite(source.world[:, 2]))
    if len(known) == 0 or len(target.positions) == 0:
        return {}
    expected, depth = camera.project(source.world[known])
    tree = cKDTree(target.positions)
    near = tree.query_ball_point(expected, _SEARCH * unit, return_sorted=True)
    found = {}
    for feature, z, candidates in zip(known, depth, near, strict=True):
        if z <= 0 or not candidates:
            continue
        likeness = target.descriptors[candidates] @ source.descriptors[feature]
        distance = np.sqrt(np.maximum(2 - 2 * likeness, 0))
        best = int(np.argmin(distance))
        place = target.positions[candidates]
        others = np.linalg.norm(place - place[best], axis=1) > _SAME_FEATURE * unit
        # Alone in its area, a candidate has only its own distance to speak for it.
        rival = float(distance[others].min()) if others.any() else 0.7
        if distance[best] < _RATIO * rival:
            found[int(feature)] = int(candidates[best])
    return found


def _tracks(matches: Sequence[tuple[Feature, Feature]]) -> list[list[Feature]]:
    """Connected features, without those that meet one view twice."""
    parent: dict[Feature, Feature] = {}

    def root(feature: Feature) -> Feature:
        while parent.setdefault(feature, feature) != feature:
            feature = parent[feature]
        return feature

    for a, b in matches:
        first, second = sorted((root(a), root(b)))
        parent[second] = first
    groups: dict[Feature, list[Feature]] = {}
    for feature in sorted(parent):
        groups.setdefault(root(feature), []).append(feature)
    return [
        track
        for _, track in sorted(groups.items())
        if len({view for view, _ in track}) == len(track)
    ]


def _model(
    cameras: Sequence[Camera],
    features: Sequence[_Features],
    tracks: Sequence[Sequence[Feature]],
    options: BundleOptions,
) -> Any:
    import pycolmap

    model = pycolmap.Reconstruction()
    slots: list[dict[int, int]] = []
    lenses: dict[tuple[float, ...], int] = {}
    for k, camera in enumerate(cameras, start=1):
        used = sorted({feature for track in tracks for view, feature in track if view == k - 1})
        slots.append({feature: slot for slot, feature in enumerate(used)})
        focal = (camera.fx + camera.fy) / 2
        same = (camera.width, camera.height, camera.cx, camera.cy)
        own = () if options.free_focals else (focal,)
        lens = lenses.setdefault((*same, *own), k) if options.shared_focal else k
        if lens == k:
            model.add_camera_with_trivial_rig(
                pycolmap.Camera(
                    camera_id=lens, model="SIMPLE_PINHOLE", width=camera.width,
                    height=camera.height, params=[focal, camera.cx, camera.cy],
                )
            )  # fmt: skip
        image = pycolmap.Image(
            name=camera.name, camera_id=lens, image_id=k,
            keypoints=features[k - 1].positions[used].reshape(-1, 2),
        )  # fmt: skip
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(camera.cam_from_world[:3]))
    for track in tracks:
        pixels = np.array([features[view].positions[feature] for view, feature in track])
        point = _meeting_point([cameras[view] for view, _ in track], pixels)
        elements = pycolmap.Track()
        for view, feature in track:
            elements.add_element(view + 1, slots[view][feature])
        model.add_point3D(point, elements, np.zeros(3, np.uint8))
    return model


def _meeting_point(cameras: Sequence[Camera], pixels: Array) -> Array:
    """Point nearest to the rays of pixels [N, 2], one per camera, in least squares."""
    matrix, right = np.zeros((3, 3)), np.zeros(3)
    for camera, pixel in zip(cameras, pixels, strict=True):
        ray = np.append((pixel - (camera.cx, camera.cy)) / (camera.fx, camera.fy), 1.0)
        ray = camera.rotation.T @ (ray / np.linalg.norm(ray))
        across = np.eye(3) - np.outer(ray, ray)
        matrix += across
        right += across @ camera.centre
    # Parallel rays meet far away, not nowhere.
    return np.asarray(np.linalg.solve(matrix + 1e-12 * np.eye(3), right), np.float64)


def _adjust(model: Any, options: BundleOptions) -> None:
    import pycolmap

    settings = pycolmap.BundleAdjustmentOptions()
    settings.refine_focal_length = options.free_focals
    settings.refine_principal_point = False
    settings.refine_extra_params = False
    settings.print_summary = False
    settings.ceres.use_gpu = False
    settings.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
    settings.ceres.loss_function_scale = _LOSS
    settings.ceres.solver_options.num_threads = 1
    config = pycolmap.BundleAdjustmentConfig()
    for number in sorted(model.images):
        config.add_image(number)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    # `pycolmap.bundle_adjustment` does the same, but writes to the user's screen.
    pycolmap.create_default_bundle_adjuster(settings, config, model).solve()


def _residuals(model: Any) -> list[tuple[int, int, int, float]]:
    """(point, image, keypoint, reprojection error) of every observation, sorted."""
    found = []
    for number in sorted(model.point3D_ids()):
        point = model.points3D[number]
        for element in point.track.elements:
            image = model.images[element.image_id]
            projected = image.project_point(point.xyz)
            error = (
                np.inf
                if projected is None
                else float(np.linalg.norm(projected - image.points2D[element.point2D_idx].xy))
            )
            found.append((number, element.image_id, element.point2D_idx, error))
    return found


def _errors(model: Any) -> Array:
    return np.array([error for *_, error in _residuals(model)])


def _drop(model: Any, max_error: float) -> None:
    for number, image, keypoint, error in _residuals(model):
        if error > max_error and model.exists_point3D(number):
            # Deletes the point as well where fewer than two observations are left.
            model.delete_observation(image, keypoint)


def _read(model: Any, number: int, camera: Camera) -> Camera:
    image = model.images[number]
    ratio = model.cameras[image.camera_id].focal_length / ((camera.fx + camera.fy) / 2)
    pose = np.eye(4)
    pose[:3] = image.cam_from_world().matrix()
    return replace(camera, fx=camera.fx * ratio, fy=camera.fy * ratio, cam_from_world=pose)
