"""Meshes from outside: what is whole is read as it is, all else is refused by name."""

from __future__ import annotations

import resource
import struct
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import open3d as o3d
import pytest

from pipeline.artifacts.gaussians import read_gaussians_ply
from pipeline.artifacts.points import Points
from pipeline.errors import RequestError
from pipeline.geometry.mesh import Mesh
from pipeline.untrusted.files import MESH
from pipeline.untrusted.scenes.meshes import read_mesh
from pipeline.untrusted.scenes.ply import read_cloud

SETTING = "evaluate.mesh"
CORNERS = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], np.float64)
FACES = np.array([[0, 1, 2], [0, 3, 1], [1, 3, 2], [0, 2, 3]])


def ply(
    order: str = "binary_little_endian", vertices: int | str = 4, faces: int | str = 4,
    index: str = "int", length: str = "uchar",
) -> bytes:  # fmt: skip
    """A tetrahedron; counts and types of the header as asked."""
    head = (
        f"ply\nformat {order} 1.0\ncomment made here\nelement vertex {vertices}\n"
        "property float x\nproperty float y\nproperty float z\nproperty uchar red\n"
        f"element face {faces}\nproperty list {length} {index} vertex_indices\nend_header\n"
    ).encode()
    if order == "ascii":
        rows = [f"{x:g} {y:g} {z:g} 7" for x, y, z in CORNERS]
        rows += [f"3 {a} {b} {c}" for a, b, c in FACES]
        return head + ("\n".join(rows) + "\n").encode()
    mark = ">" if "big" in order else "<"
    body = b"".join(struct.pack(f"{mark}3fB", *corner, 7) for corner in CORNERS)
    return head + body + b"".join(struct.pack(f"{mark}B3i", 3, *face) for face in FACES)


def stl() -> bytes:
    rows = [struct.pack("<12fH", 0, 0, 0, *CORNERS[face].reshape(-1), 0) for face in FACES]
    return bytes(80) + struct.pack("<I", len(rows)) + b"".join(rows)


def stl_text() -> bytes:
    lines = ["solid tooth"]
    for face in FACES:
        corners = [f"  vertex {x:g} {y:g} {z:g}" for x, y, z in CORNERS[face]]
        lines += ["facet normal 0 0 1", " outer loop", *corners, " endloop", "endfacet"]
    return "\n".join([*lines, "endsolid tooth"]).encode()


def obj() -> bytes:
    rows = [f"v {x:g} {y:g} {z:g}" for x, y, z in CORNERS]
    rows += [f"f {a + 1}/1/1 {b + 1} {c + 1}//2" for a, b, c in FACES]
    return ("# made here\n" + "\n".join(rows) + "\n").encode()


def refused(tmp_path: Path, name: str, content: bytes) -> str:
    """What is said of a file."""
    path = tmp_path / name
    path.write_bytes(content)
    with pytest.raises(RequestError) as error:
        Mesh.read(path, SETTING)
    said = str(error.value)
    assert said.startswith(f"{SETTING}: {path} ") and "Give a triangle mesh" in said
    assert error.value.exit_status == 2 and len(said) < 400
    return said


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("a.ply", ply("ascii")),
        ("a.ply", ply()),
        ("a.ply", ply("binary_big_endian")),
        ("a.ply", ply().replace(b"\nend_header\n", b"\r\nend_header\r\n")),
        ("a.STL", stl()),
        ("a.stl", b"solid but binary" + stl()[16:]),
        ("a.stl", stl_text()),
        ("a.obj", obj()),
        ("a.obj", obj().replace(b"f 1/1/1 2 3//2", b"vn 0 0 1\nf -4 -3 -2")),
    ],
)
def test_a_whole_mesh_is_read_as_it_is(tmp_path: Path, name: str, content: bytes) -> None:
    (tmp_path / name).write_bytes(content)
    vertices, triangles = read_mesh(tmp_path / name)
    assert vertices.dtype == np.float64 and triangles.dtype == np.uint32
    np.testing.assert_array_equal(vertices[triangles], CORNERS[FACES])
    mesh = Mesh.read(tmp_path / name, SETTING)
    assert mesh.diagonal == pytest.approx(3**0.5)
    assert mesh.distances(np.array([[0.5, -1.0, 0.0]])) == pytest.approx([1.0])


