"""From verified pairs to cameras and sparse points, through pycolmap's mappers."""

from __future__ import annotations

import tempfile
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from stages.init.colmap import quiet_pycolmap
from stages.init.geometry import Correspondences, Lens, Pair, TwoView

Array = npt.NDArray[np.float64]
Integers = npt.NDArray[np.int64]


@dataclass(frozen=True)
class Solution:
    """Cameras and sparse points, in a frame and at a scale of no meaning.

    Attributes:
        poses: view index -> [4, 4] cam_from_world.
        focals: view index -> focal length in pixels.
        points: [P, 3] world.
        observed_point: [O] int64, point of each observation.
        observed_view: [O] int64, view of each observation.
        observed_pixel: [O, 2] pixels.
        residuals: [O] reprojection error in pixels.
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
        positions: for each view [K, 2] keypoints in pixels.
        points: for each view [K] the keypoint that stands for each keypoint's place.
        correspondences: the matches of each pair.
    """

    lenses: list[Lens]
    lens_of_view: list[int]
    positions: list[Array]
    points: list[Integers]
    correspondences: dict[Pair, Correspondences]


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
) -> Solution | None:
    """Reconstruct from the pairs in `edges`.

    Args:
        focals: for each lens, pixels.
        refine_focal: free the focal lengths in bundle adjustment.
        method: ``"incremental"`` or ``"global"``.
        max_error: reprojection error in pixels beyond which an observation is dropped.
        min_tri_angle: degrees below which a point is dropped.
        scratch: folder for the mapper's database.

    Returns:
        The largest model, or None if there is none.
    """
    pycolmap = quiet_pycolmap()
    if not edges:
        return None
    run = {"incremental": _incremental, "global": _global}[method]
    with tempfile.TemporaryDirectory(dir=scratch) as name:
        folder = Path(name)
        database = folder / "database.db"
        _write_database(database, given, edges, focals)
        models = run(pycolmap, database, folder, refine_focal, max_error, min_tri_angle, seed)
    if not models:
        return None
    best = max(sorted(models), key=lambda key: (models[key].num_reg_images(),
                                                models[key].num_points3D()))  # fmt: skip
    return _solution(models[best], tuple(sorted(edges)))


def _write_database(
    path: Path, given: MappingInput, edges: dict[Pair, TwoView], focals: list[float]
) -> None:
    """Write a COLMAP database whose matches are verified already."""
    pycolmap = quiet_pycolmap()
    database = pycolmap.Database.open(str(path))
    for index, (lens, focal) in enumerate(zip(given.lenses, focals, strict=True), start=1):
        camera = lens.camera(focal)
        camera.camera_id = index
        camera.has_prior_focal_length = True
        database.write_camera(camera, use_camera_id=True)
        rig = pycolmap.Rig(rig_id=index)
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


def _incremental(
    pycolmap: Any, database: Path, folder: Path, refine_focal: bool, max_error: float,
    min_tri_angle: float, seed: int,
) -> dict[int, Any]:  # fmt: skip
    """COLMAP's incremental mapper, lenient enough for three views (FINDINGS, section 1)."""
    options = pycolmap.IncrementalPipelineOptions()
    options.num_threads = 1  # more threads add up residuals in any order
    options.random_seed = seed
    options.extract_colors = False
    options.min_model_size = 2
    options.max_num_models = 3
    options.min_num_matches = 8
    options.ba_refine_focal_length = refine_focal
    options.ba_refine_extra_params = False
    # Fewer rounds of bundle adjustment than COLMAP's own: the same poses in 60 % of the time.
    options.ba_global_frames_ratio = 1.5
    options.ba_global_points_ratio = 1.5
    options.ba_local_max_refinements = 1
    options.ba_global_max_refinements = 2
    mapper = options.mapper
    mapper.num_threads = 1
    mapper.random_seed = seed
    mapper.init_min_num_inliers = 30
    mapper.init_min_tri_angle = 2.0
    mapper.init_max_forward_motion = 1.0  # the test rejects good pairs under a wrong focal length
    mapper.init_max_error = max_error
    mapper.init_max_reg_trials = 4
    mapper.max_reg_trials = 5
    mapper.abs_pose_max_error = 3 * max_error
    mapper.abs_pose_min_num_inliers = 8
    mapper.abs_pose_min_inlier_ratio = 0.1
    mapper.abs_pose_refine_focal_length = False
    mapper.abs_pose_refine_extra_params = False
    mapper.ba_local_min_tri_angle = 3.0
    mapper.filter_min_tri_angle = min_tri_angle
    mapper.filter_max_reproj_error = max_error
    triangulation = options.triangulation
    triangulation.random_seed = seed
    triangulation.min_angle = min_tri_angle
    triangulation.ignore_two_view_tracks = False
    triangulation.merge_max_reproj_error = max_error
    triangulation.complete_max_reproj_error = max_error
    found: dict[int, Any] = pycolmap.incremental_mapping(
        str(database), str(folder), str(folder), options
    )
    return found


