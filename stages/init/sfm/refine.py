"""Bundle adjustment of a finished reconstruction, which also asks whether the lens bends."""

from __future__ import annotations

from typing import Any

import numpy as np

from pipeline.geometry.models.colmap import quiet_pycolmap
from stages.init.sfm.mapping import Distortions, MappingInput, Solution, lens_cameras, solution_of
from stages.init.sfm.options import RefinementOptions
from stages.init.sfm.solver import EXIF_TOLERANCE, Solver
from stages.init.sfm.undistort import distort_pixels

#: A lens that shrinks its corners, relative to its middle, to less than this share is a wrong guess
#: (fisheye lenses need another model).
LEAST_STRETCH = 0.3


def refine_solution(
    solver: Solver, best: Solution, free: bool, options: RefinementOptions
) -> Solution:
    """Adjust a reconstruction robustly, with a radial coefficient per lens where that helps.

    Args:
        solver: what it was made by.
        best: the reconstruction.
        free: the focal lengths may change.
    """
    scale = options.loss_scale * solver.pixel

    def adjusted(found: Solution, distortions: Distortions | None) -> Solution:
        return bundle_adjust(
            found, solver.given, solver.focals_of(found),
            refine_focal=free, distortions=distortions, loss_scale=scale,
        )  # fmt: skip

    plain = adjusted(best, None)
    if not solver.sane(plain):
        plain = best
    able = _lenses_seen_enough(solver, best, options)
    if options.refine_distortion == "never" or not any(able):
        return plain
    start: Distortions = [0.0 if enough else None for enough in able]
    bent = adjusted(best, start)
    gained = robust_cost(bent, scale) < (1 - options.distortion_gain) * robust_cost(plain, scale)
    if not _believable(solver, bent) or not (gained or options.refine_distortion == "always"):
        return plain
    # The pairs verified and the points found anew: those at the rim were taken for errors.
    found: Distortions = [
        k1 if enough else None
        for k1, enough in zip(solver.distortions_of(bent), able, strict=True)
    ]  # fmt: skip
    again = solver.solve(solver.focals_of(bent), free, distortions=found)
    if again is None or len(again.poses) < len(best.poses):
        return bent
    found = [
        k1 if enough else None
        for k1, enough in zip(solver.distortions_of(again), able, strict=True)
    ]  # fmt: skip
    again = adjusted(again, found)
    return again if _believable(solver, again) else bent


def robust_cost(solution: Solution, scale: float) -> float:
    """Sum of the soft-L1 loss of the reprojection errors."""
    squares = np.minimum(solution.residuals / scale, 1e6) ** 2
    return float(2 * scale**2 * np.sum(np.sqrt(1 + squares) - 1))


def _lenses_seen_enough(
    solver: Solver, solution: Solution, options: RefinementOptions
) -> list[bool]:
    views = np.zeros(len(solver.given.lenses), np.int64)
    observations = np.zeros(len(solver.given.lenses), np.int64)
    for view in solution.poses:
        lens = solver.given.lens_of_view[view]
        views[lens] += 1
        observations[lens] += int((solution.observed_view == view).sum())
    enough = views >= options.distortion_views
    return [bool(b) for b in enough & (observations >= options.distortion_observations)]


def _believable(solver: Solver, solution: Solution) -> bool:
    """Focal lengths and error as a camera's, near EXIF's, and no lens that folds its image.

    From three photographs a radial coefficient and the focal length can trade places; EXIF decides.
    """
    lenses = list(
        zip(
            solver.given.lenses,
            solver.focals_of(solution),
            solver.distortions_of(solution),
            strict=True,
        )
    )
    if any(
        lens.focal and abs(focal / lens.focal - 1) > EXIF_TOLERANCE for lens, focal, _ in lenses
    ):
        return False
    corners = [
        1 + 3 * k1 * (lens.width**2 + lens.height**2) / (4 * focal**2) for lens, focal, k1 in lenses
    ]
    return solver.sane(solution) and min(corners) > LEAST_STRETCH


def bundle_adjust(
    solution: Solution,
    given: MappingInput,
    focals: list[float],
    *,
    refine_focal: bool,
    distortions: Distortions | None,
    loss_scale: float,
) -> Solution:
    """Adjust cameras and points of a reconstruction to its observations.

    Args:
        solution: the reconstruction.
        given: lenses, and which view has which.
        focals: for each lens, pixels, to start from.
        refine_focal: free the focal lengths.
        distortions: for each lens the radial coefficient to start from, to be refined; None: the
            lenses are pinholes.
        loss_scale: pixels of reprojection error from which on it counts less than squared
            (soft L1).

    Returns:
        The same views, points and observations.
    """
    pycolmap = quiet_pycolmap()
    model = _model(pycolmap, solution, given, lens_cameras(given.lenses, focals, distortions))
    options = pycolmap.BundleAdjustmentOptions()
    options.print_summary = False
    options.refine_focal_length = refine_focal
    options.refine_extra_params = distortions is not None
    options.ceres.use_gpu = False
    options.ceres.loss_function_type = pycolmap.LossFunctionType.SOFT_L1
    options.ceres.loss_function_scale = loss_scale
    options.ceres.solver_options.num_threads = 1  # more add up residuals in any order
    options.ceres.solver_options.function_tolerance = 1e-6
    config = pycolmap.BundleAdjustmentConfig()
    for view in sorted(solution.poses):
        config.add_image(view + 1)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    # Not pycolmap.bundle_adjustment: that switches COLMAP's chatter on again.
    pycolmap.create_default_bundle_adjuster(options, config, model).solve()
    return solution_of(model, solution.edges)


def _model(pycolmap: Any, solution: Solution, given: MappingInput, cameras: list[Any]) -> Any:
    """The reconstruction as pycolmap has it; view v is image v + 1."""
    model = pycolmap.Reconstruction()
    for camera in cameras:
        model.add_camera_with_trivial_rig(camera)
    index = np.zeros(len(solution.observed_view), np.int64)
    for view, pose in sorted(solution.poses.items()):
        lens = given.lenses[given.lens_of_view[view]]
        mine = np.flatnonzero(solution.observed_view == view)
        index[mine] = np.arange(len(mine))
        pixels = distort_pixels(
            solution.observed_pixel[mine], solution.focals[view],
            solution.distortions.get(view, 0.0), (lens.width, lens.height),
        )  # fmt: skip
        image = pycolmap.Image(
            name=f"{view:05d}", keypoints=pixels, camera_id=given.lens_of_view[view] + 1,
            image_id=view + 1,
        )  # fmt: skip
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(pose[:3]))
    by_point = np.argsort(solution.observed_point, kind="stable")
    starts = np.searchsorted(solution.observed_point[by_point], np.arange(len(solution.points) + 1))
    for point, position in enumerate(solution.points):
        track = pycolmap.Track()
        for observation in by_point[starts[point] : starts[point + 1]]:
            view = int(solution.observed_view[observation])
            track.add_element(view + 1, int(index[observation]))
        model.add_point3D(position, track)
    return model
