"""Adam (Kingma & Ba 2015) on a packed matrix with a learning rate per column."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from stages.splatting.kernels.adam import adam_step
from stages.splatting.threads import KERNELS

Floats = npt.NDArray[np.float32]
F = np.float32
#: How fast the moments forget, and what keeps a step finite.
BETA1, BETA2, EPSILON = 0.9, 0.999, 1e-15


class Adam:
    """Adam's state for a packed matrix whose rows come and go.

    Attributes:
        first, second: [N, D] float32 moments.
        steps: steps taken.
    """

    def __init__(self, shape: tuple[int, int]) -> None:
        self.first: Floats = np.zeros(shape, np.float32)
        self.second: Floats = np.zeros(shape, np.float32)
        self.steps = 0

    def step(self, parameters: Floats, gradient: Floats, rates: Floats) -> None:
        """Move `parameters` in place."""
        self.steps += 1
        corrections = (F(1 / (1 - BETA1**self.steps)), F(1 / (1 - BETA2**self.steps)))
        with KERNELS:
            adam_step(
                parameters, gradient, self.first, self.second, rates, *corrections,
                F(BETA1), F(BETA2), F(EPSILON),
            )  # fmt: skip

    def select(self, source: npt.NDArray[np.int64], fresh: npt.NDArray[np.bool_]) -> None:
        """Rows follow `source` [N']; where `fresh` [N'] they start from zero."""
        self.first = np.where(fresh[:, None], F(0), self.first[source])
        self.second = np.where(fresh[:, None], F(0), self.second[source])

    def resize(self, columns: int) -> None:
        """Drop the last columns, or add some; those start from zero."""
        more = max(0, columns - self.first.shape[1])
        self.first, self.second = (
            np.pad(moment[:, :columns], ((0, 0), (0, more))) for moment in (self.first, self.second)
        )
