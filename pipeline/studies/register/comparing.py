"""Two visits compared: who stood still, what the others did, how sure that is."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from pipeline.artifacts.dental.fdi import JAWS, Jaw
from pipeline.errors import ReconstructionError
from pipeline.process.native import one_blas_thread
from pipeline.studies.register import solving
from pipeline.studies.register.both_ways import both_ways, mirrored
from pipeline.studies.register.estimate import PARTNERS, WIDEST, Estimate
from pipeline.studies.register.geometry import first_frame, inverted, refined_frame
from pipeline.studies.register.jaws import of_jaw, stand_otherwise, way_of_lower
from pipeline.studies.register.movement import to_parts, tooth_axes
from pipeline.studies.register.pictures.matching import pairs_of
from pipeline.studies.register.uncertainty import RANGE, measured, misfit
from pipeline.studies.register.visit import Visit, in_frame, scale_of

Array = npt.NDArray[np.float64]

#: Half of a 95 % interval in standard deviations (of a shift's parts, of a turn's), with fewer than
#: six photographs, and with more by what a tooth is measured (`Moved.basis`); and what it never
#: falls below: shifts (mm), tip and torque, and rotation (degrees). Chosen on generated mouths so
#: that a tooth's shift and its turn are both covered in 95 % of the teeth, of those that moved
#: alone as well, and so are 95 % of the parts: benchmarks/register.py --calibrate. What does the
#: same to all photographs (shading, where marks are few) shows in none of the jackknives, nor does
#: what a tooth that few of them show did along their lines of sight; both are mostly of teeth that
#: flow measures. Of three photographs, rotation is the least sure: crowns are round about their
#: length, so that their shape does not tell it.
FACTORS = {"few": (2.0, 1.4), "marks": (3.1, 3.7), "flow": (6.1, 3.2)}
FLOORS = {"few": (0.2, 4.0, 6.0), "marks": (0.02, 0.5, 0.75), "flow": (0.02, 4.0, 6.0)}
MANY = 6
#: Share of the jackknife over photographs that counts. Of few photographs mostly one or two show a
#: tooth: without them the estimate falls back to no motion, so that the jackknife says how far the
#: tooth went rather than how sure that is.
BY_PHOTOGRAPH = 0.25
#: Visits are one patient's if crowns' surroundings correlate by this at least (see `likeness`).
LEAST_LIKENESS = 0.8
#: And if so many teeth, and such a share of them, agree with one frame.
LEAST_TEETH, LEAST_SHARE = 5, 0.5


@dataclass(frozen=True)
class Moved:
    """What one tooth did.

    Attributes:
        tooth: FDI.
        parts: [6] `movement.PARTS`: mm and degrees.
        deviation: [6] standard deviation of each as the equations and jackknives give it.
        half: [6] half of the 95 % interval of each.
        distance, angle: length of the shift (mm) and of the turn (degrees), with their halves of
            the interval.
        certain: it moved: at least one part lies beyond its interval, with room for there being
            six of them.
        still: it belongs to the teeth that everything is measured against; `certain` ones don't.
        at: [3] the point whose shift is given: the middle of what is seen of the crown at the first
            visit, in its frame, mm.
        motion: [4, 4] of the tooth in that frame.
        displacement: [6] shift (mm) and rotation vector (rad) there.
        spots: that it was measured by.
        photographs: of the second visit that show them.
        basis: what its intervals stand on, a key of `FACTORS`: few photographs, or else the marks
            of its enamel, both ways, or optical flow.
    """

    tooth: int
    parts: Array
    deviation: Array
    half: Array
    distance: tuple[float, float]
    angle: tuple[float, float]
    certain: bool
    still: bool
    at: Array
    motion: Array
    displacement: Array
    spots: int
    photographs: int
    basis: str


@dataclass(frozen=True)
class Comparison:
    """Two visits of a patient.

    Attributes:
        first, second: the visits.
        first_from_second: [4, 4] similarity of their frames, by the teeth that stood still.
        teeth: what could be measured, by number.
        missing: those that could not be, of either visit.
        likeness, share, residual: what the decision that it is one patient stands on: median
            correlation of crowns' surroundings; share of the teeth that agree with one frame;
            median distance of crown from crown, mm.
        scale_percent: standard deviation of all lengths together, percent; None: not known.
        scale_source: whose.
        relative_scale: size of the second run's millimetre in the first's, as the runs have them.
        first_scaled_by: what the first run's lengths were multiplied by: 1, or as many of the
            second's millimetres as one of its own is, where the second's are the surer ones.
        jaws: those that were compared each by itself, since they stand to each other otherwise than
            at the first visit; the first of them gives the frame. Empty: all teeth together.
        jaws_apart: how far the lower jaw then went against the upper one, mm; None: not known.
    """

    first: Visit
    second: Visit
    first_from_second: Array
    teeth: tuple[Moved, ...]
    missing: tuple[int, ...]
    likeness: float
    share: float
    residual: float
    scale_percent: float | None
    scale_source: str
    relative_scale: float
    first_scaled_by: float
    jaws: tuple[Jaw, ...] = ()
    jaws_apart: float | None = None

    @property
    def still(self) -> list[int]:
        """Numbers of the teeth that everything is measured against."""
        return [tooth.tooth for tooth in self.teeth if tooth.still]


@one_blas_thread()
def compare_visits(first: Visit, second: Visit) -> Comparison:
    """Bring two visits into one frame and measure what the teeth did.

    Raises:
        ReconstructionError: they are of two patients, or share too few teeth.
    """
    frame, agreeing = _frame(first, second)
    for visit in (first, second):
        _axes(visit)
    surer, scaled_by = first, 1.0
    if second.scale_doubt < first.scale_doubt:  # the surer millimetre counts for both
        surer, scaled_by = second, 1 / scale_of(frame)
        first = first.in_frame(np.diag([scaled_by] * 3 + [1.0]))
        frame, agreeing = _frame(first, second)
    if stand_otherwise(first, second, LEAST_TEETH):
        found = _jaw_by_jaw(first, second)
    else:
        found = _compared(first, second, frame, agreeing, _axes(first))
    return replace(
        found, scale_percent=surer.scale_percent, scale_source=surer.scale_source,
        relative_scale=found.relative_scale / scaled_by, first_scaled_by=scaled_by,
    )  # fmt: skip


def _axes(visit: Visit) -> dict[int, Array]:
    try:
        return tooth_axes(visit.centres)
    except ValueError as error:
        raise ReconstructionError(
            f"Of '{visit.name}' it can't be told what is mesial and what is buccal: {error}."
        ) from error


def _jaw_by_jaw(first: Visit, second: Visit) -> Comparison:
    """Compare each jaw by itself; the frame is that of the upper one, if it can be compared.

    The teeth of a jaw that can't be are not measured.
    """
    axes = _axes(first)
    found: dict[Jaw, Comparison] = {}
    failures = []
    for jaw in JAWS:
        a, b = of_jaw(first, jaw), of_jaw(second, jaw)
        try:
            _axes(a), _axes(b)
            found[jaw] = _compared(a, b, *_frame(a, b), axes)
        except ReconstructionError as error:
            failures.append(error)
    if not found:
        raise failures[0]
    main = next(iter(found.values()))
    teeth = sorted((t for one in found.values() for t in one.teeth), key=lambda t: t.tooth)
    apart = None
    if len(found) == len(JAWS):
        frames = [one.first_from_second for one in found.values()]
        apart = way_of_lower(first.centres, frames[0], frames[1])
    return replace(
        main, first=first, second=second, teeth=tuple(teeth),
        missing=_missing(first, second, teeth),
        likeness=min(one.likeness for one in found.values()),
        share=min(one.share for one in found.values()),
        residual=max(one.residual for one in found.values()),
        jaws=tuple(found), jaws_apart=apart,
    )  # fmt: skip


def _compared(
    first: Visit, second: Visit, frame: Array, agreeing: list[int], axes: Mapping[int, Array]
) -> Comparison:
    """What teeth did that were one rigid thing at both visits, but for those that moved.

    Args:
        frame: [4, 4] first_from_second to begin with. agreeing: teeth that agree with it.
        axes: of the first visit's teeth (`movement.tooth_axes`).
    """
    share = len(agreeing) / len(set(first.centres) & set(second.centres))
    frame = refined_frame(first, second, frame, agreeing)
    cameras = (
        [look.camera for look in first.looks],
        [in_frame(look.camera, frame) for look in second.looks],
    )
    if not pairs_of(*cameras, PARTNERS, WIDEST):
        raise ReconstructionError(
            f"No photograph of '{second.name}' looks at the teeth from nearly the same side as one "
            f"of '{first.name}' (within {2 * WIDEST:.0f} degrees), so that they can't be laid over "
            "each other. Photograph both visits from the same places."
        )
    there, back = both_ways(first, second, frame, agreeing)
    likeness = min(there.likeness, back.likeness)
    if likeness < LEAST_LIKENESS or share < LEAST_SHARE:
        raise ReconstructionError(
            f"'{first.name}' and '{second.name}' do not look like two visits of one patient: "
            f"{len(agreeing)} of the teeth that both have stand in the same places "
            f"({100 * share:.0f} %, at least {100 * LEAST_SHARE:.0f} % are needed), and laid over "
            f"each other the crowns' surfaces agree with a correlation of {likeness:.2f} (at least "
            f"{LEAST_LIKENESS} is needed). Nothing was written. If they are of one patient, look "
            "at check.html of both workspaces: a wrong tooth number is the usual cause. Put right, "
            "it counts once the pipeline has run there again."
        )
    many = min(len(first.looks), len(second.looks)) >= MANY
    teeth = _teeth(axes, there, back, many)
    # What went no farther than most do by noise alone may still be sure to have moved.
    while moved := {t.tooth for t in teeth if t.certain} & {*there.still, *back.still}:
        there, back = (
            replace(way, still=tuple(n for n in way.still if n not in moved))
            for way in (there, back)
        )
        teeth = _teeth(axes, there, back, many)
    if not teeth:
        raise ReconstructionError(f"No tooth of '{second.name}' shows enough to be measured by.")
    # By surfaces, not by cameras: what a camera's distance is off, its focal length makes good.
    joint = refined_frame(first, second, frame, there.still)
    return Comparison(
        first, second, joint, tuple(teeth), _missing(first, second, teeth), likeness, share,
        max(there.residual, back.residual), None, "", scale_of(joint), 1.0,
    )  # fmt: skip


def _missing(first: Visit, second: Visit, teeth: Sequence[Moved]) -> tuple[int, ...]:
    """Numbers of the teeth of both visits that none of `teeth` is."""
    every = set(first.centres) | set(second.centres)
    return tuple(sorted(every - {tooth.tooth for tooth in teeth}))


def halves(
    deviation: Array, factors: tuple[float, float], floors: tuple[float, float, float]
) -> Array:  # fmt: skip
    """[..., 6] half of the 95 % intervals of parts, by their deviations [..., 6].

    Args:
        deviation: of each part, mm and degrees.
        factors: of a shift's parts, and of a turn's.
        floors: what they never fall below: shifts, tip and torque, rotation; mm and degrees.
    """
    return np.asarray(np.hypot(np.repeat(factors, 3) * deviation, np.repeat(floors, (3, 2, 1))))


def _frame(first: Visit, second: Visit) -> tuple[Array, list[int]]:
    try:
        frame, agreeing = first_frame(second.centres, first.centres)
    except ValueError as error:
        frame, agreeing, why = np.eye(4), [], str(error)
    else:
        why = f"only {len(agreeing)} teeth stand in the same places"
    if len(agreeing) < LEAST_TEETH:
        raise ReconstructionError(
            f"'{first.name}' and '{second.name}' can't be brought into one frame: {why}; at least "
            f"{LEAST_TEETH} teeth that did not move are needed. Either they are of two patients, "
            "or teeth have wrong numbers (check.html in both workspaces), or nearly all have moved."
        )
    return frame, agreeing


def _mirrored(
    back: Estimate, there: Estimate, by_photograph: float
) -> dict[int, tuple[Array, Array]]:
    """What the way back says of each tooth, as a displacement [6] of the way there, covariance."""
    frame = inverted(back.first_from_second)  # first_from_second of the way there
    scale = scale_of(frame)
    turn = np.zeros((6, 6))
    turn[:3, :3], turn[3:, 3:] = frame[:3, :3], frame[:3, :3] / scale
    found = {}
    for number, (displacement, covariance) in measured(back, by_photograph).items():
        if number not in there.centres:
            continue
        centre = back.centres[number]
        motion = solving.moved_tooth(np.eye(4), displacement, centre)
        same = mirrored(motion, frame)
        found[number] = (
            solving.displacement(same, there.centres[number]), turn @ covariance @ turn.T
        )  # fmt: skip
    return found


def _teeth(axes: Mapping[int, Array], there: Estimate, back: Estimate, many: bool) -> list[Moved]:
    """Both ways together: their mean; what they differ by adds to the doubt.

    So do pictures that do not fit, where photographs are few. Where they are many, a tooth that one
    way alone finds is not measured: nothing would tell if that is wrong.
    """
    result = []
    by_photograph = 1.0 if many else BY_PHOTOGRAPH
    forwards = measured(there, by_photograph)
    backwards = _mirrored(back, there, by_photograph)
    for number, (forward, covariance) in sorted(forwards.items()):
        displacement = forward
        if many and number not in backwards:
            continue
        if number in backwards:
            other, its = backwards[number]
            displacement = (forward + other) / 2
            half = (forward - other) / 2
            covariance = (covariance + its) / 2 + np.outer(half, half)
        leads = to_parts(axes[number])
        parts = leads @ displacement
        deviation = np.sqrt(np.maximum(np.diag(leads @ covariance @ leads.T), 0))
        if not many:
            basis = "few"
            fits = [way.fits[number] for way in (there, back) if number in way.fits]
            deviation *= misfit(min(fits, default=RANGE[0]))
        else:
            basis = "marks" if number in there.told & back.told else "flow"
        interval = halves(deviation, FACTORS[basis], FLOORS[basis])
        mine = [s for s in there.spots if s.tooth == number and len(s.points)]
        turn = float(np.degrees(Rotation.from_rotvec(displacement[3:]).magnitude()))
        result.append(
            Moved(
                number, parts, deviation, interval,
                (float(np.linalg.norm(displacement[:3])), float(np.linalg.norm(interval[:3]))),
                (turn, float(np.linalg.norm(interval[3:]))),
                bool((np.abs(parts) > SIX * interval).any()), number in there.still,
                there.centres[number], solving.moved_tooth(
                    np.eye(4), displacement, there.centres[number]
                ),
                displacement, sum(len(s.points) for s in mine), len({s.second for s in mine}),
                basis,
            )
        )  # fmt: skip
    return result


#: The largest of six independent deviations lies within so many 95 % intervals of one in 95 %.
SIX = 1.35
