"""Gaussians of another program: the stage `splats`, with good files and bad ones."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.lib.recfunctions import repack_fields
from plyfile import PlyData, PlyElement

from pipeline import cli
from pipeline.artifacts import gaussians as files
from pipeline.artifacts.cameras import Cameras
from pipeline.artifacts.gaussians import Gaussians, read_gaussians_ply, write_gaussians_ply
from pipeline.artifacts.space.frames import BACKGROUND
from pipeline.artifacts.space.scale import Scale
from pipeline.errors import RequestError
from pipeline.running.outcomes import RunSummary
from pipeline.stage import LocalContext
from stages.evaluate.stage import EvaluateConfig, EvaluateStage
from stages.export.splatfiles.compressed import compressed_ply_bytes
from stages.export.stage import ExportConfig, ExportStage
from stages.splats.placing import said_background, share_in_view
from stages.splats.stage import SplatsConfig, SplatsStage
from stages.splatting.frame import move_gaussians
from stages.splatting.rendering import render
from tests.stages import export_scene as scene
from tests.stages.splat_files import read_compressed_ply

#: our world -> the input's millimetres: turned about no axis in particular, 20 times as large
TURN = np.array([[2, -1, 2], [2, 2, -1], [-1, 2, 2]]) / 3
SIMILARITY = np.eye(4)
SIMILARITY[:3] = np.column_stack([20 * TURN, [1.0, 2.0, 3.0]])
ONLY_SPLATS = {
    "colmap": False, "mesh": False, "video": False, "viewer": False, "preview": False,
}  # fmt: skip


def in_mm() -> Cameras:
    return Cameras(scene.ball_cameras(), SIMILARITY, Scale("mm"), given=True)


def imported(folder: Path, file: Path, cameras: Cameras | None = None, **settings: Any) -> Any:
    """The context of a run of the stage on a file."""
    config = SplatsConfig(file=str(file), **settings)
    context = LocalContext(
        config, folder, {"cameras": cameras or in_mm()}, SplatsStage().sources(config, {})
    )
    SplatsStage().run(context)
    return context


def psnr(folder: Path, case: dict[str, Any]) -> float:
    """Mean PSNR of the input views as `evaluate` says it."""
    config = EvaluateConfig(comparisons=False, support_pictures=False, novel_angle=0, flip=False)
    context = LocalContext(config, folder, case, threads=1)
    EvaluateStage().run(context)
    return float(context.result("metrics").input.mean["psnr"])


def peer_ply(path: Path, gaussians: Gaussians, degree: int = 3, normals: bool = True) -> Path:
    """A `.ply` with as many f_rest_* as a degree has, quaternions of any length, as peers do."""
    write_gaussians_ply(path, gaussians)
    rows = PlyData.read(path)["vertex"].data
    rest = 3 * ((degree + 1) ** 2 - 1)
    number = gaussians.sh[:, 1 : (degree + 1) ** 2].transpose(0, 2, 1).reshape(len(rows), -1)
    names = [n for n in rows.dtype.names if not n.startswith("f_rest") and (normals or n[0] != "n")]
    dtype = [(n, "<f4") for n in names] + [(f"f_rest_{k}", "<f4") for k in range(rest)]
    written = np.empty(len(rows), dtype)
    for name in names:
        written[name] = rows[name] * (3.0 if name.startswith("rot_") else 1.0)
    for k in range(rest):
        written[f"f_rest_{k}"] = number[:, k]
    PlyData([PlyElement.describe(written, "vertex")], byte_order="<").write(str(path))
    return path


@pytest.mark.parametrize("frame", ["input", "world", "upright"])
def test_our_own_export_comes_back_as_it_was(tmp_path: Path, frame: str) -> None:
    case = {**scene.ball_case(), "cameras": in_mm()}
    case["views"] = replace(case["views"], views=case["views"].views[:3])
    # not what the photographs show, so that there is an error to compare
    grey = (0.25, 0.5, 0.125)
    case["gaussians"] = replace(
        case["gaussians"], sh=case["gaussians"].sh * np.float32(0.9), background=grey
    )
    exporting = LocalContext(ExportConfig(frame=frame, **ONLY_SPLATS), tmp_path / "e", case)
    ExportStage().run(exporting)
    file = tmp_path / "e" / "exports" / "splats.ply"
    context = imported(tmp_path / "s", file, frame=frame)
    assert context.figures == {"gaussians": 1500, "in_view": 1.0}
    assert not context.warnings
    back = context.result("gaussians")
    assert back.background == grey
    np.testing.assert_allclose(back.means, case["gaussians"].means, atol=1e-5)
    for camera in scene.ball_cameras():
        before, after = render(case["gaussians"], camera), render(back, camera)
        np.testing.assert_allclose(after.image, before.image, atol=2e-3)
    smaller = imported(tmp_path / "c", file.with_name("splats.compressed.ply"), frame=frame)
    assert smaller.result("gaussians").background == grey
    np.testing.assert_allclose(
        render(smaller.result("gaussians"), camera).image, before.image, atol=0.05
    )
    before_db = psnr(tmp_path / "a", case)
    after_db = psnr(tmp_path / "b", case | {"gaussians": back})
    assert 10 < before_db < 40
    assert after_db == pytest.approx(before_db, abs=0.01)


@pytest.mark.parametrize("said", ["", "0.1 0.2", "0.1 0.2 2", "nan 0 0", "red green blue"])
def test_a_background_that_is_no_colour_is_black(tmp_path: Path, said: str) -> None:
    file = tmp_path / "peer.ply"
    write_gaussians_ply(file, scene.ball_gaussians(50), 0, [f"{BACKGROUND} {said}"])
    assert said_background(file) == (0, 0, 0)
    write_gaussians_ply(file, scene.ball_gaussians(50), 0, [f"{BACKGROUND} 0.5 0.25 1.0"])
    assert said_background(file) == (0.5, 0.25, 1)
    given = imported(tmp_path / "s", file, frame="world", background=(0.0, 0.0, 0.0))
    assert given.result("gaussians").background == (0, 0, 0)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
@pytest.mark.parametrize("normals", [True, False])
def test_files_of_every_degree_are_read(tmp_path: Path, degree: int, normals: bool) -> None:
    ball = scene.ball_gaussians(200, degree)
    file = peer_ply(tmp_path / "peer.ply", move_gaussians(ball, SIMILARITY), degree, normals)
    back = imported(tmp_path / "s", file).result("gaussians")
    np.testing.assert_allclose(np.linalg.norm(back.quats_wxyz, axis=1), 1, atol=1e-6)
    np.testing.assert_allclose(back.sh, ball.sh, atol=1e-5)
    np.testing.assert_allclose(back.log_scales, ball.log_scales, atol=1e-5)


def test_a_scene_in_another_frame_is_told(tmp_path: Path) -> None:
    ball = scene.ball_gaussians(500)
    cameras = scene.ball_cameras()
    file = tmp_path / "peer.ply"
    write_gaussians_ply(file, replace(ball, means=ball.means + np.float32([0, 0, -9])))
    with pytest.raises(RequestError, match=r"none of the photographs shows any .* --keep-crs"):
        imported(tmp_path / "a", file, frame="world")
    write_gaussians_ply(file, ball)
    assert imported(tmp_path / "b", file, frame="world").figures["in_view"] == 1
    aside = replace(ball, means=ball.means + np.float32([0, 2, 0]))
    assert 0 < share_in_view(aside, cameras) < 0.2
    write_gaussians_ply(file, aside)
    (told,) = imported(tmp_path / "c", file, frame="world").warnings
    assert "may be in another frame" in told


def packed(path: Path, gaussians: Gaussians, degree: int = 3) -> Path:
    path.write_bytes(compressed_ply_bytes(gaussians, degree))
    return path


@pytest.mark.parametrize("degree", [0, 1, 3])
def test_a_compressed_ply_is_read(tmp_path: Path, degree: int) -> None:
    ball = scene.ball_gaussians(600, degree)
    file = packed(tmp_path / "peer.ply", ball, degree)
    expected, there = read_compressed_ply(file)
    assert there == degree
    back = imported(tmp_path / "s", file, frame="world").result("gaussians")
    np.testing.assert_allclose(back.means, expected.means, atol=1e-6)
    np.testing.assert_allclose(back.log_scales, expected.log_scales, atol=1e-5)
    np.testing.assert_allclose(back.quats_wxyz, expected.quats_wxyz, atol=1e-6)
    np.testing.assert_allclose(back.logit_opacities, expected.logit_opacities, atol=1e-4)
    np.testing.assert_allclose(back.sh, expected.sh, atol=0.016)  # -4 and 4 are the ends of a byte


def test_wholly_opaque_gaussians_are_drawn_and_invisible_ones_are_not(tmp_path: Path) -> None:
    ball = scene.ball_gaussians(500)
    for whole, part in ((np.inf, 14.0), (-np.inf, -14.0)):
        given = ball.logit_opacities.copy()
        given[::2] = whole
        write_gaussians_ply(tmp_path / "peer.ply", replace(ball, logit_opacities=given))
        read = imported(tmp_path / "s", tmp_path / "peer.ply", frame="world").result("gaussians")
        assert np.isfinite(read.logit_opacities).all()
        near = replace(ball, logit_opacities=np.where(np.isinf(given), part, given).astype("f4"))
        camera = scene.ball_cameras()[0]
        np.testing.assert_allclose(
            render(read, camera).image, render(near, camera).image, atol=1e-4
        )


def test_a_compressed_ply_with_whole_opacities_is_read(tmp_path: Path) -> None:
    """As splat-transform writes them; its colours may have no bounds of their own."""
    file = packed(tmp_path / "peer.ply", scene.ball_gaussians(300), 0)
    found = PlyData.read(file, mmap=False)
    vertices, chunks = found["vertex"].data, found["chunk"].data
    vertices["packed_color"] |= 255
    vertices["packed_color"][7] &= 0xFFFFFF00
    named = [n for n in chunks.dtype.names if n[-2:] not in ("_r", "_g", "_b")]
    elements = [
        PlyElement.describe(repack_fields(chunks[named]), "chunk"),
        PlyElement.describe(vertices, "vertex"),
    ]
    PlyData(elements, byte_order="<").write(str(file))
    read = imported(tmp_path / "s", file, frame="world").result("gaussians")
    assert read.logit_opacities[7] < -15 and np.delete(read.logit_opacities, 7).min() > 15
    colours = 0.5 + 0.28209479 * read.sh[:, 0]
    red = vertices["packed_color"] >> 24
    np.testing.assert_allclose(colours[:, 0], red / 255, atol=1e-5)


def broken(change: Callable[[Any], None]) -> Callable[[Path], None]:
    """Writes a file of splats with one thing changed in its rows."""

    def write(path: Path) -> None:
        write_gaussians_ply(path, scene.ball_gaussians(50))
        found = PlyData.read(path, mmap=False)
        change(found["vertex"].data)
        found.write(str(path))

    return write


def without(*names: str) -> Callable[[Path], None]:
    def write(path: Path) -> None:
        write_gaussians_ply(path, scene.ball_gaussians(50))
        rows = PlyData.read(path)["vertex"].data
        kept = rows[[name for name in rows.dtype.names if name not in names]].copy()
        PlyData([PlyElement.describe(repack_fields(kept), "vertex")]).write(str(path))

    return write


def put(name: str, value: float) -> Callable[[Path], None]:
    def change(rows: Any) -> None:
        rows[name][7] = value

    return broken(change)


def no_rotation(rows: Any) -> None:
    for k in range(4):
        rows[f"rot_{k}"][:3] = 0


def empty(path: Path) -> None:
    write_gaussians_ply(path, scene.ball_gaussians(50))
    found = PlyData.read(path, mmap=False)
    PlyData([PlyElement.describe(found["vertex"].data[:0], "vertex")]).write(str(path))


def packed_wrong(old: bytes, new: bytes, more: bytes = b"") -> Callable[[Path], None]:
    def write(path: Path) -> None:
        data = packed(path, scene.ball_gaussians(300, 1), 1).read_bytes()
        assert old in data
        path.write_bytes(data.replace(old, new) + more)

    return write


def absurd(path: Path) -> None:
    write_gaussians_ply(path, scene.ball_gaussians(50))
    path.write_bytes(path.read_bytes().replace(b"vertex 50\n", b"vertex 99999999999\n"))


BAD: list[tuple[Callable[[Path], Any], str]] = [
    (lambda path: path.write_text("photograph"), "is no .ply. Of our own results give splats.ply"),
    (lambda path: path.write_text("ply\n"), "is no whole PLY"),
    (lambda path: path.mkdir(), "there is no file"),
    (lambda path: None, "there is no file"),
    (empty, "holds no Gaussians"),
    (absurd, "is cut off: its header says 99999999999 rows"),
    (without("opacity", "rot_3"), "has no vertices with opacity, rot_3"),
    (without("f_rest_44"), "has 44 properties f_rest_*"),
    (without(*(f"f_rest_{k}" for k in range(21, 45)), "f_rest_3"), "has 20 properties f_rest_*"),
    (without(*(f"f_rest_{k}" for k in range(21))), "has 24 properties f_rest_*"),
    (put("x", np.nan), "1 of the 50 Gaussians in"),
    (put("f_rest_20", np.inf), "1 of the 50 Gaussians in"),
    (put("opacity", np.nan), "1 of the 50 Gaussians in"),
    (put("scale_1", 90.0), "a size beyond measure"),
    (packed_wrong(b"float min_scale_y", b"float min_scale_q"), "it lacks min_scale_y"),
    (packed_wrong(b"uint packed_scale", b"int packed_scale"), "it lacks packed_scale"),
    (packed_wrong(b"uchar f_rest_8", b"uchar f_rest_9"), "its harmonics are not those"),
    (packed_wrong(b"chunk 2\n", b"chunk 3\n", bytes(72)), "it has 3 chunks for 300 Gaussians"),
    (packed_wrong(b"vertex 300\n", b"vertex 900\n"), "is cut off"),
    (broken(no_rotation), "3 of the 50 Gaussians in"),
]


@pytest.mark.parametrize(
    ("write", "told"), BAD, ids=lambda value: value[:40] if isinstance(value, str) else ""
)
def test_a_bad_file_is_refused_in_words(
    tmp_path: Path, write: Callable[[Path], Any], told: str
) -> None:
    write(tmp_path / "peer.ply")
    with pytest.raises(RequestError, match=r"^splats\.file: ") as refused:
        imported(tmp_path / "s", tmp_path / "peer.ply")
    assert told in str(refused.value)
    assert "\n" not in str(refused.value)


def test_more_than_any_scene_has_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_gaussians_ply(tmp_path / "peer.ply", scene.ball_gaussians(50))
    monkeypatch.setattr(files, "MOST_GAUSSIANS", 49)
    with pytest.raises(RequestError, match="has 50 Gaussians, more than the 49"):
        read_gaussians_ply(tmp_path / "peer.ply")


def test_no_file_is_refused() -> None:
    with pytest.raises(RequestError, match=r"splats\.file=PATH"):
        SplatsStage().sources(SplatsConfig(), {})


@pytest.mark.slow
def test_the_command_refuses_it_with_status_2(
    sample_run: RunSummary,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    command = ["pipeline", "run", "-w", str(sample_run.workspace), "--stages", "splats,evaluate"]
    given = ["--dry-run", "--set", f"splats.file={tmp_path / 'none.ply'}"]
    monkeypatch.setattr("sys.argv", [*command, *given])
    with pytest.raises(SystemExit) as stop:
        cli.main()
    said = capsys.readouterr().err
    assert stop.value.code == 2
    assert "splats.file: there is no file" in said.replace("\n", " ")
    assert "Traceback" not in said
