"""Colours towards views from which no photograph shows them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from stages.fit import numerics
from stages.fit.parts.base import Part
from stages.fit.parts.density import contribution
from stages.fit.parts.surface import Surface
from stages.fit.settings import AutoBool, AutoFloat, PartSettings, automatic

if TYPE_CHECKING:
    from stages.fit.arrays import Array, Floats
    from stages.fit.trainer import Trainer

#: Gaussians beside each, what a pixel counts against one of them, and steps of the solver. Twelve
#: patients, each photograph predicted from the other two: 19.34 dB without the part, 19.61 so (se
#: of the gain .07); 40 steps 19.62, then 6 neighbours 19.59, a firmness of 1 19.63.
NEIGHBOURS, FIRMNESS, STEPS = 12, 10.0, 15
#: a photograph that shows so many pixels of a Gaussian says half of what it looks like there
HARDLY = 0.02


@dataclass(frozen=True)
class _Looks:
    """How the photographs' views see Gaussians.

    Attributes:
        harmonics: [N, K, 3] of the Gaussians.
        basis: [V, N, K] what each of them adds to what each view sees.
        pixels: [V, N] of each view that a Gaussian colours.
    """

    harmonics: Floats
    basis: Array
    pixels: Array

    @classmethod
    def of(cls, fit: Trainer, factor: int) -> _Looks:
        """With images reduced by a factor."""
        from stages.splatting.harmonics import seen_from
        from stages.splatting.kernels.projection import HARMONICS

        packed, basis, pixels = fit.packed, [], []
        number, terms = len(packed), (packed.shape[1] - HARMONICS) // 3
        for view, target in enumerate(fit.targets):
            mask = target[factor].colour.mask
            pixels.append(contribution(fit.render(view, factor), mask, mask)[1])
            centre = fit.viewpoint(view, target[factor]).centre
            basis.append(seen_from(centre, packed[:, :3])[:, :terms])
        harmonics = packed[:, HARMONICS:].reshape(number, terms, 3)
        return cls(harmonics, np.array(basis), np.array(pixels, np.float64))

    @property
    def enough(self) -> bool:
        """Whether there is something to turn, and something to turn by."""
        views, number, terms = self.basis.shape
        return min(views, number, terms) > 1


def _turn(fit: Trainer, harmonics: Floats) -> None:
    from stages.splatting.kernels.projection import HARMONICS

    fit.packed[:, HARMONICS:] = harmonics.reshape(len(harmonics), -1)


class Harmonics(Part, switch="harmonics_at", on=0.3, off=0.0):
    """How colours turn with the view, where no photograph tells it: as beside it.

    Once, while Gaussians are few; the steps after it bring back what photographs lost by it. It
    helps views from elsewhere, not the borders of photographs: those are for `Photometry`.
    """

    class Settings(PartSettings):
        harmonics_at: AutoFloat = automatic({3: 0.0}, held=0.3, le=1)
        """share of the iterations (before an extension) after which harmonics follow their
        neighbours' where no photograph tells them; 0: never. Half of the iterations gain less
        (.21 dB, not .27)"""

    @classmethod
    def of(cls, fit: Trainer) -> Part | None:
        return None if fit.lit else super().of(fit)

    def begin(self, fit: Trainer) -> None:
        # once, however long the fit becomes, and before the last iteration
        iterations = self.settings.iterations
        if fit.iteration == min(round(self.settings.harmonics_at * iterations), iterations - 1):
            self._spread(fit)

    def _spread(self, fit: Trainer) -> None:
        looks = _Looks.of(fit, fit.reduction(fit.iteration))
        if not looks.enough:
            return
        near = numerics.total_variation.connected(fit.packed[:, :3], NEIGHBOURS)
        found = numerics.harmonics.spread(
            looks.harmonics, looks.basis, looks.pixels, *near, FIRMNESS, STEPS
        )
        _turn(fit, found)


class Photometry(Part, switch="photometry", on=True, off=False, needs=("cloud",)):
    """What a photograph does not show looks from there as that photograph would show it.

    Exposures, and the light that comes with the camera, differ: without it the border of what a
    photograph shows is an edge across teeth, where the scene is looked at from there. Photographs
    keep their colours.
    """

    class Settings(PartSettings):
        photometry: AutoBool = automatic({3: False}, held=True)
        """where a surface is held and there is no light, at the end: what a photograph does not
        show gets the colours, from where it was taken, that it would have there by its exposure
        and its light"""

    @classmethod
    def of(cls, fit: Trainer) -> Part | None:
        return super().of(fit) if fit.settings.hold_surface and not fit.lit else None

    def end(self, fit: Trainer) -> None:
        from stages.splatting.harmonics import OFFSET

        looks, surface = _Looks.of(fit, 1), fit.find(Surface)
        assert surface is not None
        shown = looks.pixels.sum(0) > numerics.photometry.LEAST
        if not looks.enough or not shown.any():
            return
        positions = fit.packed[:, :3].astype(np.float64)
        of = [
            numerics.photometry.features(
                positions, surface.anchor[:, 3:6].astype(np.float64), fit.viewpoint(view, target[1])
            )
            for view, target in enumerate(fit.targets)
        ]
        colours = OFFSET + np.einsum("vnk,nkc->vnc", looks.basis, looks.harmonics)
        light = numerics.photometry.light_of(colours)
        beyond = numerics.photometry.expected(light, np.array(of), looks.pixels)
        sure = looks.pixels / (looks.pixels + HARDLY)
        wanted = beyond + sure[..., None] * (colours - beyond)
        found = numerics.harmonics.reaching(looks.harmonics, looks.basis, wanted - OFFSET, sure)
        _turn(fit, np.where(shown[:, None, None], found, looks.harmonics))
