"""One point, so that the kernel of the evaluation is compiled."""

from __future__ import annotations

import numpy as np

from pipeline.artifacts.cameras import Camera
from stages.splatting.support import SeenSurface, supporting_views


def support() -> None:
    """What a run with default settings needs."""
    camera = Camera("000", 8, 8, 8, 8, 4, 4, np.eye(4))
    supporting_views(np.ones((1, 3)), [SeenSurface(camera, np.ones((8, 8), np.float32))], 0.1)
