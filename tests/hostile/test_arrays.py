"""Pointmaps in `.npz` from outside: whole ones are read, all else is refused, nothing unpacked."""

from __future__ import annotations

import io
import resource
import struct
import sys
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pipeline.artifacts.views import View
from pipeline.errors import RequestError
from pipeline.untrusted.arrays import read_arrays
from stages.pointmaps.files import KEYS, PairFile, match_names, read_pairs

VIEWS = [View(f"{k:03d}", np.zeros((6, 8, 3), np.float32), source_name=n) for k, n in
         enumerate(("a.jpg", "b.jpg"))]  # fmt: skip


def arrays(**changes: Any) -> dict[str, Any]:
    points = np.full((6, 8, 3), 2.0, np.float32)
    given = {"points_i": points, "points_j_in_i": points,
             "confidence_i": points[..., 0], "confidence_j": points[..., 0]}  # fmt: skip
    return {**given, "names": np.array(["a.jpg", "b.jpg"]), **changes}


def packed(save: Callable[..., None] = np.savez, **changes: Any) -> bytes:
    stream = io.BytesIO()
    save(stream, **arrays(**changes))
    return stream.getvalue()


def zipped(entries: dict[str, bytes], way: int = zipfile.ZIP_STORED) -> bytes:
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", way) as archive:
        for name, data in entries.items():
            archive.writestr(name, data)
    return stream.getvalue()


def npy(header: str, data: bytes = b"", version: int = 1) -> bytes:
    text = header.encode("latin-1") + b"\n"
    form = "<H" if version == 1 else "<I"
    return b"\x93NUMPY" + bytes([version, 0]) + struct.pack(form, len(text)) + text + data


def header(descr: str = "'<f4'", shape: str = "(6, 8, 3)", order: str = "False") -> str:
    return f"{{'descr': {descr}, 'fortran_order': {order}, 'shape': {shape}, }}"


def used(path: Path) -> Any:
    """A pair as the stage uses it."""
    found = match_names([path], VIEWS, "auto")
    return next(read_pairs(found, VIEWS, 0.1, lambda *_: None))


def refused(tmp_path: Path, content: bytes) -> str:
    path = tmp_path / "pair.npz"
    path.write_bytes(content)
    with pytest.raises(RequestError) as error:
        used(path)
    said = str(error.value)
    assert said.startswith(str(path)) and error.value.exit_status == 2 and len(said) < 600
    return said


@pytest.mark.parametrize("save", [np.savez, np.savez_compressed])
def test_what_numpy_writes_is_read_as_numpy_reads_it(
    tmp_path: Path, save: Callable[..., None]
) -> None:
    path = tmp_path / "x.npz"
    given = {
        "a": np.arange(24.0).reshape(2, 3, 4), "b": np.asfortranarray(np.eye(3, 5, dtype=">i2")),
        "c": np.array(["ä", "b"]), "d": np.array([b"x", b"yy"]), "e": np.array(7, np.uint8),
        "f": np.zeros((0, 3), bool),
    }  # fmt: skip
    save(path, **given)
    found, names = read_arrays(path, [*given, "other"])
    assert names == sorted(given) == sorted(found)
    for name, values in given.items():
        np.testing.assert_array_equal(found[name], values)
        assert found[name].dtype == values.dtype
    for named in (["a.jpg", "b.jpg"], [b"a.jpg", b"b.jpg"]):
        path.write_bytes(packed(save, names=np.array(named)))
        assert used(path).points_i.shape == (6, 8, 3)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"", "is empty"),
        (b"PK", "cut off, or is no zip"),
        (b"something else that is long enough to hold an end", "cut off, or is no zip"),
        (npy(header(), bytes(576)), "is one .npy array"),
        (packed()[:-1], "cut off, or is no zip"),
        (packed()[: len(packed()) // 2], "cut off, or is no zip"),
        (packed() + b"x", "cut off, or is no zip"),
        (zipped({}), "holds no arrays"),
        (zipped({"points_i.npy": b""}), "no names"),
        (zipped({f"{k}.npy": b"" for k in range(70)}), "list of 70 arrays"),
        (zipped({"x" * 60_000 + f"{k}.npy": b"" for k in range(2)}), "list of 2 arrays"),
        (zipped({"names.npy": b""}), "'names', which is no array"),
        (zipped({"names.npy": b"\x93NUMPY"}), "'names', which is no array"),
        (zipped({"names.npy": b"\x93NUMPY\1\0"}), "can't be read as .npz"),
        (zipped({"names.npy": b"\x93NUMPY\x09\0" + bytes(90)}), "'names', which is no array"),
        (zipped({"names.npy": npy("{" * 9000)}), "of a type that is not taken"),
        (zipped({"names.npy": npy("(" * 60_000)}), "of a type that is not taken"),
        (zipped({"names.npy": npy("__import__('os')")}), "of a type that is not taken"),
        (zipped({"names.npy": npy(header("'|O'", "(2,)"), b"cos\nsystem\n")}), "objects"),
        (zipped({"names.npy": npy(header("[('a', '<f4')]"), bytes(576))}), "fields are not"),
        (zipped({"names.npy": npy(header("'<c8'"), bytes(1152))}), "not taken"),
        (zipped({"names.npy": npy(header("'<f3'"), bytes(1152))}), "of an unknown type"),
        (zipped({"names.npy": npy(header("'<U0'"), b"")}), "is not taken"),
        (zipped({"names.npy": npy(header("'<f4'", "(999999999999, 999999999999)"), b"")}),
         "says that it has 3999999999992000000000004 bytes"),
        (zipped({"names.npy": npy(header("'<f4'", "(-1, 8)"), b"")}), "not taken"),
        (zipped({"names.npy": npy(header("'<f4'", "(1, 1, 1, 1, 1, 1, 1, 1, 1)"), bytes(4))}),
         "is not taken"),
        (zipped({"names.npy": npy(header("'<f4'", "(2,)"), bytes(9))}), "8 bytes, and 9 are there"),
        (zipped({"names.npy": npy(header("'<f4'", "(2,)"), bytes(7))}), "8 bytes, and 7 are there"),
        (zipped({"names.npy": npy(header("'<f4'", "(2,)"), bytes(8))}, zipfile.ZIP_BZIP2),
         "packed as no .npz is"),
        (packed(names=np.array([1, 2])), "names holds int64, not names"),
        (packed(names=np.array(["a.jpg"])), "names holds 1 names"),
        (packed(names=np.array([["a.jpg", "b.jpg"]] * 2)), "names holds 4 names"),
        (packed(names=np.zeros((0, 0))), "names holds float64, not names"),
        (packed(points_i=np.zeros((0, 0, 3), np.float32), confidence_i=np.zeros((0, 0))),
         "maps of i have 0x0 pixels"),
        (packed(points_i=np.zeros((6, 8, 3), "U4")), "points_i holds <U4, not numbers"),
        (packed(points_i=np.zeros((6, 8, 4), np.float32)), "the points of i have the shape"),
        (packed(points_i=np.array(3.0)), "the points of i have the shape"),
        (packed(confidence_i=np.zeros((6, 7))), "the points of i have the shape"),
        (packed(transform_i=np.eye(2)), "transform_i is not an affine 3x3"),
        (packed(transform_i=np.zeros((3, 3))), "transform_i is not an affine 3x3"),
        (packed(transform_j=np.full((3, 3), np.nan)), "transform_j is not an affine 3x3"),
        (packed(transform_j=np.array("x")), "transform_j holds <U1, not numbers"),
        (packed(transform_from=np.array("moon")), "transform_from is 'moon'"),
        (packed(transform_from=np.array(["working"] * 3)), "transform_from is '3 words'"),
    ],
)  # fmt: skip
def test_a_damaged_file_is_refused(tmp_path: Path, content: bytes, words: str) -> None:
    assert words in refused(tmp_path, content)


