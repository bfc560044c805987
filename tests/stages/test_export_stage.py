"""The export stage as a whole: every file, what it says, and that it says no more."""

import hashlib
import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import av
import numpy as np
import open3d
import pycolmap
import pytest
from pydantic import ValidationError

from pipeline.artifacts.cameras import Cameras, read_colmap
from pipeline.artifacts.gaussians import read_gaussians_ply
from pipeline.artifacts.space.scale import Scale
from pipeline.artifacts.views import View, Views, read_png, to_uint8
from pipeline.errors import ReconstructionError
from pipeline.stage import LocalContext
from stages.export.pictures.video import Video
from stages.export.stage import ExportConfig, ExportStage
from stages.splatting.frame import move_cameras
from tests.stages import export_scene as scene

ROOT = Path(__file__).parents[2]
#: our world -> the input's millimetres
SIMILARITY = np.array([[0, -20, 0, 1], [20, 0, 0, 2], [0, 0, 20, 3], [0, 0, 0, 1.0]])
IN_MM = Scale("mm", "length", 2.5)
SMALL = {
    "mesh_faces": 2000, "mesh_resolution": 64, "mesh_views": 3, "video_seconds": 0.8,
    "video_fps": 10, "colmap_points": 400,
}  # fmt: skip


def export(folder: Path, threads: int = 1, inputs: dict | None = None, **settings) -> LocalContext:
    case = scene.ball_case() if inputs is None else inputs
    config = ExportConfig(**{**SMALL, **settings})
    context = LocalContext(config, folder, case, threads=threads)
    ExportStage().run(context)
    return context


def metric_case() -> dict:
    case = scene.ball_case()
    mask = np.ones((scene.HEIGHT, scene.WIDTH), bool)
    mask[:10] = False
    first = replace(case["views"].views[0], mask=mask)
    case["views"] = Views((first, *case["views"].views[1:]))
    case["cameras"] = Cameras(
        case["cameras"].cameras, input_from_world=SIMILARITY, scale=IN_MM, given=True
    )
    return case


@pytest.fixture(scope="module")
def exported(tmp_path_factory: pytest.TempPathFactory) -> LocalContext:
    return export(tmp_path_factory.mktemp("export"), inputs=metric_case())


@pytest.fixture(scope="module")
def folder(exported: LocalContext) -> Path:
    return exported.folder / "exports"


