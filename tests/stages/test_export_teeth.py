"""`teeth.json`: numbers, doubts, outlines and places of teeth on a ball whose shape is known."""

import csv
import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest

from pipeline.artifacts.cameras import Cameras
from pipeline.artifacts.dental.fdi import ALL_TEETH, is_primary, is_upper
from pipeline.artifacts.space.frames import Frame
from pipeline.artifacts.space.scale import NO_SCALE, Scale
from pipeline.artifacts.teeth import Crown, Dentition, Teeth
from pipeline.artifacts.views import View, Views
from pipeline.geometry.models.known_cameras import KnownCamera, as_pinhole
from pipeline.stage import LocalContext
from stages.dentition.working import outline_in_view
from stages.export.measuring.mouth import exported_dentition
from stages.export.measuring.teeth_table import teeth_table, tooth_name
from stages.export.scene import assemble
from stages.export.stage import ExportConfig, ExportStage
from stages.export.teeth import (
    SeenCrown,
    describe_teeth,
    joint_centre,
    without_names,
)
from tests.stages import export_scene as scene
from tests.stages.ball_teeth_case import PLACES, cap_outline, teeth_of_ball

#: our world -> the input's millimetres
SIMILARITY = np.array([[0, -20, 0, 1], [20, 0, 0, 2], [0, 0, 20, 3], [0, 0, 0, 1.0]])
QUIET = {"colmap": False, "mesh": False, "video": False, "viewer": False, "preview": False}
IN_MM = Scale("mm", "tooth_widths", 4.0)


def case():
    found = scene.ball_case()
    found["cameras"] = Cameras(
        found["cameras"].cameras, input_from_world=SIMILARITY, scale=IN_MM, given=True
    )
    aside = View("004", found["views"].views[0].image, source_name="Smith_John_5.jpg")
    found["views"] = Views((*found["views"].views, aside))
    found["teeth"] = teeth_of_ball()
    ball = found["gaussians"]  # so dense that its back does not shine through
    opaque = np.full_like(ball.logit_opacities, 6.0)
    found["gaussians"] = replace(ball, logit_opacities=opaque, log_scales=ball.log_scales + 0.2)
    return found


def export(folder: Path, inputs: dict) -> Path:
    context = LocalContext(ExportConfig(**QUIET), folder, inputs, threads=1)
    ExportStage().run(context)
    return folder / "exports"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return export(tmp_path_factory.mktemp("teeth"), case())


@pytest.fixture(scope="module")
def written(folder: Path) -> dict:
    return json.loads((folder / "teeth.json").read_text())


def test_each_tooth_once_with_its_numbers(written: dict) -> None:
    first, second = written["teeth"]
    assert (first["fdi"], first["universal"], first["dentition"], first["jaw"]) == (
        11, "8", "permanent", "upper",
    )  # fmt: skip
    assert (second["fdi"], second["universal"], second["dentition"], second["jaw"]) == (
        74, "L", "primary", "lower",
    )  # fmt: skip
    assert (first["doubt"], second["doubt"]) == (0.02, 0.15), "the least of the photographs"
    assert [seen["doubt"] for seen in first["seen_in"]] == [0.02, 0.1, 0.4]


def test_centres_are_where_the_crowns_are(written: dict) -> None:
    assert written["units"] == "mm" and written["frame"] == "input"
    assert written["scale"] == IN_MM.as_dict()
    for tooth in written["teeth"]:
        direction = np.array(PLACES[tooth["fdi"]])
        truth = SIMILARITY[:3, :3] @ (direction / np.linalg.norm(direction)) + SIMILARITY[:3, 3]
        # the ball has a radius of 20 mm, the crowns are 6 mm wide
        np.testing.assert_allclose(tooth["centre"], truth, atol=0.5)
        assert 0 < tooth["spread"] < 2


def test_sizes_are_what_the_photographs_show(written: dict) -> None:
    """A crown of 2 x 20 mm x sin(.15 rad) = 5.98 mm: foreshortened, so never much larger."""
    for tooth in written["teeth"]:
        assert 5.3 < tooth["width"] < 6.3
        assert 5.3 < tooth["height"] < 6.3


def test_no_size_of_a_crown_that_goes_on_unseen(tmp_path: Path) -> None:
    inputs = case()
    cut = [
        replace(view, upper=tuple(replace(crown, cut_left=True) for crown in view.upper))
        for view in inputs["teeth"].views
    ]
    inputs["teeth"] = Teeth(tuple(replace(view, kind="lower") for view in cut))
    found = json.loads((export(tmp_path, inputs) / "teeth.json").read_text())
    first, second = found["teeth"]
    assert (first["width"], first["height"]) == (None, None)
    assert second["width"] and second["height"] is None, "an occlusal photograph shows no height"


