"""What is kept of a surface beyond the gum that the reader knows."""

from __future__ import annotations

import numpy as np

from pipeline.artifacts.confidence import FILLED, MEASURED
from stages.init.dental.solution import ArchFit, PlacedView
from stages.init.dental.surface.beyond import without_guesses_beyond
from stages.init.dental.surface.chart.looks import SurfaceView
from stages.init.dental.surface.dense import ArchSurface

SIZE = (20, 40)  # height, width
FOCAL, AWAY = 20.0, 10.0


def wall(measured_from: float) -> tuple[ArchSurface, ArchFit]:
    """A wall before a camera, measured to the right of a column of its photograph, a guess left.

    A point lies at the middle of each pixel.
    """
    height, width = SIZE
    row, column = np.mgrid[:height, :width] + 0.5
    x = (column - width / 2) / FOCAL * AWAY
    y = (row - height / 2) / FOCAL * AWAY
    positions = np.stack([x, y, np.zeros_like(x)], axis=-1).reshape(-1, 3).astype(np.float32)
    confidence = np.where(column > measured_from, MEASURED, FILLED).astype(np.float32)
    number = np.arange(height * width).reshape(SIZE)
    faces = np.stack([number[:-1, :-1], number[:-1, 1:], number[1:, :-1]], axis=-1).reshape(-1, 3)
    normals = np.broadcast_to(np.float32([0, 0, -1]), positions.shape).copy()
    view = SurfaceView(
        np.full(SIZE, AWAY, np.float32), normals.reshape(*SIZE, 3), confidence.copy()
    )
    surface = ArchSurface(
        views=(view, None), positions=positions, colors=np.ones_like(positions), normals=normals,
        confidence=confidence.ravel(), tooth=np.zeros(len(positions), bool),
        faces=faces.astype(np.int32), gains=np.ones((2, 3)),
    )  # fmt: skip
    pose = np.eye(4)
    pose[2, 3] = AWAY
    fit = ArchFit((PlacedView(pose, FOCAL, "frontal", (), (), 0.5), None), {}, {}, 0.0)
    return surface, fit


def test_beyond_the_jaws_only_what_was_measured_stays() -> None:
    surface, fit = wall(measured_from=30)
    jaw = np.zeros(SIZE, bool)
    jaw[5:15, 10:20] = True
    expected = jaw | (surface.views[0].confidence >= MEASURED)  # type: ignore[union-attr]
    kept = without_guesses_beyond(surface, fit, [jaw, None])
    (view, absent) = kept.views
    assert view is not None and absent is None
    np.testing.assert_array_equal(view.depth, np.where(expected, AWAY, 0))
    np.testing.assert_array_equal(view.normal[..., 2], np.where(expected, -1, 0))
    np.testing.assert_array_equal(view.confidence[~expected], 1)
    np.testing.assert_array_equal(kept.positions, surface.positions[expected.ravel()])
    for part in (kept.colors, kept.normals, kept.confidence, kept.tooth):
        assert len(part) == expected.sum()
    corners = surface.positions[surface.faces[expected.ravel()[surface.faces].all(axis=1)]]
    np.testing.assert_array_equal(kept.positions[kept.faces], corners)


def test_on_the_jaws_guesses_stay() -> None:
    surface, fit = wall(measured_from=100)
    kept = without_guesses_beyond(surface, fit, [np.ones(SIZE, bool), None])
    np.testing.assert_array_equal(kept.positions, surface.positions)
    np.testing.assert_array_equal(kept.faces, surface.faces)


def test_what_no_photograph_shows_on_the_jaws_is_gone_if_it_is_a_guess() -> None:
    surface, fit = wall(measured_from=100)
    kept = without_guesses_beyond(surface, fit, [np.zeros(SIZE, bool), None])
    assert len(kept.positions) == len(kept.faces) == 0