def bytes_of(folder: Path) -> dict[str, str]:
    return {
        str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


def test_everything_is_there_and_counted(exported: LocalContext, folder: Path) -> None:
    description = json.loads((folder / "scene.json").read_text())
    assert set(description["files"]) == {
        "viewer.html", "preview.png", "orbit.mp4", "splats.ply", "mesh.ply", "mesh.stl", "mesh.glb",
        "points.ply", "colmap", "transforms.json", "splats_constant_colour.ply",
        "splats.compressed.ply", "splats.sog", "splats.spz",
    }  # fmt: skip
    assert {path.name for path in folder.iterdir()} == {
        *description["files"], "scene.json", "README.txt",
    }  # fmt: skip
    assert description["frame"]["units"] == "mm"
    assert description["frame"]["name"] == "input"
    np.testing.assert_allclose(description["frame"]["frame_from_world"], SIMILARITY)
    np.testing.assert_allclose(description["frame"]["up"], [1, 0, 0], atol=0.01)
    assert description["counts"]["photographs"] == 4
    assert description["counts"]["placed_photographs"] == 3
    assert description["scale"] == IN_MM.as_dict()
    turned = description["frame"]["file_from_frame"]
    metres = np.diag([0.001, 0.001, 0.001, 1]).tolist()
    assert turned == {"mesh.glb": metres}, "the frame of given cameras is kept"
    assert " ".join(IN_MM.text.split()) in " ".join((folder / "README.txt").read_text().split())
    assert (folder / "mesh.stl").read_bytes()[:80].startswith(b"dentalsplat mm +-2.5% (length)")
    page = (folder / "viewer.html").read_text()
    assert json.dumps(IN_MM.as_dict(), separators=(",", ":")) in page
    assert exported.figures["splats"] == 1500
    assert exported.figures["mesh_faces"] == description["counts"]["mesh_faces"] > 500
    assert 0.05 < exported.figures["page_mb"] < 1
    assert not exported.warnings


def test_nothing_says_who_or_where(exported: LocalContext, folder: Path) -> None:
    secrets = [b"Smith", b"John", b"5ec2e7", b"Exif", b"EXIF", str(exported.folder).encode()]
    for path in folder.rglob("*"):
        assert "smith" not in path.name.lower()
        if path.is_file():
            data = path.read_bytes()
            for secret in secrets:
                assert secret not in data, f"{path.name} holds {secret!r}"


def test_pngs_hold_pixels_only(folder: Path) -> None:
    for path in folder.rglob("*.png"):
        data, at, kinds = path.read_bytes(), 8, set()
        while at < len(data):
            kinds.add(data[at + 4 : at + 8])
            at += 12 + int.from_bytes(data[at : at + 4], "big")
        assert kinds <= {b"IHDR", b"IDAT", b"IEND"}, path.name


def test_the_same_input_gives_the_same_bytes(tmp_path: Path, folder: Path) -> None:
    again = export(tmp_path, threads=2, inputs=metric_case())
    assert bytes_of(again.folder / "exports") == bytes_of(folder)


WHO_LOADS = """
import sys, threading
from pathlib import Path

class Watch:
    def find_spec(self, name, path=None, target=None):
        if name == "pymeshlab":
            print("in the main thread:", threading.current_thread() is threading.main_thread())

sys.meta_path.insert(0, Watch())
from tests.stages.test_export_stage import export
export(Path(sys.argv[1]), threads=2, splat_files=False, video=False)
"""


def test_pymeshlab_is_loaded_in_the_main_thread(tmp_path: Path) -> None:
    # PyMeshLab's Qt belongs to the thread that loads it: once that has ended, the program's own
    # end writes into freed memory (valgrind; `malloc_consolidate(): unaligned fastbin chunk`)
    command = [sys.executable, "-c", WHO_LOADS, str(tmp_path)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert done.stdout == "in the main thread: True\n"


ON_A_FULL_DISK = """
from pathlib import Path
import numpy as np
from stages.export.pictures.video import Video
with Video(Path("/dev/full"), (32, 32), 10, 20, beside=True) as video:
    for _ in range(9):
        video.add(np.zeros((48, 32), np.uint8))
"""


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="there is no /dev/full here")
def test_a_video_on_a_full_disk_is_an_error_and_no_crash() -> None:
    command = [sys.executable, "-c", ON_A_FULL_DISK]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 1 and "No space left" in done.stderr


def test_splats_are_in_the_stated_frame(folder: Path) -> None:
    splats = read_gaussians_ply(folder / "splats.ply")
    before = scene.ball_gaussians()
    expected = before.means @ SIMILARITY[:3, :3].T + SIMILARITY[:3, 3]
    np.testing.assert_allclose(splats["means"], expected, atol=1e-4)
    np.testing.assert_allclose(splats["log_scales"], before.log_scales + np.log(20), atol=1e-5)


def test_the_colmap_model_agrees_with_the_cameras(folder: Path) -> None:
    expected = move_cameras(scene.ball_cameras(), SIMILARITY)
    found = read_colmap(folder / "colmap" / "sparse" / "0")
    assert [camera.name for camera in found] == ["000", "001", "002"]
    for camera, truth in zip(found, expected, strict=True):
        np.testing.assert_allclose(camera.cam_from_world, truth.cam_from_world, atol=1e-9)
        np.testing.assert_allclose(camera.matrix, truth.matrix)
    model = pycolmap.Reconstruction(str(folder / "colmap" / "sparse" / "0"))
    assert model.num_reg_images() == 3
    assert 100 < model.num_points3D() <= 400
    for image in model.images.values():
        assert (folder / "colmap" / "images" / image.name).exists()
        camera = model.cameras[image.camera_id]
        assert image.num_points3D > 50
        for point2d in image.points2D:
            point = model.points3D[point2d.point3D_id]
            pixel = camera.img_from_cam(image.cam_from_world() * point.xyz)
            np.testing.assert_allclose(pixel, point2d.xy, atol=1e-3)
            # nothing on the far side of the ball is called seen
            centre = SIMILARITY[:3, 3]
            eye = image.projection_center() - centre
            assert (point.xyz - centre) @ eye > 0


def test_the_images_are_the_photographs(folder: Path) -> None:
    for view in scene.ball_case()["views"].views[:3]:
        picture = read_png(folder / "colmap" / "images" / f"{view.name}.png")
        assert np.array_equal(picture, to_uint8(view.image))
    assert not (folder / "colmap" / "images" / "003.png").exists(), "it has no camera"
    mask = read_png(folder / "colmap" / "masks" / "000.png.png")
    assert (mask[:10] == 0).all() and (mask[10:] == 255).all()


def test_nerfstudios_cameras_agree(folder: Path) -> None:
    transforms = json.loads((folder / "transforms.json").read_text())
    assert (folder / transforms["ply_file_path"]).exists()
    for frame, truth in zip(
        transforms["frames"], move_cameras(scene.ball_cameras(), SIMILARITY), strict=True
    ):
        assert (folder / frame["file_path"]).exists()
        assert (folder / frame["mask_path"]).exists()
        assert (frame["w"], frame["h"]) == (truth.width, truth.height)
        opengl = np.array(frame["transform_matrix"])
        np.testing.assert_allclose(opengl[:3, 3], truth.centre, atol=1e-9)
        np.testing.assert_allclose(opengl[:3, 2], -truth.rotation[2], atol=1e-9)  # looks along -z
        np.testing.assert_allclose(opengl[:3, 1], -truth.rotation[1], atol=1e-9)  # y is up
        assert np.linalg.det(opengl[:3, :3]) == pytest.approx(1)
        assert (frame["fl_x"], frame["fl_y"]) == (truth.fx, truth.fy)
        assert (frame["cx"], frame["cy"]) == (truth.cx, truth.cy)


def test_nerfstudios_points_are_what_its_cameras_show(folder: Path) -> None:
    """As its data parser has it: OpenGL's axes, and the points of `ply_file_path` as they are."""
    transforms = json.loads((folder / "transforms.json").read_text())
    cloud = open3d.io.read_point_cloud(str(folder / transforms["ply_file_path"]))
    points, colors = np.asarray(cloud.points), np.asarray(cloud.colors)
    for frame in transforms["frames"]:
        world_from_camera = np.array(frame["transform_matrix"])
        x, y, z = ((points - world_from_camera[:3, 3]) @ world_from_camera[:3, :3]).T
        u = frame["fl_x"] * x / -z + frame["cx"]
        v = frame["fl_y"] * -y / -z + frame["cy"]
        picture = read_png(folder / frame["file_path"])
        inside = (u >= 0) & (v >= 0) & (u < frame["w"]) & (v < frame["h"])
        assert (z < 0).all() and inside.mean() > 0.9
        shown = picture[v[inside].astype(int), u[inside].astype(int)] / 255
        front = z[inside] > np.median(z)  # the other half is hidden
        away = np.abs(shown - colors[inside])[front]
        mixed = np.abs(shown - colors[inside][::-1])[front]
        assert np.median(away) < 0.5 * np.median(mixed), "each has the colour of its own pixel"


@pytest.mark.parametrize("name", ["mesh.ply", "mesh.stl"])
def test_the_mesh_is_the_ball_where_it_was_seen(folder: Path, name: str) -> None:
    mesh = open3d.io.read_triangle_mesh(str(folder / name))
    assert 500 < len(mesh.triangles) <= 2000
    local = (np.asarray(mesh.vertices) - SIMILARITY[:3, 3]) / 20
    error = np.abs(np.linalg.norm(local, axis=1) - 1)
    assert np.median(error) < 0.03
    assert np.percentile(error, 95) < 0.15
    assert local[:, 2].min() < -0.9
    if name == "mesh.ply":
        assert mesh.has_vertex_colors()


def test_both_ways_to_a_mesh(tmp_path: Path) -> None:
    for method in ("tsdf", "poisson"):
        context = export(
            tmp_path / method, mesh_method=method, colmap=False, video=False, viewer=False,
            preview=False, splat_files=False,
        )  # fmt: skip
        file = tmp_path / method / "exports" / "mesh_without_scale.ply"
        mesh = open3d.io.read_triangle_mesh(str(file))
        error = np.abs(np.linalg.norm(np.asarray(mesh.vertices), axis=1) - 1)
        assert np.median(error) < 0.03
        assert context.figures["mesh_faces"] == len(mesh.triangles)
        names = {path.name for path in (tmp_path / method / "exports").iterdir()}
        assert names == {
            "splats.ply", "mesh_without_scale.ply", "mesh_without_scale.stl",
            "mesh_without_scale.glb", "scene.json", "README.txt",
        }  # fmt: skip


def test_the_video_plays_and_shows_the_scene(folder: Path) -> None:
    with av.open(str(folder / "orbit.mp4")) as video:
        stream = video.streams.video[0]
        assert stream.codec_context.name == "h264"
        assert stream.codec_context.pix_fmt == "yuv420p"
        assert stream.average_rate == 10
        frames = [frame.to_ndarray(format="rgb24") for frame in video.decode(video=0)]
    assert len(frames) == 8
    truth = scene.ball_case()["views"].views[1].image * 255.0
    for frame in frames:
        assert frame.shape == (scene.HEIGHT, scene.WIDTH, 3)
        assert frame[40:80, 60:100].mean() > 40
    assert np.abs(frames[0] - truth).mean() < 12, "it starts at the middle photograph"
    assert np.abs(frames[0][:, ::-1] - truth).mean() > 20
    assert np.abs(frames[2].astype(float) - frames[6]).mean() > 5, "the camera moves"


def test_the_best_video_is_one_that_plays_everywhere(tmp_path: Path) -> None:
    """Without loss it is "High 4:4:4 Predictive", which few decoders know."""
    with pytest.raises(ValidationError):
        ExportConfig(video_crf=0)
    with Video(tmp_path / "best.mp4", (32, 32), 10, crf=1) as video:
        video.add(np.random.default_rng(0).integers(0, 255, (48, 32), np.uint8))
    with av.open(str(tmp_path / "best.mp4")) as found:
        assert found.streams.video[0].codec_context.profile == "High"


def test_the_preview_is_a_picture(folder: Path) -> None:
    picture = read_png(folder / "preview.png")
    assert picture.ndim == 3
    assert 800 < picture.shape[1] < 1300
    assert picture.std() > 30


def test_too_little_for_a_mesh_is_said_and_the_rest_is_made(tmp_path: Path) -> None:
    case = scene.ball_case()
    case["points"] = case["points"][np.arange(20)]
    context = export(tmp_path, inputs=case, video=False)
    assert len(context.warnings) == 1 and "No mesh" in context.warnings[0]
    assert context.figures["mesh_faces"] == 0
    names = {path.name for path in (tmp_path / "exports").iterdir()}
    assert not any(name.startswith("mesh") for name in names)
    assert {"viewer.html", "preview.png", "splats.ply"} <= names
    assert json.loads((tmp_path / "exports" / "scene.json").read_text())["skipped"]


def test_points_are_optional_and_views_may_differ_in_size(tmp_path: Path) -> None:
    case = scene.ball_case()
    del case["points"]
    small = case["cameras"].cameras[2].resized(81, 61)
    image = np.ascontiguousarray(case["views"].views[2].image[:61, :81])
    case["cameras"] = Cameras((*case["cameras"].cameras[:2], small))
    case["views"] = Views((*case["views"].views[:2], View(name="002", image=image)))
    context = export(tmp_path, inputs=case)
    assert context.figures["mesh_faces"] > 300
    description = json.loads((tmp_path / "exports" / "scene.json").read_text())
    assert description["frame"]["units"] == "arbitrary"
    assert description["frame"]["name"] == "upright"


def test_settings_that_leave_no_mesh_are_named(tmp_path: Path) -> None:
    alone = {"colmap": False, "splat_files": False, "video": False, "viewer": False}
    context = export(tmp_path, mesh_confidence=100, preview=False, **alone)
    (said,) = context.warnings
    assert "known with export.mesh_confidence=100.0 (as a rule 1.2) and" in said
    assert "export.mesh_resolution=64 (as a rule 256). Leave that out" in said


def test_the_readme_speaks_of_what_is_there(tmp_path: Path) -> None:
    """And of what was asked for and is not; not of folders and files that nobody asked for."""
    case = scene.ball_case()
    case["points"] = case["points"][np.arange(20)]
    case["cameras"] = replace(case["cameras"], mouth_from_world=np.diag([1.0, -1, -1, 1]))
    less = {"colmap": False, "splat_files": False, "video": False, "preview": False}
    export(tmp_path, inputs=case, **less)
    text = " ".join((tmp_path / "exports" / "README.txt").read_text().split())
    assert "splats*.ply by 180 degrees about z, for SuperSplat. scene.json has the matrices" in text
    assert "Not made (mesh): too little surface for a mesh." in text
    for absent in ("colmap", "transforms.json", "mesh*.stl", "splats.sog", ".glb", "teeth.json"):
        assert absent not in text


def test_without_cameras_it_says_so(tmp_path: Path) -> None:
    case = scene.ball_case()
    case["cameras"] = Cameras(())
    with pytest.raises(ReconstructionError, match="none of the photographs"):
        export(tmp_path, inputs=case)


def test_a_mouth_stands_upright_in_every_file(tmp_path: Path) -> None:
    case = scene.ball_case()
    mouth = np.diag([1.0, -1, -1, 1])
    mouth[:3, 3] = [0.1, -0.2, -1]
    textbook = Scale("mm", "textbook_teeth", 15.0)
    case["cameras"] = replace(
        case["cameras"], scale=textbook, mouth_from_world=mouth, input_from_world=SIMILARITY
    )
    export(tmp_path, inputs=case, video=False, viewer=False, preview=False)
    home = tmp_path / "exports"
    description = json.loads((home / "scene.json").read_text())
    frame = description["frame"]
    assert frame["name"] == "mouth"
    similarity = np.array(frame["frame_from_world"])
    np.testing.assert_allclose(similarity, np.diag([20.0, 20, 20, 1]) @ mouth)
    assert description["scale"]["text"] in " ".join((home / "README.txt").read_text().split())
    ball = scene.ball_gaussians().means @ similarity[:3, :3].T + similarity[:3, 3]
    turn = np.array(frame["file_from_frame"]["splats.ply"])[:3, :3]
    found = read_gaussians_ply(home / "splats.ply")["means"]
    np.testing.assert_allclose(found, ball @ turn.T, atol=1e-3)
    centre = similarity[:3, 3]
    for name in ("mesh.ply", "mesh.stl"):
        turn = np.array(frame["file_from_frame"].get(name, np.eye(4)))[:3, :3]
        vertices = np.asarray(open3d.io.read_triangle_mesh(str(home / name)).vertices)
        away = vertices @ turn - centre  # back in the frame
        assert np.median(np.abs(np.linalg.norm(away, axis=1) - 20)) < 0.6
        assert away[:, 2].max() > 18, "the front, which was photographed, towards the viewer"
    assert b"z up" in (home / "mesh.stl").read_bytes()[:80]
