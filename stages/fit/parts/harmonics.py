"""How colours turn with the view spreads to where no photograph tells it."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from stages.fit import numerics
from stages.fit.parts.base import Part
from stages.fit.parts.density import contribution
from stages.fit.settings import AutoFloat, PartSettings, automatic

if TYPE_CHECKING:
    from stages.fit.trainer import Trainer

#: Gaussians beside each, what a pixel counts against one of them, and steps of the solver. Twelve
#: patients, each photograph predicted from the other two: 19.34 dB without the part, 19.61 so (se
#: of the gain .07); 40 steps 19.62, then 6 neighbours 19.59, a firmness of 1 19.63.
NEIGHBOURS, FIRMNESS, STEPS = 12, 10.0, 15


class Harmonics(Part, switch="harmonics_at", on=0.3, off=0.0):
    """Once, while Gaussians are few; the steps after it bring back what photographs lost by it."""

    class Settings(PartSettings):
        harmonics_at: AutoFloat = automatic({3: 0.0}, held=0.3, le=1)
        """share of the iterations after which harmonics follow their neighbours' where no
        photograph tells them; 0: never. Half of the iterations gain less (.21 dB, not .27)"""

    @classmethod
    def of(cls, fit: Trainer) -> Part | None:
        return None if fit.lit else super().of(fit)

    def begin(self, fit: Trainer) -> None:
        if fit.iteration == round(self.settings.harmonics_at * fit.iterations):
            self._spread(fit)

    def _spread(self, fit: Trainer) -> None:
        from stages.splatting.harmonics import seen_from
        from stages.splatting.kernels.projection import HARMONICS

        packed = fit.packed
        number, terms = len(packed), (packed.shape[1] - HARMONICS) // 3
        if number < 2 or terms < 2:
            return
        factor = fit.reduction(fit.iteration)
        basis, pixels = [], []
        for view, target in enumerate(fit.targets):
            mask = target[factor].colour.mask
            pixels.append(contribution(fit.render(view, factor), mask, mask)[1])
            centre = fit.viewpoint(view, target[factor]).centre
            basis.append(seen_from(centre, packed[:, :3])[:, :terms])
        near = numerics.total_variation.connected(packed[:, :3], NEIGHBOURS)
        found = numerics.harmonics.spread(
            packed[:, HARMONICS:].reshape(number, terms, 3), np.array(basis), np.array(pixels),
            *near, FIRMNESS, STEPS,
        )  # fmt: skip
        packed[:, HARMONICS:] = found.reshape(number, -1)