@pytest.mark.parametrize("suffix", [".ply", ".stl", ".obj"])
@pytest.mark.parametrize("text", [False, True])
def test_what_open3d_writes_is_read(tmp_path: Path, suffix: str, text: bool) -> None:
    ball = o3d.geometry.TriangleMesh.create_sphere(2.0, 10)
    ball.compute_vertex_normals()
    path = tmp_path / f"ball{suffix}"
    assert o3d.io.write_triangle_mesh(path, ball, write_ascii=text and suffix == ".ply")
    vertices, triangles = read_mesh(path)
    truth = np.asarray(ball.vertices)[np.asarray(ball.triangles)]
    np.testing.assert_allclose(vertices[triangles], truth, atol=1e-5)


@pytest.mark.parametrize("order", ["ascii", "binary_big_endian"])
def test_polygons_become_fans(tmp_path: Path, order: str) -> None:
    head = ply(order, faces=3).split(b"end_header\n")[0] + b"end_header\n"
    faces = [(0, 1, 2), (0, 1, 2, 3), (3, 2, 1)]
    if order == "ascii":
        body = b"0 0 0 1\n1 0 0 1\n0 1 0 1\n0 0 1 1\n3 0 1 2\n4 0 1 2 3\n3 3 2 1\n"
    else:
        body = b"".join(struct.pack(">3fB", *corner, 7) for corner in CORNERS)
        body += b"".join(struct.pack(f">B{len(f)}i", len(f), *f) for f in faces)
    (tmp_path / "a.ply").write_bytes(head + body)
    _, triangles = read_mesh(tmp_path / "a.ply")
    assert triangles.tolist() == [[0, 1, 2], [0, 1, 2], [0, 2, 3], [3, 2, 1]]


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"", "does not begin with a line 'ply'"),
        (b"ply\nformat ascii 1.0\n", "no end_header"),
        (ply("binary_middle_endian"), "line 2"),
        (ply(vertices=0), "shorter than 3"),
        (ply(vertices=0, faces=0)[:-9], "longer than its header"),
        (ply(vertices=0, faces=0).split(b"end_header\n")[0] + b"end_header\n", "no triangles"),
        (ply(faces=0)[:-52], "no triangles"),
        (ply(vertices=10**12), "says 1000000000000 rows of 'vertex'"),
        (ply(faces=2**31 - 1), "says 2147483647 rows of 'face'"),
        (ply(faces=2**62), "says 4611686018427387904 rows of 'face'"),
        (ply(faces=5), "cut off"),
        (ply(faces=3), "13 bytes are left over"),
        (ply("ascii", faces=10**9), "says 1000000000 rows of 'face'"),
        (ply("ascii", faces=3), "4 numbers are left over"),
        (ply(vertices=-4), "line 4"),
        (ply(vertices="many"), "line 4"),
        (ply(length="float"), "line 10"),
        (ply(length="double"), "line 10"),
        (ply(index="quad"), "line 10"),
        (ply(index="float"), "has the vertex"),
        (ply().replace(b"property uchar red", b"property float y"), "declares the property 'y'"),
        (ply().replace(b"element face", b"element vertex"), "element 'vertex' twice"),
        (ply().replace(b"\xff", b"").replace(b"float x", b"float q"), "no vertices with x"),
        (ply().replace(b"vertex_indices", b"vertex_colours"), "no faces with vertex_indices"),
        (ply()[:-1], "cut off"),
        (ply()[: len(ply()) // 2], "no end_header"),
        (ply("ascii")[:-1], "last line has no end"),
        (ply("ascii")[:-9], "last line has no end"),
        (ply("ascii")[:-8], "cut off"),
        (ply("ascii").replace(b"3 0 3 1", b"3 0 x 1"), "no number in its body"),
        (ply("ascii").replace(b"3 0 3 1", b"3 0 9 1"), "has the vertex 9"),
        (ply("ascii").replace(b"3 0 3 1", b"3 0 -1 1"), "has the vertex -1"),
        (ply("ascii").replace(b"3 0 3 1", b"3 0 1.5 1"), "has the vertex 1.5"),
        (ply("ascii").replace(b"3 0 3 1", b"nan 0 3 1"), "nan values"),
        (ply("ascii").replace(b"3 0 3 1", b"1e300 0 3 1"), "1e+300 values"),
        (ply("ascii").replace(b"3 0 3 1", b"-3 0 3 1"), "-3 values"),
        (ply("ascii").replace(b"0 0 1 7", b"0 0 nan 7"), "vertex 3 is at (0, 0, nan)"),
        (ply("ascii").replace(b"0 0 1 7", b"0 inf 1 7"), "vertex 3 is at (0, inf, 1)"),
        (ply("ascii").replace(b"0 0 1 7", b"0 1e30 1 7"), "vertex 3 is at (0, 1e+30, 1)"),
        (ply("ascii").replace(b"0 1 0", b"0 0 0").replace(b"1 0 0", b"0 0 0").replace(
            b"0 0 1 7", b"0 0 0 7"), "all at one place"),
        (ply().replace(struct.pack("<B3i", 3, 0, 3, 1), struct.pack("<B3i", 250, 0, 3, 1)),
         "cut off, or damaged"),
        (ply().replace(struct.pack("<B3i", 3, 0, 3, 1), struct.pack("<B3i", 0, 0, 3, 1)),
         "shorter than 3"),
        (ply().replace(struct.pack("<B3i", 3, 0, 3, 1), struct.pack("<B3i", 3, 0, 4, 1)),
         "has the vertex 4, and there are 4"),
        (ply().replace(b"comment made here", b"comment\n" * 2000), "header of"),
        (b"ply\n" + b"comment" * 20000, "no end_header"),
    ],
)  # fmt: skip
def test_a_damaged_ply_is_refused(tmp_path: Path, content: bytes, words: str) -> None:
    assert words in refused(tmp_path, "a.ply", content)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"", "the head alone has 84"),
        (stl()[:-1], "says 4 triangles, which are 284 bytes, and it has 283"),
        (stl() + b"\0", "and it has 285"),
        (bytes(80) + struct.pack("<I", 2**32 - 1) + bytes(50), "says 4294967295 triangles"),
        (bytes(84), "holds no triangles"),
        (stl()[:84] + bytes(200), "all at one place"),
        (stl()[:96] + struct.pack("<f", float("nan")) + stl()[100:], "vertex 0 is at (nan, 0, 0)"),
        (stl_text()[:-15], "no endsolid"),
        (stl_text()[:-25], "cut off"),
        (stl_text()[: len(stl_text()) // 2], "STL"),
        (stl_text().replace(b"endloop", b"vertex 1 2 3", 1), "line 7"),
        (stl_text().replace(b"vertex 1 0 0", b"vertex 1 0", 1), "2 coordinates"),
        (stl_text().replace(b"vertex 1 0 0", b"vertex 1 0 ?", 1), "no number"),
        (b"solid nothing\nendsolid nothing\n", "holds no triangles"),
    ],
)
def test_a_damaged_stl_is_refused(tmp_path: Path, content: bytes, words: str) -> None:
    said = refused(tmp_path, "a.stl", content)
    assert words in said or (words == "cut off" and "line" in said)


