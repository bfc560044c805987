"""Which tooth is which: labellings compared by their evidence.

A crown's label is a position along its row (see `sightings`). Every labelling is solved (`bundle`)
and scored by cost + log determinant of the Hessian + what landmarks left unused, missing teeth and
defective crowns cost: twice the negative log evidence. The determinant matters: a labelling shifted
by a tooth shares fewer landmarks between the views and so fits more easily.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from pipeline.artifacts.dental.fdi import is_upper
from stages.dentition.tooth_rows import (
    NO_TOOTH,
    NO_TOOTH_COST,
    POSITIONS,
    Labels,
)
from stages.init.dental.cameras.bundle import (
    NO_MATCHES,
    Adjusted,
    CameraPriors,
    Matches,
    Sightings,
    adjust,
)
from stages.init.dental.cameras.held import HeldCameras
from stages.init.dental.numbering.arch_options import ArchOptions
from stages.init.dental.numbering.labellings.ends import ends_cost, hidden_at_ends
from stages.init.dental.numbering.sightings import SeenRow, SightingCache
from stages.init.dental.template import position_of, textbook_arch

Array = npt.NDArray[np.float64]
ViewLabels = tuple[Labels, Labels]

#: Roles that three photographs have.
MAIN_ROLES = ("right", "frontal", "left")
#: What it costs that two of three photographs have the same role.
REPEATED_ROLE_COST = 15.0
#: Steps of the solver: for one view alone, while searching, at the end.
VIEW_STEPS, SEARCH_STEPS, FINAL_STEPS = 12, 8, 40


@dataclass(frozen=True)
class Labelling:
    """A hypothesis about some of the views.

    Attributes:
        views: indices of the photographs.
        roles: of each.
        labels: (upper, lower) positions of the crowns of each.
        absent: FDI numbers of teeth that no photograph shows though their neighbours are shown.
        closed: those of them whose space the teeth behind have closed.
        primary: permanent numbers in whose place primary teeth stand.
    """

    views: tuple[int, ...]
    roles: tuple[str, ...]
    labels: tuple[ViewLabels, ...]
    absent: frozenset[int] = frozenset()
    closed: frozenset[int] = frozenset()
    primary: frozenset[int] = frozenset()


@dataclass(frozen=True)
class Scored:
    """A labelling, solved.

    Attributes:
        labelling: the hypothesis.
        adjusted: its solution.
        score: twice the negative log evidence with all costs.
    """

    labelling: Labelling
    adjusted: Adjusted
    score: float


def row_defects(labels: Labels, absent: frozenset[int]) -> int:
    """How many crowns of a row are merged, split, spurious or skipped under its labels.

    Teeth hidden before its first or last crown are no defects (`ends.hidden_at_ends`).

    Args:
        labels: positions of the row's crowns.
        absent: positions of this jaw that are missing in the patient.
    """
    named = [i for i, label in enumerate(labels) if label != NO_TOOTH]
    defects = 0
    for i, j in pairwise(named):
        nameless = j - i - 1
        defects += labels[i] == labels[j]
        if not nameless and len(labels) > 2 and (i == 0 or j == len(labels) - 1):
            continue
        skipped = sum(p not in absent for p in range(labels[i] + 1, labels[j]))
        if nameless or skipped:
            # One crown for two teeth and two crowns for one are one defect each.
            defects += max(1, abs(nameless - skipped))
    if named:
        # Beyond the named ones: the last crown of a row is cut off and may be anything.
        first, last = named[0], named[-1]
        before = sum(labels[first] - (first - k) >= 0 for k in range(1, first))
        after = range(last + 1, len(labels) - 1)
        defects += before + sum(labels[last] + (k - last) < POSITIONS for k in after)
    return defects


class Scorer:
    """Solves and scores labellings of one set of photographs."""

    def __init__(
        self,
        rows: list[tuple[SeenRow, SeenRow]],
        focals: Array,
        focal_deviations: Array,
        options: ArchOptions,
        threads: int,
        held: HeldCameras | None = None,
        primary: frozenset[int] = frozenset(),
    ) -> None:
        self.rows = rows
        self.primary = primary
        self.held = held
        self.cache = SightingCache(rows)
        # A search asks for the same rows thousands of times.
        self._looks: dict[tuple[int, int, Labels], float] = {}
        self._row_costs: dict[tuple[int, int, Labels, frozenset[int]], float] = {}
        self.focals, self.focal_deviations = focals, focal_deviations
        self.options = options
        self.threads = threads
        self._searched: dict[Labelling, Scored] = {}
        self.solved = 0
        side, spread = options.side_yaw, options.side_yaw_deviation
        self._yaw_of = {
            "right": (-side, spread),
            "left": (side, spread),
            "frontal": (0.0, options.frontal_yaw_deviation),
            # Half way, and as wide as is left between the others.
            "between right": (-side / 2, spread),
            "between left": (side / 2, spread),
        }

    def sightings(self, labelling: Labelling) -> Sightings:
        """What a labelling says was seen, views numbered as it has them.

        Of two photographs alone, landmarks stay where they were seen: what is taken back rests on
        angles that are not known yet, and of 24 pairs 17 pass with it, 20 without.
        """
        yaws = [self._yaw_of[role][0] for role in labelling.roles]
        return self.cache.collect(
            labelling.views, labelling.labels, yaws if len(self.rows) > 2 else None
        )

    def priors(self, views: tuple[int, ...], roles: tuple[str, ...]) -> CameraPriors:
        """Camera priors of some views in their roles."""
        options = self.options
        yaws = [self._yaw_of[role] for role in roles]
        angles = [
            (options.elevation_deviation, spread, options.roll_deviation) for _, spread in yaws
        ]
        return CameraPriors(
            yaws=np.array([yaw for yaw, _ in yaws], np.float64),
            angle_deviations=np.array(angles, np.float64).reshape(-1, 3),
            elevation=options.elevation,
            distance=options.distance,
            distance_deviation=options.distance_deviation,
            focals=np.ascontiguousarray(self.focals[list(views)]),
            focal_deviations=np.ascontiguousarray(self.focal_deviations[list(views)]),
        )

    def looks(self, labelling: Labelling) -> float:
        """What the looks of the crowns speak against a labelling (evidence)."""
        return self.options.looks_weight * sum(
            self._looks_of_row(view, jaw, labels[jaw])
            for view, labels in zip(labelling.views, labelling.labels, strict=True)
            for jaw in (0, 1)
        )

    def _looks_of_row(self, view: int, jaw: int, labels: Labels) -> float:
        key = (view, jaw, labels)
        if key not in self._looks:
            self._looks[key] = looks_cost(self.rows[view][jaw], labels)
        return self._looks[key]

    def row_costs(self, view: int, labels: ViewLabels, absent: frozenset[int]) -> float:
        """What both rows of a view cost whatever the cameras are, their looks apart.

        Args:
            view: which.
            labels: of its rows.
            absent: FDI numbers of teeth that are missing in the patient.
        """
        return sum(self._costs_of_row(view, jaw, labels[jaw], absent) for jaw in (0, 1))

    def _costs_of_row(self, view: int, jaw: int, labels: Labels, absent: frozenset[int]) -> float:
        key = (view, jaw, labels, absent)
        if key not in self._row_costs:
            options = self.options
            places = frozenset(position_of(t) for t in absent if is_upper(t) == (jaw == 0))
            self._row_costs[key] = (
                options.unused_cost * self.cache.unused(view, jaw, labels)
                + options.defect_cost * row_defects(labels, places)
                + options.hidden_cost * hidden_at_ends(labels, places)
            )
        return self._row_costs[key]

    def costs(self, labelling: Labelling) -> float:
        """What a labelling costs before it is solved."""
        options = self.options
        total = options.cost_of_missing(labelling.absent) + self.looks(labelling)
        for view, labels in zip(labelling.views, labelling.labels, strict=True):
            total += self.row_costs(view, labels, labelling.absent)
        if len(self.rows) <= 3 and options.order is None:
            total += REPEATED_ROLE_COST * (len(labelling.roles) - len(set(labelling.roles)))
        return total

    def solve(
        self,
        labelling: Labelling,
        start: tuple[Array, Array] | None = None,
        max_steps: int = FINAL_STEPS,
        matches: Matches = NO_MATCHES,
        deviation: float | None = None,
    ) -> Scored:
        """Solve and score one labelling.

        Args:
            labelling: the hypothesis.
            start: unknowns and offsets to start from.
            max_steps: of the solver.
            matches: dense ones, where there are any.
            deviation: of landmarks from the textbook arch, mm; None: that of numberings. Scores
                with different ones don't compare.
        """
        adjusted = adjust(
            self.sightings(labelling),
            textbook_arch(labelling.closed, labelling.primary),
            self.priors(labelling.views, labelling.roles),
            deviation or self.options.numbering_deviation,
            matches=matches,
            start=start,
            max_steps=max_steps,
            tolerance=0.05 if max_steps < FINAL_STEPS else 0.005,
            # One photograph alone says nothing of how cameras lie to each other.
            held=self.held.of(labelling.views) if self.held and len(labelling.views) > 1 else None,
        )
        self.solved += 1
        ends = ends_cost(self.rows, labelling.views, labelling.labels, adjusted)
        return Scored(labelling, adjusted, adjusted.evidence + self.costs(labelling) + ends)

    def solve_all(
        self, jobs: list[tuple[Labelling, tuple[Array, Array] | None]], max_steps: int
    ) -> list[Scored]:
        """Solve labellings, on several threads, in the order given.

        In `SEARCH_STEPS` none is solved twice, whatever it starts from: the edits of labellings
        that are near each other lead to the same ones again and again.
        """
        if max_steps != SEARCH_STEPS:
            return self._solve_each(jobs, max_steps)
        new = {job[0]: job for job in reversed(jobs) if job[0] not in self._searched}
        fresh = list(reversed(new.values()))
        for scored in self._solve_each(fresh, max_steps):
            self._searched[scored.labelling] = scored
        return [self._searched[labelling] for labelling, _ in jobs]

    def _solve_each(
        self, jobs: list[tuple[Labelling, tuple[Array, Array] | None]], max_steps: int
    ) -> list[Scored]:
        for labelling, _ in jobs:
            for view, labels in zip(labelling.views, labelling.labels, strict=True):
                self.row_costs(view, labels, labelling.absent)  # before threads share the caches
        if self.threads < 2 or len(jobs) < 2:
            return [self.solve(labelling, start, max_steps) for labelling, start in jobs]
        with ThreadPoolExecutor(self.threads) as pool:
            return list(pool.map(lambda job: self.solve(job[0], job[1], max_steps), jobs))


def looks_cost(row: SeenRow, labels: Labels) -> float:
    """Twice the negative log probability of a row's labels by the looks of its crowns."""
    total = 0.0
    for looks, score, label in zip(row.looks, row.scores, labels, strict=True):
        # A crown that is hardly one may be none at less cost.
        total -= float(looks[label]) if label != NO_TOOTH else -NO_TOOTH_COST * float(score)
    return 2 * total
