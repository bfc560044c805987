"""When depth is completed by the shape of teeth, and what of it is used."""

import numpy as np
import pytest

from pipeline.artifacts.cameras import Camera
from pipeline.artifacts.confidence import FILLED
from pipeline.errors import ReconstructionError, RequestError
from pipeline.stage import LocalContext
from stages.init import densify
from stages.init.config import InitConfig
from stages.init.dental.reconstruct import PlacedTeeth
from stages.init.placement import Placement
from stages.stereo.options import DenseView
from tests.stages.init_teeth_case import (
    FOCAL,
    SIZE,
    found_teeth,
    photographs,
    read_teeth,
    side_pose,
)

UNIT = 0.02  # of the cameras' world per mm of the arch


def context(tmp_path, teeth=None, **settings):
    inputs = {"views": photographs()} | ({"teeth": teeth} if teeth else {})
    return LocalContext(InitConfig(**settings), tmp_path, inputs=inputs, threads=1)


@pytest.mark.parametrize(
    ("count", "teeth", "settings", "expected"),
    [
        (3, read_teeth(), {}, True),
        (3, None, {}, False),
        (4, read_teeth(4), {}, False),
        (2, read_teeth(2), {}, False),
        (3, read_teeth(2), {}, False),
        (3, read_teeth(3, aside=(1,)), {}, False),
        (3, read_teeth(), {"dental": {"complete_depth": False}}, False),
    ],
    ids=["three", "no teeth", "four", "two", "one without", "set aside", "switched off"],
)
def test_three_photographs_of_teeth_are_completed(tmp_path, count, teeth, settings, expected):
    asked = context(tmp_path, teeth, **settings)
    assert densify.few_of_teeth(asked, photographs(count)) is expected


@pytest.mark.parametrize("method", ["sgbm", "sweep"])
def test_the_quick_preview_says_what_it_can_not_see(tmp_path, method):
    """A camera that moves ahead leaves nothing to rectify."""
    asked = context(tmp_path, dense={"method": method})
    height, width = SIZE
    ahead = np.eye(4)
    ahead[2, 3] = -0.5
    poses = [
        Camera(f"{k:03d}", width, height, FOCAL, FOCAL, width / 2, height / 2, pose)
        for k, pose in enumerate((np.eye(4), ahead))
    ]
    corner = np.array([0.5 * width / FOCAL, 0.5 * height / FOCAL, 1.0])
    points = np.random.default_rng(0).uniform(-0.7, 0.7, (60, 3)) * corner * 3 + (0, 0, 4)
    views = photographs(2)
    seen = (np.arange(60),) * 2
    densify.densify(asked, views, Placement(views.views, tuple(poses), points, seen, {(0, 1): 60}))
    assert any("sparse reconstruction are added" in text for text in asked.warnings)
    assert any("plane sweep" in text for text in asked.warnings) is (method == "sgbm")


def cameras():
    """Those of the arch frame, in a world of another unit."""
    placed = []
    for k, yaw in enumerate((-40, 0, 40)):
        pose = side_pose(yaw)
        pose[:3, 3] *= UNIT
        placed.append(
            Camera(f"{k:03d}", SIZE[1], SIZE[0], FOCAL, FOCAL, SIZE[1] / 2, SIZE[0] / 2, pose)
        )
    return placed


def stereo(known):
    """Depth of a wall where `known` [H, W]."""
    nothing = np.zeros(SIZE, np.float32)
    depth = np.where(known, np.float32(3), nothing)
    sure = np.where(known, np.float32(7), np.float32(1))
    return [DenseView(depth, sure, np.zeros((*SIZE, 3), np.float32), nothing) for _ in range(3)]


def ball_before_the_cameras(monkeypatch):
    """Teeth whose surface is a ball, whatever is measured; what was measured."""
    found, asked = found_teeth(), {}

    def place(views, *_, **__):
        small = type("Small", (), {
            "views": views, "dentitions": found.dentitions, "fit": found.fit,
        })  # fmt: skip
        return PlacedTeeth(views, found.dentitions, found.fit, small, [])

    def surface(start, depths, *_):
        asked["depths"] = depths
        return found.surface.views

    monkeypatch.setattr("stages.init.dental.place_known.place_teeth", place)
    monkeypatch.setattr(densify, "started_surface", lambda *_: None)
    monkeypatch.setattr(densify, "completed_surface", surface)
    return found, asked


def test_what_is_measured_stays_and_crowns_fill_the_rest(tmp_path, monkeypatch):
    found, asked = ball_before_the_cameras(monkeypatch)
    known = np.zeros(SIZE, bool)
    known[:, :40] = True
    dense = stereo(known)
    result, completed = densify.completed_by_teeth(
        context(tmp_path, read_teeth()), photographs(), cameras(), lambda: dense
    )
    assert completed
    for there, before, ball in zip(result, dense, found.surface.views, strict=True):
        np.testing.assert_array_equal(there.depth[known], before.depth[known])
        np.testing.assert_array_equal(there.confidence[known], 7)
        rest = ~known
        np.testing.assert_allclose(there.depth[rest], UNIT * ball.depth[rest], rtol=1e-5)
        np.testing.assert_array_equal(
            there.confidence[rest], np.where(ball.depth[rest] > 0, np.float32(FILLED), 1)
        )
    for depth in asked["depths"]:  # in mm of the arch
        np.testing.assert_allclose(depth[known], 3 / UNIT, rtol=1e-5)
        assert not depth[~known].any()


@pytest.mark.parametrize(
    ("where", "why"),
    [
        ("stages.init.densify.completed_surface", ReconstructionError),
        ("stages.init.dental.place_known.place_teeth", ReconstructionError),
        ("stages.init.dental.place_known.place_teeth", RequestError),
    ],
)
def test_teeth_that_are_not_where_the_depth_is_complete_nothing(tmp_path, monkeypatch, where, why):
    ball_before_the_cameras(monkeypatch)

    def elsewhere(*_, **__):
        raise why("the crowns would lie elsewhere")

    monkeypatch.setattr(where, elsewhere)
    asked = context(tmp_path, read_teeth())
    dense = stereo(np.ones(SIZE, bool))
    found = densify.completed_by_teeth(asked, photographs(), cameras(), lambda: dense)
    assert found == (dense, False)
    assert asked.warnings == []


def test_an_order_of_other_photographs_stops_nothing(tmp_path):
    asked = context(tmp_path, read_teeth(), dental={"order": ("right", "left")})
    dense = stereo(np.ones(SIZE, bool))
    found = densify.completed_by_teeth(asked, photographs(), cameras(), lambda: dense)
    assert found == (dense, False)
