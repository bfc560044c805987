"""Fusion of two tiny depth maps, so that its kernel is compiled."""

from __future__ import annotations

import numpy as np

from pipeline.artifacts.cameras import Camera
from stages.align.fusion import FusionOptions, fuse

HEIGHT, WIDTH = 24, 32


def fusion() -> None:
    """What a run with default settings needs."""
    camera = Camera("000", WIDTH, HEIGHT, WIDTH, WIDTH, WIDTH / 2, HEIGHT / 2, np.eye(4))
    depth = np.ones((HEIGHT, WIDTH), np.float32)
    fuse([depth] * 2, [2 * depth] * 2, [np.dstack([depth] * 3)] * 2, [camera] * 2, FusionOptions())
