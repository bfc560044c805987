"""Bundle adjustment of a finished reconstruction, which also asks whether the lens bends."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from pipeline.geometry.models.colmap import quiet_pycolmap
from stages.init.sfm.mapping import Distortions, MappingInput, Solution, lens_cameras, solution_of
from stages.init.sfm.options import RefinementOptions
from stages.init.sfm.solver import EXIF_TOLERANCE, Solver
from stages.init.sfm.undistort import distort_pixels

Array = npt.NDArray[np.float64]
Found = TypeVar("Found", Solution, Solution | None)

#: Reprojection error, pixels at the reference size, from which on it counts less than squared.
LOSS_SCALE = 0.5
#: Placed views and observations that a lens needs for a radial coefficient, and the share by which
#: the (robust) sum of squared errors must fall with it. Straight lenses gain up to .002, those of
#: phones and compact cameras .08 to .33, and a strong barrel that is seen within 10 degrees .015.
DISTORTION_VIEWS, DISTORTION_OBSERVATIONS, DISTORTION_GAIN = 3, 300, 0.01
#: A lens that shrinks its corners, relative to its middle, to less than this share is a wrong guess
#: (fisheye lenses need another model).
LEAST_STRETCH = 0.3
#: A photograph was taken with another zoom where a focal length of its own, with its points held,
#: lowers its cost to this share and differs by this much. Of eleven photographs of a house, twelve
#: frames of a scan video and twelve of a generated mouth none has less than .97, or differs by more
#: than .008; of one that is zoomed by 1.25 to 2 among these .71 to .94, and .026 to .088: points
#: that contradict the wrong focal length have been left out.
ZOOMED_COST, ZOOMED_BY = 0.96, 0.015
#: Found anew with lenses of their own, one must differ by this much: less is no other zoom.
ANOTHER_ZOOM = 0.05
#: Photographs that must be placed besides: points that hang on few others bend with a wrong one.
BESIDES_ZOOMED = 3
#: Rounds of finding the cameras with it: each keeps matches that the one before took for errors.
ZOOM_ROUNDS = 2
#: With fewer points a photograph does not tell its focal length; of more than so many, some do.
LEAST_OBSERVED, MOST_OBSERVED = 30, 400


def refine_solution(
    solver: Solver, best: Solution, free: bool, options: RefinementOptions
) -> Solution:
    """Adjust a reconstruction robustly, with a radial coefficient per lens where that helps.

    Focal lengths that are near EXIF's stay near; where `known_focal` has left EXIF's for a good
    reason, EXIF says nothing here either.

    Args:
        solver: what it was made by.
        best: the reconstruction.
        free: the focal lengths may change.
    """
    scale = LOSS_SCALE * solver.pixel
    heeded = _near_exif(solver, best)

    def near_exif(find: Callable[[bool], Found]) -> Found:
        """With free focal lengths, if they may be, or held ones where free ones leave EXIF's."""
        found = find(free)
        left = free and heeded and found is not None and not _near_exif(solver, found)
        return find(False) if left else found

    def adjusted(found: Solution, distortions: Distortions | None) -> Solution:
        return near_exif(lambda free: bundle_adjust(
            found, solver.given, solver.focals_of(found),
            refine_focal=free, distortions=distortions, loss_scale=scale,
        ))  # fmt: skip

    plain = adjusted(best, None)
    if not solver.sane(plain):
        plain = best
    able = _lenses_seen_enough(solver, best)
    if options.refine_distortion == "never" or not any(able):
        return plain
    start: Distortions = [0.0 if enough else None for enough in able]
    bent = adjusted(best, start)
    gained = robust_cost(bent, scale) < (1 - DISTORTION_GAIN) * robust_cost(plain, scale)
    if not _believable(solver, bent) or not (gained or options.refine_distortion == "always"):
        return plain
    # The pairs verified and the points found anew: those at the rim were taken for errors.
    found: Distortions = [
        k1 if enough else None
        for k1, enough in zip(solver.distortions_of(bent), able, strict=True)
    ]  # fmt: skip
    again = near_exif(
        lambda free: solver.solve(solver.focals_of(bent), free, distortions=found)
    )  # fmt: skip
    if again is None or len(again.poses) < len(best.poses):
        return bent
    found = [
        k1 if enough else None
        for k1, enough in zip(solver.distortions_of(again), able, strict=True)
    ]  # fmt: skip
    again = adjusted(again, found)
    return again if _believable(solver, again) else bent