def test_a_row_for_each_tooth(folder: Path, written: dict) -> None:
    rows = list(csv.DictReader((folder / "teeth.csv").open(encoding="utf-8", newline="")))
    assert [row["name"] for row in rows] == [
        "upper right central incisor", "lower left primary first molar",
    ]  # fmt: skip
    assert [(row["fdi"], row["universal"], row["side"]) for row in rows] == [
        ("11", "8", "right"), ("74", "L", "left"),
    ]  # fmt: skip
    for row, tooth in zip(rows, written["teeth"], strict=True):
        assert [float(row[axis]) for axis in "xyz"] == tooth["centre"]
        for name in ("doubt", "spread", "width", "height"):
            assert float(row[name]) == tooth[name]
        assert (row["unit"], row["photographs"]) == ("mm", "3")


def test_what_is_not_known_is_an_empty_cell() -> None:
    tooth = {"fdi": 85, "universal": "T", "jaw": "lower", "dentition": "primary", "doubt": 0.5}
    twice = [{"photograph": "002"}] * 2  # two crowns that carry the number
    tooth |= {"centre": None, "spread": None, "width": None, "height": None, "seen_in": twice}
    text = teeth_table({"units": "arbitrary", "teeth": [tooth]})
    assert text.splitlines()[1] == (
        "85,T,lower right primary second molar,lower,right,primary,0.5,,,,,,,arbitrary,1"
    )


@pytest.mark.parametrize("number", sorted(ALL_TEETH))
def test_every_tooth_has_a_name_of_its_own(number: int) -> None:
    name = tooth_name(number)
    assert [n for n in ALL_TEETH if tooth_name(n) == name] == [number]
    assert name.split()[0] == ("upper" if is_upper(number) else "lower")
    assert ("primary" in name) == is_primary(number)


def test_outlines_are_pixels_of_the_images(written: dict) -> None:
    for camera, seen in zip(scene.ball_cameras(), written["teeth"][0]["seen_in"], strict=True):
        assert seen["photograph"] == camera.name
        np.testing.assert_allclose(seen["outline"], cap_outline(camera, PLACES[11]), atol=0.006)


def test_photographs_say_why_they_are_not_used(written: dict, folder: Path) -> None:
    said = {photo["name"]: photo["set_aside"] for photo in written["photographs"]}
    assert said == {
        "000": "", "001": "", "002": "", "003": "it could not be placed",
        "004": "it shows the same as another photograph, which is clearer",
    }  # fmt: skip
    assert [photo["used"] for photo in written["photographs"]] == [True] * 3 + [False] * 2
    assert written["photographs"][0]["unnumbered_crowns"] == 1
    for path in folder.iterdir():
        assert b"Smith" not in path.read_bytes()


def test_what_cannot_be_measured_says_why(written: dict) -> None:
    assert written["scale"]["unit"] == "mm"
    said = {entry["name"]: entry["not_visible"] for entry in written["measurements"]}
    assert said["overjet"] == "no photograph shows 31 or 41 with depth"
    assert said["intermolar_upper"] == "no photograph shows 16 with depth"
    assert all(entry["value"] is None for entry in written["measurements"])


def test_it_is_described(folder: Path) -> None:
    description = json.loads((folder / "scene.json").read_text())
    assert "teeth.json" in description["files"]
    assert description["counts"]["teeth"] == 2
    assert "Teeth: 2 in teeth.json" in (folder / "README.txt").read_text()


def test_the_same_input_gives_the_same_bytes(tmp_path: Path, folder: Path) -> None:
    again = export(tmp_path, case())
    for name in ("teeth.json", "teeth.csv"):
        assert (again / name).read_bytes() == (folder / name).read_bytes()


def test_without_teeth_there_is_no_file(tmp_path: Path) -> None:
    inputs = case()
    names = [view.name for view in inputs["views"].views]
    inputs["teeth"] = Teeth(tuple(Dentition(n, (scene.WIDTH, scene.HEIGHT), "none") for n in names))
    out = export(tmp_path, inputs)
    assert not (out / "teeth.json").exists()
    assert "teeth.json" not in (out / "README.txt").read_text()


def test_a_crown_without_depth_has_no_place() -> None:
    inputs = case()
    first = inputs["teeth"].views[0]
    corner = np.array([[2.0, 2], [9, 2], [9, 9], [2, 9]])  # beside the ball
    beside = replace(first.upper[0], outline=corner)
    made = assemble(
        inputs["views"], Cameras(inputs["cameras"].cameras[:1]), inputs["gaussians"], None,
        Frame("world", np.eye(4)), 1, lambda *_: None,
    )  # fmt: skip
    alone = Teeth((replace(first, upper=(beside,), lower=()),))
    found = describe_teeth(alone, inputs["views"], made.cameras, made.seen, "world", NO_SCALE)
    assert found["teeth"][0]["centre"] is None and found["teeth"][0]["spread"] is None
    assert len(found["teeth"][0]["seen_in"]) == 1


