"""What can be turned about the dense surface of the teeth."""

from __future__ import annotations

from dataclasses import dataclass

#: Tissue is looked for this far around its outline (mm), for the cameras' errors.
OUTLINE_ERROR = 0.5


@dataclass(frozen=True)
class SweepRound:
    """One round of the sweep along the surface's normals.

    Attributes:
        reach: furthest offset from the surface, mm.
        step: distance of the planes, mm.
        window: side of the correlation window, mm on the chart.
        prior: cost of an offset of 2 mm: how much the surface swept around is believed.
        stiffness: of the fit to the offsets found; larger is smoother.
        inset: how far within their jaw's tissue samples have to lie to be compared, mm; below 0:
            how far beyond it they may. A window that reaches over the biting edges also compares
            what lies behind them: it finds edges that are far off, and draws upper ones in and
            lower ones out.
    """

    reach: float
    step: float
    window: float
    prior: float
    stiffness: float
    inset: float = -OUTLINE_ERROR


@dataclass(frozen=True)
class SurfaceOptions:
    """Settings of `dense_surface`. Lengths are millimetres of the arch frame."""

    # samples per mm of the unrolled charts
    chart_density: float = 7.0
    # how far each crown bulges between its zenith and its tip
    crown_bulge: float = 0.8
    # power by which a crown falls towards its neighbours; larger: flatter in front, steeper beside
    crown_flatness: float = 2.6
    # smoothing of the thin-plate spline through the crown points
    crown_smoothing: float = 0.3
    # rounds of the sweep, coarse to fine; none: the crown shape as it is
    rounds: tuple[SweepRound, ...] = (
        SweepRound(reach=3.0, step=0.15, window=1.2, prior=0.3, stiffness=5.0),
        SweepRound(reach=1.5, step=0.075, window=0.8, prior=0.15, stiffness=2.0, inset=0.4),
    )
    # penalties of semi-global matching: one plane, and more, per unit of 1 - correlation
    sgm_p1: float = 0.1
    sgm_p2: float = 0.6
    # correlation below which an offset counts nothing, and above which it counts in full
    correlation_floor: float = 0.3
    correlation_full: float = 0.8
    # pull of every offset towards the crown shape, against a weight of 1 of a full correlation
    anchor: float = 0.02
    # an offset further than this from the fit loses weight (iteratively reweighted)
    outlier: float = 0.6
    # a view takes part where the cosine between normal and line of sight is above this
    least_facing: float = 0.25
    # a view says what is tooth and what is gum from this cosine: below it shows them drawn out
    least_showing: float = 0.35
    # the same where another view faces them better: half their width is left
    least_beside: float = 0.5
    # whether what no view sees from there has no depth; with exact cameras it is right all the same
    only_clear: bool = True
    # pairs of views closer or further apart (degrees) are not compared
    least_pair_angle: float = 12.0
    most_pair_angle: float = 65.0
    # partners, to either side, that a view is compared with
    partners: int = 1
    # whether what no photographs agree on is kept out of the dark beside the jaws that others show;
    # cameras must be exact for that
    carve: bool = False
    # gum shown beyond the crowns, where photographs show gum
    gum_height: float = 4.0
    # gum shown beyond the last tooth that a photograph shows; None: as far as the chart goes
    past_row: float | None = 1.5
    # with a larger gum_height the gum beyond this is swept strip by strip, each going on from the
    # last; cameras must be exact for that
    grow_from: float = 5.0
    # height of the strips
    grow_step: float = 1.5
    # the sweep of each strip
    grow_round: SweepRound = SweepRound(reach=4.0, step=0.15, window=1.6, prior=0.1, stiffness=8.0)
    # weight of what photographs agree on there, against 1 on the crowns
    gum_trust: float = 0.2
    # confidence where no photographs agree is 1 + exp(this): more than what is completed has
    guess: float = -1.6
    # rims are smoothed over this length
    rim_smoothing: float = 0.35
    # teeth go on this far behind what hides their biting edges, as the crown shape has them
    hidden_edge: float = 1.2
    # power of the cosine by which views share in the colour
    colour_power: float = 6.0
    # distance of the points of the cloud
    cloud_spacing: float = 0.14
