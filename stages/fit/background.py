"""The colour behind everything, found with the Gaussians."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
from numba import prange

from pipeline.kernels import kernel
from stages.fit.settings import FitSettings
from stages.fit.targets import Target
from stages.splatting.threads import KERNELS

Array = npt.NDArray[np.float64]
Floats = npt.NDArray[np.float32]


@kernel(parallel=True)
def _lay_over(  # type: ignore[no-untyped-def]
    image: Floats, transmittance: Floats, colour: Floats, result: Floats
):
    channels, height, width = image.shape
    for row in prange(channels * height):
        channel, y = row // height, row % height
        behind = colour[channel]
        for x in range(width):
            result[channel, y, x] = image[channel, y, x] + transmittance[y, x] * behind


@kernel(parallel=True)
def _pull_back(  # type: ignore[no-untyped-def]
    d_image: Floats, transmittance: Floats, colour: Floats, d_transmittance: Floats, sums: Array
):
    """Gradients of `_lay_over`: of the transmittance (added to), of the colour in `sums` [H, 3]."""
    height, width = transmittance.shape
    for y in prange(height):
        red, green, blue = 0.0, 0.0, 0.0
        for x in range(width):
            left = transmittance[y, x]
            r, g, b = d_image[0, y, x], d_image[1, y, x], d_image[2, y, x]
            red += r * left
            green += g * left
            blue += b * left
            d_transmittance[y, x] += r * colour[0] + g * colour[1] + b * colour[2]
        sums[y, 0] = red
        sums[y, 1] = green
        sums[y, 2] = blue


class Background:
    """One sRGB colour, and Adam on it.

    What no Gaussian stands before still has a colour: a dark throat, a cheek out of focus. Where
    part of the photographs is masked out, nobody knows what is behind, and it stays black.

    Attributes:
        values: [3] float64 in 0..1.
        learned: whether it is found by the fit, or given.
    """

    def __init__(self, settings: FitSettings, targets: Sequence[dict[int, Target]]) -> None:
        given = settings.background
        whole = all(bool(view[min(view)].colour.mask.all()) for view in targets)
        # a view that is still to be placed must not find what is missing painted behind
        self.learned = given == "auto" and whole and not settings.progressive
        self.values = np.zeros(3) if given == "auto" else np.array(given, np.float64)
        self.rate = settings.background_lr
        self.moments = np.zeros((2, 3))
        self.steps = 0

    def behind(self, image: Floats, transmittance: Floats) -> Floats:
        """[3, H, W] an image laid over the background through what it lets pass, [H, W]."""
        if not self.values.any():
            return image
        result = np.empty(image.shape, np.float32)
        with KERNELS:
            _lay_over(image, transmittance, self.values.astype(np.float32), result)
        return result

    def step(
        self, d_image: Floats, transmittance: Floats, d_transmittance: Floats | None = None
    ) -> None:
        """Move the colour against the gradient [3, H, W] of an image laid over it.

        What that gradient says of the transmittance is added to `d_transmittance` [H, W].
        """
        if not (self.learned or self.values.any()):
            return
        sums = np.empty((len(transmittance), 3))
        if d_transmittance is None:
            d_transmittance = np.zeros_like(transmittance)
        with KERNELS:
            _pull_back(
                d_image, transmittance, self.values.astype(np.float32), d_transmittance, sums
            )
        if not self.learned:
            return
        gradient = sums.sum(0)
        self.steps += 1
        self.moments[0] = 0.9 * self.moments[0] + 0.1 * gradient
        self.moments[1] = 0.99 * self.moments[1] + 0.01 * gradient**2
        mean = self.moments[0] / (1 - 0.9**self.steps)
        spread = np.sqrt(self.moments[1] / (1 - 0.99**self.steps))
        self.values = np.clip(self.values - self.rate * mean / (spread + 1e-15), 0, 1)

    def state(self) -> dict[str, Any]:
        """For a checkpoint."""
        return {
            "values": self.values.tolist(), "moments": self.moments.tolist(), "steps": self.steps
        }  # fmt: skip

    def restore(self, state: dict[str, Any]) -> None:
        """Take up what `state` gave."""
        self.values, self.moments = np.array(state["values"]), np.array(state["moments"])
        self.steps = state["steps"]
