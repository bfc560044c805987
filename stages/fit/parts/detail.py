"""Gaussians are split where the photographs show more than they do.

A fit begins with small images and few Gaussians. Each time the images get larger, and between few
views some times more at full size, what is left of the error tells where the photographs hold
more than these Gaussians can: smooth enamel needs no more of them, bark does. So their number
follows the content, and most steps are taken with few.

Only what is fine in the error counts. What is even over several pixels is shading that the model
does not have, or a place that is off: no finer Gaussians mend that, and they would go to the
places where they gain least.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from stages.fit import numerics
from stages.fit.arrays import Array, Floats
from stages.fit.parts.base import Figures, Part
from stages.fit.parts.start import coarse_factors
from stages.fit.parts.surface import Surface
from stages.fit.settings import AutoFloat, AutoInt, PartSettings, automatic
from stages.photographs.noise import noise_level

if TYPE_CHECKING:
    from stages.fit.trainer import Trainer

#: share of the steps at full size by which Gaussians are split last: the rest lets them settle
LAST = 0.6
#: room for more, as a share of all that there may be, below which a split is not worth its time
WORTH = 0.05
#: an error counts above so many times the photograph's own noise
NOISE = 1.5
#: Gaussians are split along axes whose standard deviation is more pixels than this
SIZE = 0.5


class Detail(Part, switch="detail", on=True, off=False, kept=("added", "latest")):
    """Attributes:
    added: Gaussians, so far.
    """

    class Settings(PartSettings):
        detail: bool = True
        """split Gaussians where the photographs show more than they do, each time the images get
        larger"""
        # three photographs of a street gain 3 dB and .2 of their sharpness by it, three real ones
        # of teeth .1 of it with hardly more Gaussians; unseen views stay. Twelve views,
        # which densification serves, gain nothing
        detail_rounds: AutoInt = automatic({5: 2, 6: 0}, held=2, le=1000)
        """and so many times more at full size"""
        # more between few views gains nothing and costs time; from six on, textured scenes use it
        detail_density: AutoFloat = automatic({5: 0.3, 6: 0.6}, ge=None, gt=0)
        """there are at most so many Gaussians for each pixel of a photograph; the largest errors
        come first"""
        # between few views that are close to each other, more Gaussians for what hardly shows cost
        # unseen views .1 dB; on a held surface nothing
        detail_error: AutoFloat = automatic({3: 0.03}, held=0.01, le=1)
        """an error counts above this (of 0..1), and above the photograph's own noise"""

    def __init__(self, fit: Trainer) -> None:
        super().__init__(fit)
        self.added = 0

    def begin(self, fit: Trainer) -> None:
        if self._due(fit):
            self._split(fit, fit.reduction(fit.iteration + 1))

    def _due(self, fit: Trainer) -> bool:
        """Whether images get larger now, or it is time for a further round at full size."""
        s, now = self.settings, fit.iteration
        coarse = s.coarse_fraction * fit.iterations if coarse_factors(s) else 0.0
        step = LAST * (fit.iterations - coarse) / max(s.detail_rounds, 1)
        rounds = (round(coarse + step * (k + 1)) for k in range(s.detail_rounds))
        return now > 0 and (fit.reduction(now + 1) < fit.reduction(now) or now in rounds)

    def _split(self, fit: Trainer, factor: int) -> None:
        s: Any = self.settings
        pixels = max(target[1].width * target[1].height for target in fit.targets)
        most = int(s.detail_density * pixels)
        excess, seen = unexplained(fit, factor, NOISE, s.detail_error)
        rows = np.flatnonzero(seen >= s.final_prune_contribution)
        if most - len(rows) < WORTH * most:
            return
        if 0 < len(rows) < len(seen):
            # what hides behind the others takes time, and the places of those that show
            fit.replace(np.ascontiguousarray(fit.packed[rows]), rows, np.zeros(len(rows), bool))
            excess = excess[rows]
        axes = numerics.detail.wide_axes(fit.packed, self._pixel(fit, factor), SIZE)
        wanted = (excess > 0)[:, None]
        axes = numerics.detail.within(axes & wanted, excess, most - len(fit.packed))
        if not axes.any():
            return
        packed, source, fresh = numerics.detail.divide(fit.packed, axes)
        self.added += len(packed) - len(fit.packed)
        self.latest = fit.iteration
        fit.replace(packed, source, fresh)
        surface = fit.find(Surface)
        if surface is not None:
            surface.shrink(fresh, numerics.detail.SHRINK)

    def _pixel(self, fit: Trainer, factor: int) -> Floats:
        """[N] the size of a pixel of the nearest view at a Gaussian, in units of the frame."""
        pixel = np.full(len(fit.packed), np.inf, np.float32)
        for view, target in enumerate(fit.targets):
            viewpoint = fit.viewpoint(view, target[factor])
            depth = fit.packed[:, :3] @ viewpoint.pose[2, :3] + viewpoint.pose[2, 3]
            ahead = depth > fit.settings.near
            size = depth / np.float32(viewpoint.intrinsics[:2].max())
            pixel = np.where(ahead, np.minimum(pixel, size), pixel)
        return pixel

    def summary(self) -> Figures:
        return {"split_for_detail": self.added}


def unexplained(fit: Trainer, factor: int, times: float, least: float) -> tuple[Array, Array]:
    """[N] fine squared error beyond the photographs' noise that Gaussians colour, and their area.

    Args:
        fit: as it stands.
        factor: by which the images are reduced that are compared.
        times, least: errors count above this many standard deviations of the noise, and above this.

    Returns:
        The error: a sum over the pixels of all views, weighted by what a Gaussian contributes to
        each. And the largest area that it colours in a single view, in pixels at full size.
    """
    excess, seen = np.zeros((2, len(fit.packed)))
    for view in fit.views:
        colour = fit.targets[view][factor].colour
        rendering, error = fit.missing(view, factor)
        own = noise_level(colour.target.mean(0), colour.mask)
        noise = max(times * own, least)
        fine = numerics.detail.fine(error, colour.mask)
        planes = np.zeros_like(rendering.planes)
        planes[0] = colour.mask
        planes[1] = ((fine * fine).mean(0) - np.float32(noise * noise)) * colour.mask
        gradients = rendering.backward(planes, np.zeros_like(rendering.transmittance))
        seen = np.maximum(seen, factor * factor * gradients.features[:, 0])
        excess += gradients.features[:, 1]
    return excess, seen
