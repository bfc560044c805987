"""From verified pairs to cameras and sparse points, through pycolmap's mappers."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from pipeline.geometry.graph import Pair
from pipeline.geometry.models.colmap import quiet_pycolmap
from stages.init.sfm.mappers import MapperOptions, global_models, incremental_models
from stages.init.sfm.matching.features import Features
from stages.init.sfm.matching.two_view import Correspondences, Lens, TwoView
from stages.init.sfm.undistort import distort_pixels, undistort_pixels

Array = npt.NDArray[np.float64]
Integers = npt.NDArray[np.int64]
Distortions = list[float | None]

#: From this many views on mapping takes long enough to be hurried.
MANY_VIEWS = 9


@dataclass(frozen=True)
class Solution:
    """Cameras and sparse points, in a frame and at a scale of no meaning.

    Attributes:
        poses: view index -> [4, 4] cam_from_world.
        focals: view index -> focal length in pixels.
        distortions: view index -> radial coefficient k1 (see `undistort`); where it is not 0 the
            pixels below are those of the undistorted image.
        points: [P, 3] world.
        observed_point: [O] int64, point of each observation.
        observed_view: [O] int64, view of each observation.
        observed_pixel: [O, 2] pixels.
        residuals: [O] reprojection error in pixels of the photograph.
        edges: the pairs of views that it was made from.
    """

    poses: dict[int, Array]
    focals: dict[int, float]
    points: Array
    observed_point: Integers
    observed_view: Integers
    observed_pixel: Array
    residuals: Array
    edges: tuple[Pair, ...] = ()
    distortions: dict[int, float] = field(default_factory=dict)

    @property
    def error(self) -> float:
        """Root mean square reprojection error in pixels."""
        return float(np.sqrt(np.mean(self.residuals**2))) if len(self.residuals) else np.inf

    def centres(self) -> Array:
        """[V, 3] projection centres, in the order of the view indices."""
        poses = [self.poses[view] for view in sorted(self.poses)]
        return np.array([-pose[:3, :3].T @ pose[:3, 3] for pose in poses]).reshape(-1, 3)

    def points_of(self, view: int) -> Integers:
        """Sorted indices of the points that a view observes."""
        return np.unique(self.observed_point[self.observed_view == view])

    def triangulation_angles(self) -> Array:
        """[P] largest angle in degrees under which two of its views see each point."""
        order = sorted(self.poses)
        centre = dict(zip(order, self.centres(), strict=True))
        rays = self.points[self.observed_point] - np.array(
            [centre[view] for view in self.observed_view.tolist()]
        ).reshape(-1, 3)
        rays /= np.maximum(np.linalg.norm(rays, axis=1, keepdims=True), 1e-12)
        largest = np.zeros(len(self.points))
        by_point = np.argsort(self.observed_point, kind="stable")
        starts = np.searchsorted(self.observed_point[by_point], np.arange(len(self.points) + 1))
        for point in range(len(self.points)):
            mine = rays[by_point[starts[point] : starts[point + 1]]]
            if len(mine) > 1:
                largest[point] = np.degrees(np.arccos(np.clip((mine @ mine.T).min(), -1, 1)))
        return largest


@dataclass(frozen=True)
class MappingInput:
    """What the mappers get.

    Attributes:
        lenses: the distinct cameras.
        lens_of_view: [N] for each view its lens.
        positions: for each view [K, 2] keypoints in pixels of its lens.
        points: for each view [K] the keypoint that stands for each keypoint's place.
        correspondences: the matches of each pair.
    """

    lenses: list[Lens]
    lens_of_view: list[int]
    positions: list[Array]
    points: list[Integers]
    correspondences: dict[Pair, Correspondences]

    @classmethod
    def of(
        cls, lenses: list[Lens], lens_of_view: list[int], features: Sequence[Features],
        found: Mapping[Pair, Correspondences], shapes: Sequence[tuple[int, ...]],
    ) -> MappingInput:  # fmt: skip
        """Views of these shapes (rows, columns) with these features, and the matches between them.

        The middle of each is moved to that of its lens.
        """
        shifts = [
            np.array([lenses[lens].width - shape[1], lenses[lens].height - shape[0]]) / 2
            for lens, shape in zip(lens_of_view, shapes, strict=True)
        ]
        moved = {
            (i, j): replace(
                those, positions_i=those.positions_i + shifts[i],
                positions_j=those.positions_j + shifts[j],
            )
            for (i, j), those in sorted(found.items())
        }  # fmt: skip
        return cls(
            lenses, lens_of_view,
            [feature.positions + shift for feature, shift in zip(features, shifts, strict=True)],
            [feature.points for feature in features], moved,
        )  # fmt: skip


def map_views(
    given: MappingInput,
    edges: dict[Pair, TwoView],
    focals: list[float],
    *,
    refine_focal: bool,
    method: str,
    max_error: float,
    min_tri_angle: float,
    seed: int,
    scratch: Path,
    distortions: Distortions | None = None,
) -> Solution | None:
    """Reconstruct from the pairs in `edges`.

    Args:
        focals: for each lens, pixels.
        refine_focal: free the focal lengths in bundle adjustment.
        method: ``"incremental"`` or ``"global"``.
        max_error: reprojection error in pixels beyond which an observation is dropped.
        min_tri_angle: degrees below which a point is dropped.
        scratch: folder for the mapper's database.
        distortions: for each lens the radial coefficient to start from, to be refined, or None
            where it is a pinhole; None: all are.

    Returns:
        The largest model, or None if there is none.
    """
    pycolmap = quiet_pycolmap()
    if not edges:
        return None
    run = {"incremental": incremental_models, "global": global_models}[method]
    options = MapperOptions(
        refine_focal, distortions is not None, max_error, min_tri_angle, seed,
        many=len(given.positions) >= MANY_VIEWS,
    )  # fmt: skip
    with tempfile.TemporaryDirectory(dir=scratch) as name:
        folder = Path(name)
        database = folder / "database.db"
        cameras = lens_cameras(given.lenses, focals, distortions)
        _write_database(database, given, edges, cameras)
        models = run(pycolmap, database, folder, options)
    if not models:
        return None
    best = max(sorted(models), key=lambda key: (models[key].num_reg_images(),
                                                models[key].num_points3D()))  # fmt: skip
    return solution_of(models[best], tuple(sorted(edges)))


def lens_cameras(
    lenses: list[Lens], focals: list[float], distortions: Distortions | None
) -> list[Any]:
    """The pycolmap cameras of lenses, numbered from 1; pinholes where there is no distortion."""
    cameras = []
    for index, (lens, focal) in enumerate(zip(lenses, focals, strict=True)):
        camera = lens.camera(focal, None if distortions is None else distortions[index])
        camera.camera_id = index + 1
        camera.has_prior_focal_length = True
        cameras.append(camera)
    return cameras


def _write_database(
    path: Path, given: MappingInput, edges: dict[Pair, TwoView], cameras: list[Any]
) -> None:
    """Write a COLMAP database whose matches are verified already."""
    pycolmap = quiet_pycolmap()
    database = pycolmap.Database.open(str(path))
    for camera in cameras:
        database.write_camera(camera, use_camera_id=True)
        rig = pycolmap.Rig(rig_id=camera.camera_id)
        rig.add_ref_sensor(camera.sensor_id)
        database.write_rig(rig, use_rig_id=True)
    for view, positions in enumerate(given.positions):
        camera_id = given.lens_of_view[view] + 1
        image = pycolmap.Image(name=f"{view:05d}", camera_id=camera_id, image_id=view + 1)
        database.write_image(image, use_image_id=True)
        frame = pycolmap.Frame(frame_id=view + 1, rig_id=camera_id)
        frame.add_data_id(image.data_id)
        database.write_frame(frame, use_frame_id=True)
        database.write_keypoints(view + 1, positions.astype(np.float32))
    for (i, j), edge in sorted(edges.items()):
        features = given.correspondences[i, j].features[edge.inliers]
        places = np.stack([given.points[i][features[:, 0]], given.points[j][features[:, 1]]], 1)
        matches = np.unique(places, axis=0).astype(np.uint32)
        geometry = pycolmap.TwoViewGeometry()
        geometry.config = pycolmap.TwoViewGeometryConfiguration.CALIBRATED
        geometry.cam2_from_cam1 = pycolmap.Rigid3d(edge.j_from_i)
        geometry.E = pycolmap.essential_matrix_from_pose(geometry.cam2_from_cam1)
        geometry.inlier_matches = matches
        database.write_matches(i + 1, j + 1, matches)
        database.write_two_view_geometry(i + 1, j + 1, geometry)
    database.close()


def solution_of(model: Any, edges: tuple[Pair, ...]) -> Solution:
    """Copy a pycolmap reconstruction into arrays, sorted by identifier, without distortion."""
    poses, lenses = {}, {}
    for image_id in sorted(model.images):
        image = model.images[image_id]
        if image.has_pose:
            poses[image_id - 1] = np.vstack([image.cam_from_world().matrix(), [0, 0, 0, 1]])
            lenses[image_id - 1] = model.cameras[image.camera_id]
    points, observed_point, observed_view, observed_pixel = [], [], [], []
    for number, point_id in enumerate(sorted(model.points3D)):
        point = model.points3D[point_id]
        points.append(point.xyz)
        track = sorted((element.image_id, element.point2D_idx) for element in point.track.elements)
        for image_id, keypoint in track:
            observed_point.append(number)
            observed_view.append(image_id - 1)
            observed_pixel.append(model.images[image_id].points2D[keypoint].xy)
    pixels = np.array(observed_pixel, np.float64).reshape(-1, 2)
    views = np.array(observed_view, np.int64)
    distortions = {
        view: float(lens.params[3]) if len(lens.params) > 3 else 0.0
        for view, lens in lenses.items()
    }
    focals = {view: float(lens.focal_length) for view, lens in lenses.items()}
    residuals = np.zeros(len(pixels))
    places = np.array(points, np.float64).reshape(-1, 3)
    numbers = np.array(observed_point, np.int64)
    for view, lens in lenses.items():
        mine, size = views == view, (lens.width, lens.height)
        bend = focals[view], distortions[view], size
        local = places[numbers[mine]] @ poses[view][:3, :3].T + poses[view][:3, 3]
        depth = np.where(np.abs(local[:, 2]) < 1e-12, 1e-12, local[:, 2])
        seen = local[:, :2] / depth[:, None] * focals[view] + np.array(size) / 2
        # in the photograph: straightened, the rim of a barrel is larger, and so are its errors
        if distortions[view]:
            seen = distort_pixels(seen, *bend)
        missed = np.linalg.norm(seen - pixels[mine], axis=1)
        residuals[mine] = np.where(local[:, 2] > 0, missed, np.inf)
        if distortions[view]:
            pixels[mine] = undistort_pixels(pixels[mine], *bend)
    return Solution(
        poses=poses,
        focals=focals,
        points=places,
        observed_point=numbers,
        observed_view=views,
        observed_pixel=pixels,
        residuals=residuals,
        edges=edges,
        distortions=distortions,
    )
