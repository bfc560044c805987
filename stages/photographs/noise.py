"""The noise of a photograph.

Immerkaer 1996, "Fast Noise Variance Estimation", by the median instead of the mean.
"""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float32]

#: takes out what is even or linear, and multiplies the deviation of noise by the norm
LAPLACE = np.array([[1, -2, 1], [-2, 4, -2], [1, -2, 1]], np.float32)
LAPLACE_NORM = 6.0
#: median of absolute values to standard deviation, for a normal distribution
MEDIAN_TO_SIGMA = 1 / 0.6745


def noise_level(grey: Floats, mask: Floats | None = None) -> float:
    """Standard deviation of a photograph's noise, by the median: texture and edges are no noise.

    Args:
        grey: [H, W], in any unit, which is the result's.
        mask: [H, W] 1 where it counts; None: everywhere.

    Returns:
        0 where nothing counts.
    """
    second = np.abs(cv2.filter2D(grey, cv2.CV_32F, LAPLACE))
    if mask is not None:
        second = second[cv2.erode(mask, np.ones((3, 3), np.uint8)) > 0]
    return float(np.median(second)) * MEDIAN_TO_SIGMA / LAPLACE_NORM if second.size else 0.0
