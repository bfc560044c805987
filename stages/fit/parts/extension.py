"""A scene that is far from right when the fit has come some way gets more steps, and larger ones.

Points are missing there, or in the wrong place: a lawn or a tree that stereo could not see has to
grow out of what is near. Teeth are right by then, and the rates that serve a lawn overshoot there.
Noise and an exposure that changes are no reason: more steps would only learn the noise by heart.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from stages.fit.arrays import Floats
from stages.fit.parts.base import Figures, Part
from stages.fit.settings import AutoFloat, Pair, PartSettings, automatic
from stages.photographs.noise import noise_level

if TYPE_CHECKING:
    from stages.fit.trainer import Trainer

#: share of the iterations after which it is decided: images are small still
DECIDED = 0.35
#: squared error below which a photograph counts as explained: 60 dB
LEAST_ERROR = 1e-6
#: by which share more steps are taken where all is wrong: with rates twice as high, 1,166 steps in
#: place of 583 give 11 photographs of a castle 2.4 dB, and .2 where a view is unseen
MORE = 1.0


class Extension(Part, switch="extension", off=0.0, kept=("share",)):
    """Attributes:
    share: of the whole extension that the fit got.
    """

    class Settings(PartSettings):
        extension: AutoFloat = automatic(
            f"{MORE} where fit.iterations is automatic and no surface is held, else 0"
        )
        """by which share of the iterations a fit is longer that is far from right by then; its
        rates of positions and harmonics are up to twice as high"""
        # eleven photographs of a castle have 18.6 dB by then, three of a street 21.8; 12 of a mouth
        # with much noise (.1) 23.6, with exposures of their own (15 %) 25.6, else 25.8 and more
        extension_psnr: Pair = (20.5, 23.5)
        """up to the first PSNR, in dB, the whole extension, from the second one on none, in
        proportion between them; without noise and differences of exposure"""

    def __init__(self, fit: Trainer) -> None:
        super().__init__(fit)
        self.share = 0.0

    def begin(self, fit: Trainer) -> None:
        s = self.settings
        if fit.iteration != round(DECIDED * s.iterations):
            return
        self.share = 1 - float(np.interp(structural_psnr(fit), s.extension_psnr, (0, 1)))
        fit.iterations = s.iterations + round(self.share * s.extension * s.iterations)
        fit.haste = 1 + self.share

    def summary(self) -> Figures:
        return {"extension": round(self.share, 2)}


def structural_psnr(fit: Trainer) -> float:
    """How well a fit explains its photographs, in dB: the mean over the views that take part.

    By what is left of them when each channel has its best gain and bias, and noise is taken off.
    """
    found = []
    for view in fit.views:
        factor = fit.reduction(fit.iteration)
        colour = fit.targets[view][factor].colour
        _, error = fit.missing(view, factor)
        inside = colour.mask > 0
        unexplained = [
            _residual(shown[inside] - rest[inside], shown[inside])
            - noise_level(shown, colour.mask) ** 2
            for shown, rest in zip(colour.target, error, strict=True)
        ]
        found.append(max(float(np.mean(unexplained)), LEAST_ERROR))
    return float(np.mean(-10 * np.log10(found)))


def _residual(drawn: Floats, shown: Floats) -> float:
    """Mean squared error of values [P] by others with their best gain and bias."""
    if len(shown) < 2:
        return 0.0
    across = np.cov(np.clip(drawn, 0, 1), shown, bias=True)
    return float(across[1, 1] - across[0, 1] ** 2 / max(float(across[0, 0]), 1e-12))