def _patched(data: bytes, mark: bytes, at: int, form: str, value: int, which: int = 0) -> bytes:
    """A field changed in the record that begins with a mark."""
    begin = -1
    for _ in range(which + 1):
        begin = data.index(mark, begin + 1)
    new = struct.pack(form, value)
    return data[: begin + at] + new + data[begin + at + len(new) :]


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (_patched(packed(np.savez_compressed), b"PK\1\2", 24, "<I", 2**31), "would take"),
        (_patched(packed(), b"PK\1\2", 24, "<I", 3), "which are not there"),
        (_patched(packed(), b"PK\1\2", 20, "<I", 2**31), "which are not there"),
        (_patched(packed(), b"PK\1\2", 42, "<I", 2**31), ".npz"),
        (_patched(packed(), b"PK\1\2", 8, "<H", 1), "encrypted"),
        (_patched(packed(), b"PK\1\2", 10, "<H", 12), "packed as no .npz is"),
        (_patched(packed(), b"PK\1\2", 10, "<H", 8), ".npz"),
        (_patched(packed(), b"PK\1\2", 16, "<I", 77, 4), "Bad CRC-32"),
        (_patched(packed(), b"PK\5\6", 10, "<H", 9000), "list of 9000 arrays"),
        (_patched(packed(), b"PK\5\6", 12, "<I", 2**31), "bytes"),
        (_patched(packed(), b"PK\5\6", 16, "<I", 2**31), ".npz"),
        (packed().replace(b"names.npy", b"../../x.p"), "lacks"),
        (packed().replace(b"points_j_in_i.npy", b"points_i.npy     "), "lacks points_j_in_i"),
        (packed().replace(b"confidence_j", b"confidence_i"), "'confidence_i' twice"),
    ],
)
def test_a_directory_that_lies_is_refused(tmp_path: Path, content: bytes, words: str) -> None:
    if words == "lacks":  # an entry of another name is only an array more
        (tmp_path / "pair.npz").write_bytes(content)
        _, names = read_arrays(tmp_path / "pair.npz", KEYS)
        assert "../../x.p" in names and not (tmp_path.parent.parent / "x.p").exists()
        return
    assert words in refused(tmp_path, content)


def test_changed_bytes_are_noticed(tmp_path: Path) -> None:
    data = bytearray(packed())
    data[data.index(b"points_i.npy") + 200] ^= 0xFF
    assert "CRC" in refused(tmp_path, bytes(data))


def test_a_bomb_is_not_unpacked(tmp_path: Path) -> None:
    flat = np.zeros((2500, 4000, 3), np.float32)
    content = packed(np.savez_compressed, points_i=flat)
    del flat
    path = tmp_path / "pair.npz"
    path.write_bytes(content)
    assert len(content) < 1_000_000
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(RequestError, match=r"would take 12. MB when unpacked"):
        used(path)
    unit = 1 if sys.platform == "darwin" else 1024
    assert (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) * unit < 50e6


def test_what_is_no_file_is_named(tmp_path: Path) -> None:
    path = tmp_path / "a_b.npz"
    path.mkdir()
    with pytest.raises(RequestError, match=r"a_b\.npz is a folder, not a file"):
        match_names([path], VIEWS, "auto")
    one = PairFile(tmp_path / "none.npz", 0, 1)
    with pytest.raises(RequestError, match=r"none\.npz can't be read \(No such file"):
        next(read_pairs([one], VIEWS, 0.1, lambda *_: None))