def test_an_obj_without_a_last_line_break_is_whole_if_all_vertices_have_faces(
    tmp_path: Path,
) -> None:
    for name, content in (("a.obj", obj()), ("b.obj", obj()[:-1])):
        (tmp_path / name).write_bytes(content)
    first, second = (Mesh.read(tmp_path / name, "evaluate.mesh") for name in ("a.obj", "b.obj"))
    assert np.array_equal(first.vertices, second.vertices)
    beside = np.array([[0.2, 0.1, -1.0]])
    assert np.array_equal(first.closest(beside), second.closest(beside))


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"\n", "holds no triangles"),
        (obj()[: obj().index(b"3//2") + 4], "last line has no end"),
        (obj().replace(b" 3//2", b" 5//2"), "has the vertex 4, and there are 4"),
        (obj().replace(b"f 1/1/1 2 3//2", b"f 1 2"), "2 corners"),
        (obj().replace(b"f 1/1/1 2 3//2", b"f"), "0 corners"),
        (obj().replace(b"f 1/1/1 2 3//2", b"f 0 1 2"), "has the corner '0'"),
        (obj().replace(b"f 1/1/1 2 3//2", b"f -9 1 2"), "has the corner -9"),
        (obj().replace(b"f 1/1/1 2 3//2", b"f 1.5 1 2"), "has the corner '1.5'"),
        (obj().replace(b"f 1/1/1 2 3//2", b"f " + b"9" * 40 + b" 1 2"), "has the corner '9999"),
        (obj().replace(b"v 1 0 0", b"v 1 0"), "2 coordinates"),
        (obj().replace(b"v 1 0 0", b"v 1 0 nan"), "vertex 1 is at (1, 0, nan)"),
        (obj().replace(b"v 1 0 0", b"v 1 0 \0"), "zero bytes"),
        (b"v " + b"1 " * 200_000 + b"\n", "has a line of 400002 bytes"),
    ],
)
def test_a_damaged_obj_is_refused(tmp_path: Path, content: bytes, words: str) -> None:
    assert words in refused(tmp_path, "a.obj", content)