def _global(
    pycolmap: Any, database: Path, folder: Path, refine_focal: bool, max_error: float,
    min_tri_angle: float, seed: int,
) -> dict[int, Any]:  # fmt: skip
    """COLMAP's global mapper (GLOMAP), with two-view tracks allowed."""
    options = pycolmap.GlobalPipelineOptions()
    options.num_threads = 1
    options.random_seed = seed
    options.min_model_size = 2
    options.min_num_matches = 8
    mapper = options.mapper
    mapper.num_threads = 1
    mapper.random_seed = seed
    mapper.rotation_averaging.random_seed = seed
    mapper.global_positioning.random_seed = seed
    mapper.global_positioning.use_gpu = False
    mapper.global_positioning.min_num_view_per_track = 2
    mapper.track_min_num_views_per_track = 2
    mapper.min_tri_angle_deg = min_tri_angle
    mapper.bundle_adjustment.min_track_length = 2
    mapper.bundle_adjustment.refine_focal_length = refine_focal
    mapper.bundle_adjustment.refine_extra_params = False
    mapper.bundle_adjustment.ceres.use_gpu = False
    mapper.bundle_adjustment.ceres.solver_options.num_threads = 1
    mapper.retriangulation.ignore_two_view_tracks = False
    mapper.retriangulation.merge_max_reproj_error = max_error
    mapper.retriangulation.complete_max_reproj_error = max_error
    mapper.retriangulation.random_seed = seed
    found: dict[int, Any] = pycolmap.global_mapping(
        str(database), str(folder), str(folder), options
    )
    return found


def _solution(model: Any, edges: tuple[Pair, ...]) -> Solution:
    """Copy a pycolmap reconstruction into arrays, sorted by identifier."""
    poses, focals = {}, {}
    for image_id in sorted(model.images):
        image = model.images[image_id]
        if not image.has_pose:
            continue
        view = image_id - 1
        poses[view] = np.vstack([image.cam_from_world().matrix(), [0, 0, 0, 1]])
        focals[view] = float(model.cameras[image.camera_id].focal_length)
    points, observed_point, observed_view, observed_pixel = [], [], [], []
    for number, point_id in enumerate(sorted(model.points3D)):
        point = model.points3D[point_id]
        points.append(point.xyz)
        track = sorted((element.image_id, element.point2D_idx) for element in point.track.elements)
        for image_id, keypoint in track:
            observed_point.append(number)
            observed_view.append(image_id - 1)
            observed_pixel.append(model.images[image_id].points2D[keypoint].xy)
    solution = Solution(
        poses=poses,
        focals=focals,
        points=np.array(points, np.float64).reshape(-1, 3),
        observed_point=np.array(observed_point, np.int64),
        observed_view=np.array(observed_view, np.int64),
        observed_pixel=np.array(observed_pixel, np.float64).reshape(-1, 2),
        residuals=np.zeros(0),
        edges=edges,
    )
    lenses = {view: model.cameras[model.images[view + 1].camera_id] for view in poses}
    return with_residuals(solution, {
        view: (lens.principal_point_x, lens.principal_point_y) for view, lens in lenses.items()
    })  # fmt: skip


def with_residuals(solution: Solution, centre: dict[int, tuple[float, float]]) -> Solution:
    """The solution with its reprojection errors, for principal points in pixels per view."""
    residuals = np.zeros(len(solution.observed_point))
    for view, pose in solution.poses.items():
        mine = solution.observed_view == view
        local = solution.points[solution.observed_point[mine]] @ pose[:3, :3].T + pose[:3, 3]
        depth = np.where(np.abs(local[:, 2]) < 1e-12, 1e-12, local[:, 2])
        pixel = local[:, :2] / depth[:, None] * solution.focals[view] + np.array(centre[view])
        residuals[mine] = np.linalg.norm(pixel - solution.observed_pixel[mine], axis=1)
        residuals[mine] = np.where(local[:, 2] > 0, residuals[mine], np.inf)
    return replace(solution, residuals=residuals)
