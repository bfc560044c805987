"""A tiny depth map of points, so that its kernel is compiled."""

from __future__ import annotations

import numpy as np

from pipeline.artifacts.cameras import Camera
from stages.flow.geometry import splat_depth

HEIGHT, WIDTH = 24, 32


def splatting() -> None:
    """What a run with default settings needs."""
    camera = Camera("000", WIDTH, HEIGHT, WIDTH, WIDTH, WIDTH / 2, HEIGHT / 2, np.eye(4))
    splat_depth(np.array([[0.0, 0.0, 2.0]]), np.array([0.1]), camera)
