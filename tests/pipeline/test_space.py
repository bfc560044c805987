"""What is said of the scale, and the frames that a scene is given in."""

import json
from dataclasses import replace

import numpy as np
import pytest

from pipeline.artifacts.cameras import Camera, Cameras
from pipeline.artifacts.space.frames import frame_of
from pipeline.artifacts.space.scale import NO_SCALE, Scale, said_by_cameras

CAMERA = Camera("000", 8, 6, 9, 9, 4, 3, np.eye(4))
TEXTBOOK = Scale("mm", "textbook_teeth", 15.0)
LARGER = np.array([[0, -20.0, 0, 1], [20, 0, 0, 2], [0, 0, 20, 3], [0, 0, 0, 1]])
MOUTH = np.diag([1.0, -1, -1, 1])
MOUTH[:3, 3] = [0.1, 0.2, 0.3]


def test_one_sentence_says_it_all() -> None:
    assert TEXTBOOK.text == (
        "Lengths are in millimetres, from the widths of textbook teeth: \u00b115 % (one standard "
        "deviation)."
    )
    assert "no unit" in NO_SCALE.text and NO_SCALE.short == "no scale"
    assert said_by_cameras("mm").text == (
        "Lengths are in millimetres, as the cameras that were given say; how far these may be off "
        "is not known, and taken to be \u00b15 % (one standard deviation)."
    )
    assert (said_by_cameras("mm").counted_percent, NO_SCALE.counted_percent) == (5, 0)
    assert said_by_cameras("arbitrary") == NO_SCALE
    assert Scale("mm", "length", 2.26).short == "mm +-2.3% (length)"
    TEXTBOOK.short.encode("ascii")
    aside = Scale("none", "length")
    assert "own units" in aside.text and "in the other frames they are in mill" in aside.text
    assert (aside.short, aside.units, aside.counted_percent) == ("no scale", "arbitrary", 0)


@pytest.mark.parametrize(
    "scale", [NO_SCALE, TEXTBOOK, Scale("mm", "cameras"), Scale("none", "length")]
)
def test_the_record_comes_back(scale) -> None:
    record = json.loads(json.dumps(scale.as_dict()))
    assert set(record) == {"unit", "source", "uncertainty_percent", "counted_percent", "text"}
    assert Scale.from_dict(record) == scale
    assert Scale.from_dict({**record, "source": "a dream"}).source == "none"


def test_files_from_before_there_was_a_record_load(tmp_path) -> None:
    Cameras((CAMERA,), LARGER, TEXTBOOK).save(tmp_path)
    file = tmp_path / "frame.json"
    old = {"units": "mm", "input_from_world": LARGER.tolist(), "provisional": False}
    file.write_text(json.dumps(old))
    found = Cameras.load(tmp_path)
    assert found.scale == Scale("mm") and found.units == "mm" and not found.given
    assert "no source is recorded" in found.scale.text
    file.write_text(json.dumps({**old, "units": "arbitrary"}))
    assert Cameras.load(tmp_path).scale == NO_SCALE


def test_auto_takes_the_frame_that_is_known_best() -> None:
    bare = Cameras((CAMERA,), LARGER)
    assert frame_of(bare).name == "upright"
    # lengths without a unit stay those of our world: nothing is to look like millimetres
    np.testing.assert_array_equal(frame_of(bare).from_world, np.diag([1.0, -1, -1, 1]))
    metric = replace(bare, scale=TEXTBOOK)
    np.testing.assert_allclose(frame_of(metric).from_world, np.diag([20.0, -20, -20, 1]))
    mouth = replace(metric, mouth_from_world=MOUTH)
    assert frame_of(mouth).name == "mouth"
    np.testing.assert_allclose(
        frame_of(mouth).from_world, np.diag([20.0, 20, 20, 1]) @ MOUTH, atol=1e-12
    )
    assert frame_of(replace(mouth, given=True)).name == "input"
    np.testing.assert_array_equal(frame_of(replace(mouth, given=True)).from_world, LARGER)


def test_a_frame_that_can_not_be_had_is_said() -> None:
    bare = Cameras((CAMERA,), LARGER, given=True)
    found = frame_of(bare, "mouth")
    assert found.name == "upright" and "asked for" in found.lacking and found.stands
    assert not frame_of(replace(bare, mouth_from_world=MOUTH), "mouth").lacking
    assert frame_of(bare, "world").name == "world" and not frame_of(bare, "world").stands
    assert not frame_of(bare, "input").lacking
    alone = replace(bare, given=False, scale=TEXTBOOK)  # millimetres are no given cameras
    for cameras, name in ((alone, "upright"), (replace(alone, mouth_from_world=MOUTH), "mouth")):
        found = frame_of(cameras, "input")
        assert found.name == name and "no cameras were given" in found.lacking
        np.testing.assert_array_equal(found.from_world, frame_of(cameras).from_world)
