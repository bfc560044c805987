"""Every artifact kind: what is saved is loaded, and the bytes repeat."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from pipeline.artifacts import KINDS, Artifact, artifact_class
from pipeline.artifacts.cameras import Camera, Cameras, read_colmap
from pipeline.artifacts.flow import Flow, FlowPair
from pipeline.artifacts.gaussians import Gaussians, Light, ply_properties
from pipeline.artifacts.metrics import Metrics
from pipeline.artifacts.pictures import Pictures
from pipeline.artifacts.pointmaps import PointmapPair, Pointmaps
from pipeline.artifacts.points import Points
from pipeline.artifacts.space.scale import Scale
from pipeline.artifacts.teeth import Crown, Dentition, Teeth
from pipeline.artifacts.views import HeldOut, View, Views
from pipeline.errors import RequestError


def rigid(rng: np.random.Generator) -> np.ndarray:
    rotation, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    pose = np.eye(4)
    pose[:3, :3] = rotation * np.sign(np.linalg.det(rotation))
    pose[:3, 3] = rng.normal(size=3)
    return pose


def crown() -> Crown:
    """One with a landmark missing."""
    corners = np.array([[1.0, 1.25], [4, 1.25], [4, 3.75], [1, 3.75]])
    ends = np.array([[2.5, 1.25], [2.5, 3.75], [4.0, 2.5]])
    return Crown(
        "upper", ends[0], ends[1], None, ends[2], None, None, 3.0, 2.5,
        outline=corners, score=0.5, numbers={11: 0.75, 51: 0.25}, number=11, doubt=0.125,
    )  # fmt: skip


def samples() -> dict[str, Artifact]:
    """One artifact of each kind that holds arrays, with mixed image sizes."""
    rng = np.random.default_rng(0)

    def floats(*shape: int) -> np.ndarray:
        return rng.uniform(size=shape).astype(np.float32)

    def pixels(*shape: int) -> np.ndarray:
        return (rng.integers(0, 256, shape) / np.float32(255)).astype(np.float32)

    mask = rng.uniform(size=(5, 7)) > 0.5
    return {
        "views": Views(
            (
                View("000", pixels(5, 7, 3), mask, source_name="a.jpg", focal_px=31.5),
                View(
                    "001",
                    pixels(8, 6, 3),
                    working_from_source=np.diag([-2.0, 2, 1]),
                    turned_over=True,
                ),
            ),
            ordered=True,
        ),
        "held_out": HeldOut((View("h000", pixels(5, 7, 3), source_name="b.jpg"),)),
        "pointmaps": Pointmaps(
            [
                PointmapPair(
                    "000", "001", floats(5, 7, 3), floats(8, 6, 3), floats(5, 7), floats(8, 6)
                )
            ]
        ),
        "cameras": Cameras(
            (
                Camera("000", 7, 5, 9.1, 9.2, 3.5, 2.5, rigid(rng)),
                Camera("001", 6, 8, 9.0, 9.0, 3.0, 4.0, rigid(rng)),
            ),
            input_from_world=np.diag([2.0, 2, 2, 1]),
            scale=Scale("mm", "length", 2.5),
            given=True,
            mouth_from_world=rigid(rng),
        ),
        "points": Points(floats(9, 3), pixels(9, 3), floats(9, 3), 1 + floats(9), floats(9)),
        "flow": Flow((FlowPair("000", "001", floats(5, 7, 2), floats(8, 6, 2), mask, mask),)),
        "gaussians": Gaussians(
            floats(9, 3),
            floats(9, 4),
            floats(9, 3),
            floats(9),
            floats(9, 16, 3),
            Light(floats(9, 3), floats(9, 3), 0.9, 2.1, 1.3, (97.0, 15.5), (0.45, 0.04)),
        ),
        "metrics": Metrics({"mean": {"psnr": 31.25}, "unplaced": []}),
        "teeth": Teeth(
            (
                Dentition("000", (7, 5), "front", (crown(),), roll=np.radians(-3.5)),
                Dentition("001", (6, 8), "none", set_aside="no teeth"),
            ),
            {"000": rng.integers(0, 256, (5, 7, 3)).astype(np.uint8)},
        ),
        "pictures": Pictures({"matches": rng.integers(0, 256, (5, 7, 3)).astype(np.uint8)}),
    }


def assert_same(a: object, b: object) -> None:
    if isinstance(a, np.ndarray):
        np.testing.assert_allclose(a, b, rtol=0, atol=1e-12)
        assert a.dtype == b.dtype  # type: ignore[attr-defined]
    elif isinstance(a, Pointmaps):
        for left, right in zip(a, b, strict=True):  # type: ignore[call-overload]
            assert_same(vars(left), vars(right))
    elif isinstance(a, tuple | list):
        assert len(a) == len(b)  # type: ignore[arg-type]
        for left, right in zip(a, b, strict=True):  # type: ignore[call-overload]
            assert_same(left, right)
    elif isinstance(a, dict):
        assert a.keys() == b.keys()  # type: ignore[attr-defined]
        for key in a:
            assert_same(a[key], b[key])  # type: ignore[index]
    elif hasattr(a, "__dataclass_fields__"):
        assert_same(vars(a), vars(b))
    else:
        assert a == b


def test_samples_cover_every_kind() -> None:
    assert set(samples()) | {"exports"} == set(KINDS)


@pytest.mark.parametrize("kind", sorted(set(KINDS) - {"exports"}))
def test_saved_is_loaded_and_bytes_repeat(kind: str, tmp_path: Path) -> None:
    artifact = samples()[kind]
    first, second = tmp_path / "first", tmp_path / "second"
    first.mkdir(), second.mkdir()
    artifact.save(first)
    loaded = artifact_class(kind).load(first)
    assert_same(artifact, loaded)
    artifact.save(second)
    files = sorted(p.relative_to(first) for p in first.rglob("*") if p.is_file())
    assert files
    for name in files:
        assert (first / name).read_bytes() == (second / name).read_bytes(), name


def test_unknown_kind_names_the_nearest() -> None:
    with pytest.raises(RequestError, match="Did you mean 'points'"):
        artifact_class("pionts")


def test_projection_and_unprojection_are_inverse() -> None:
    camera = samples()["cameras"].cameras[0]  # type: ignore[attr-defined]
    depth = np.full((5, 7), 2.5)
    world = camera.unproject(depth)
    pixels, z = camera.project(world.reshape(-1, 3))
    v, u = np.mgrid[:5, :7] + 0.5
    np.testing.assert_allclose(pixels, np.stack([u, v], -1).reshape(-1, 2), atol=1e-9)
    np.testing.assert_allclose(z, 2.5)
    half, _ = camera.resized(14, 10).project(world.reshape(-1, 3))
    np.testing.assert_allclose(half, pixels * 2, atol=1e-9)


def test_gaussians_without_light_are_one_file(tmp_path: Path) -> None:
    lit = samples()["gaussians"]
    plain = dataclasses.replace(lit, light=None)  # type: ignore[type-var]
    plain.save(tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["gaussians.ply"]
    assert Gaussians.load(tmp_path).light is None
    lit.save(tmp_path)
    light = Gaussians.load(tmp_path).light
    assert light is not None and light.widths == (97.0, 15.5)
    assert len(light[np.arange(4)].albedo) == 4


def test_gaussian_ply_has_the_standard_properties(tmp_path: Path) -> None:
    samples()["gaussians"].save(tmp_path)
    header = (tmp_path / "gaussians.ply").read_bytes().split(b"end_header")[0].decode()
    names = [line.split()[-1] for line in header.splitlines() if line.startswith("property float")]
    assert names == ply_properties()
    assert len(names) == 62


def test_cameras_with_distortion_are_refused(tmp_path: Path) -> None:
    import pycolmap

    model = pycolmap.Reconstruction()
    lens = pycolmap.Camera(
        camera_id=1, model="SIMPLE_RADIAL", width=8, height=6, params=[9, 4, 3, 0.1]
    )
    model.add_camera_with_trivial_rig(lens)
    image = pycolmap.Image(name="000.png", camera_id=1, image_id=1)
    model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(np.eye(4)[:3]))
    model.write_text(str(tmp_path))
    with pytest.raises(ValueError, match="undistort"):
        read_colmap(tmp_path)


@pytest.mark.parametrize("lying", [False, True])
def test_a_view_turned_over_shows_the_same_places_on_the_other_side(lying: bool) -> None:
    rng = np.random.default_rng(0)
    image, mask = rng.uniform(size=(6, 9, 3)).astype(np.float32), rng.uniform(size=(6, 9)) > 0.5
    upright = np.array([[0.0, -0.5, 9.0], [0.5, 0, 0], [0, 0, 1]])  # a quarter turn, half the size
    view = View(
        "000", image, mask, upright if lying else np.diag([0.5, 0.5, 1.0]),
        (12, 18) if lying else (18, 12), "a.jpg", focal_px=31.5,
    )  # fmt: skip
    over = view.mirrored()
    assert (over.name, over.source_name, over.focal_px) == ("000", "a.jpg", 31.5)
    assert (over.width, over.height, over.upright_size) == (9, 6, view.upright_size)
    assert over.image.flags.c_contiguous
    assert over.mask is not None
    source_from_working = np.linalg.inv(view.working_from_source)
    for row, column in np.ndindex(6, 9):
        source = source_from_working @ [column + 0.5, row + 0.5, 1]
        x, y, _ = over.working_from_source @ source - 0.5
        there = round(float(y)), round(float(x))
        np.testing.assert_allclose([y, x], there, atol=1e-9)
        np.testing.assert_array_equal(over.image[there], image[row, column])
        assert over.mask[there] == mask[row, column]
    x, y = view.working_place((7, 4))
    np.testing.assert_allclose(over.working_place((7, 4)), (9 - x, y))
    again = over.mirrored()
    assert over.turned_over and not again.turned_over
    np.testing.assert_array_equal(again.image, image)
    np.testing.assert_allclose(again.working_from_source, view.working_from_source)
    assert dataclasses.replace(view, mask=None).mirrored().mask is None
