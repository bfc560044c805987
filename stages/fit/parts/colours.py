"""Colours that come nearest to the photographs, solved for where Gaussians lie at the end.

With everything else as it is, an image is a linear function of the Gaussians' colours, and steps by
gradients alone are slow at what is fine: many small Gaussians that overlap. A few steps of
conjugate gradients (Hestenes and Stiefel 1952) on the normal equations of the squared error over
all photographs do what hundreds of Adam's would. With a light it is albedos that are solved for, by
the slope of what they look like (Gauss-Newton). Harmonics above the constant stay.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from stages.fit import numerics
from stages.fit.arrays import Floats
from stages.fit.parts.base import Part
from stages.fit.parts.camera import Exposure
from stages.fit.parts.light import Light
from stages.fit.settings import PartSettings, Positive, Whole

if TYPE_CHECKING:
    from stages.fit.trainer import Trainer
    from stages.splatting.rasterizer import Rendering, Viewpoint


#: Nearest Gaussians whose colours say what a colour may be.
NEIGHBOURS = 8
#: Holds colours where they are: as if this many pixels of each view showed them so.
DAMPING = 0.01
#: Colours stay this near to the range of those that the neighbours had. Damped so little, what
#: photographs hardly show would else get loud ones that none has, and other viewpoints do show.
REACH = 0.1


class Colours(Part, switch="colour_steps", on=4, off=0):
    """What is left of the error, as far as colours can mend it."""

    class Settings(PartSettings):
        colour_steps: Whole = 4
        """steps of conjugate gradients that solve for the colours at the end; 0: none"""
        # on photographs with noise of .06, albedos were else off by .053, not by .027 as without
        colour_spread: Positive = 0.055
        """how far they may be expected to move (standard deviation): noise of the photographs,
        against this and squared, is added to the damping"""

    def end(self, fit: Trainer) -> None:
        from stages.splatting.kernels.features import C0
        from stages.splatting.kernels.projection import HARMONICS

        s, light = self.settings, fit.find(Light)
        looks, rest = [], []
        wanted = np.zeros((len(fit.packed), 3), np.float32)
        for view, target in enumerate(fit.targets):
            rendering, error = fit.missing(view)
            mask = target[1].colour.mask
            look = _Look(fit.viewpoint(view, target[1]), slope_of(fit, view), mask)
            wanted += look.back(rendering, error)
            looks.append(look)
            rest.append(np.abs(error[:, mask > 0]).ravel())

        def normal(colours: Floats) -> Floats:
            total = np.zeros_like(colours)
            for look in looks:
                drawn = fit.draw(look.viewpoint, colours * look.slope)
                total += look.back(drawn, drawn.planes)
            return total

        noise = numerics.colours.deviation(rest)
        damping = (DAMPING + (noise / s.colour_spread) ** 2) * len(looks)
        move = numerics.colours.solved(normal, wanted, damping, s.colour_steps)
        constant = fit.packed[:, HARMONICS : HARMONICS + 3]
        colours = constant * C0 if light is None else light.material[:, :3]
        move = numerics.colours.bounded(
            move, colours, fit.packed[:, :3], NEIGHBOURS, REACH
        )  # fmt: skip
        if light is None:
            constant += move / C0
        else:
            light.brighten(move)


@dataclass(frozen=True)
class _Look:
    """How a view sees colours.

    Attributes:
        viewpoint: its camera.
        slope: [N or 1, 3] of what Gaussians look like there, by the colours that are solved for.
        mask: [H, W], 1 where the photograph may be used.
    """

    viewpoint: Viewpoint
    slope: Floats
    mask: Floats

    def back(self, rendering: Rendering, image: Floats) -> Floats:
        """[N, 3] sums of an image's pixels, weighted by what each Gaussian adds to them."""
        masked = np.ascontiguousarray(image * self.mask)
        gradients = rendering.backward(masked, np.zeros_like(rendering.transmittance))
        return np.asarray(gradients.features[:, :3] * self.slope)


def slope_of(fit: Trainer, view: int) -> Floats:
    """[N or 1, 3] how what Gaussians look like in a photograph changes with their own colour."""
    light, exposure = fit.find(Light), fit.find(Exposure)
    slope = np.ones((1, 3), np.float32)
    if light is not None:
        slope = light.by_albedo(fit.packed, fit.viewpoint(view, fit.targets[view][1]))
    if exposure is not None:
        slope = slope * exposure.values[view, 0].astype(np.float32)
    return slope
