"""Triangle meshes from outside: PLY, STL and OBJ, read by ourselves.

Readers for every variant of these formats believe what a header says. Here the counts of a file are
held against its bytes first, and an OBJ opens no other file.
"""

from __future__ import annotations

import re
import struct
from array import array
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from pipeline.untrusted.files import MESH, UnusableFile, read
from pipeline.untrusted.scenes.ply import read_ply

Vertices = npt.NDArray[np.float64]
Triangles = npt.NDArray[np.uint32]

#: Coordinates beyond this are of no thing that was photographed, and single precision ends there.
FARTHEST = 1e9
#: Bytes of a line; a polygon of 10,000 corners fits.
_LONGEST_LINE = 1 << 17
_COUNT = re.compile(rb"[-+]?\d{1,12}")


def read_mesh(path: Path) -> tuple[Vertices, Triangles]:
    """The triangles of a .ply, .stl or .obj; polygons are parted into fans.

    Args:
        path: the file; its suffix says the format.

    Returns:
        vertices [V, 3] float64 and triangles [T, 3] uint32 indices of them, both checked.

    Raises:
        UnusableFile: it can't be read, is damaged or cut off, or holds no triangles.
    """
    reader = _READERS.get(path.suffix.lower())
    if reader is None:
        raise UnusableFile("is no .ply, .stl or .obj")
    vertices, triangles = reader(path)
    if not len(triangles):
        raise UnusableFile("holds no triangles")
    wrong = ~(np.abs(vertices) < FARTHEST).all(1)  # also where it is no number
    if wrong.any():
        row = int(np.argmax(wrong))
        raise UnusableFile(
            f"is damaged: vertex {row} is at {_place(vertices[row])}, which no scan has"
        )
    if not np.ptp(vertices[triangles.reshape(-1)], axis=0).any():
        raise UnusableFile("holds only triangles whose corners are all at one place")
    return vertices, triangles


def _place(vertex: Vertices) -> str:
    return f"({', '.join(f'{value:.6g}' for value in vertex)})"


def _ply(path: Path) -> tuple[Vertices, Triangles]:
    elements = read_ply(path, MESH)
    vertex, face = elements.get("vertex"), elements.get("face")
    if vertex is None or any(axis not in vertex.columns for axis in "xyz"):
        raise UnusableFile("holds no vertices with x, y and z")
    corners = None
    if face is not None:
        corners = face.lists.get("vertex_indices", face.lists.get("vertex_index"))
    if corners is None:
        raise UnusableFile("holds no triangles: it has no faces with vertex_indices")
    vertices = np.stack([np.asarray(vertex.columns[axis], np.float64) for axis in "xyz"], 1)
    return vertices, _fans(*corners, len(vertices))


def _fans(lengths: npt.NDArray[np.int64], corners: npt.NDArray[Any], vertices: int) -> Triangles:
    """[T, 3] polygons [sum of lengths] of `lengths` corners each, parted around their first."""
    if not len(lengths):
        return np.zeros((0, 3), np.uint32)
    if lengths.min() < 3:
        raise UnusableFile(f"is damaged: face {int(lengths.argmin())} has fewer than three corners")
    wrong = ~((corners >= 0) & (corners < vertices))
    if corners.dtype.kind == "f":
        wrong |= corners != np.floor(corners)
    if wrong.any():
        raise UnusableFile(
            f"is damaged: a face has the vertex {corners[np.argmax(wrong)]:g}, and there are "
            f"{vertices} (0 to {vertices - 1})"
        )
    corners = corners.astype(np.uint32)
    if (lengths == 3).all():
        return corners.reshape(-1, 3)
    starts = np.cumsum(lengths) - lengths
    fans = lengths - 2
    first = np.repeat(starts, fans)
    step = np.arange(fans.sum()) - np.repeat(np.cumsum(fans) - fans, fans) + 1
    return np.stack([corners[first], corners[first + step], corners[first + step + 1]], 1)


def _stl(path: Path) -> tuple[Vertices, Triangles]:
    data = read(path, MESH)
    count = struct.unpack_from("<I", data, 80)[0] if len(data) >= 84 else 0
    if len(data) == 84 + 50 * count and len(data) >= 84:
        rows = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("flags", "<u2")])
        vertices = np.frombuffer(data, rows, count, 84)["corners"].reshape(-1, 3)
    elif data[:5].lower() == b"solid" and b"\0" not in data[:1000]:
        vertices = _stl_text(data)
    elif len(data) < 84:
        raise UnusableFile(f"is no STL: it has {len(data)} bytes, and the head alone has 84")
    else:
        raise UnusableFile(
            f"is cut off or damaged: its head says {count} triangles, which are {84 + 50 * count} "
            f"bytes, and it has {len(data)}"
        )
    triangles = np.arange(len(vertices), dtype=np.uint32).reshape(-1, 3)
    return vertices.astype(np.float64), triangles