def test_centres_count_by_the_pixels_that_show_the_crown() -> None:
    def seen(photograph, x, pixels, doubt=0.1):
        centre = None if x is None else np.array([x, 0.0, 0])
        return SeenCrown(photograph, 11, doubt, np.zeros((3, 2)), centre, pixels)

    first, second = seen("000", 0.0, 300), seen("001", 4.0, 100)
    centre, spread = joint_centre([first, second, seen("002", None, 2)])
    np.testing.assert_allclose(centre, [1, 0, 0])
    assert spread == pytest.approx(3)
    assert joint_centre([seen("000", 2.0, 9)])[1] is None
    assert joint_centre([seen("000", None, 0)]) == (None, None)
    # another crown of the same photograph that carries the number is another tooth
    centre, _ = joint_centre([seen("000", 9.0, 500, 0.6), first, second])
    np.testing.assert_allclose(centre, [1, 0, 0])


def test_a_strip_of_a_crown_and_a_doubtful_number_do_not_move_a_tooth() -> None:
    def seen(photograph, x, pixels, doubt=0.0, whole=True):
        return SeenCrown(
            photograph, 13, doubt, np.zeros((3, 2)), np.array([x, 0.0, 0]), pixels, whole=whole
        )

    first, second = seen("000", 0.0, 300), seen("001", 1.0, 300)
    for strip in (seen("002", 9.0, 20, whole=False), seen("002", 9.0, 300, doubt=0.3)):
        centre, spread = joint_centre([first, second, strip])
        np.testing.assert_allclose(centre, [0.5, 0, 0])
        assert spread == pytest.approx(0.5)
        np.testing.assert_allclose(joint_centre([strip])[0], [9, 0, 0])
    # the last tooth of a row goes on unseen where it is seen best
    centre, _ = joint_centre([seen("000", 0.0, 300, whole=False), seen("001", 4.0, 100)])
    np.testing.assert_allclose(centre, [1, 0, 0])


def undistorted(turned: bool) -> tuple[View, View]:
    """A picture whose colours are its places, and the same with the distortion taken out."""
    width, height = (90, 120) if turned else (120, 90)
    v, u = np.mgrid[:height, :width] + 0.5
    image = np.stack([u / 128, v / 128, 0 * u], -1).astype(np.float32)
    transform = np.array([[0, -1.0, 90], [1, 0, 0], [0, 0, 1]]) if turned else np.eye(3)
    view = View("000", image, working_from_source=transform, source_size=(120, 90))
    lens = pycolmap.Camera(
        model="OPENCV", width=240, height=180, params=[210, 205, 122, 88, -0.2, 0.05, 1e-3, 2e-3]
    )
    return view, as_pinhole(view, KnownCamera("000", lens, np.eye(4)))[0]


@pytest.mark.parametrize("turned", [False, True])
def test_outlines_follow_an_image_that_was_undistorted(turned: bool) -> None:
    view, straight = undistorted(turned)
    outline = np.array([[20.0, 25], [70, 22], [75, 70], [15, 60]])
    moved = outline_in_view(outline, (view.width, view.height), straight)
    assert np.abs(moved - outline).max() > 1
    index = (moved - 0.5).astype(np.float32)
    shown = cv2.remap(straight.image, index[None, :, 0], index[None, :, 1], cv2.INTER_LINEAR)
    # the undistorted image has 8 bits: its coordinates are rounded to half pixels
    np.testing.assert_allclose(shown[0, :, :2] * 128, outline, atol=0.27)


def test_crowns_of_a_tilted_photograph_keep_their_width_as_their_outlines_move() -> None:
    """8 x 12 pixels, tilted by 40 degrees: 8 wide along the row, 14 from left to right."""
    view, straight = undistorted(False)
    turn = np.radians(40)
    right, down = np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
    corners = [a * 4 * right + b * 6 * down for a, b in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
    outline = np.array([60.0, 45]) + corners
    zenith, tip = (np.array([60.0, 45]) + b * 6 * down for b in (-1, 1))
    crown = Crown("upper", zenith, tip, None, None, tip, None, 8, 12, outline=outline, number=11)
    size = (view.width, view.height)
    read = Dentition("000", size, "front", (crown,))
    assert exported_dentition(read, view) is read
    (moved,) = exported_dentition(read, straight).upper
    for name in ("outline", "tip", "zenith"):
        expected = outline_in_view(np.atleast_2d(getattr(crown, name)), size, straight)
        np.testing.assert_allclose(np.atleast_2d(getattr(moved, name)), expected)
    assert moved.width == pytest.approx(8, rel=0.1)
    assert moved.height == pytest.approx(12, rel=0.1)


def test_outlines_follow_an_image_of_another_size() -> None:
    view = View("000", np.zeros((60, 80, 3), np.float32))
    moved = outline_in_view(np.array([[40.0, 30]]), (160, 120), view)
    np.testing.assert_allclose(moved, [[20, 15]])


def test_reasons_name_no_file() -> None:
    views = {"002": View("002", np.zeros((2, 2, 3), np.float32), source_name="A Smith.jpg")}
    reason = "it shows the same as A Smith.jpg, which is clearer"
    assert without_names(reason, views) == "it shows the same as 002, which is clearer"
    assert "Smith" not in without_names(reason, {})
    assert without_names("the jaws are apart in it", views) == "the jaws are apart in it"
