"""Damage meshes, models, cameras, arrays and settings at random; each must be read or refused.

    python tests/soak/fuzz_numbers.py --seed 1 --count 2000

Every input is made from a whole one by flipped bytes, cuts, pieces left out or said twice, counts
and numbers changed. A process of its own reads it, with memory and time capped. What it says of
an input is `read`, `refused` (an error that explains itself, exit status 2), or BROKEN: any other
exception, a crash, more memory or more time. Exit status 1 if any is BROKEN.
"""

from __future__ import annotations

import argparse
import io
import json
import multiprocessing
import random
import re
import resource
import shutil
import sqlite3
import struct
import sys
import tempfile
import time
import traceback
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np

ROOT = Path(__file__).resolve().parents[2]
SAMPLES = ROOT / "data_samples" / "three_photos"
#: Seconds and MB of address space beyond what the warm reader has, that an input may take.
SECONDS, MEGABYTES = 10.0, 256


@dataclass(frozen=True)
class Seed:
    """A whole input: the file that is damaged, what lies beside it, and what reads it."""

    name: str
    reader: str
    file: Path
    text: bool


# -- whole inputs ---------------------------------------------------------------------------------


def seeds(home: Path) -> list[Seed]:
    """Write whole inputs of every kind below a folder."""
    return [*_meshes(home), *_models(home), *_lists(home), *_settings(home)]


def _meshes(home: Path) -> Iterator[Seed]:
    import open3d as o3d
    from plyfile import PlyData, PlyElement

    from pipeline.artifacts.gaussians import Gaussians, write_gaussians_ply

    ball = o3d.geometry.TriangleMesh.create_sphere(2.0, 5)
    ball.compute_vertex_normals()
    for name in ("little.ply", "ascii.ply", "mesh.stl", "mesh.obj"):
        o3d.io.write_triangle_mesh(home / name, ball, write_ascii=name == "ascii.ply")
        yield Seed(name, "mesh", home / name, name in ("ascii.ply", "mesh.obj"))
    corners, faces = np.asarray(ball.vertices), np.asarray(ball.triangles)
    vertex = np.array([tuple(v) for v in corners], [(axis, ">f8") for axis in "xyz"])
    face = np.empty(len(faces), [("vertex_indices", object), ("flag", "u1")])
    face["vertex_indices"] = [f[[0, 1, 2, 0][: 3 + k % 2]] for k, f in enumerate(faces)]
    face["flag"] = 0
    table = PlyElement.describe(face, "face", val_types={"vertex_indices": "u4"})
    big = PlyData([PlyElement.describe(vertex, "vertex"), table], byte_order=">")
    big.write(str(home / "big.ply"))
    yield Seed("big.ply", "mesh", home / "big.ply", False)
    lines = ["solid ball"]
    for corner in corners[faces]:
        rows = [f"vertex {x:.6g} {y:.6g} {z:.6g}" for x, y, z in corner]
        lines += ["facet normal 0 0 1", "outer loop", *rows, "endloop", "endfacet"]
    (home / "text.stl").write_text("\n".join([*lines, "endsolid ball"]))
    yield Seed("text.stl", "mesh", home / "text.stl", True)
    count = 8
    shape = {"means": (3,), "quats_wxyz": (4,), "log_scales": (3,), "logit_opacities": (),
             "sh": (16, 3)}  # fmt: skip
    splats = {name: np.ones((count, *rest), np.float32) for name, rest in shape.items()}
    write_gaussians_ply(home / "splats.ply", Gaussians(**splats))
    yield Seed("splats.ply", "splats", home / "splats.ply", False)


def _models(home: Path) -> Iterator[Seed]:
    import pycolmap

    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs = options.num_cameras_per_rig = 2
    options.num_frames_per_rig, options.num_points3D = 2, 12
    options.num_points2D_without_point3D = 3
    pycolmap.set_random_seed(1)
    model = pycolmap.synthesize_dataset(options)
    for form in ("bin", "txt", "old"):
        folder = home / f"model_{form}"
        folder.mkdir()
        (model.write_text if form == "txt" else model.write_binary)(str(folder))
        for stem in ("rigs", "frames") if form == "old" else ():
            (folder / f"{stem}.bin").unlink()
        for path in sorted(folder.iterdir()):
            yield Seed(f"{form}/{path.name}", "model", path, form == "txt")
    path = home / "database.db"
    database = pycolmap.Database.open(str(path))
    random_ = np.random.default_rng(1)
    lens = pycolmap.Camera(model="PINHOLE", width=640, height=480, params=[600, 600, 320, 240])
    camera = database.write_camera(lens)
    for name in ("a.png", "b.png"):
        image = database.write_image(pycolmap.Image(name=name, camera_id=camera))
        database.write_keypoints(image, random_.uniform(0, 480, (20, 2)).astype(np.float32))
    geometry = pycolmap.TwoViewGeometry()
    geometry.inlier_matches = np.stack([np.arange(20)] * 2, 1).astype(np.uint32)
    database.write_two_view_geometry(1, 2, geometry)
    database.close()
    yield Seed("database.db", "database", path, False)


