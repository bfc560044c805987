"""Adam (Kingma & Ba 2015) on a few numbers; on Gaussians it is `stages.splatting.adam`."""

from __future__ import annotations

from typing import Any

import numpy as np


def adam_step(
    gradient: Any, first: Any, second: Any, steps: int, rate: Any, beta2: float = 0.999
) -> tuple[Any, Any, Any]:
    """The step against a gradient, to be subtracted, and the moments after it; beta1 is .9.

    Args:
        gradient, first, second: arrays of one shape, or floats.
        steps: how many there are, this one counted.
        rate: of learning, one or of that shape.
    """
    first = 0.9 * first + 0.1 * gradient
    second = beta2 * second + round(1 - beta2, 6) * gradient**2
    spread = np.sqrt(second / (1 - beta2**steps))
    return rate * (first / (1 - 0.9**steps)) / (spread + 1e-15), first, second
