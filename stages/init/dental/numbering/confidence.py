"""When to doubt a fit: sentences for the user."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from pipeline.artifacts.teeth import Dentition
from pipeline.geometry.rigid import angle_between
from stages.dentition.tooth_rows import NO_TOOTH
from stages.init.dental.cameras.bundle import Adjusted, Sightings
from stages.init.dental.cameras.kernels import PER_VIEW
from stages.init.dental.cameras.unrolled import PairFigures
from stages.init.dental.numbering.arch_options import ArchOptions
from stages.init.dental.numbering.colours import BURNT_OUT, DARK_BESIDE, ColourDistance
from stages.init.dental.numbering.labellings.scorer import (
    MAIN_ROLES,
    Scored,
    Scorer,
)
from stages.init.dental.numbering.mirrored import PERHAPS_MIRRORED
from stages.init.dental.numbering.rivals import Margins

Array = npt.NDArray[np.float64]

#: Prior standard deviations off, beyond which a pose is said to be at the edge: a tilt by 24
#: degrees from what is usual; photographs of children come to 18.
EDGE = 3.0
#: Evidence beyond the least margin, and sureness of one mouth, that raise the odds by a factor e.
MARGIN_UNIT, SAME_MOUTH_UNIT = 4.0, 1.5
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


@dataclass(frozen=True)
class Evidence:
    """What a fit can be doubted for.

    Attributes:
        margins: by how much its labelling beats others.
        common_mouth: per photograph, twice the log Bayes factor that it shows the same mouth as the
            others (`edits.common_mouth`).
        mirrored: of photographs from the front, twice the log Bayes factor that they are mirror
            images (`mirrored.mirror_evidence`).
        colours: per photograph, how far its colours are from the others'.
        bands: per photograph, the height of its band of teeth, pixels.
        pairs: how the dense matches of pairs agree.
    """

    margins: Margins
    common_mouth: Sequence[float]
    mirrored: Mapping[int, float]
    colours: Sequence[ColourDistance]
    bands: Sequence[float]
    pairs: dict[tuple[int, int], PairFigures]


@dataclass(frozen=True)
class SameMouth:
    """How sure it is that all photographs show one mouth; below 0: doubt.

    Attributes:
        one_light: if one light took them all.
        any_light: if the camera chose a white balance for each.
        odd: the photograph that fits the others worst, by its place in the row.
    """

    one_light: float
    any_light: float
    odd: int

    @property
    def sureness(self) -> float:
        return max(self.one_light, self.any_light)


def same_mouth(evidence: Evidence, options: ArchOptions) -> SameMouth:
    """Weigh places of the teeth, colours, dense matches, and whether the camera's clock says that
    it was one sitting; by the photograph that fits worst."""
    one, other = [], []
    by_chance = options.common_mouth_by_chance if len(evidence.colours) > 2 else 0.0
    sitting = {True: 1.0, False: -1.0, None: 0.0}[options.one_sitting] * options.sitting_evidence
    for view, (common, colour) in enumerate(
        zip(evidence.common_mouth, evidence.colours, strict=True)
    ):
        places = (common - by_chance) / options.common_mouth_unit
        share = max((p.share for pair, p in evidence.pairs.items() if view in pair), default=0.0)
        hue = options.colour_weight * (options.max_colour - colour.one_light)
        one.append(places + hue + sitting)
        other.append(
            min(places, options.any_light_places * places)
            + sitting
            + options.any_light_colour_weight * (options.max_colour - colour.any_light)
            + options.any_light_match_weight * _more_matches(share, options.usual_share)
            - options.any_light_cost
        )
    return SameMouth(min(one), min(other), int(np.argmin(one)))


def _more_matches(share: float, usual: float) -> float:
    """Logarithm of a share of dense matches over the usual one; bounded where there are none."""
    return float(np.log((share + 0.25 * usual) / usual))


def case_confidence(figures: dict[str, float], doubted: bool, options: ArchOptions) -> float:
    """One confidence for a case, 0..1: by its weakest point; below .5 exactly where it is doubted.

    Args:
        figures: of `fit_doubts`.
        doubted: is there any doubt?
    """
    weakest = min(
        (figures["margin"] - options.min_margin) / MARGIN_UNIT,
        SAME_MOUTH_UNIT * figures["same_mouth"],
    )
    confidence = 1 / (1 + float(np.exp(-np.clip(weakest, -30, 30))))
    return min(confidence, 0.49) if doubted else max(confidence, 0.5)


def fit_doubts(
    photos: Sequence[str], scorer: Scorer, best: Scored, evidence: Evidence, options: ArchOptions
) -> tuple[list[str], dict[str, float]]:
    """Doubts about the fit, and the figures that they rest on.

    Args:
        photos: names of the photographs placed, as the user knows them.
        scorer, best: the search and its outcome.
        evidence: what speaks for and against it.
        options: thresholds.
    """
    adjusted, labelling = best.adjusted, best.labelling
    figures: dict[str, float] = {
        "margin": evidence.margins.cameras,
        "numbers_margin": evidence.margins.numbers,
        "local_margin": evidence.margins.local,
    }
    doubts: list[str] = []
    if figures["margin"] < options.min_margin:
        doubts.append(
            f"another numbering of the teeth explains the photographs nearly as well (margin "
            f"{figures['margin']:.0f}, wanted {options.min_margin:.0f}): check the numbers"
        )
    known = scorer.held is not None
    for view, (common, colour) in enumerate(
        zip(evidence.common_mouth, evidence.colours, strict=True)
    ):
        figures[f"common_mouth_{view}"] = common
        figures[f"colour_{view}"] = colour.one_light
        figures[f"contrast_{view}"] = colour.any_light
    one = same_mouth(evidence, options)
    figures["same_mouth"] = one.sureness
    figures["same_mouth_one_light"] = one.one_light
    # One photograph of another patient makes all three strangers to each other: the worst is named.
    if one.sureness < 0 and not known:
        fit = evidence.common_mouth[one.odd] > options.common_mouth_by_chance
        exposure = _badly_exposed(photos, evidence.colours)
        doubts.append(_stranger(photos[one.odd], places_fit=fit) + exposure)
    for view, factor in evidence.mirrored.items():
        figures[f"mirrored_{view}"] = factor
        if factor > PERHAPS_MIRRORED:
            doubts.append(
                f"{photos[view]} seems to be a mirror image, or those of the sides are: its teeth "
                "fit theirs better turned over"
            )
    doubts += _view_doubts(photos, scorer, best, evidence.bands, figures, options)
    priors = scorer.priors(labelling.views, labelling.roles)
    for (i, j), pair in sorted(evidence.pairs.items()):
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
        if pair.epipolar_error > options.max_epipolar_error:
            doubts.append(
                f"what matches between {a} and {b} contradicts their cameras (off by "
                f"{100 * pair.epipolar_error:.1f} % of the height of the row, median)"
            )
    if not known and not options.one_film:
        doubts += unlike_neighbours(photos, adjusted, evidence.pairs, options)
    return doubts, figures


def unlike_neighbours(
    photos: Sequence[str], adjusted: Adjusted, pairs: Mapping[tuple[int, int], PairFigures],
    options: ArchOptions,
) -> list[str]:  # fmt: skip
    """Doubts about photographs from nearly the same side as others, none of which they match."""
    nearby = {
        pair: figures.share
        for pair, figures in pairs.items()
        if angle_between(*(adjusted.rotations[view] for view in pair)) < options.nearby
    }
    best = {
        view: max(share for pair, share in nearby.items() if view in pair)
        for pair in nearby
        for view in pair
    }
    return [
        f"{photos[i]} and {photos[j]} show the teeth from nearly the same side, but hardly "
        f"anything in one is found in the other ({100 * share:.0f} %): they are of two patients or "
        "of two visits, or one is not sharp"
        for (i, j), share in sorted(nearby.items())
        if min(best[i], best[j]) < options.min_nearby_share
    ]


def _stranger(photo: str, places_fit: bool) -> str:
    """Why a photograph may show another mouth than the others."""
    if places_fit:
        return (
            f"{photo} may show another patient, or was taken in another light (a phone chooses its "
            "own white balance): its teeth stand where the others' do, but its colours differ more "
            "than those of one patient in one light"
        )
    return (
        f"{photo} may show another patient, or a picture that was mirrored or is upside down: its "
        "colours and the places of its teeth fit the others' badly"
    )


def _badly_exposed(photos: Sequence[str], colours: Sequence[ColourDistance]) -> str:
    """What to add of photographs with far too much or too little light: that changes colours."""
    seen = list(zip(photos, colours, strict=True))
    bright = [
        f"{photo} ({100 * colour.white:.0f} % of its teeth are plain white)"
        for photo, colour in seen
        if colour.white > BURNT_OUT
    ]
    dark = [
        f"{photo} ({1 / max(colour.light, 0.01):.1f} times darker than the others)"
        for photo, colour in seen
        if colour.light < DARK_BESIDE and not bright
    ]
    told = ""
    for which, what, more in ((bright, "bright", "less"), (dark, "dark", "more")):
        if which:
            told += (
                f"; far too {what} {'is' if len(which) == 1 else 'are'} {' and '.join(which)}, "
                f"which alone changes colours: take {'it' if len(which) == 1 else 'them'} again "
                f"with {more} light or another exposure"
            )
    return told


def _view_doubts(
    photos: Sequence[str], scorer: Scorer, best: Scored, bands: Sequence[float],
    figures: dict[str, float], options: ArchOptions,
) -> list[str]:  # fmt: skip
    """Doubts about single photographs; their figures are added."""
    adjusted, labelling = best.adjusted, best.labelling
    doubts = []
    sightings = scorer.sightings(labelling)
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
        inner = [label for row in labelling.labels[view] for label in row[1:-1]]
        unnamed = inner.count(NO_TOOTH) / max(len(inner), 1)
        figures[f"unnamed_{view}"] = unnamed
        if unnamed > options.max_unnamed:
            count = inner.count(NO_TOOTH)
            doubts.append(
                f"{count} crown{'s' * (count > 1)} of {photo} fit{'s' * (count == 1)} no tooth: "
                "crowns found badly, a mirrored photograph or another patient"
            )
    return doubts


def plain_role(role: str) -> str:
    """The role's name as users know it."""
    return "between" if role.startswith("between") else role