def with_zoomed(
    solver: Solver, best: Solution, free: bool, options: RefinementOptions
) -> tuple[Solver, Solution]:
    """Give photographs that were taken with another zoom than the others a lens of their own.

    With the others' focal length such a one stands too near or too far, and fits all the same.

    Args:
        solver, best, options: as in `refine_solution`.
        free: the focal lengths may change; if not, none is asked.
    """
    scale = LOSS_SCALE * solver.pixel
    if not free or len(best.poses) <= BESIDES_ZOOMED:
        return solver, best
    own = {view: own_focal(solver.given, best, view, scale) for view in sorted(best.poses)}
    zoomed = [
        view for view, (focal, share) in own.items()
        if share < ZOOMED_COST and abs(focal / best.focals[view] - 1) > ZOOMED_BY
    ]  # fmt: skip
    if not zoomed or len(best.poses) - len(zoomed) < BESIDES_ZOOMED:
        return solver, best
    lenses, of_view = [*solver.given.lenses], [*solver.given.lens_of_view]
    for view in zoomed:
        lenses.append(replace(lenses[of_view[view]], focal=None))
        of_view[view] = len(lenses) - 1
    apart = solver.on(replace(solver.given, lenses=lenses, lens_of_view=of_view))
    focals = {view: own[view][0] if view in zoomed else f for view, f in best.focals.items()}
    found: Solution | None = replace(best, focals=focals)
    for _ in range(ZOOM_ROUNDS):
        if found is not None:
            bends: Distortions = [k1 or None for k1 in apart.distortions_of(found)]
            found = apart.solve(
                apart.focals_of(found), True, distortions=bends if any(bends) else None
            )
    if found is None or len(found.poses) < len(best.poses) or not apart.sane(found):
        return solver, best
    found = refine_solution(apart, found, free, options)
    differ = any(abs(found.focals[view] / best.focals[view] - 1) > ANOTHER_ZOOM for view in zoomed)
    return (apart, found) if differ else (solver, best)


def own_focal(
    given: MappingInput, solution: Solution, view: int, scale: float
) -> tuple[float, float]:
    """Focal length that fits a view best, with its points held, and the share of its cost left."""
    lens = given.lenses[given.lens_of_view[view]]
    mine = np.flatnonzero(solution.observed_view == view)
    mine = mine[:: max(1, len(mine) // MOST_OBSERVED)]
    pose, focal = solution.poses[view], solution.focals[view]
    local = solution.points[solution.observed_point[mine]] @ pose[:3, :3].T + pose[:3, 3]
    pixels = solution.observed_pixel[mine] - (lens.width / 2, lens.height / 2)
    if len(local) < LEAST_OBSERVED:
        return focal, 1.0
    depth = float(np.median(local[:, 2]))

    def residuals(change: Array) -> Array:
        moved = local @ Rotation.from_rotvec(change[:3]).as_matrix().T + change[3:6] * depth
        ray = moved[:, :2] / np.maximum(moved[:, 2:], 1e-6 * depth)
        return np.asarray(((focal * np.exp(change[6]) * ray - pixels) / scale).ravel())

    found = least_squares(residuals, np.zeros(7), loss="soft_l1")
    before = float(np.sum(np.sqrt(1 + residuals(np.zeros(7)) ** 2) - 1))  # as `soft_l1` has it
    return focal * float(np.exp(found.x[6])), float(found.cost) / max(before, 1e-12)


def robust_cost(solution: Solution, scale: float) -> float:
    """Sum of the soft-L1 loss of the reprojection errors."""
    squares = np.minimum(solution.residuals / scale, 1e6) ** 2
    return float(2 * scale**2 * np.sum(np.sqrt(1 + squares) - 1))


def _lenses_seen_enough(solver: Solver, solution: Solution) -> list[bool]:
    views = np.zeros(len(solver.given.lenses), np.int64)
    observations = np.zeros(len(solver.given.lenses), np.int64)
    for view in solution.poses:
        lens = solver.given.lens_of_view[view]
        views[lens] += 1
        observations[lens] += int((solution.observed_view == view).sum())
    enough = views >= DISTORTION_VIEWS
    return [bool(b) for b in enough & (observations >= DISTORTION_OBSERVATIONS)]


def _near_exif(solver: Solver, solution: Solution) -> bool:
    """Is the focal length of every lens near the one that is known of it, if any is?

    From three photographs a focal length trades places with the distance and with a radial
    coefficient; EXIF decides.
    """
    found = zip(solver.given.lenses, solver.focals_of(solution), strict=True)
    return all(abs(focal / (lens.focal or focal) - 1) <= EXIF_TOLERANCE for lens, focal in found)


def _believable(solver: Solver, solution: Solution) -> bool:
    """Focal lengths and error as a camera's, and no lens that folds its image."""
    found = zip(
        solver.given.lenses, solver.focals_of(solution), solver.distortions_of(solution),
        strict=True,
    )  # fmt: skip
    corners = [
        1 + 3 * k1 * (lens.width**2 + lens.height**2) / (4 * focal**2) for lens, focal, k1 in found
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
