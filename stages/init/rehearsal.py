"""Matching, dense stereo and teeth of almost nothing, so that their kernels are compiled."""

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


def teeth() -> None:
    """A square of a chart seen twice; cameras of teeth, whose kernels are compiled on import."""
    import stages.init.dental.cameras.held
    import stages.init.dental.cameras.minimise  # noqa: F401
    from stages.init.dental.surface.chart.raster import raster_chart
    from stages.init.dental.surface.dense import ArchSurface
    from stages.init.dental.surface.photos.photo import Photo
    from stages.init.dental.surface.sweep import matching_cost
    from stages.init.dental.turned_sheet import render_turned

    plain, used = np.ones((HEIGHT, WIDTH), np.float32), np.ones((HEIGHT, WIDTH), bool)
    image = np.ones((HEIGHT, WIDTH, 3), np.float32)
    camera = np.array([*np.eye(3).ravel(), 0.0, 0.0, 50.0, WIDTH, WIDTH / 2, HEIGHT / 2])
    photos = [
        Photo(
            k, camera, (HEIGHT, WIDTH), 1.0, image, plain, plain, plain, plain, plain, plain,
            plain, plain, plain, used,
        )
        for k in range(VIEWS)
    ]  # fmt: skip
    rows, columns = np.mgrid[:HEIGHT, :WIDTH].astype(np.float32)
    points = np.stack([columns - WIDTH / 2, rows - HEIGHT / 2, 0 * rows], -1)
    normals = np.broadcast_to(np.array([0, 0, -1], np.float32), points.shape)
    with kernel_threads(1):
        raster_chart(photos[0], points, used)
        seen = np.ones((VIEWS, HEIGHT, WIDTH), bool)
        matching_cost(points, normals, np.zeros(3, np.float32), photos, seen, [[0, 1]], 2)
    corner, normal = points[:2, :2].reshape(4, 3), normals[:2, :2].reshape(4, 3)
    faces = np.array([[0, 1, 2]], np.int32)
    surface = ArchSurface(
        (), corner, 0 * corner, normal, np.ones(4, np.float32), np.ones(4, bool), faces,
        np.ones((0, 3)),
    )  # fmt: skip
    render_turned(surface, 0.0, 0.0, WIDTH, HEIGHT)


def features() -> None:
    """Features, matches and dense stereo."""
    random = np.random.default_rng(0)
    found = Features(
        random.uniform(0, 30, (20, 2)), random.uniform(0, 99, (20, 128)).astype(np.float32),
        np.ones(20, np.float32), np.ones(20, np.float32), np.arange(20),
    )  # fmt: skip
    match_features(found, found, ratio=0.8, distinct_radius=8.0)
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
