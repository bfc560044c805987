"""Settings of `fit_arch`. Imports nothing heavy."""

from __future__ import annotations

from dataclasses import dataclass, replace

from pipeline.artifacts.dental.fdi import is_left, other_side


@dataclass(frozen=True)
class ArchOptions:
    """Settings of `fit_arch`.

    Angles are in degrees, lengths in millimetres, image errors as shares of the band of teeth (the
    distance from the upper to the lower gum line in the photograph, about 15 mm).
    """

    #: What each photograph is, in file order: `right`, `frontal`, `left` or `between`; None: found.
    order: tuple[str, ...] | None = None
    #: Focal length expected where it is unknown, as a multiple of the image's long side, and its
    #: relative standard deviation: each photograph may be a crop of its own.
    focal_per_side: float = 1.9
    focal_deviation: float = 0.35
    #: Camera distance expected, and its relative standard deviation: from a phone nearby to a long
    #: lens. (Each photograph's lies around the one of them all, `kernels.OWN_DISTANCE`.) With
    #: 125 and .15 twelve patients and the scan video come out nearly the same: they hardly tell it.
    distance: float = 150.0
    distance_deviation: float = 0.3
    #: Side views are expected at plus and minus this yaw, within these standard deviations.
    side_yaw: float = 48.0
    side_yaw_deviation: float = 15.0
    frontal_yaw_deviation: float = 8.0
    elevation: float = 4.0
    elevation_deviation: float = 8.0
    roll_deviation: float = 6.0
    #: How far a patient's landmark lies from the textbook arch before that is stretched, along each
    #: axis, where numberings are compared. The smaller, the better is the mean evidence of twelve
    #: patients, of generated mouths and of the scan video (1.5, 1.2, 1, .8); with .8 more wrong
    #: numbers of altered photographs are not marked (7 cases of 70, not 3).
    numbering_deviation: float = 1.0
    #: The same where the cameras of the numbering found are: patients don't differ from the
    #: textbook landmark by landmark, and the more they are held to it the smaller angles come out
    #: (exact landmarks of generated mouths: by 3.2 degrees with .8, by 1.7 with this).
    landmark_deviation: float = 1.2
    #: What a landmark that a labelling leaves unused costs (twice the log likelihood).
    unused_cost: float = 8.0
    #: What it costs to call a tooth missing in all photographs.
    missing_cost: float = 20.0
    #: Premolars, taken out for a treatment or never there, are missing more often: twice the
    #: negative log odds of 5 first ones of 262 and 11 second ones of 143 (twelve patients and 110
    #: labelled photographs that show a tooth behind). And mostly on both sides: what the second
    #: of two costs. Molars at their rates (first ones 2 of 55) are called missing where they are
    #: not.
    missing_first_premolar_cost: float = 8.0
    missing_second_premolar_cost: float = 5.0
    missing_pair_cost: float = 2.0
    #: What it costs to call a crown merged, split or none.
    defect_cost: float = 12.0
    #: What it costs that a tooth is hidden before the last crown of a row: from .5 to 3 as many
    #: numbers of twelve patients come out right.
    hidden_cost: float = 1.5
    #: Weight of what the crowns look like beside where they lie.
    looks_weight: float = 1.0
    #: Labellings of a photograph's rows that look likeliest and are tried. (With 40 the same
    #: numbers in twelve patients, and confidences that differ by .013 at most.)
    rows_tried: int = 16
    #: Labellings kept per photograph, and jointly, while searching.
    candidates_per_view: int = 10
    beam: int = 16
    #: Rounds of dense matching on the unrolled arch (0: landmarks alone).
    dense_rounds: int = 3
    #: Pixels per millimetre of the unrolled arch.
    chart_scale: float = 8.0
    #: Total weight of the dense matches of a pair, in matches; where they dominate the landmarks
    #: the cameras drift.
    dense_weight: float = 40.0
    #: Below this margin another labelling is nearly as good: doubt.
    min_margin: float = 6.0
    #: Do all photographs show one mouth? The log Bayes factor by the places of the teeth in these
    #: units, and the distance of colours below the largest usual one by this weight, must not come
    #: to less than 0 together.
    common_mouth_unit: float = 6.0
    #: What places of three and more photographs come to by themselves: mouths are more alike than
    #: the model believes. Of 84 triads (twelve patients, each altered in seven ways) 82 pass, and
    #: of 396 mixes of two patients 10; with 8 or 10 as many and 15 or 13, with 20 as many, 7, but
    #: photographs of one mouth pass more narrowly.
    common_mouth_by_chance: float = 15.0
    colour_weight: float = 6.0
    max_colour: float = 2.2
    #: Or, if the camera chose a white balance for each photograph: places that fit count less,
    #: colours only by the contrast of gum and enamel, and dense matches by the logarithm of their
    #: share over the usual one; together they must make good what colours no longer say. Unit and
    #: weight were chosen on twelve patients, each altered in seven ways (81 of 84 passed then),
    #: against the 396 ways to put a photograph of one of them among two of another (8): a clinic
    #: mixes up far fewer cases than its phones colour; other weights were no better. The cost was
    #: chosen when gum became what the reader sees as gum: altered in fourteen ways 159 of 168 pass,
    #: of the mixes 7, 3 of them with a warning of another light; with a cost of 2, 154 and 7 (with
    #: that and all beside the teeth taken for gum, 158 and 9).
    any_light_places: float = 0.33
    any_light_colour_weight: float = 2.0
    any_light_match_weight: float = 3.0
    usual_share: float = 0.008
    any_light_cost: float = 1.25
    #: Were all photographs taken at one sitting, by the camera's clock? None: it doesn't say. What
    #: that adds to the evidence for one mouth, or takes from it: a factor of 20 to the odds. It is
    #: an assumption: of photographs that were mixed up, one set in twenty was taken within the
    #: minutes that a patient's are, and of those of one patient, one in twenty on several days.
    one_sitting: bool | None = None
    sitting_evidence: float = 2.0
    #: Median landmark error above which the fit is doubted. This limit, that of epipolar
    #: errors and `confidence.EDGE` lie a third above the most that twelve patients came to, each
    #: also altered in seven ways; the next one a sixth. None of 136 mixes of two patients, nor of
    #: 57 with mirror images or open jaws, was refused for one of the four alone.
    max_error: float = 0.055
    #: Standard deviation of the angle between neighbouring views above which it is doubted. It says
    #: how far photographs of one mouth, altered, move it: by .9 of it, 3 degrees (root mean square
    #: of 168). It does not know how far the arch's proportions are from the textbook's.
    max_angle_deviation: float = 10.0
    #: Share of the crowns, those at the ends of the rows apart, left without a number above which
    #: a photograph is doubted: a third. (At most .11 in twelve patients; no mix of patients or of
    #: mirror images was refused for this alone.)
    max_unnamed: float = 0.34
    #: Median distance of dense matches from their epipolar lines above which a pair is doubted, as
    #: a share of the band.
    max_epipolar_error: float = 0.036
    #: Photographs less than `nearby` degrees apart are doubted if dense matches cover less than
    #: this share of what both show. Of 16 generated mouths that pass otherwise, each photographed
    #: twice from one side, blurred, small or in another light as well, it is .08 to .36, below .1
    #: in one; of 31 pairs of two mouths .02 to .09. Of a real one .30, of five pairs of two
    #: patients .01 to .02. With cameras and crops at random (`benchmarks/nearby.py`, 30 mouths) .13
    #: and more, and up to 20 degrees .09; of two mouths .04 at most. Further apart real ones
    #: match as little as strangers do: .24 at 13 degrees, .13 at 21, .05 at 29 in the scan video,
    #: .04 to .12 at 22 and .01 to .05 at 30 to 37 between fronts and sides of twelve patients.
    nearby: float = 15.0
    min_nearby_share: float = 0.1
    #: All are frames of one film, some of which may be too blurred to match.
    one_film: bool = False

    def cost_of_missing(self, absent: frozenset[int]) -> float:
        """What it costs to call these teeth (FDI numbers) missing in the patient."""
        premolars = {4: self.missing_first_premolar_cost, 5: self.missing_second_premolar_cost}
        total = 0.0
        for tooth in sorted(absent):
            cost = premolars.get(tooth % 10, self.missing_cost)
            second = tooth % 10 in premolars and is_left(tooth) and other_side(tooth) in absent
            total += self.missing_pair_cost if second else cost
        return total

    def of_a_child(self) -> ArchOptions:
        """The same where primary teeth may stand. A second primary molar looks like a first
        permanent one, which it would be called if the premolar in its own place were easily
        missing."""
        cost = self.missing_cost
        return replace(
            self, missing_first_premolar_cost=cost, missing_second_premolar_cost=cost,
            missing_pair_cost=cost,
        )  # fmt: skip