#: What a facet of a textual STL is made of, one word or more a line.
_FACET = (b"facet", b"outer", b"vertex", b"vertex", b"vertex", b"endloop", b"endfacet")


def _stl_text(data: bytes) -> npt.NDArray[np.float64]:
    """[3 T, 3] corners of a textual STL, which may hold several solids."""
    found = array("d")
    inside, place = False, 0
    for number, line in enumerate(_lines(data), 1):
        words = line.split(None, 1)
        if not words:
            continue
        word = words[0].lower()
        if place == 0 and word == (b"endsolid" if inside else b"solid"):
            inside = not inside
        elif inside and word == _FACET[place]:
            if word == b"vertex":
                found.extend(_three(words, number))
            place = (place + 1) % len(_FACET)
        else:
            raise UnusableFile(f"is no STL: line {number} is {_shown(line)}")
    if inside:
        raise UnusableFile("is cut off: its last solid has no endsolid")
    return np.frombuffer(found, np.float64).reshape(-1, 3)


def _obj(path: Path) -> tuple[Vertices, Triangles]:
    """Vertices and faces; all else (materials, normals, textures, lines) is passed over.

    The format has no counts. Some programs leave the last line without an end; where it has none,
    each vertex must have a face, as a file that was cut off among its faces hardly has.
    """
    data = read(path, MESH)
    if b"\0" in data:
        raise UnusableFile("is no OBJ: it holds zero bytes, which are no text")
    vertices, corners, lengths = array("d"), array("q"), array("q")
    for number, line in enumerate(_lines(data), 1):
        words = line.split(None, 1)
        if words and words[0] == b"v":
            vertices.extend(_three(words, number, more=True))
        elif words and words[0] == b"f":
            before = len(corners)
            for corner in words[1].split() if len(words) > 1 else ():
                corners.append(_corner(corner, len(vertices) // 3, number))
            lengths.append(len(corners) - before)
            if lengths[-1] < 3:
                raise UnusableFile(
                    f"is damaged: the face in line {number} has {lengths[-1]} corners"
                )
    if not lengths:
        return np.zeros((0, 3)), np.zeros((0, 3), np.uint32)
    count = len(vertices) // 3
    faces = _fans(np.array(lengths), np.array(corners), count)
    if not data.endswith((b"\n", b"\r")) and len(np.unique(faces)) < count:
        raise UnusableFile(
            "is cut off: its last line has no end, and there are vertices without a face (if it is "
            "whole, add a line break there)"
        )
    return np.frombuffer(vertices, np.float64).reshape(-1, 3), faces


def _corner(text: bytes, vertices: int, line: int) -> int:
    """Index of the vertex in `17`, `17/4/2` or `-1` (the last so far)."""
    index = text.partition(b"/")[0]
    if not _COUNT.fullmatch(index) or int(index) == 0:
        raise UnusableFile(f"is damaged: line {line} has the corner {_shown(text)}")
    value = int(index)
    if value < 0 and vertices + value < 0:
        raise UnusableFile(
            f"is damaged: line {line} has the corner {value}, and {vertices} vertices are before it"
        )
    return value - 1 if value > 0 else vertices + value


def _three(words: list[bytes], line: int, more: bool = False) -> list[float]:
    """The three numbers behind a word; more (a weight, a colour) only where allowed."""
    try:
        values = [float(word) for word in (words[1].split() if len(words) > 1 else ())]
    except ValueError:
        raise UnusableFile(f"is damaged: line {line} holds something that is no number") from None
    if len(values) != 3 and not (more and 3 < len(values) <= 8):
        raise UnusableFile(f"is damaged: line {line} has {len(values)} coordinates, not 3")
    return values[:3]


def _lines(data: bytes) -> Iterator[bytes]:
    """The lines of a text, without all of them in memory at once."""
    begin = 0
    while begin < len(data):
        end = data.find(b"\n", begin)
        end = len(data) if end < 0 else end
        if end - begin > _LONGEST_LINE:
            raise UnusableFile(f"has a line of {end - begin} bytes, which no mesh needs")
        yield data[begin:end]
        begin = end + 1


def _shown(text: bytes) -> str:
    """A piece of a file for a message."""
    return repr(text[:40].decode("latin-1"))


_READERS: dict[str, Callable[[Path], tuple[Vertices, Triangles]]] = {
    ".ply": _ply, ".stl": _stl, ".obj": _obj,
}  # fmt: skip
