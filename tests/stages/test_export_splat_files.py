"""The splat files for viewers that know less: what they hold, and how they look."""

import shutil
import subprocess
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from plyfile import PlyData

from pipeline.artifacts.gaussians import Gaussians, read_gaussians_ply, write_gaussians_ply
from stages.export.orientation import Z_UP, file_from_frame
from stages.export.scene import assemble
from stages.export.splatfiles.compressed import compressed_ply_bytes
from stages.export.splatfiles.order import morton_order
from stages.export.splatfiles.plain import LEAST_SEEN, with_constant_color
from stages.export.splatfiles.spz import spz_bytes
from stages.export.splatfiles.writing import COMPRESSED, CONSTANT, FULL, SPZ, write_splats
from stages.splatting.frame import move_gaussians
from stages.splatting.rendering import contributions, render, seen_colors
from tests.stages import export_scene as scene
from tests.stages.splat_files import read_compressed_ply, read_spz

CAMERAS = scene.ball_cameras()


def one_sided(degree: int = 2) -> Gaussians:
    """The ball with half of its brightness in harmonics that the cameras see from one side."""
    ball = scene.ball_gaussians(degree=degree)
    sh = ball.sh.copy()
    sh[:, 2] = 0
    sh[:, 0] -= 1.2
    sh[:, 2] += 1.2 * 0.28209479 / 0.48860251  # back again, for who looks along +z
    return replace(ball, sh=sh)


def db(gaussians: Gaussians, truth: Gaussians) -> float:
    """PSNR of one scene against another, over the cameras."""
    errors = [
        np.mean((render(gaussians, c).image.clip(0, 1) - render(truth, c).image.clip(0, 1)) ** 2)
        for c in CAMERAS
    ]
    return float(-10 * np.log10(np.mean(errors)))


def constant_alone(gaussians: Gaussians) -> Gaussians:
    """As a viewer without harmonics shows it."""
    sh = np.zeros_like(gaussians.sh)
    sh[:, 0] = gaussians.sh[:, 0]
    return replace(gaussians, sh=sh, light=None)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    case = scene.ball_case()
    made = assemble(
        case["views"], case["cameras"], one_sided(), None, np.diag([1.0, -1, -1, 1]), 1,
        lambda *_: None,
    )  # fmt: skip
    home = tmp_path_factory.mktemp("splats")
    write_splats(home, made, True, ["Lengths are in millimetres: \u00b15 %."])
    return home


def back(name: str, gaussians: Gaussians) -> Gaussians:
    """What a file holds, in our world."""
    frame = move_gaussians(gaussians, np.linalg.inv(file_from_frame(name, True)))
    return move_gaussians(frame, np.diag([1.0, -1, -1, 1]))


def test_a_viewer_without_harmonics_shows_the_right_brightness(folder: Path) -> None:
    ball = one_sided()
    before = db(constant_alone(ball), ball)
    plain = Gaussians(**read_gaussians_ply(folder / CONSTANT))
    assert not plain.sh[:, 1:].any()
    after = db(back(CONSTANT, plain), ball)
    assert before < 15 and after > 20, (before, after)


def test_colors_count_by_what_a_camera_sees_of_a_gaussian() -> None:
    ball = one_sided()
    shares = [contributions(ball, camera) for camera in CAMERAS]
    for camera, share in zip(CAMERAS, shares, strict=True):
        # all weights of a picture add up to its alpha
        assert share.sum() == pytest.approx(render(ball, camera).alpha.sum(), rel=1e-3)
    mean = with_constant_color(ball, CAMERAS)
    seen = np.stack([seen_colors(ball, camera) for camera in CAMERAS])
    aside = int(np.argmax(np.array(shares).max(0) - 2 * np.sort(shares, axis=0)[1]))
    hidden = int(np.argmin(sum(shares)))
    assert sum(shares)[aside] > 1
    for index in (aside, hidden):
        weights = [share[index] for share in shares]
        if sum(weights) < LEAST_SEEN:
            weights = [1, 1, 1]
        color = 0.5 + 0.28209479 * mean.sh[index, 0]
        truth = np.average(seen[:, index], axis=0, weights=weights)
        np.testing.assert_allclose(color, np.clip(truth, 0, 1), atol=1e-4)


def test_a_light_beside_the_lens_is_in_the_constant_colors() -> None:
    lit = scene.lit_ball()
    assert db(with_constant_color(lit, CAMERAS), lit) > db(constant_alone(lit), lit) + 3


@pytest.mark.parametrize(
    ("name", "least_db", "degree"), [(FULL, 60, 2), (COMPRESSED, 38, 2), (SPZ, 30, 2)]
)
def test_files_look_as_the_scene(folder: Path, name: str, least_db: float, degree: int) -> None:
    path, ball = folder / name, one_sided()
    if name == FULL:
        found, bands = Gaussians(**read_gaussians_ply(path)), degree
        assert len(PlyData.read(path)["vertex"].properties) == 62 - 21, "no empty third band"
    else:
        found, bands = (read_spz if name == SPZ else read_compressed_ply)(path)
        assert path.stat().st_size < (folder / FULL).stat().st_size / 2
    assert bands == degree
    assert len(found) == len(ball)
    assert db(back(name, found), ball) > least_db