def _lists(home: Path) -> Iterator[Seed]:
    listed = json.loads((SAMPLES / "transforms.json").read_text())
    (home / "transforms.json").write_text(json.dumps(listed, indent=1))
    yield Seed("transforms.json", "cameras", home / "transforms.json", True)
    points = np.random.default_rng(2).uniform(1, 2, (6, 8, 3)).astype(np.float32)
    arrays = {"points_i": points, "points_j_in_i": points, "confidence_i": points[..., 0] + 1,
              "confidence_j": points[..., 0] + 1, "names": np.array(["a.jpg", "b.jpg"]),
              "transform_i": np.eye(3), "transform_from": np.array("working")}  # fmt: skip
    for name, save in (("stored.npz", np.savez), ("packed.npz", np.savez_compressed)):
        save(home / name, **arrays)
        yield Seed(name, "arrays", home / name, False)


def _settings(home: Path) -> Iterator[Seed]:
    shutil.copy(ROOT / "configs" / "paper.yaml", home / "preset.yaml")
    yield Seed("preset.yaml", "preset", home / "preset.yaml", True)
    shutil.copy(ROOT / "configs" / "suites" / "smoke.yaml", home / "suite.yaml")
    yield Seed("suite.yaml", "suite", home / "suite.yaml", True)
    crowns = "{at: [412, 300], tooth: 16}, {at: [80.5, 310], remove: true}"
    (home / "teeth.yaml").write_text(
        "photographs:\n  a.jpg:\n    use: true\n    kind: right\n    mirrored: false\n"
        f"    crowns: [{crowns}, {{at: [240, 296], split: [[238, 220], [243, 380]]}}]\n"
    )
    yield Seed("teeth.yaml", "teeth", home / "teeth.yaml", True)
    (home / "set.txt").write_text("init.dental.tooth_widths={11: 8.5, 21: 8.4}")
    yield Seed("set.txt", "setting", home / "set.txt", True)


# -- damage ---------------------------------------------------------------------------------------

_WORDS = (
    b"nan", b"inf", b"-1", b"0", b"1e999", b"-1e30", b"4294967296", b"18446744073709551615",
    b"99999999999999999999999999", b"0x_", b"0x10", b"1_0", b"~", b"''", b"true", b"null", b"[]",
    b"{}", b"[[[[[[[[[[[[[[[[", b"&a [*a]", b"*a", b"!!int x", b"2024-02-30", b"~nosuchuser/x",
    b"\"x\"", b"-", b"", b"\xff", b"\0",
)  # fmt: skip
_NUMBER = re.compile(rb"-?\d+(?:\.\d+)?(?:[eE][-+]?\d+)?")


def damaged(data: bytes, chance: random.Random, text: bool) -> bytes:
    """A whole input with one to three things wrong."""
    for _ in range(chance.choice((1, 1, 1, 2, 3))):
        ways: list[Callable[[bytes, random.Random], bytes]] = [
            _flipped, _cut, _without, _twice, _inserted, _value,
        ]  # fmt: skip
        ways += [_word, _word, _word, _line] if text else [_value, _value, _flipped]
        data = chance.choice(ways)(data, chance)
    return data


def _span(data: bytes, chance: random.Random) -> tuple[int, int]:
    begin = chance.randrange(len(data) + 1)
    return begin, min(len(data), begin + chance.choice((1, 2, 4, 8, 30, 200)))


def _flipped(data: bytes, chance: random.Random) -> bytes:
    found = bytearray(data)
    for _ in range(chance.choice((1, 1, 2, 8)) if found else 0):
        found[chance.randrange(len(found))] ^= 1 << chance.randrange(8)
    return bytes(found)


def _cut(data: bytes, chance: random.Random) -> bytes:
    return data[: chance.randrange(len(data) + 1)]


def _without(data: bytes, chance: random.Random) -> bytes:
    begin, end = _span(data, chance)
    return data[:begin] + data[end:]


def _twice(data: bytes, chance: random.Random) -> bytes:
    begin, end = _span(data, chance)
    return data[:end] + data[begin:]


def _inserted(data: bytes, chance: random.Random) -> bytes:
    begin, _ = _span(data, chance)
    return data[:begin] + chance.randbytes(chance.choice((1, 4, 50))) + data[begin:]


