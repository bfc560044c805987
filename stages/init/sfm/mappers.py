"""Settings of COLMAP's mappers, lenient enough for three views (FINDINGS, section 1)."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any


@dataclass(frozen=True)
class MapperOptions:
    """What both mappers are told.

    Attributes:
        refine_focal: free the focal lengths in bundle adjustment.
        refine_distortion: free the radial coefficients.
        max_error: reprojection error in pixels beyond which an observation is dropped.
        min_tri_angle: degrees below which a point is dropped.
        seed: of the random samples.
        many: there are many views: bundle adjustment on the way may stop early and leave out points
            that add little, since one that does neither follows at the end.
    """

    refine_focal: bool
    refine_distortion: bool
    max_error: float
    min_tri_angle: float
    seed: int
    many: bool = False


def incremental_models(
    pycolmap: Any, database: Path, folder: Path, given: MapperOptions
) -> dict[int, Any]:
    """All models of COLMAP's incremental mapper from a database of verified matches."""
    options = pycolmap.IncrementalPipelineOptions()
    options.num_threads = 1  # more threads add up residuals in any order
    options.random_seed = given.seed
    options.extract_colors = False
    options.min_model_size = 2
    options.max_num_models = 3
    options.min_num_matches = 8
    options.ba_refine_focal_length = given.refine_focal
    options.ba_refine_extra_params = given.refine_distortion
    # Fewer rounds of bundle adjustment than COLMAP's own: the same poses in 60 % of the time.
    options.ba_global_frames_ratio = 1.5
    options.ba_global_points_ratio = 1.5
    options.ba_local_max_refinements = 1
    options.ba_global_max_refinements = 2
    mapper = options.mapper
    if given.many:  # 24 views in half the time, 12 in two thirds; cameras as near to the truth
        options.ba_global_frames_ratio = 2.0
        options.ba_global_points_ratio = 2.0
        options.ba_global_max_refinements = 1
        options.ba_local_max_num_iterations = 10
        options.ba_global_max_num_iterations = 20
        options.ba_local_function_tolerance = 1e-3
        options.ba_global_function_tolerance = 1e-5
        mapper.ba_global_ignore_redundant_points3D = True
    mapper.num_threads = 1
    mapper.random_seed = given.seed
    mapper.init_min_num_inliers = 30
    mapper.init_min_tri_angle = 2.0
    mapper.init_max_forward_motion = 1.0  # the test rejects good pairs under a wrong focal length
    mapper.init_max_error = given.max_error
    mapper.init_max_reg_trials = 4
    mapper.max_reg_trials = 5
    mapper.abs_pose_max_error = 3 * given.max_error
    mapper.abs_pose_min_num_inliers = 8
    mapper.abs_pose_min_inlier_ratio = 0.1
    mapper.abs_pose_refine_focal_length = False
    mapper.abs_pose_refine_extra_params = False
    mapper.ba_local_min_tri_angle = 3.0
    mapper.filter_min_tri_angle = given.min_tri_angle
    mapper.filter_max_reproj_error = given.max_error
    triangulation = options.triangulation
    triangulation.random_seed = given.seed
    triangulation.min_angle = given.min_tri_angle
    triangulation.ignore_two_view_tracks = False
    triangulation.merge_max_reproj_error = given.max_error
    triangulation.complete_max_reproj_error = given.max_error
    found: dict[int, Any] = pycolmap.incremental_mapping(
        str(database), str(folder), str(folder), options
    )
    return found


def global_models(
    pycolmap: Any, database: Path, folder: Path, given: MapperOptions
) -> dict[int, Any]:
    """All models of COLMAP's global mapper (GLOMAP), with two-view tracks allowed."""
    options = pycolmap.GlobalPipelineOptions()
    options.num_threads = 1
    options.random_seed = given.seed
    options.min_model_size = 2
    options.min_num_matches = 8
    mapper = options.mapper
    mapper.num_threads = 1
    mapper.random_seed = given.seed
    mapper.rotation_averaging.random_seed = given.seed
    mapper.global_positioning.random_seed = given.seed
    mapper.global_positioning.use_gpu = False
    mapper.global_positioning.min_num_view_per_track = 2
    mapper.track_min_num_views_per_track = 2
    mapper.min_tri_angle_deg = given.min_tri_angle
    mapper.bundle_adjustment.min_track_length = 2
    mapper.bundle_adjustment.refine_focal_length = given.refine_focal
    mapper.bundle_adjustment.refine_extra_params = given.refine_distortion
    mapper.bundle_adjustment.ceres.use_gpu = False
    mapper.bundle_adjustment.ceres.solver_options.num_threads = 1
    mapper.retriangulation.ignore_two_view_tracks = False
    mapper.retriangulation.merge_max_reproj_error = given.max_error
    mapper.retriangulation.complete_max_reproj_error = given.max_error
    mapper.retriangulation.random_seed = given.seed
    found: dict[int, Any] = pycolmap.global_mapping(
        str(database), str(folder), str(folder), options
    )
    return found
