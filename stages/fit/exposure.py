"""A gain and a bias per view and channel, so that a camera's exposure does not become geometry."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
Floats = npt.NDArray[np.float32]


class Exposure:
    """Adam on gains and biases; their means over the views stay 1 and 0.

    Attributes:
        values: [V, 2, 3] gain and bias.
        moments: [2, V, 2, 3].
    """

    def __init__(self, views: int) -> None:
        self.values = np.tile(np.array([[1.0], [0.0]]), (views, 1, 3))
        self.moments = np.zeros((2, *self.values.shape))

    def apply(self, view: int, image: Floats) -> Floats:
        """[3, H, W] as that view's camera exposed it."""
        gain, bias = self.values[view].astype(np.float32)
        return np.asarray(image * gain[:, None, None] + bias[:, None, None], np.float32)

    def step(self, view: int, image: Floats, d_image: Floats, rate: float, steps: int) -> Floats:
        """Move a view's gain and bias.

        Args:
            view: which.
            image: [3, H, W] before `apply`; d_image: gradient after it.
            rate: of learning.
            steps: how often this view had its turn, to within one.

        Returns:
            Gradient of `image`.
        """
        gain = self.values[view, 0].astype(np.float32)
        by_gain = (d_image * image).sum((1, 2), dtype=np.float64)
        gradient = np.stack([by_gain, d_image.sum((1, 2), dtype=np.float64)])
        first, second = self.moments[:, view]
        first[:] = 0.9 * first + 0.1 * gradient
        second[:] = 0.999 * second + 0.001 * gradient**2
        mean, spread = first / (1 - 0.9**steps), np.sqrt(second / (1 - 0.999**steps))
        self.values[view] -= rate * mean / (spread + 1e-15)
        # a gain common to all views is the scene's brightness
        self.values[:, 0] /= self.values[:, 0].mean(0)
        self.values[:, 1] -= self.values[:, 1].mean(0)
        return np.asarray(d_image * gain[:, None, None], np.float32)