def _value(data: bytes, chance: random.Random) -> bytes:
    """A number of four or eight bytes in place of another."""
    begin = chance.randrange(len(data) + 1)
    if chance.random() < 0.5:  # heads have the counts
        begin = min(begin, chance.randrange(100))
    values = (
        struct.pack("<I", chance.choice((0, 1, 255, 2**31, 2**32 - 1))),
        struct.pack("<Q", chance.choice((0, 2**31, 2**40, 2**63, 2**64 - 1))),
        struct.pack(chance.choice("<>") + "d", chance.choice((0.0, float("nan"), -1e300, 1e12))),
        struct.pack(chance.choice("<>") + "f", chance.choice((0.0, float("inf"), -1e30, 1e9))),
    )
    new = chance.choice(values)
    return data[:begin] + new + data[begin + len(new) :]


def _word(data: bytes, chance: random.Random) -> bytes:
    """A number of a text changed, or one of the words that readers trip over in its place."""
    places = list(_NUMBER.finditer(data))
    if not places:
        return _inserted(data, chance)
    place = chance.choice(places)
    new = chance.choice(_WORDS)
    if chance.random() < 0.3:
        new = str(chance.choice((-1, 1, 10)) * chance.randrange(1, 1000)).encode()
    return data[: place.start()] + new + data[place.end() :]


def _line(data: bytes, chance: random.Random) -> bytes:
    lines = data.split(b"\n")
    at = chance.randrange(len(lines))
    way = chance.randrange(3)
    if way == 0:
        del lines[at]
    elif way == 1:
        lines.insert(at, lines[chance.randrange(len(lines))])
    else:
        lines[at] = lines[at] * chance.choice((2, 1000))
    return b"\n".join(lines)


# -- reading --------------------------------------------------------------------------------------


def _read(reader: str, path: Path) -> None:
    """Read an input as the stage or command that takes it does."""
    from pipeline.artifacts.dental.corrections import read_corrections
    from pipeline.artifacts.gaussians import read_gaussians_ply
    from pipeline.config import load_config
    from pipeline.geometry.mesh import Mesh
    from pipeline.studies.benchmark.suite import load_suite

    if reader == "mesh":
        mesh = Mesh.read(path, "mesh")
        assert np.isfinite(mesh.distances(np.ones((3, 3)))).all()
    elif reader == "splats":
        read_gaussians_ply(path)
    elif reader == "model":
        _use_cameras(path.parent)
        from pipeline.geometry.models.model_points import read_model_points
        from pipeline.studies.compare.evidence import mapped_keypoints

        read_model_points(path.parent)
        mapped_keypoints(path.parent)
    elif reader == "cameras":
        _use_cameras(path)
    elif reader == "database":
        from pipeline.studies.compare.evidence import pair_table, read_evidence, triangulation_angle

        found = read_evidence(path)
        for entry in pair_table(found):
            triangulation_angle(found, (entry["images"][0], entry["images"][1]))
    elif reader == "arrays":
        _use_arrays(path)
    elif reader == "preset":
        load_config(path)
    elif reader == "suite":
        load_suite(path, data=ROOT / "data_samples")
    elif reader == "teeth":
        read_corrections(path)
    else:
        load_config(None, [path.read_bytes().decode("latin-1")])


def _use_cameras(path: Path) -> None:
    from pipeline.artifacts.views import View
    from pipeline.geometry.models.known_cameras import as_pinhole, model_files, read_cameras

    for known in read_cameras(model_files(path, "cameras").values(), "cameras")[0]:
        shape = known.lens.width / known.lens.height
        width, height = max(1, round(min(40, 40 * shape))), max(1, round(min(40, 40 / shape)))
        image = np.zeros((height, width, 3), np.float32)
        _, camera = as_pinhole(View("000", image, source_size=(width, height)), known)
        assert np.isfinite([camera.fx, camera.fy, camera.cx, camera.cy]).all()
        assert np.isfinite(camera.cam_from_world).all() and camera.fx > 0


def _use_arrays(path: Path) -> None:
    from pipeline.artifacts.views import View
    from stages.pointmaps.files import match_names, read_pairs

    views = [
        View(f"{k:03d}", np.zeros((6, 8, 3), np.float32), source_name=f"{'ab'[k]}.jpg")
        for k in range(2)
    ]
    for _ in read_pairs(match_names([path], views, "auto"), views, 0.1, lambda *_: None):
        pass