def test_an_obj_opens_no_other_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "a.obj").write_bytes(b"mtllib a.mtl\nmtllib ../../etc/passwd\nusemtl x\n" + obj())
    opened: list[object] = []
    sys.addaudithook(lambda event, values: opened.append(values[0]) if event == "open" else None)
    read_mesh(tmp_path / "a.obj")
    named = [str(name) for name in opened]
    assert not [name for name in named if "mtl" in name or "passwd" in name]
    assert [name for name in named if name.endswith("a.obj")]


def test_other_suffixes_and_missing_files_are_named(tmp_path: Path) -> None:
    assert "is no .ply, .stl or .obj" in refused(tmp_path, "a.gltf", b"{}")
    for path in (tmp_path / "none.ply", tmp_path, Path("~nosuchuser/a.ply"), Path("a" * 5000)):
        with pytest.raises(RequestError, match=SETTING):
            Mesh.read(path, SETTING)


def _floats(order: str, count: int, values: int) -> bytes:
    """A cloud's header that says more than there is."""
    head = f"ply\nformat {order} 1.0\nelement vertex {count}\n" + "property float x\n"
    return head.encode() + b"end_header\n" + b"1 " * values + b"\n"


_MEASURE = """
import resource, sys
from pathlib import Path
from pipeline.untrusted.files import UnusableFile
from pipeline.untrusted.scenes.meshes import read_mesh
before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
try:
    read_mesh(Path(sys.argv[1]))
    said = "read"
except UnusableFile as error:
    said = str(error)
print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before, said)
"""


@pytest.mark.parametrize(
    ("name", "make", "times"),
    [
        ("head.ply", lambda: ply(faces=2**40, vertices=2**40), 1),
        ("text.ply", lambda: _floats("ascii", 2**33, 4_000_000), 8),
        ("lists.ply", lambda: (
            b"ply\nformat binary_little_endian 1.0\nelement face 3000000\n"
            b"property list uchar uchar vertex_indices\nend_header\n" + bytes(8_000_000)), 4),
        ("count.stl", lambda: bytes(80) + struct.pack("<I", 2**32 - 1) + bytes(8_000_000), 4),
        ("line.obj", lambda: b"f " + b"1 " * 4_000_000 + b"\n", 4),
        ("lines.obj", lambda: b"f 1 1 1\n" * 400_000, 10),
    ],
)  # fmt: skip
def test_memory_is_bounded_by_the_file(
    tmp_path: Path, name: str, make: Callable[[], bytes], times: int
) -> None:
    (tmp_path / name).write_bytes(make())
    command = [sys.executable, "-c", _MEASURE, str(tmp_path / name)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr
    kilobytes, said = done.stdout.split(maxsplit=1)
    unit = 1 if sys.platform == "darwin" else 1024
    size = (tmp_path / name).stat().st_size
    assert int(kilobytes) * unit < times * size + 8e6, said
    assert said.strip() != "read"


def test_splats_and_clouds_are_read_by_the_same_reader(tmp_path: Path) -> None:
    path = tmp_path / "points.ply"
    path.write_bytes(ply())
    assert read_cloud(path, "xyz")["red"].tolist() == [7] * 4
    with pytest.raises(RequestError, match=r"points\.ply has no vertices with f_dc_0, f_dc_1"):
        read_gaussians_ply(path)
    with pytest.raises(RequestError, match=r"points\.ply has no vertices with nx, ny, nz, green"):
        Points.load(tmp_path)
    path.write_bytes(ply()[:-20])
    for reader in (read_gaussians_ply, lambda at: Points.load(at.parent)):
        with pytest.raises(RequestError, match=r"points\.ply is cut off"):
            reader(path)


def test_a_mesh_beyond_the_limit_is_not_read(tmp_path: Path) -> None:
    path = tmp_path / "a.ply"
    with path.open("wb") as file:
        file.write(ply())
        file.truncate(MESH.most_bytes + 1)
    with pytest.raises(RequestError, match="more than a mesh may have"):
        Mesh.read(path, SETTING)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss < 1 << 30
