"""Matching and dense stereo of almost nothing, so that their kernels are compiled."""

from __future__ import annotations

import numpy as np

from pipeline.kernels import kernel_threads
from stages.init.sfm.matching.features import Features
from stages.init.sfm.matching.match import match_features
from stages.stereo.aggregate import aggregate, decide
from stages.stereo.consistency import check
from stages.stereo.fill import complete
from stages.stereo.sweep import cost_volume

HEIGHT, WIDTH, VIEWS = 24, 32, 2


def everything() -> None:
    """What a run with default settings needs."""
    random = np.random.default_rng(0)
    features = Features(
        random.uniform(0, 30, (20, 2)), random.uniform(0, 99, (20, 128)).astype(np.float32),
        np.ones(20, np.float32), np.ones(20, np.float32), np.arange(20),
    )  # fmt: skip
    match_features(features, features, ratio=0.8, distinct_radius=8.0)
    gray = random.uniform(0, 1, (HEIGHT, WIDTH)).astype(np.float32)
    known, even = np.ones((HEIGHT, WIDTH), bool), np.ones((HEIGHT, WIDTH), np.float32)
    still = np.tile(np.eye(3, dtype=np.float32).ravel(), (4, 1, 1))
    depths = np.ones((VIEWS, HEIGHT, WIDTH), np.float32)
    camera = [WIDTH, WIDTH, WIDTH / 2, HEIGHT / 2, WIDTH, HEIGHT, *np.eye(3).ravel(), 0.0, 0.0, 0.0]
    with kernel_threads(1):
        volume = cost_volume(
            gray, known, gray[None], np.array([[HEIGHT, WIDTH]], np.float32), still, window=5
        )
        decide(aggregate(volume, even, 0.1), volume)
        check(
            0, depths, depths, np.array([camera] * VIEWS, np.float64), (HEIGHT, WIDTH),
            0.01, 1.0, 0.02, np.array([1]),
        )  # fmt: skip
        complete(even, even, gray, 1.0)
