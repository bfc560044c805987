"""MAP bundle adjustment of cameras and a stretched textbook arch, with analytic Jacobians.

Unknowns, each in units of its prior's standard deviation, so that the Hessian is that of a
whitened problem and its determinant compares hypotheses:
- per view seven: rotation vector (tilt, yaw, roll about the camera's axes, applied after the
  nominal rotation), place of the arch's centre in the camera frame, log focal length;
- nine of the arch: stretch along x, y, z; shift and extra stretch of the lower jaw;
- three per landmark: its own offset. These are eliminated (Schur complement). They are stretched
  with the arch: in true millimetres, offsets would be the cheaper the smaller the arch, and all
  patients come out a seventh too small.

Minimised is twice the negative log posterior by Levenberg-Marquardt with reweighting (pseudo-Huber
on landmarks, Cauchy on dense matches).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import numpy.typing as npt

from stages.init.dental.cameras import kernels
from stages.init.dental.cameras.held import (
    PER_SIMILARITY,
    HeldCameras,
    nearest_similarity,
)
from stages.init.dental.cameras.minimise import minimise
from stages.init.dental.template import is_lower_landmark

Array = npt.NDArray[np.float64]
Indices = npt.NDArray[np.int64]

#: The point of the arch that cameras look at (mm).
ARCH_CENTRE = np.array([0.0, 0.0, kernels.CENTRE_Z])
_NO_PAIRS = np.zeros((0, 2), np.int64)


@dataclass(frozen=True)
class Sightings:
    """Landmarks seen in photographs: pixels about the principal point, the roll taken out.

    Attributes:
        view: [O] index of the view.
        landmark: [O] index into `template.landmark_names`.
        pixels: [O, 2] right and down of the principal point.
        deviations: [O, 2] standard deviation of each.
    """

    view: Indices
    landmark: Indices
    pixels: Array
    deviations: Array


@dataclass(frozen=True)
class Matches:
    """Dense matches of pairs of views, for the epipolar constraint.

    Attributes:
        pairs: [P, 2] views.
        starts: [P + 1] where each pair's matches start in `pixels`.
        pixels: [M, 4] x, y in the first view and x, y in the second, as in `Sightings`.
        weights: [P] weight of each match of a pair.
        deviations: [P] standard deviation of the distance from the epipolar line, pixels.
    """

    pairs: Indices
    starts: Indices
    pixels: Array
    weights: Array
    deviations: Array


NO_MATCHES = Matches(_NO_PAIRS, np.zeros(1, np.int64), np.zeros((0, 4)), np.zeros(0), np.zeros(0))


@dataclass(frozen=True)
class CameraPriors:
    """What is believed of the cameras beforehand.

    Attributes:
        yaws: [V] degrees; 0 looks at the patient from the front, positive from the patient's left.
        angle_deviations: [V, 3] degrees: tilt, yaw, roll.
        elevation: degrees by which cameras stand above the biting plane.
        distance, distance_deviation: mm, and relative.
        focals, focal_deviations: [V] pixels, and relative (0: held).
    """

    yaws: Array
    angle_deviations: Array
    elevation: float
    distance: float
    distance_deviation: float
    focals: Array
    focal_deviations: Array


@dataclass(frozen=True)
class Adjusted:
    """A solution of `adjust`.

    Attributes:
        unknowns: [7V + 9] in units of their priors.
        offsets: [L, 3] of all landmarks, in units of their prior (0 where unseen).
        cost: twice the negative log posterior, up to a constant.
        log_determinant: of the Hessian.
        rotations: [V, 3, 3] camera from arch.
        translations: [V, 3] mm.
        focals: [V] pixels.
        points: [L, 3] all landmarks, mm.
        reduced: [7V + 9, 7V + 9] Hessian of `unknowns` after elimination of the landmarks; with
            held cameras [16, 16], of the similarity and the arch.
        held: the cameras were known and held still relative to each other.
    """

    unknowns: Array
    offsets: Array
    cost: float
    log_determinant: float
    rotations: Array
    translations: Array
    focals: Array
    points: Array
    reduced: Array
    held: bool = False

    @property
    def evidence(self) -> float:
        """Twice the negative log evidence (Laplace's approximation), up to a constant."""
        return self.cost + self.log_determinant

    def project(self, view: int, points: Array) -> Array:
        """[N, 3] points to [N, 2] pixels about the principal point, the roll taken out."""
        local = points @ self.rotations[view].T + self.translations[view]
        return np.asarray(self.focals[view] * local[:, :2] / local[:, 2:])


@lru_cache(maxsize=64)
def nominal_rotation(yaw: float, elevation: float) -> Array:
    """[3, 3] camera from arch, looking at the arch's centre from a yaw and elevation (degrees).

    Not to be written to: it is cached.
    """
    y, e = np.radians([yaw, elevation])
    forward = -np.array([np.sin(y) * np.cos(e), np.sin(e), np.cos(y) * np.cos(e)])
    right = np.cross(forward, [0.0, 1.0, 0.0])
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    rotation.flags.writeable = False
    return rotation


def _first_guess(
    unknowns: Array, sightings: Sightings, template: Array, nominal: Array, priors: CameraPriors
) -> None:
    """Centre and distance of each view from centre and spread of its landmarks, into unknowns."""
    for v in range(len(priors.yaws)):
        mine = sightings.view == v
        if mine.sum() < 3:
            continue
        points = (template[sightings.landmark[mine]] - ARCH_CENTRE) @ nominal[v].T
        pixels = sightings.pixels[mine]
        focal, depth = float(priors.focals[v]), priors.distance
        shift = np.zeros(2)
        for _ in range(3):
            seen = focal * (points[:, :2] + shift) / (points[:, 2:] + depth)
            ratio = float(np.sqrt(pixels.var(0).sum() / max(float(seen.var(0).sum()), 1e-9)))
            if priors.focal_deviations[v] > 0:
                half = float(np.clip(0.5 * np.log(ratio), -0.5, 0.5))
                focal, depth = focal * np.exp(half), depth * np.exp(half) / ratio
            else:
                depth /= ratio
            seen = focal * (points[:, :2] + shift) / (points[:, 2:] + depth)
            shift += (pixels.mean(0) - seen.mean(0)) * depth / focal
        mine_unknowns = unknowns[kernels.PER_VIEW * v : kernels.PER_VIEW * (v + 1)]
        mine_unknowns[3:5] = shift / kernels.CENTRE_UNIT
        mine_unknowns[5] = (depth - priors.distance) / kernels.CENTRE_UNIT
        if priors.focal_deviations[v] > 0:
            mine_unknowns[6] = np.log(focal / priors.focals[v]) / priors.focal_deviations[v]


def shaped_points(
    unknowns: Array, offsets: Array, template: Array, landmark_deviation: float
) -> Array:
    """[L, 3] landmarks in mm for `unknowns` [.. + 9] and `offsets` [L, 3]."""
    g = unknowns[-kernels.PER_ARCH :]
    lower = is_lower_landmark()[:, None]
    stretch = 1 + kernels.STRETCH * g[:3] + lower * kernels.LOWER_STRETCH * g[6:9]
    own = template + landmark_deviation * offsets
    return np.asarray(stretch * own + lower * kernels.LOWER_SHIFT * g[3:6])


def adjust(
    sightings: Sightings,
    template: Array,
    priors: CameraPriors,
    landmark_deviation: float,
    matches: Matches = NO_MATCHES,
    start: tuple[Array, Array] | None = None,
    max_steps: int = 40,
    tolerance: float = 0.02,
    held: HeldCameras | None = None,
) -> Adjusted:
    """Find cameras, arch and landmarks of largest posterior probability.

    Args:
        sightings: what was seen of which landmark.
        template: [L, 3] the textbook arch, mm.
        priors: of the cameras.
        landmark_deviation: mm by which a landmark lies off the textbook arch, before it is
            stretched.
        matches: dense matches, where there are any.
        start: unknowns [7V + 9] and offsets [L, 3] to start from; None: from the priors.
        max_steps: Levenberg-Marquardt steps at most.
        tolerance: decrease of the cost at which it stops.
        held: the cameras, where they are known (two or more; the priors' focals are taken as
            they are): only the arch moves before them. Matches tell nothing then.
    """
    views = len(priors.yaws)
    nominal = np.stack([nominal_rotation(float(yaw), priors.elevation) for yaw in priors.yaws])
    if start is None:
        unknowns = np.zeros(kernels.PER_VIEW * views + kernels.PER_ARCH)
        offsets = np.zeros((len(template), 3))
        _first_guess(unknowns, sightings, template, nominal, priors)
    else:
        unknowns, offsets = start[0].copy(), start[1].copy()
    # Only the landmarks seen enter: an unseen one stays on the arch and adds nothing.
    enters = np.zeros(len(template), np.bool_)
    enters[sightings.landmark] = True
    seen = np.flatnonzero(enters)
    compact = (np.cumsum(enters) - 1)[sightings.landmark]
    seen_offsets = np.ascontiguousarray(offsets[seen])
    angles = np.radians(priors.angle_deviations)

    def place() -> tuple[Array, Array, Array]:
        rotations, centres, focals = np.empty((views, 3, 3)), np.empty((views, 3)), np.empty(views)
        kernels.place_cameras(
            unknowns, views, nominal, angles, float(priors.distance), priors.focals,
            priors.focal_deviations, rotations, centres, focals, np.empty((views, 3, 3)),
        )  # fmt: skip
        return rotations, centres, focals

    turns, shifts = np.empty((views, 3, 3)), np.empty((views, 3))
    similarity = np.eye(3), np.zeros(3), 0.0
    size, focal_deviations = len(unknowns), priors.focal_deviations
    if held is not None:
        turns, shifts = held.from_first()
        similarity = nearest_similarity(*place()[:2], turns, shifts)
        size, focal_deviations = PER_SIMILARITY + kernels.PER_ARCH, np.zeros(views)
        matches = NO_MATCHES
    reduced = np.empty((size, size))
    cost, log_determinant = minimise(
        unknowns, seen_offsets, sightings.view, compact, sightings.pixels,
        sightings.deviations, np.ascontiguousarray(template[seen]), is_lower_landmark()[seen],
        float(landmark_deviation), nominal, angles, float(priors.distance),
        float(priors.distance_deviation), priors.focals, focal_deviations, matches.pairs,
        matches.starts, matches.pixels, matches.weights, matches.deviations,
        held is not None, *similarity, turns, shifts, max_steps, tolerance, reduced,
    )  # fmt: skip
    offsets = np.zeros_like(offsets)
    offsets[seen] = seen_offsets
    rotations, centres, focals = place()
    return Adjusted(
        unknowns=unknowns,
        offsets=offsets,
        cost=float(cost),
        log_determinant=float(log_determinant) if np.isfinite(log_determinant) else np.inf,
        rotations=rotations,
        translations=centres - rotations @ ARCH_CENTRE,
        focals=focals,
        points=shaped_points(unknowns, offsets, template, landmark_deviation),
        reduced=reduced,
        held=held is not None,
    )


def view_angles(adjusted: Adjusted) -> Array:
    """[V, 2] yaw and elevation of each camera as seen from the arch's centre, degrees."""
    centres = -np.einsum("vji,vj->vi", adjusted.rotations, adjusted.translations) - ARCH_CENTRE
    yaw = np.degrees(np.arctan2(centres[:, 0], centres[:, 2]))
    elevation = np.degrees(np.arctan2(centres[:, 1], np.hypot(centres[:, 0], centres[:, 2])))
    return np.stack([yaw, elevation], axis=1)
