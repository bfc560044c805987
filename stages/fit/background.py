"""The colour behind everything, found with the Gaussians."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from stages.fit.settings import FitSettings
from stages.fit.targets import Target

Array = npt.NDArray[np.float64]
Floats = npt.NDArray[np.float32]


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

    def colour(self) -> Floats:
        """[3, 1, 1] float32, for planar images."""
        return np.asarray(self.values[:, None, None], np.float32)

    def behind(self, image: Floats, transmittance: Floats) -> Floats:
        """[3, H, W] an image laid over the background through what it lets pass, [H, W]."""
        return image + transmittance * self.colour() if self.values.any() else image

    def step(self, d_image: Floats, transmittance: Floats) -> None:
        """Move the colour against the gradient [3, H, W] of the image laid over it."""
        if not self.learned:
            return
        self.steps += 1
        gradient = (d_image * transmittance).sum((1, 2), dtype=np.float64)
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