def test_files_stand_as_their_readers_expect(folder: Path) -> None:
    """Our world has y down and z ahead: what is highest has the least y."""
    world = one_sided().means
    highest, nearest = world[world[:, 1].argmin()], world[world[:, 2].argmin()]
    ply = Gaussians(**read_gaussians_ply(folder / FULL)).means
    shown = ply * [-1, -1, 1]  # SuperSplat turns it by 180 degrees about z
    spz = read_spz(folder / SPZ)[0].means
    for means in (shown, spz):  # y up, z towards the viewer, x as in the photographs
        top, front = means[means[:, 1].argmax()], means[means[:, 2].argmax()]
        np.testing.assert_allclose(top, highest * [1, -1, -1], atol=1e-3)
        np.testing.assert_allclose(front, nearest * [1, -1, -1], atol=1e-3)
    np.testing.assert_array_equal(Z_UP[:3, :3] @ [0, 1, 0], [0, 0, 1])
    np.testing.assert_array_equal(Z_UP[:3, :3] @ [0, 0, 1], [0, -1, 0])
    np.testing.assert_array_equal(file_from_frame("splats.ply", False), np.eye(4))


def test_the_header_says_the_scale(folder: Path) -> None:
    for name in (FULL, CONSTANT, COMPRESSED):
        head = (folder / name).read_bytes().partition(b"end_header")[0].decode("ascii")
        assert "comment Lengths are in millimetres: +-5 %." in head
        assert "comment dentalsplat turned: 180 degrees about z" in head


@pytest.mark.parametrize("degree", [0, 1, 3])
@pytest.mark.parametrize("count", [0, 1, 256, 257, 600])
def test_any_number_of_any_degree(tmp_path: Path, count: int, degree: int) -> None:
    ball = scene.ball_gaussians(max(count, 1), degree)
    few = Gaussians(
        ball.means[:count] * 30, ball.quats_wxyz[:count], ball.log_scales[:count] + 3,
        ball.logit_opacities[:count], ball.sh[:count],
    )  # fmt: skip
    (tmp_path / "a.spz").write_bytes(spz_bytes(few, degree))
    (tmp_path / "a.ply").write_bytes(compressed_ply_bytes(few, degree))
    for found, bands in (
        read_spz(tmp_path / "a.spz"), read_compressed_ply(tmp_path / "a.ply")
    ):  # fmt: skip
        assert len(found) == count
        assert bands == degree or not count
        if count:
            np.testing.assert_allclose(found.means, few.means, atol=60 / 1023)
            np.testing.assert_allclose(found.log_scales, few.log_scales, atol=0.04)
            np.testing.assert_allclose(found.sh[:, 0], few.sh[:, 0], atol=0.02)
            np.testing.assert_allclose(found.sh[:, 1:], few.sh[:, 1:], atol=0.04)
            cosine = np.abs((found.quats_wxyz * few.quats_wxyz).sum(1))
            assert cosine.min() > 0.998  # .spz has 8 bits, and finds w from the rest
            np.testing.assert_allclose(found.logit_opacities, few.logit_opacities, atol=0.35)


def test_the_order_keeps_neighbours_together() -> None:
    points = np.random.default_rng(0).uniform(-1, 1, (2000, 3)).astype(np.float32)
    order = morton_order(points)
    assert sorted(order) == list(range(2000))
    steps = np.linalg.norm(np.diff(points[order], axis=0), axis=1).mean()
    assert steps < 0.25 * np.linalg.norm(np.diff(points, axis=0), axis=1).mean()


def test_all_62_properties_where_nothing_else_is_asked(tmp_path: Path) -> None:
    write_gaussians_ply(tmp_path / "a.ply", scene.ball_gaussians(5))
    assert len(PlyData.read(tmp_path / "a.ply")["vertex"].properties) == 62


@pytest.mark.skipif(shutil.which("splat-transform") is None, reason="needs splat-transform (npm)")
@pytest.mark.parametrize("name", [FULL, CONSTANT, COMPRESSED, SPZ])
def test_playcanvas_reads_them(folder: Path, tmp_path: Path, name: str) -> None:
    out = tmp_path / "out.ply"
    subprocess.run(["splat-transform", folder / name, out], check=True, timeout=120)
    theirs = read_gaussians_ply(out)["means"]
    if name == SPZ:  # their .ply have y down
        theirs = theirs * [1, -1, -1]
        ours = read_spz(folder / name)[0].means
    elif name == COMPRESSED:
        ours = read_compressed_ply(folder / name)[0].means
    else:
        ours = read_gaussians_ply(folder / name)["means"]
    np.testing.assert_allclose(theirs, ours, atol=1e-5)
