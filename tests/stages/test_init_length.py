"""A length between two pixels that the user knows: what it says of the scale, and how surely."""

from dataclasses import replace

import numpy as np
import pytest

from pipeline.artifacts.cameras import Camera
from pipeline.artifacts.views import View, Views
from pipeline.errors import RequestError
from stages.init.scale import mm_per_unit, photo_named
from stages.init.write import place_in


def test_length_that_cannot_be_measured_is_refused():
    view = View("a", np.zeros((30, 40, 3), np.float32), working_from_source=np.diag([0.1, 0.1, 1]),
                source_size=(400, 300))  # fmt: skip
    camera = Camera("a", 40, 30, 50, 50, 20, 15, np.eye(4))
    depth = np.full((30, 40), 2, np.float32)
    np.testing.assert_allclose(view.working_place((100, 50)), (10, 5))
    # 20 working pixels at depth 2 and focal length 50 are 0.8 units.
    assert mm_per_unit(view, camera, depth, (100, 100), (300, 100), 8.0)[0] == pytest.approx(10)
    with pytest.raises(RequestError, match="outside the photograph"):
        mm_per_unit(view, camera, depth, (100, 100), (500, 100), 8.0)
    with pytest.raises(RequestError, match="nothing is known of the depth"):
        mm_per_unit(view, camera, 0 * depth, (100, 100), (300, 100), 8.0)
    with pytest.raises(RequestError, match="the same place"):
        mm_per_unit(view, camera, depth, (100, 100), (100, 100), 8.0)


def test_the_photograph_of_a_length_is_the_one_whose_file_is_called_so() -> None:
    """Every second photograph of a series, whose numbers are those of other views."""
    image = np.zeros((3, 4, 3), np.float32)
    named = ["000.png", "002.png", "004.png", "film.mp4#0", "film.mp4#7"]
    views = Views(tuple(View(f"{k:03d}", image, source_name=n) for k, n in enumerate(named)))
    found = {name: photo_named(views, name).source_name for name in (*named, "002", "003")}
    assert found == {name: name for name in named} | {"002": "002.png", "003": "film.mp4#0"}
    with pytest.raises(RequestError, match=r"2 photographs are called 'film' \(film\.mp4#0, "):
        photo_named(views, "film")
    with pytest.raises(RequestError, match=r"there is no photograph '04\.png'. Did you mean '004"):
        photo_named(views, "04.png")


def test_a_length_is_of_the_photograph_before_its_lens_was_taken_out() -> None:
    """Two spots of a plane, clicked where a barrel lens shows them."""
    view = View("a", np.zeros((300, 400, 3), np.float32), source_size=(400, 300))
    straight = replace(view, lens_taken_out="SIMPLE_RADIAL 400 300 320 200 150 -0.15")
    camera = Camera("a", 400, 300, 320, 320, 200, 150, np.eye(4))
    depth = np.full((300, 400), 2, np.float32)
    bent = 160 * (1 - 0.15 * 0.5**2)  # of a spot 160 pixels from the middle, half the focal length
    ends = (200 - bent, 150.0), (200 + bent, 150.0)
    units = 2 * 320 / 320
    factor, _ = mm_per_unit(
        view, camera, depth, *ends, 10.0, lambda pixel: place_in(straight, view, pixel)
    )
    assert factor == pytest.approx(10.0 / units, rel=1e-4)
    assert mm_per_unit(view, camera, depth, *ends, 10.0)[0] > 1.03 * factor


def test_uncertainty_of_a_length_covers_what_clicks_and_depth_do() -> None:
    """Clicks 1.5 pixels off, depth .3 % off, a caliper .1 mm off: as often as it says."""
    view = View("a", np.zeros((300, 400, 3), np.float32), source_size=(400, 300))
    camera = Camera("a", 400, 300, 500, 500, 200, 150, np.eye(4))
    depth = np.add.outer(np.zeros(300), 90 + 0.02 * np.arange(400)).astype(np.float32)
    start, end = np.array([150.0, 140]), np.array([200.0, 145])
    truth, said = mm_per_unit(view, camera, depth, tuple(start), tuple(end), 9.0)
    random = np.random.default_rng(2)
    found = []
    for _ in range(300):
        wavy = depth.copy()
        for point in (start, end):
            x, y = point.astype(int)
            wavy[y - 20 : y + 21, x - 20 : x + 21] *= random.normal(1, 0.003)
        ends = [tuple(point + random.normal(0, 1.5, 2)) for point in (start, end)]
        found.append(mm_per_unit(view, camera, wavy, *ends, 9.0 + random.normal(0, 0.1))[0])
    assert said == pytest.approx(np.std(found) / truth, rel=0.2)
    longer = mm_per_unit(view, camera, depth, (50.0, 140), (350.0, 145), 54.0)[1]
    assert longer < said / 4
