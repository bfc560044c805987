"""Features or teeth: when photographs are placed by their teeth, and what is said of that."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from pipeline.artifacts.teeth import UNREAD
from pipeline.artifacts.views import View, Views
from pipeline.errors import ReconstructionError
from pipeline.stage import StageContext
from stages.init.dental.read import labelled_teeth, set_aside_reasons
from stages.init.sfm.matching.features import Features
from stages.init.sfm.options import ClassicalOptions
from stages.init.sfm.sounding import sound

#: Degrees by which rows of teeth may be turned for photographs to count as upright: half of what
#: features do not stand (`roll.SMALLEST_ROLL`), for two may be turned against each other.
UPRIGHT = 6.0
#: How few and how many photographs the dental path takes on its own accord.
DENTAL_VIEWS = (2, 12)
#: So many photographs of a mouth, or all if there are fewer, features must place for teeth to know
#: no more.
ENOUGH = 3
#: Of so many it is asked first whether features may link them: more around one mouth are never all
#: as far apart as that they can't. Of a clinic's whole folder those are asked that show the closed
#: bite: open mouths, jaws from above and what is shown twice link nothing that they don't.
SOUNDED_VIEWS = 6


@dataclass
class ByTeeth:
    """The dental path as one of two ways; it is gone once at most.

    Attributes:
        context, views: of the stage.
        failure: why it led nowhere.
        features: of the views, if they had to be found to ask whether they link them.
    """

    context: StageContext
    views: Views
    failure: ReconstructionError | None = None
    features: list[Features] | None = None

    def place(self) -> None:
        """Place the views by their teeth, and write what came out.

        Raises:
            ReconstructionError: as `from_teeth`; the second time the same at once.
        """
        from stages.init.dental.place import from_teeth

        if self.failure is None:
            try:
                return from_teeth(self.context, self.views)
            except ReconstructionError as failure:
                self.failure = failure
        raise self.failure

    def to_try(self) -> set[str]:
        """Views that it may place; empty where it is not worth a try.

        Few photographs, and of teeth.
        """
        if not self.context.has("teeth"):
            return set()
        teeth = labelled_teeth(self.context, self.views)
        shown = {dentition.name for dentition in teeth.chosen} & set(self.views.by_name())
        return shown if DENTAL_VIEWS[0] <= len(shown) <= DENTAL_VIEWS[1] else set()

    def upright(self) -> bool:
        """Do the rows of teeth say that no photograph is rolled against the others?

        Those in some frames of a film speak for all: a camera is not turned between two frames.
        """
        if not self.context.has("teeth"):
            return False
        read = {dentition.name: dentition for dentition in self.context.load("teeth").chosen}
        rolls = [abs(math.degrees(read[v.name].roll)) for v in self.views.views if v.name in read]
        enough = len(self.views) / 3 if self.views.ordered else len(self.views)
        return len(rolls) >= max(enough, 1) and max(rolls) < UPRIGHT

    def is_first(
        self, views: Sequence[View], focals: list[float | None], options: ClassicalOptions
    ) -> bool:
        """Few photographs that features won't link: finding that out would take longest of all.

        Args:
            views: as features see them.
            focals: of each view in pixels, or None.
            options: of the attempt by features.
        """
        shown = self.to_try()
        if not shown:
            return False
        asked = list(range(len(views)))
        if len(views) > SOUNDED_VIEWS and not self.views.ordered and self._all_were_read():
            asked = [k for k in asked if views[k].name in shown]
        if len(asked) > SOUNDED_VIEWS:
            return False
        sounding = sound(
            [views[k].gray() for k in asked], [views[k].valid() for k in asked],
            [focals[k] for k in asked], self.views.ordered, options, seed=self.context.seed,
            threads=self.context.threads, scratch=self.context.scratch,
        )  # fmt: skip
        if len(asked) == len(views):
            self.features = sounding.features
        return sounding.linked < min(ENOUGH, len(shown))

    def _all_were_read(self) -> bool:
        read = labelled_teeth(self.context, self.views).views
        return all(dentition.kind != UNREAD for dentition in read)

    def knows_more(self, placed: set[str]) -> bool:
        """Would it place a mouth of which features have placed hardly any?

        Two photographs of the front look alike and are linked; those of the sides, by which the
        arch is known, are then missing. Features that do place enough of the mouth place it better.
        """
        shown = self.to_try()
        return len(shown & placed) < min(ENOUGH, len(shown))

    def with_what_was_set_aside(self, unplaced: ReconstructionError) -> ReconstructionError:
        """The failure of features; with the photographs that are missing for the teeth, if any."""
        teeth = labelled_teeth(self.context, self.views) if self.context.has("teeth") else None
        shown = teeth is not None and any(view.all_crowns for view in teeth.views)
        if teeth is None or not shown or len(teeth.chosen) >= DENTAL_VIEWS[0]:
            return unplaced
        aside = set_aside_reasons(teeth, self.views)
        without = f" ({aside})" if aside else ""
        return ReconstructionError(
            f"{unplaced} By their teeth photographs are needed that show the closed bite from the "
            f"front and from one side, better from both, and {len(teeth.chosen)} of "
            f"{len(teeth.views)} do{without}. Add what is missing; if one was set aside wrongly, "
            "say so in check.html.",
            unplaced.pictures,
            {**unplaced.artifacts, "teeth": teeth},
        )


def neither(unplaced: ReconstructionError, doubtful: ReconstructionError) -> ReconstructionError:
    """The failure of both ways: that of the teeth as a whole, for it says what can be mended here;
    of the texture that there was too little."""
    texture = str(unplaced).split(". ")[0].rstrip(".")
    return ReconstructionError(
        f"Neither the texture nor the teeth place these photographs safely. By texture: {texture}. "
        f"By teeth: {doubtful}",
        doubtful.pictures or unplaced.pictures,
        doubtful.artifacts,
    )
