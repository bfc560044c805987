"""A scene that is far from right when the fit has come some way gets more steps, and larger ones.

Points are missing there, or in the wrong place: a lawn or a tree that stereo could not see has to
grow out of what is near. Teeth are right by then, and the rates that serve a lawn overshoot there.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from stages.fit.parts.base import Figures, Part
from stages.fit.settings import AutoFloat, Pair, PartSettings, automatic

if TYPE_CHECKING:
    from stages.fit.trainer import Trainer

#: share of the iterations after which it is decided: images are small still
DECIDED = 0.35
#: by which share more steps are taken where all is wrong: with rates twice as high, 1,166 steps in
#: place of 583 give 11 photographs of a castle 2.4 dB, .4 where a view is unseen
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
        rates of positions and colours are up to twice as high"""
        # eleven photographs of a castle have 18.6 dB by then, three of a street 20.6, six to twelve
        # of five mouths 23.6 to 34.9
        extension_psnr: Pair = (19.0, 23.0)
        """up to the first PSNR, in dB, the whole extension, from the second one on none, in
        proportion between them"""

    def __init__(self, fit: Trainer) -> None:
        super().__init__(fit)
        self.share = 0.0

    def begin(self, fit: Trainer) -> None:
        s = self.settings
        if fit.iteration != round(DECIDED * s.iterations):
            return
        self.share = 1 - float(np.interp(fit.psnr, s.extension_psnr, (0, 1)))
        fit.iterations = s.iterations + round(self.share * s.extension * s.iterations)
        fit.haste = 1 + self.share

    def summary(self) -> Figures:
        return {"extension": round(self.share, 2)}
