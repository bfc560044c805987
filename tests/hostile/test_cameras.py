"""Cameras in `transforms.json` from outside: what no camera has is refused by frame and field."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pipeline.artifacts.space.scale import NO_SCALE
from pipeline.errors import RequestError
from pipeline.geometry.models.known_cameras import model_files, read_cameras
from pipeline.stage import LocalContext
from stages.swap.stage import SwapConfig, SwapStage

#: What is refused is not waited for.
pytestmark = pytest.mark.timeout(60)
SETTING = "init.cameras"
Change = Callable[[dict[str, Any]], Any]
NAN, INF = float("nan"), float("inf")


def cameras() -> dict[str, Any]:
    frames = []
    for number in range(3):
        pose = np.eye(4)
        pose[:3, 3] = 3 * number, 0, 5
        frames.append({"file_path": f"{number}.jpg", "transform_matrix": pose.tolist()})
    return {"w": 640, "h": 480, "fl_x": 600.0, "cx": 320, "cy": 240, "frames": frames}


def refused(path: Path, text: str) -> str:
    path.write_text(text)
    with pytest.raises(RequestError) as error:
        read_cameras(model_files(path, SETTING).values(), SETTING)
    said = str(error.value)
    assert said.startswith(f"{SETTING}: {path} ") and error.value.exit_status == 2
    assert len(said) < 500
    return said


def frame(**values: Any) -> Change:
    """The second frame says something of its own."""
    return lambda data: data["frames"][1].update(values)


def common(**values: Any) -> Change:
    return lambda data: data.update(values)


def scaled(percent: Any) -> Change:
    record = {"unit": "mm", "source": "length", "uncertainty_percent": percent}
    return common(units="mm", dentalsplat_scale=record)


def turned(matrix: Any) -> Change:
    pose = np.eye(4)
    pose[:3, :3] = matrix
    return frame(transform_matrix=pose.tolist())


def shifted(*centre: Any) -> Change:
    rows = np.eye(4).tolist()
    for row, value in zip(rows, centre, strict=False):
        row[3] = value
    return frame(transform_matrix=rows)


MATRIX = "transform_matrix"
FRAME = "frame 1 ('1.jpg')"


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (common(fl_x=0), "fx of frame 0 ('0.jpg') is 0"),
        (common(fl_x=-1), "fx of frame 0 ('0.jpg') is -1"),
        (frame(fl_x=0.0), f"fx of {FRAME} is 0"),
        (frame(fl_x=-600), f"fx of {FRAME} is -600"),
        (frame(fl_y=0), f"fy of {FRAME} is 0"),
        (frame(fl_x=1e12), f"fx of {FRAME} is 1e+12"),
        (frame(fl_x=1e308), "has fl_x 1e+308"),
        (frame(fl_x="600"), f"has fl_x '600' in {FRAME}, not a number"),
        (frame(fl_x=True), "has fl_x True"),
        (frame(fl_x=[600]), "has fl_x a list"),
        (frame(fl_x={"x": 1}), "has fl_x a mapping"),
        (frame(fl_x=10**400), "has fl_x a number of many digits"),
        (frame(w=0), f"has w 0 in {FRAME}"),
        (frame(h=0), f"has h 0 in {FRAME}"),
        (frame(h=-480), "has h -480"),
        (frame(h=480.5), "has h 480.5"),
        (frame(w=10**9), "has w 1000000000"),
        (frame(w="640"), "has w '640'"),
        (common(h=None), "gives no 'h' for 0.jpg"),
        (lambda data: data.pop("fl_x"), "gives no 'camera_angle_x' for 0.jpg"),
        (lambda data: (data.pop("fl_x"), data.update(camera_angle_x=0)), "has camera_angle_x 0"),
        (lambda data: (data.pop("fl_x"), data.update(camera_angle_x=4)), "has camera_angle_x 4"),
        (frame(cx=1e6), f"cx of {FRAME} is 1e+06; that is far outside the image of 640 x 480"),
        (frame(cy=-1e5), f"cy of {FRAME} is -100000"),
        (frame(cx="middle"), "has cx 'middle'"),
        (frame(k1=1e20), f"k1 of {FRAME} is 1e+20"),
        (frame(p2="x"), "has p2 'x'"),
        (frame(camera_model="EQUIRECTANGULAR"), "has camera_model 'EQUIRECTANGULAR'"),
        (frame(camera_model=7), "has camera_model 7"),
        (turned(-np.eye(3)), f"{MATRIX} of {FRAME} is mirrored"),
        (turned(np.diag([1, 1, -1])), f"{MATRIX} of {FRAME} is mirrored"),
        (turned(2 * np.eye(3)), f"{MATRIX} of {FRAME} is no rotation; its axes are 2 2 2 long"),
        (turned(np.zeros((3, 3))), f"{MATRIX} of {FRAME} is no rotation; its axes are 0 0 0"),
        (turned([[1, 0.2, 0], [0, 1, 0], [0, 0, 1]]), "is no rotation"),
        (turned([[1e200, 0, 0], [0, 1e200, 0], [0, 0, 1]]), "is no rotation"),
        (shifted(1e15), f"{MATRIX} of {FRAME} is 1e+15 away"),
        (shifted("0"), f"has '0' in the {MATRIX} of {FRAME}, not a number"),
        (shifted(None), "has None in the"),
        (shifted([0]), "has a list in the"),
        (frame(transform_matrix=None), f"has a {MATRIX} of shape None"),
        (frame(transform_matrix=7), f"has a {MATRIX} of shape 7"),
        (frame(transform_matrix=[[1, 2], [3, 4]]), "of shape 2x2"),
        (frame(transform_matrix=[[1, 2, 3, 4]] * 5), "of shape 5x4"),
        (frame(transform_matrix=[1, 2, 3, 4]), "of shape 4x0"),
        (frame(transform_matrix=[[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 2]]),
         "whose last row is 0 0 0 2 in frame"),
        (frame(file_path=3), "has a frame 1 whose file_path is 3"),
        (frame(file_path=""), "has a frame 1 whose file_path is ''"),
        (frame(file_path=None), "whose file_path is None"),
        (frame(file_path="a\nb"), "can't be printed"),
        (frame(file_path="x" * 9000), "has a frame 1 whose file_path is"),
        (frame(file_path="0.jpg"), "says file_path '0.jpg' twice, in frames 0 and 1"),
        (scaled("10 %"), "uncertainty_percent '10 %' in dentalsplat_scale, not a number from 0"),
        (scaled(-1), "has uncertainty_percent -1 in"),
        (scaled(True), "has uncertainty_percent True in"),
        (scaled([2]), "has uncertainty_percent a list in"),
        (scaled(10**400), "has uncertainty_percent a number of many digits"),
        (common(frames={}), "holds no list 'frames'"),
        (common(frames="none"), "holds no list 'frames'"),
        (common(frames=None), "holds no list 'frames'"),
        (common(frames=[]), "holds no posed image"),
        (common(frames=[1, 2]), "has a frame 0 that is 1, not a mapping"),
        (common(frames=[[]]), "has a frame 0 that is a list"),
        (frame(fl_x=NAN), "holds NaN, which is no number"),
        (frame(k1=INF), "holds Infinity, which is no number"),
        (shifted(-INF), "holds -Infinity"),
    ],
)  # fmt: skip
def test_what_no_camera_has_is_refused(tmp_path: Path, change: Change, words: str) -> None:
    data = cameras()
    change(data)
    assert words in refused(tmp_path / "transforms.json", json.dumps(data))


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "can't be read as JSON"),
        ("[]", "holds no list 'frames'"),
        ("null", "holds no list 'frames'"),
        ('"frames"', "holds no list 'frames'"),
        ('{"frames": [', "can't be read as JSON"),
        ('{"frames": [], "frames": []}', "says 'frames' twice"),
        ('{"frames": [{"w": 1e999}]}', "holds 1e999, which is larger"),
        ('{"frames": [' + "9" * 5000 + "]}", "too many digits"),
        ("[" * 100_000, "nested deeper"),
        ('{"a":' * 100_000, "nested deeper"),
        ('{"frames": ' + "[" * 100_000 + "]" * 100_000 + "}", "nested deeper"),
        ("[" + "[]," * 2_000_001 + "[]]", "more entries than can be meant"),
        ("[" + "0," * 8_000_001 + "0]", "more entries than can be meant"),
    ],
)
def test_what_is_no_list_of_cameras_is_refused(tmp_path: Path, text: str, words: str) -> None:
    assert words in refused(tmp_path / "transforms.json", text)


def test_what_is_no_text_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "transforms.json"
    path.write_bytes(b'{"frames": "\xff"}')
    with pytest.raises(RequestError, match=r"transforms\.json is not text in UTF-8 \(byte 12\)"):
        read_cameras([path], SETTING)
    path.unlink()
    path.mkdir()
    with pytest.raises(RequestError, match="is a folder, not a file"):
        read_cameras([path], SETTING)


def test_what_cameras_may_have_is_kept(tmp_path: Path) -> None:
    """Fields of each frame, three rows, few digits, off-centre and bent: all of it is real."""
    data = cameras()
    angle = np.radians(30)
    rows = [[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]]
    rounded = [[round(value, 4) for value in row] + [1.5] for row in rows]
    data["frames"][1].update(
        transform_matrix=rounded, w=640.0, cx=-50, k1=-0.3, fl_y=590, camera_model="OPENCV_FISHEYE"
    )
    data["units"], data["note"] = 3, {"any": ["thing"]}
    (tmp_path / "transforms.json").write_text(json.dumps(data))
    found, scale = read_cameras(model_files(tmp_path).values())
    assert scale == NO_SCALE
    assert [camera.name for camera in found] == ["0.jpg", "1.jpg", "2.jpg"]
    assert found[1].lens.params.tolist() == [600, 590, -50, 240, -0.3, 0, 0, 0]
    assert found[1].lens.model_name == "OPENCV_FISHEYE"
    centre = -np.linalg.inv(found[1].cam_from_world[:3, :3]) @ found[1].cam_from_world[:3, 3]
    np.testing.assert_allclose(centre, [1.5] * 3, atol=1e-3)


def test_all_of_a_lens_counts(tmp_path: Path) -> None:
    """A fisheye as instant-ngp calls it, and the k3 that Metashape finds."""
    data = cameras()
    data["frames"][0].update(k1=0.1, k3=0.02, is_fisheye=True)
    data["frames"][1].update(k1=0.1, k3=0.02, is_fisheye=False)
    (tmp_path / "transforms.json").write_text(json.dumps(data))
    found, _ = read_cameras(model_files(tmp_path).values())
    assert [one.lens.model_name for one in found] == ["OPENCV_FISHEYE", "FULL_OPENCV", "OPENCV"]
    assert found[0].lens.params.tolist()[4:] == [0.1, 0, 0.02, 0]
    ray = np.array([[0.3, -0.2, 1.0]])
    square = 0.3**2 + 0.2**2
    bent = ray[0, :2] * (1 + 0.1 * square + 0.02 * square**3)
    pixel = found[1].lens.img_from_cam(ray)[0]
    straight = found[2].lens.img_from_cam(np.array([[*bent, 1.0]]))[0]
    np.testing.assert_allclose(pixel, straight, atol=1e-6)
    data["frames"][1]["k4"] = 0.01
    (tmp_path / "transforms.json").write_text(json.dumps(data))
    with pytest.raises(RequestError, match=r"k4 0\.01 in frame 1"):
        read_cameras(model_files(tmp_path).values())


def test_a_stage_refuses_them_too(tmp_path: Path) -> None:
    data = cameras()
    data["frames"][1]["fl_x"] = 0
    path = tmp_path / "transforms.json"
    path.write_text(json.dumps(data))
    config = SwapConfig(cameras=str(path))
    context = LocalContext(
        config, tmp_path, inputs={"views": None, "cameras": None},
        sources=SwapStage().sources(config, {}), threads=1,
    )  # fmt: skip
    with pytest.raises(RequestError, match=r"^swap\.cameras: .*fx of frame 1"):
        SwapStage().run(context)