def role_doubts(best: Scored) -> list[str]:
    """Three photographs are one from each side and one from the front, two of these the front and a
    side: both sides share so few teeth that the angle between them may be off by any amount."""
    roles = best.labelling.roles
    if len(roles) == 2 and ("frontal" not in roles or len(set(roles)) == 1):
        lacking = "one from each side" if "frontal" in roles else "one from the front"
        why = "share too few teeth" if len(set(roles)) == 2 else "show the teeth from one side"
        return [
            f"the two photographs look like {' and '.join(map(plain_role, roles))} views, which "
            f"{why}: add {lacking}"
        ]
    if len(roles) == 2:
        return []
    absent = [role for role in MAIN_ROLES if role not in roles]
    if not absent:
        return []
    twice = [role for role in MAIN_ROLES if roles.count(role) > 1]
    return [
        f"{roles.count(twice[0])} photographs look like {twice[0]} views and none like a "
        f"{' or a '.join(absent)} view: one of them may be mirrored, or taken twice"
    ]


def kind_doubts(best: Scored, dentitions: list[Dentition], photos: list[str]) -> list[str]:
    """One photograph may look like what it is not; two are a wrong numbering."""
    kinds = {"right": "right", "left": "left", "front": "frontal"}
    odd = [
        f"{photos[view]} (looks like {kinds[dentitions[view].kind]}, its teeth like {role})"
        for view, role in zip(best.labelling.views, best.labelling.roles, strict=True)
        if role in MAIN_ROLES and kinds.get(dentitions[view].kind, role) != role
    ]
    return [f"photographs don't show the sides that they look like: {', '.join(odd)}"] * (
        len(odd) > 1
    )
