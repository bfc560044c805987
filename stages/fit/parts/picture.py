"""What lies between the Gaussians and a photograph: the background, and the camera's exposure."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from stages.fit.parts.base import Floats, Part, Step
from stages.fit.settings import AUTO, AutoColour, PartSettings, Positive, Weight, automatic

if TYPE_CHECKING:
    from stages.fit.trainer import Trainer


class Background(
    Part, switch="", absent={"background": (0.0, 0.0, 0.0)},
    kept=("colour.values", "colour.moments", "colour.steps"),
):  # fmt: skip
    """What no Gaussian stands before still has a colour: a dark throat, a cheek out of focus.

    Where part of the photographs is masked out, nobody knows what is behind, and it stays black.

    Attributes:
        colour: of the background, and its optimiser.
    """

    class Settings(PartSettings):
        background: AutoColour = automatic(
            "found by the fit; black where photographs are partly masked out", ge=None
        )
        """colour behind everything, sRGB 0..1"""
        background_lr: Weight = 1e-2
        """learning rate of that colour"""

    def __init__(self, fit: Trainer) -> None:
        from stages.fit.numerics import background

        given: Any = fit.settings.background
        free = given == AUTO
        whole = all(bool(view[min(view)].colour.mask.all()) for view in fit.targets)
        # a view that is still to be placed must not find what is missing painted behind
        learned = free and whole and not fit.settings.progressive
        values: Sequence[float] = (0.0, 0.0, 0.0) if free else given
        self.colour = background.Background(values, learned, fit.settings.background_lr)

    def show(self, view: int | None, image: Floats, transmittance: Floats) -> Floats:
        return self.colour.behind(image, transmittance)

    def compare(self, fit: Trainer, step: Step) -> None:
        self.colour.step(step.d_planes[:3], step.rendering.transmittance, step.d_transmittance)


class Exposure(Part, switch="exposure", on=True, off=False, kept=("values", "moments")):
    """A gain and a bias per view and channel, so that exposure does not become geometry.

    Adam on them; their means over the views stay 1 and 0.

    Attributes:
        values: [V, 2, 3] gain and bias.
        moments: [2, V, 2, 3].
        before: [3, H, W] the image last shown, as the scene has it.
    """

    class Settings(PartSettings):
        exposure: bool = False
        """fit a gain and a bias per view and channel, for cameras that change exposure"""
        exposure_lr: Positive = 1e-3
        """learning rate of exposure"""

    def __init__(self, fit: Trainer) -> None:
        super().__init__(fit)
        self.values = np.tile(np.array([[1.0], [0.0]]), (len(fit.targets), 1, 3))
        self.moments = np.zeros((2, *self.values.shape))
        self.before: Floats = np.empty((3, 0, 0), np.float32)

    def show(self, view: int | None, image: Floats, transmittance: Floats) -> Floats:
        if view is None:
            return image
        self.before = image
        gain, bias = self.values[view].astype(np.float32)
        return np.asarray(image * gain[:, None, None] + bias[:, None, None], np.float32)

    def compare(self, fit: Trainer, step: Step) -> None:
        # the same number of steps for every view, to within one
        steps = 1 + (fit.iteration - 1) // len(self.values)
        d_image = step.d_planes[:3]
        gain = self.values[step.view, 0].astype(np.float32)
        by_gain = (d_image * self.before).sum((1, 2), dtype=np.float64)
        gradient = np.stack([by_gain, d_image.sum((1, 2), dtype=np.float64)])
        first, second = self.moments[:, step.view]
        first[:] = 0.9 * first + 0.1 * gradient
        second[:] = 0.999 * second + 0.001 * gradient**2
        mean, spread = first / (1 - 0.9**steps), np.sqrt(second / (1 - 0.999**steps))
        self.values[step.view] -= self.settings.exposure_lr * mean / (spread + 1e-15)
        # a gain common to all views is the scene's brightness
        self.values[:, 0] /= self.values[:, 0].mean(0)
        self.values[:, 1] -= self.values[:, 1].mean(0)
        d_image *= gain[:, None, None]
