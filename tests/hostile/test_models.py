"""COLMAP models from outside: whole ones are read as COLMAP reads them, all else is refused."""

from __future__ import annotations

import shutil
import sqlite3
import struct
from pathlib import Path

import numpy as np
import pycolmap
import pytest

from pipeline.artifacts.space.scale import NO_SCALE
from pipeline.errors import RequestError
from pipeline.geometry.models.known_cameras import model_files, read_cameras
from pipeline.geometry.models.model_points import read_model_points
from pipeline.studies.compare.evidence import mapped_keypoints, read_evidence
from pipeline.untrusted.scenes.colmap import read_model

#: Counts that no file could hold are refused, not waited for.
pytestmark = pytest.mark.timeout(60)
SETTING = "init.cameras"
STEMS = ("cameras", "images", "points3D", "rigs", "frames")


@pytest.fixture(scope="module")
def models(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A model of two rigs with two cameras each, text and binary, with and without rigs."""
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs = options.num_cameras_per_rig = 2
    options.num_frames_per_rig, options.num_points3D = 3, 40
    pycolmap.set_random_seed(1)
    home = tmp_path_factory.mktemp("models")
    model = pycolmap.synthesize_dataset(options)
    for name in ("bin", "txt", "old_bin", "old_txt"):
        (home / name).mkdir()
        write = model.write_text if "txt" in name else model.write_binary
        write(str(home / name))
        for stem in ("rigs", "frames") if "old" in name else ():
            (home / name / f"{stem}.{name[4:]}").unlink()
    return home


def refused(folder: Path) -> str:
    """What is said of a model."""
    with pytest.raises(RequestError) as error:
        read_cameras(model_files(folder, SETTING).values(), SETTING)
    said = str(error.value)
    assert said.startswith(f"{SETTING}: {folder} ")
    assert "Is it whole?" in said or "holds no posed image" in said
    assert error.value.exit_status == 2 and len(said) < 500
    return said


@pytest.mark.parametrize("name", ["bin", "txt", "old_bin", "old_txt"])
def test_a_whole_model_is_read_as_colmap_reads_it(models: Path, name: str) -> None:
    folder = models / name
    truth = pycolmap.Reconstruction(str(folder))
    found, scale = read_cameras(model_files(folder).values())
    assert scale == NO_SCALE and len(found) == len(truth.images) == 12
    by_name = {image.name: image for image in truth.images.values()}
    for camera in found:
        image = by_name[camera.name]
        np.testing.assert_array_equal(camera.cam_from_world[:3], image.cam_from_world().matrix())
        lens = truth.cameras[image.camera_id]
        assert (camera.lens.model_name, *camera.lens.params) == (lens.model_name, *lens.params)
    points = read_model_points(folder)
    numbers = sorted(truth.points3D)
    np.testing.assert_array_equal(points.positions, [truth.points3D[n].xyz for n in numbers])
    for name_, image in by_name.items():
        seen = sorted({numbers.index(p.point3D_id) for p in image.points2D if p.has_point3D()})
        assert points.observed[name_].tolist() == seen
        kept = mapped_keypoints(folder)[name_]
        assert kept.tolist() == [point.has_point3D() for point in image.points2D]


@pytest.mark.parametrize("stem", STEMS)
@pytest.mark.parametrize("suffix", ["bin", "txt"])
def test_a_file_cut_off_anywhere_is_refused(
    models: Path, tmp_path: Path, stem: str, suffix: str
) -> None:
    folder = Path(shutil.copytree(models / suffix, tmp_path / "m"))
    whole = (folder / f"{stem}.{suffix}").read_bytes()
    cuts = np.unique(np.linspace(0, len(whole) - 1, 60).astype(int)).tolist()
    for cut in cuts:
        (folder / f"{stem}.{suffix}").write_bytes(whole[:cut])
        if cut == 0 and suffix == "txt":  # COLMAP's way to say that there are none
            continue
        assert f"{stem}.{suffix}" in refused(folder)
    if suffix == "bin":
        (folder / f"{stem}.{suffix}").write_bytes(whole + b"\0")
        assert f"{stem}.bin is longer than" in refused(folder)
    (folder / f"{stem}.{suffix}").unlink()
    if stem in ("rigs", "frames"):
        assert "not what belongs to it" in refused(folder)


@pytest.mark.parametrize("stem", STEMS)
@pytest.mark.parametrize("count", [2**64 - 1, 2**40, 2**31])
def test_counts_that_lie_are_refused(models: Path, tmp_path: Path, stem: str, count: int) -> None:
    folder = Path(shutil.copytree(models / "bin", tmp_path / "m"))
    path = folder / f"{stem}.bin"
    path.write_bytes(struct.pack("<Q", count) + path.read_bytes()[8:])
    said = refused(folder)
    assert f"{stem}.bin is cut off or damaged: it says {count} entries" in said


def _put(data: bytes, at: int, form: str, value: float) -> bytes:
    new = struct.pack(f"<{form}", value)
    return data[:at] + new + data[at + len(new) :]


def _text(data: bytes, old: str, new: str) -> bytes:
    assert old.encode() in data
    return data.replace(old.encode(), new.encode(), 1)


@pytest.mark.parametrize(
    ("file", "at", "form", "value", "words"),
    [
        ("cameras.bin", 12, "i", 99, "unknown kind 99"),
        ("cameras.bin", 12, "i", -1, "unknown kind -1"),
        ("cameras.bin", 12, "i", 17, "unknown kind 17"),
        ("cameras.bin", 16, "Q", 0, "width of camera 1 is 0"),
        ("cameras.bin", 24, "Q", 2**63, "height of camera 1 is 9223372036854775808"),
        ("cameras.bin", 32, "d", 0.0, "f of camera 1 is 0"),
        ("cameras.bin", 32, "d", -1.0, "f of camera 1 is -1"),
        ("cameras.bin", 32, "d", float("nan"), "f of camera 1 is nan"),
        ("cameras.bin", 32, "d", float("inf"), "f of camera 1 is inf"),
        ("cameras.bin", 40, "d", 1e7, "cx of camera 1 is 1e+07"),
        ("cameras.bin", 56, "d", float("nan"), "k of camera 1 is nan"),
        ("cameras.bin", 56, "d", 1e300, "k of camera 1 is 1e+300"),
        ("cameras.bin", 8, "I", 7, "camera 1"),
        ("images.bin", 12, "d", float("nan"), "QW QX QY QZ of image 1 is a quaternion of length"),
        ("images.bin", 12, "d", 5.0, "QW QX QY QZ of image 1 is a quaternion of length 5"),
        ("images.bin", 44, "d", float("inf"), "TX TY TZ of image 1 is inf"),
        ("images.bin", 44, "d", 1e15, "TX TY TZ of image 1 is 1e+15"),
        ("images.bin", 68, "I", 9, "whose camera 9 is not in cameras.bin"),
        ("images.bin", 72, "B", 0xFF, "not in UTF-8"),
        ("images.bin", 72, "B", 0x0A, "can't be printed"),
        ("images.bin", 72, "B", 0, "empty"),
        ("points3D.bin", 16, "d", float("nan"), "has no finite position"),
        ("points3D.bin", 51, "Q", 2**60, "says that it has 1152921504606846976 parts"),
        ("rigs.bin", 12, "I", 2**32 - 1, "rigs.bin"),
        ("rigs.bin", 16, "i", 12, "unknown kind 12"),
        ("frames.bin", 12, "I", 77, "of the rig 77, which is not there"),
        ("frames.bin", 16, "d", 0.0, "QW QX QY QZ of frame 1"),
        ("frames.bin", 48, "d", 1e3, "different poses"),
        ("frames.bin", 72, "I", 2**32 - 1, "frames.bin is damaged"),
        ("frames.bin", 72, "I", 0, "frames.bin"),
        ("frames.bin", 84, "Q", 4000, "without a frame"),
    ],
)
def test_a_damaged_entry_is_named(
    models: Path, tmp_path: Path, file: str, at: int, form: str, value: float, words: str
) -> None:
    folder = Path(shutil.copytree(models / "bin", tmp_path / "m"))
    path = folder / file
    data = path.read_bytes()
    if "length 0" in words:
        data = data[:12] + bytes(32) + data[44:]
    path.write_bytes(_put(data, at, form, value))
    assert words in refused(folder)


def test_a_quaternion_of_zeros_is_refused(models: Path, tmp_path: Path) -> None:
    folder = Path(shutil.copytree(models / "old_bin", tmp_path / "m"))
    data = (folder / "images.bin").read_bytes()
    (folder / "images.bin").write_bytes(data[:12] + bytes(32) + data[44:])
    assert "QW QX QY QZ of image 1 is a quaternion of length 0" in refused(folder)


@pytest.mark.parametrize(
    ("file", "old", "new", "words"),
    [
        ("cameras.txt", "SIMPLE_RADIAL", "SIMPLE_MAGIC", "'SIMPLE_MAGIC' is a model"),
        ("cameras.txt", "SIMPLE_RADIAL", "EQUIRECTANGULAR", "'EQUIRECTANGULAR' is a model"),
        ("cameras.txt", "SIMPLE_RADIAL 1024", "SIMPLE_RADIAL -1024", "'-1024' stands where"),
        ("cameras.txt", " 1280 ", " nan ", "f of camera 1 is nan"),
        ("cameras.txt", " 1280 ", " 1280 0x10 ", "'0x10' stands where a number should"),
        ("cameras.txt", " 1280 ", " ", "the line is too short"),
        ("cameras.txt", " 1280 ", " 1280 0 0 ", "(line 4)"),
        ("cameras.txt", "# Number of cameras: 4", "# Number of cameras: 5000000", "says 5000000"),
        ("images.txt", "# Number of images: 12", "# Number of images: 13", "says 13 in its"),
        ("images.txt", "camera000001_frame000000.png", "", "name '' is empty"),
        ("points3D.txt", "# Number of points: 40", "# Number of points: 999", "says 999"),
        ("points3D.txt", "\n1 ", "\n1 x", "stands where a number should"),
        ("points3D.txt", "\n1 ", "\n99999999999999999999999 ", "stands where a count"),
        ("points3D.txt", "\n1 ", "\n1 inf ", "points3D.txt"),
        ("frames.txt", "CAMERA", "RADAR", "'RADAR' is a model or sensor"),
        ("frames.txt", " 2 CAMERA", " 4000000000 CAMERA", "frames.txt"),
        ("rigs.txt", " 2 CAMERA", " 4000000000 CAMERA", "rigs.txt"),
    ],
)  # fmt: skip
def test_a_damaged_line_is_named(
    models: Path, tmp_path: Path, file: str, old: str, new: str, words: str
) -> None:
    folder = Path(shutil.copytree(models / "txt", tmp_path / "m"))
    path = folder / file
    path.write_bytes(_text(path.read_bytes(), old, new))
    said = refused(folder)
    assert words in said and file in said


@pytest.mark.parametrize("end", ["\n", "\r\n", " \n"])
def test_a_model_without_keypoints_has_lines_with_nothing_in_them(
    models: Path, tmp_path: Path, end: str
) -> None:
    """Programs that know poses alone write empty lines, some of them under Windows."""
    folder = Path(shutil.copytree(models / "txt", tmp_path / "m"))
    for path in folder.iterdir():
        lines = path.read_text().splitlines()
        if path.stem == "images":
            title = [line for line in lines if line[:1] == "#"]
            images = [line for line in lines if line[:1] != "#"][::2]
            lines = [*title, *(line for image in images for line in (image, ""))]
        text = "".join(f"{line}{end}" for line in lines)
        path.write_bytes(b"\xef\xbb\xbf" * (end == "\r\n") + text.encode())
    found, whole = read_model(folder), read_model(models / "txt")
    assert found.lenses == whole.lenses and found.frames == whole.frames
    for number, image in whole.images.items():
        assert found.images[number].cam_from_world == image.cam_from_world
        assert len(found.images[number].has_point) == 0


def test_entries_that_stand_twice_are_refused(models: Path, tmp_path: Path) -> None:
    for stem in STEMS:
        folder = Path(shutil.copytree(models / "txt", tmp_path / stem))
        path = folder / f"{stem}.txt"
        lines = path.read_text().splitlines(keepends=True)
        comments = [line for line in lines if line[0] == "#" and "Number of" not in line]
        entries = [line for line in lines if line[0] != "#"]
        twice = entries[: 2 if stem == "images" else 1]
        path.write_text("".join([*comments, *entries, *twice]))
        assert "twice" in refused(folder)


def test_points_of_unknown_images_are_refused(models: Path, tmp_path: Path) -> None:
    folder = Path(shutil.copytree(models / "bin", tmp_path / "m"))
    data = (folder / "points3D.bin").read_bytes()
    (folder / "points3D.bin").write_bytes(_put(data, 59, "I", 5000))
    with pytest.raises(RequestError, match="that image 5000 observes"):
        read_model_points(folder)


def _database(path: Path, *statements: str) -> Path:
    database = pycolmap.Database.open(str(path))
    lens = pycolmap.Camera(model="PINHOLE", width=64, height=48, params=[60, 60, 32, 24])
    camera = database.write_camera(lens)
    for name in ("a.png", "b.png"):
        image = database.write_image(pycolmap.Image(name=name, camera_id=camera))
        database.write_keypoints(image, np.zeros((5, 2), np.float32) + 3)
    geometry = pycolmap.TwoViewGeometry()
    geometry.inlier_matches = np.array([[0, 1], [2, 4]], np.uint32)
    database.write_two_view_geometry(1, 2, geometry)
    database.close()
    with sqlite3.connect(path) as plain:
        for statement in statements:
            plain.execute(statement)
    plain.close()
    return path


def test_a_database_is_read_and_stays_as_it_is(tmp_path: Path) -> None:
    path = _database(tmp_path / "database#1?.db")
    before = path.read_bytes()
    found = read_evidence(path)
    assert found.inliers["a.png", "b.png"].tolist() == [[0, 1], [2, 4]]
    assert found.keypoints["a.png"].tolist() == [[3, 3]] * 5
    assert found.lenses["a.png"].params.tolist() == [60, 60, 32, 24]
    assert path.read_bytes() == before


@pytest.mark.parametrize(
    ("statement", "words"),
    [
        ("UPDATE keypoints SET data = x'00112233'", "keypoints"),
        ("UPDATE keypoints SET rows = 1000000000", "keypoints"),
        ("UPDATE keypoints SET rows = -5", "keypoints"),
        ("UPDATE keypoints SET rows = 'many'", "keypoints"),
        ("UPDATE keypoints SET data = NULL", "keypoints"),
        ("UPDATE two_view_geometries SET data = x'FFFFFFFF00000000FFFFFFFF00000000'", "keypoint"),
        ("UPDATE two_view_geometries SET cols = 1, rows = 4", "two_view_geometries"),
        ("UPDATE two_view_geometries SET pair_id = 5", "two_view_geometries"),
        ("UPDATE cameras SET params = x'00'", "cameras"),
        ("UPDATE cameras SET params = zeroblob(32)", "fx of camera 1 is 0"),
        ("UPDATE cameras SET width = 0", "width of camera 1 is 0"),
        ("UPDATE cameras SET model = 99", "cameras"),
        ("UPDATE images SET camera_id = 12", "camera"),
        ("UPDATE images SET name = x'FF00' WHERE image_id = 1", "images"),
        ("DROP TABLE keypoints", "keypoints"),
        ("DELETE FROM images", "keypoints"),
    ],
)
def test_a_damaged_database_is_said_to_be(tmp_path: Path, statement: str, words: str) -> None:
    path = _database(tmp_path / "database.db", "PRAGMA foreign_keys = OFF", statement)
    with pytest.raises(sqlite3.Error, match=words):
        read_evidence(path)


def test_a_schema_that_is_no_text_is_said_to_be_damaged(tmp_path: Path) -> None:
    path = _database(tmp_path / "database.db")
    data = path.read_bytes()
    path.write_bytes(data.replace(b"CREATE TABLE keypoints", b"CREATE TABLE \xff\xfe\xfdpoints"))
    path.write_bytes(
        path.read_bytes().replace(b"CREATE TABLE images", b"CREATE \xff\xfeBLE images")
    )
    with pytest.raises(sqlite3.Error):
        read_evidence(path)


def test_a_database_that_never_ends_is_given_up(tmp_path: Path) -> None:
    endless = (
        "WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL SELECT i + 1 FROM n) "
        "SELECT i AS image_id, i || '' AS name, 1 AS camera_id FROM n"
    )
    path = _database(
        tmp_path / "database.db", "PRAGMA foreign_keys = OFF", "DROP TABLE images",
        f"CREATE VIEW images AS {endless}",
    )  # fmt: skip
    with pytest.raises(sqlite3.Error, match="images"):
        read_evidence(path)


@pytest.mark.parametrize("content", [b"", b"no database", b"SQLite format 3\0" + bytes(400)])
def test_what_is_no_database_is_said_to_be_none(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "database.db"
    path.write_bytes(content)
    with pytest.raises(sqlite3.Error):
        read_evidence(path)
    with pytest.raises(sqlite3.Error, match="folder"):
        read_evidence(tmp_path)


def test_half_a_database_is_said_to_be_damaged(tmp_path: Path) -> None:
    path = _database(tmp_path / "database.db")
    whole = path.read_bytes()
    for share in (0.1, 0.3, 0.5, 0.9):
        path.write_bytes(whole[: int(share * len(whole))])
        with pytest.raises(sqlite3.Error):
            read_evidence(path)
