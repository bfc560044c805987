"""Known cameras: whose they are by their names, and of which pixels."""

from dataclasses import replace

import numpy as np
import pycolmap
import pytest
from scipy.spatial.transform import Rotation

from pipeline.artifacts.views import View
from pipeline.errors import RequestError
from pipeline.geometry.models.known_cameras import KnownCamera, matching_cameras, pinhole_camera
from stages.views.orientation import upright_from_stored


@pytest.mark.parametrize("orientation", range(1, 9))
def test_cameras_of_stored_pictures_and_of_upright_ones(orientation):
    """What EXIF turns: a point falls on the same spot. What it mirrors has upright cameras only."""
    width, height = 40, 30
    view_from_stored = upright_from_stored(orientation, width, height)
    shown = (height, width) if orientation >= 5 else (width, height)
    image = np.zeros((shown[1], shown[0], 3), np.float32)
    view = View(
        "000", image, None, view_from_stored, source_size=(width, height), source_name="a.jpg"
    )
    mirrored = orientation in (2, 4, 5, 7)
    size, view_from_lens = (shown, np.eye(3)) if mirrored else ((width, height), view_from_stored)
    lens = pycolmap.Camera(
        model="PINHOLE", width=2 * size[0], height=2 * size[1], params=[100, 90, 36, 32]
    )
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_euler("xyz", (10, 20, 30), degrees=True).as_matrix()
    pose[2, 3] = 4.0
    known = KnownCamera("a.jpg", lens, pose)
    points = np.random.default_rng(orientation).uniform(-0.5, 0.5, (20, 3))
    there = points @ known.cam_from_world[:3, :3].T + known.cam_from_world[:3, 3]
    wanted = np.column_stack([there[:, :2] / there[:, 2:] * (50, 45) + (18, 16), np.ones(20)])
    camera = pinhole_camera(view, known)
    np.testing.assert_allclose(
        camera.project(points)[0], (wanted @ view_from_lens.T)[:, :2], atol=1e-9
    )
    assert np.linalg.det(camera.rotation) == pytest.approx(1)
    if orientation in (5, 7):
        stored = pycolmap.Camera(model="PINHOLE", width=40, height=30, params=[50, 45, 18, 16])
        with pytest.raises(RequestError, match="40 x 30 and is stored as a mirror image"):
            pinhole_camera(view, replace(known, lens=stored))


def test_the_names_that_fit_most_photographs_count():
    """Every fifth image of a film, whose names are those of other views."""
    pose = np.eye(4)
    lens = pycolmap.Camera(model="PINHOLE", width=4, height=3, params=[4, 4, 2, 1.5])
    image = np.zeros((3, 4, 3), np.float32)
    views = [View(f"{k:03d}", image, source_name=f"{5 * k:03d}.png") for k in range(12)]
    by_source = [KnownCamera(f"images/{5 * k:03d}.jpg", lens, pose) for k in range(12)]
    by_view = [KnownCamera(f"{k:03d}.png", lens, pose) for k in range(12)]
    found = matching_cameras(by_source, views)
    assert {name: known.name for name, known in found.items()} == {
        f"{k:03d}": f"images/{5 * k:03d}.jpg" for k in range(12)
    }
    found = matching_cameras(by_view, views)
    assert {name: known.name for name, known in found.items()} == {
        f"{k:03d}": f"{k:03d}.png" for k in range(12)
    }
    both = matching_cameras(by_view[:3], [views[0], views[1], views[2]])
    assert {name: known.name for name, known in both.items()} == {
        name: f"{name}.png" for name in ("000", "001", "002")
    }
    two_ways = [
        View("001", image, source_name="000.png"),
        View("000", image, source_name="001.png"),
    ]
    found = matching_cameras(by_view, two_ways)
    assert {name: known.name for name, known in found.items()} == {
        "001": "000.png", "000": "001.png"
    }, "of equally many, the names of the files count"  # fmt: skip
    with pytest.raises(RequestError, match="2 cameras fit one photograph"):
        matching_cameras([*by_view, KnownCamera("b/000.jpg", lens, pose)], views)


def test_cameras_of_all_frames_are_not_those_of_some():
    """Every third frame of a film, and the cameras of all of its frames."""
    pose, image = np.eye(4), np.zeros((3, 4, 3), np.float32)
    lens = pycolmap.Camera(model="PINHOLE", width=4, height=3, params=[4, 4, 2, 1.5])
    every = [KnownCamera(f"frames/{k:03d}.png", lens, pose) for k in range(24)]
    views = [View(f"{k:03d}", image, source_name=f"film.mp4#{3 * k}") for k in range(8)]
    with pytest.raises(RequestError, match=r"none of the .* no photograph has the number 008"):
        matching_cameras(every, views)
    found = matching_cameras(every[:5], views)  # what we exported, where some were not placed
    assert sorted(found) == ["000", "001", "002", "003", "004"]


def test_photographs_held_out_do_not_say_which_names_count():
    """Of a film 003 is held out: what is exported as 003 shows 004."""
    pose, image = np.eye(4), np.zeros((3, 4, 3), np.float32)
    lens = pycolmap.Camera(model="PINHOLE", width=4, height=3, params=[4, 4, 2, 1.5])
    exported = [KnownCamera(f"{k:03d}.png", lens, pose) for k in range(5)]
    inputs = [n for n in range(6) if n != 3]
    views = [View(f"{k:03d}", image, source_name=f"{n:03d}.jpg") for k, n in enumerate(inputs)]
    held = [View("h000", image, source_name="003.jpg")]
    found = matching_cameras(exported, views, "cameras", held)
    assert {name: known.name for name, known in found.items()} == {
        f"{k:03d}": f"{k:03d}.png" for k in range(5)
    }
    named = [KnownCamera(f".\\images\\{n:03d}.jpg", lens, pose) for n in range(6)]  # of Windows
    found = matching_cameras(named, views, "cameras", held)
    assert found["004"].name == ".\\images\\005.jpg" and "h000" in found