def _worker(jobs: Connection, whole: list[tuple[str, str]], megabytes: int) -> None:
    """Read what it is told to, and say what came of it."""
    from pipeline.errors import RequestError

    sys.stderr = io.StringIO()
    for reader, path in whole:  # loads every library, before memory is capped
        try:
            _read(reader, Path(path))
        except BaseException:
            jobs.send((f"a whole input can't be read: {path}", traceback.format_exc()))
            return
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    cap = pages * resource.getpagesize() + megabytes * (1 << 20)
    resource.setrlimit(resource.RLIMIT_AS, (cap, cap))
    jobs.send(("ready", ""))
    while True:
        reader, path = jobs.recv()
        try:
            _read(reader, Path(path))
            answer = ("read", "")
        except (RequestError, sqlite3.Error) as error:
            said = str(error)
            answer = ("refused", said) if len(said) < 4000 else ("BROKEN", "a message too long")
        except BaseException:
            answer = ("BROKEN", traceback.format_exc(limit=-4))
        jobs.send(answer)


class Reader:
    """A process that reads; another takes its place when it is gone."""

    def __init__(self, whole: list[tuple[str, str]], seconds: float, megabytes: int) -> None:
        self.whole, self.seconds, self.megabytes = whole, seconds, megabytes
        self.process: Any = None
        self._start()

    def _start(self) -> None:
        context = multiprocessing.get_context("spawn")
        self.jobs, far = context.Pipe()
        arguments = (far, self.whole, self.megabytes)
        self.process = context.Process(target=_worker, args=arguments, daemon=True)
        self.process.start()
        far.close()
        said, why = self.jobs.recv()
        if said != "ready":
            raise SystemExit(f"{said}\n{why}")

    def read(self, reader: str, path: Path) -> tuple[str, str]:
        self.jobs.send((reader, str(path)))
        try:
            if self.jobs.poll(self.seconds):
                answer: tuple[str, str] = self.jobs.recv()
                return answer
            said = f"took more than {self.seconds:g} s"
        except EOFError:
            self.process.join()
            said = f"the process ended with {self.process.exitcode}"
        self.stop()
        self._start()
        return "BROKEN", said

    def stop(self) -> None:
        self.process.kill()
        self.process.join()


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n", 1)[0])
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--count", type=int, default=2000)
    parser.add_argument("--only", default="", help="inputs whose name begins so")
    parser.add_argument("--quiet", action="store_true", help="say only what is BROKEN")
    parser.add_argument("--keep", type=Path, help="folder for inputs that are BROKEN")
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        return _run(Path(scratch), given)


def _run(scratch: Path, given: argparse.Namespace) -> int:
    home, place = scratch / "whole", scratch / "damaged"
    home.mkdir()
    found = [seed for seed in seeds(home) if seed.name.startswith(given.only)]
    chance = random.Random(given.seed)
    counts: Counter[tuple[str, str]] = Counter()
    reader = Reader([(s.reader, str(s.file)) for s in found], SECONDS, MEGABYTES)
    slowest, begin = (0.0, ""), time.monotonic()
    for number in range(given.count):
        seed = found[number % len(found)]
        shutil.rmtree(place, ignore_errors=True)
        if seed.reader == "model":
            shutil.copytree(seed.file.parent, place)
        else:
            place.mkdir()
        path = place / seed.file.name
        path.write_bytes(damaged(seed.file.read_bytes(), chance, seed.text))
        started = time.monotonic()
        outcome, said = reader.read(seed.reader, path)
        slowest = max(slowest, (time.monotonic() - started, f"{number} {seed.name}"))
        counts[seed.name, outcome] += 1
        if outcome == "BROKEN" or not given.quiet:
            line = said if outcome == "BROKEN" else said.replace(str(path), seed.file.name)[:150]
            print(f"{number} {seed.name}: {outcome} {line}", flush=True)
        if outcome == "BROKEN" and given.keep:
            given.keep.mkdir(parents=True, exist_ok=True)
            shutil.copy(path, given.keep / f"{number}_{seed.file.name}")
    reader.stop()
    outcomes = ("read", "refused", "BROKEN")
    print(f"\n{'':20}" + "".join(f"{outcome:>9}" for outcome in outcomes))
    for seed in found:
        print(f"{seed.name:20}" + "".join(f"{counts[seed.name, o]:9}" for o in outcomes))
    totals = [sum(counts[seed.name, o] for seed in found) for o in outcomes]
    print(f"{'all':20}" + "".join(f"{total:9}" for total in totals))
    print(
        f"{time.monotonic() - begin:.0f} s; the slowest took {slowest[0]:.2f} s ({slowest[1]}); "
        f"memory capped at {MEGABYTES} MB beyond the reader's own"
    )
    return 1 if totals[2] else 0


if __name__ == "__main__":
    sys.path.insert(0, str(ROOT))
    raise SystemExit(main())
