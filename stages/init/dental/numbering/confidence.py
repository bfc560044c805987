"""When to doubt a fit: sentences for the user."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from pipeline.artifacts.teeth import Dentition
from stages.geometry.tooth_rows import NO_TOOTH
from stages.init.dental.cameras.bundle import Adjusted, Sightings, view_angles
from stages.init.dental.cameras.kernels import PER_VIEW
from stages.init.dental.cameras.unrolled import PairFigures
from stages.init.dental.numbering.arch_options import ArchOptions
from stages.init.dental.numbering.hypotheses import Scored, Scorer

Array = npt.NDArray[np.float64]

#: Prior standard deviations off, beyond which a pose is said to be at the edge.
EDGE = 2.6
#: Photographs further apart than this (degrees) need not agree on the unrolled arch.
DENSE_YAW = 50.0
#: ... nor need those do so whose landmarks alone tell the angle between them: its deviation and
#: the landmarks' errors below these shares of what is allowed.
SECURE_ANGLE = 0.5
SECURE_ERROR = 0.75
#: Upper and lower rows of one photograph differ by no more crowns than this.
MAX_COUNT_DIFFERENCE = 3
#: Names of what the unknowns of a view are.
UNKNOWN_NAMES = ("tilt", "yaw", "roll")


def landmark_errors(adjusted: Adjusted, sightings: Sightings) -> Array:
    """[O] distance in pixels between each landmark seen and where the fit has it."""
    errors = np.empty(len(sightings.view))
    for view in range(len(adjusted.focals)):
        mine = sightings.view == view
        seen = adjusted.project(view, adjusted.points[sightings.landmark[mine]])
        errors[mine] = np.linalg.norm(seen - sightings.pixels[mine], axis=1)
    return errors


def relative_angle_deviation(adjusted: Adjusted, i: int, j: int, angles: Array) -> float:
    """Standard deviation of the angle between two views, degrees, from the reduced Hessian.

    Args:
        adjusted: the fit.
        i, j: views.
        angles: [V, 3] standard deviations of the views' rotations (degrees), the unknowns' units.
    """
    if adjusted.held:
        return 0.0
    covariance = np.linalg.inv(adjusted.reduced)
    to_world = np.zeros((3, len(covariance)))
    for view, sign in ((j, 1.0), (i, -1.0)):
        columns = slice(PER_VIEW * view, PER_VIEW * view + 3)
        to_world[:, columns] = sign * adjusted.rotations[view].T * angles[view]
    spread = to_world @ covariance @ to_world.T
    return float(np.sqrt(max(float(np.linalg.eigvalsh(spread)[-1]), 0.0)))


def crown_doubts(
    photos: Sequence[str], dentitions: Sequence[Dentition], options: ArchOptions
) -> list[str]:
    """Doubts about what was read from the photographs."""
    doubts = []
    for photo, dentition in zip(photos, dentitions, strict=True):
        upper, lower = len(dentition.upper), len(dentition.lower)
        if min(upper, lower) < options.min_crowns:
            doubts.append(
                f"{photo} shows only {upper} upper and {lower} lower crowns: too few to be "
                f"sure which teeth they are"
            )
        elif abs(upper - lower) > MAX_COUNT_DIFFERENCE:
            doubts.append(
                f"{photo} shows {upper} upper but {lower} lower crowns: probably lips, "
                f"gloves or gums were taken for teeth"
            )
    return doubts


def fit_doubts(
    photos: Sequence[str],
    bands: Sequence[float],
    scorer: Scorer,
    best: Scored,
    margins: tuple[float, float, float],
    pairs: dict[tuple[int, int], PairFigures],
    options: ArchOptions,
) -> tuple[list[str], dict[str, float]]:
    """Doubts about the fit, and the figures that they rest on.

    Args:
        photos: names of the photographs placed, as the user knows them.
        bands: heights of their bands of teeth, pixels.
        scorer, best: the search and its outcome.
        margins: by how much it beats the next, as `edits.margins` has it.
        pairs: how the dense matches of pairs agree (indices into `photos`).
        options: thresholds.
    """
    adjusted, labelling = best.adjusted, best.labelling
    doubts: list[str] = []
    figures: dict[str, float] = {
        "margin": margins[0],
        "missing_margin": margins[1],
        "local_margin": margins[2],
    }
    if margins[0] < options.min_margin:
        doubts.append(
            f"another numbering of the teeth explains the photographs nearly as well (margin "
            f"{margins[0]:.0f}, wanted {options.min_margin:.0f}): check the numbers in the overlay "
            f"and give one of them"
        )
    elif margins[1] < options.min_missing_margin:
        doubts.append(
            f"it is not clear whether a tooth is missing (margin {margins[1]:.0f}, wanted "
            f"{options.min_missing_margin:.0f}): check the numbers in the overlay"
        )
    elif margins[2] < options.min_local_margin:
        doubts.append(
            f"the number of a crown or two is not clear (margin {margins[2]:.0f}, wanted "
            f"{options.min_local_margin:.0f}): check the numbers in the overlay"
        )
    sightings = scorer.cache.collect(list(labelling.views), list(labelling.labels))
    errors = landmark_errors(adjusted, sightings)
    priors = scorer.priors(labelling.views, labelling.roles)
    for view, photo in enumerate(photos):
        mine = sightings.view == view
        relative = float(np.median(errors[mine])) / bands[view] if mine.any() else np.inf
        figures[f"landmark_error_{view}"] = relative
        if relative > options.max_error:
            doubts.append(
                f"the teeth of {photo} don't fit those of the others (landmarks off by "
                f"{100 * relative:.0f} % of the height of the row, median): another patient, or "
                f"crowns found badly"
            )
        unknowns = adjusted.unknowns[PER_VIEW * view : PER_VIEW * (view + 1)]
        for k, name in enumerate(UNKNOWN_NAMES):
            figures[f"{name}_{view}"] = float(unknowns[k])
            if abs(unknowns[k]) > EDGE:
                doubts.append(
                    f"{photo} would have been taken with an unusual {name} "
                    f"({unknowns[k] * priors.angle_deviations[view, k]:+.0f} degrees from what is "
                    f"usual)"
                )
        depth = float(
            (adjusted.rotations[view] @ [0.0, 0.0, -16.0] + adjusted.translations[view])[2]
        )
        far = float(np.log(max(depth, 1.0) / options.distance) / options.distance_deviation)
        figures[f"distance_{view}"] = far
        if abs(far) > EDGE:
            doubts.append(
                f"{photo} would have been taken from {depth:.0f} mm, which is unusual: "
                f"cropped, or crowns found badly"
            )
    for view, (photo, labels) in enumerate(zip(photos, labelling.labels, strict=True)):
        inner = [label for row in labels for label in row[1:-1]]
        unnamed = inner.count(NO_TOOTH) / max(len(inner), 1)
        figures[f"unnamed_{view}"] = unnamed
        if unnamed > options.max_unnamed:
            doubts.append(
                f"{inner.count(NO_TOOTH)} crowns of {photo} fit no tooth: crowns found "
                f"badly, a mirrored photograph or another patient"
            )
    yaws = view_angles(adjusted)[:, 0]
    for (i, j), pair in sorted(pairs.items()):
        a, b = photos[i], photos[j]
        deviation = relative_angle_deviation(adjusted, i, j, priors.angle_deviations)
        figures[f"angle_deviation_{i}_{j}"] = deviation
        figures[f"dense_share_{i}_{j}"] = pair.share
        figures[f"epipolar_error_{i}_{j}"] = pair.epipolar_error
        if deviation > options.max_angle_deviation:
            doubts.append(
                f"the angle between {a} and {b} is uncertain by {deviation:.0f} degrees: "
                f"too few teeth seen in both"
            )
        apart = float(abs(yaws[j] - yaws[i]))
        worst = max(figures[f"landmark_error_{i}"], figures[f"landmark_error_{j}"])
        secure = deviation < SECURE_ANGLE * options.max_angle_deviation
        secure &= worst < SECURE_ERROR * options.max_error
        if pair.share < options.min_dense_share and apart < DENSE_YAW and not secure:
            doubts.append(
                f"unrolled onto the arch, {a} and {b} hardly agree ({pair.matches} matches "
                f"on {100 * pair.share:.1f} % of what both show)"
            )
        elif pair.epipolar_error > options.max_epipolar_error:
            doubts.append(
                f"what matches between {a} and {b} contradicts their cameras (off by "
                f"{100 * pair.epipolar_error:.1f} % of the height of the row, median)"
            )
    return doubts, figures
