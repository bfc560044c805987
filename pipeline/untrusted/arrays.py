"""`.npz` from outside: what each array takes is known and allowed before any of it is unpacked."""

from __future__ import annotations

import re
import struct
import zipfile
import zlib
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import IO, Any

import numpy as np
import numpy.typing as npt

from pipeline.untrusted.files import ARRAYS, UnusableFile, opened

Array = npt.NDArray[Any]

#: Arrays of a file, and bytes of its list of them.
_MOST_ARRAYS, _LONGEST_LIST = 64, 1 << 16
#: Unpacked bytes at most: a share of the file's size, since maps are noise, and a constant one
#: beside them may take nothing.
_TIMES, _ALWAYS = 20, 1 << 26
_END = struct.Struct("<4s4H2LH")
#: What numpy writes: numbers and short texts, no objects, no fields.
_HEADER = re.compile(
    r"\{'descr': '([<>|=]?)([biufUS])(\d{1,4})', 'fortran_order': (True|False), "
    r"'shape': \(((?:\d{1,12},? ?)*)\),? ?\}\s*"
)


def read_arrays(path: Path, wanted: Iterable[str]) -> tuple[dict[str, Array], list[str]]:
    """Arrays of a `.npz`.

    Args:
        path: the file.
        wanted: names of the arrays to read, where they are there.

    Returns:
        name -> array for those wanted that are there, and the names of all that are.

    Raises:
        UnusableFile: it can't be read, is no `.npz` as numpy writes it, is damaged, or would take
            far more memory than it has bytes.
    """
    with opened(path, ARRAYS) as file:
        try:
            size = _check_end(file)
            with zipfile.ZipFile(file) as archive:
                entries = _entries(archive, size)
                found = {
                    name: _array(archive, entries[name], name) for name in wanted if name in entries
                }
        except (zipfile.BadZipFile, zlib.error, EOFError, OSError, struct.error) as error:
            raise UnusableFile(f"can't be read as .npz ({str(error)[:100]})") from error
        # Features of zip that numpy has no use for, and what zipfile trips over.
        except (NotImplementedError, RuntimeError, ValueError, OverflowError) as error:
            raise UnusableFile(f"is no .npz as numpy writes it ({str(error)[:100]})") from error
    return found, sorted(entries)


def _check_end(file: IO[bytes]) -> int:
    """The file's size, if its end says a list of arrays that is no longer than it can be."""
    size = file.seek(0, 2)
    if size == 0:
        raise UnusableFile("is empty")
    file.seek(0)
    if file.read(6) == b"\x93NUMPY":
        raise UnusableFile("is one .npy array, not a .npz; write it with numpy.savez")
    tail_size = min(size, _END.size + 20)
    file.seek(size - tail_size)
    tail = file.read(tail_size)
    if tail_size < _END.size or not tail[-_END.size :].startswith(b"PK\5\6"):
        raise UnusableFile("can't be read as .npz: it is cut off, or is no zip at all")
    *_, count, length, _, comment = _END.unpack(tail[-_END.size :])
    if comment or length > _LONGEST_LIST or count > _MOST_ARRAYS or b"PK\6\7" in tail:
        raise UnusableFile(
            f"is no .npz as numpy writes it: its list of {count} arrays has {length} bytes"
        )
    file.seek(0)
    return size


def _entries(archive: zipfile.ZipFile, size: int) -> Mapping[str, zipfile.ZipInfo]:
    """Name of an array -> its entry, all of them allowed together."""
    found: dict[str, zipfile.ZipInfo] = {}
    for entry in archive.infolist():
        name = entry.filename.removesuffix(".npy")
        if name in found:
            raise UnusableFile(f"holds the array {name[:40]!a} twice")
        if entry.flag_bits & 0x1:
            raise UnusableFile(f"holds the array {name[:40]!a} encrypted")
        if entry.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
            raise UnusableFile(
                f"holds the array {name[:40]!a} packed as no .npz is (way "
                f"{entry.compress_type}); write it with numpy.savez"
            )
        stored = entry.compress_type == zipfile.ZIP_STORED
        if (stored and entry.compress_size != entry.file_size) or (
            entry.header_offset + entry.compress_size > size
        ):
            raise UnusableFile(
                f"is damaged: its list says that the array {name[:40]!a} has "
                f"{entry.compress_size} bytes, which are not there"
            )
        found[name] = entry
    if not found:
        raise UnusableFile("holds no arrays")
    total = sum(entry.file_size for entry in found.values())
    if total > min(_ALWAYS + _TIMES * size, ARRAYS.most_bytes):
        raise UnusableFile(
            f"would take {total / 1e6:,.0f} MB when unpacked, and has {size / 1e6:,.1f} MB: no "
            "pointmap is packed so well"
        )
    return found


def _array(archive: zipfile.ZipFile, entry: zipfile.ZipInfo, name: str) -> Array:
    with archive.open(entry) as stream:
        dtype, shape, fortran = _header(stream, name)
        count = 1
        for length in shape:
            count *= length
        size = count * dtype.itemsize
        expected = entry.file_size - stream.tell()
        if size != expected:
            raise UnusableFile(
                f"is damaged: the array {name!a} says that it has {size} bytes, and "
                f"{expected} are there"
            )
        data = bytearray(size)
        view, done = memoryview(data), 0
        while done < size:
            piece = stream.read(min(size - done, 1 << 20))
            if not piece:
                raise UnusableFile(f"is cut off in the array {name!a}")
            view[done : done + len(piece)] = piece
            done += len(piece)
        stream.read(1)  # the end of the entry, where its checksum is compared
    values = np.frombuffer(data, dtype, count)
    return values.reshape(shape, order="F" if fortran else "C")


def _header(stream: IO[bytes], name: str) -> tuple[np.dtype[Any], tuple[int, ...], bool]:
    """Type, shape and order of an array, read as text that means nothing else."""
    magic = stream.read(8)
    lengths = {b"\1\0": "<H", b"\2\0": "<I", b"\3\0": "<I"}
    if magic[:6] != b"\x93NUMPY" or magic[6:] not in lengths:
        raise UnusableFile(f"holds {name[:40]!a}, which is no array of numpy's")
    form = lengths[magic[6:]]
    (length,) = struct.unpack(form, stream.read(struct.calcsize(form)))
    text = stream.read(min(length, 10_000)).decode("latin-1")
    match = _HEADER.fullmatch(text)
    if match is None or length > 10_000:
        raise UnusableFile(
            f"can't be read: the array {name[:40]!a} is of a type that is not taken (objects "
            f"and fields are not): {text[:60]!a}"
        )
    order, kind, size, fortran, shape = match.groups()
    try:
        dtype = np.dtype(f"{order}{kind}{size}")
    except TypeError:
        raise UnusableFile(
            f"can't be read: the array {name[:40]!a} is of an unknown type"
        ) from None
    lengths_of = tuple(int(part) for part in shape.replace(" ", "").split(",") if part)
    if len(lengths_of) > 8 or dtype.itemsize == 0:
        raise UnusableFile(f"can't be read: the shape of the array {name[:40]!a} is not taken")
    return dtype, lengths_of, fortran == "True"
