"""PLY from outside: every count is held against the bytes that are there before it is believed.

Text, little and big endian. No more is allocated than a few times the file's size.
"""

from __future__ import annotations

import re
from array import array
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from pipeline.errors import RequestError
from pipeline.untrusted.files import Kind, UnusableFile, read
from pipeline.untrusted.scenes.numerals import numbers_in

Array = npt.NDArray[Any]
#: Ten million Gaussians of 62 numbers.
CLOUD = Kind("a cloud of points or Gaussians", 5 << 29)
#: Of a property: its type, or those of a list's length and of its values.
Type = str | tuple[str, str]

_TYPES = {
    "char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4",
    "float": "f4", "double": "f8", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2",
    "int32": "i4", "uint32": "u4", "float32": "f4", "float64": "f8",
}  # fmt: skip
_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
_WHOLE = re.compile(r"\d{1,20}")
#: Bytes and lines of a header at most; 3DGS has 62 properties.
_LONGEST_HEADER, _MOST_LINES = 1 << 16, 1000


@dataclass(frozen=True)
class Element:
    """One element of a PLY, as `vertex` or `face`.

    Attributes:
        count: of its rows.
        columns: property -> [count]; none where rows have lists of different lengths.
        lists: list property -> (lengths [count] int64, all their values [sum of lengths]).
    """

    count: int
    columns: Mapping[str, Array]
    lists: Mapping[str, tuple[Array, Array]]


@dataclass
class _Declared:
    """An element as the header declares it."""

    name: str
    count: int
    properties: dict[str, Type] = field(default_factory=dict)


def read_ply(path: Path, kind: Kind) -> dict[str, Element]:
    """All elements of a PLY by name.

    Args:
        path: the file.
        kind: what it should be, which says how large it may be.

    Raises:
        UnusableFile: it can't be read, is no PLY, or is longer or shorter than its header says.
    """
    data = read(path, kind)
    order, declared, start = _header(data)
    body: _Body = _Binary(data, start, order) if order else _Text(data, start)
    found = {element.name: _element(element, body) for element in declared}
    if body.at < body.end:
        raise UnusableFile(
            f"is longer than its header says: {body.end - body.at} {body.unit} are left over"
        )
    return found


def read_cloud(path: Path, needed: Iterable[str]) -> Mapping[str, Array]:
    """The columns of a cloud of points or Gaussians: property -> [N].

    Args:
        needed: properties that it must have.

    Raises:
        RequestError: it can't be read, is damaged, or lacks one of them.
    """
    try:
        vertex = read_ply(path, CLOUD).get("vertex")
    except UnusableFile as error:
        raise RequestError(f"{path} {error}. Write it again.") from error
    missing = [name for name in needed if vertex is None or name not in vertex.columns]
    if vertex is None or missing:
        raise RequestError(
            f"{path} has no vertices with {', '.join(missing)}. Give a .ply with these properties."
        )
    return vertex.columns


def _header(data: bytes) -> tuple[str, list[_Declared], int]:
    """Byte order ("" for text), the elements, and where the body begins."""
    if not re.match(rb"ply[ \t]*\r?\n", data):
        raise UnusableFile("is no PLY: it does not begin with a line 'ply'")
    end = re.compile(rb"\nend_header[ \t]*(\r?\n|\Z)").search(data, 0, _LONGEST_HEADER)
    if end is None:
        raise UnusableFile("is no whole PLY: its header has no end_header")
    lines = data[: end.start()].decode("latin-1").splitlines()[1:]
    if len(lines) > _MOST_LINES:
        raise UnusableFile(f"has a header of {len(lines)} lines, which no PLY needs")
    order = None
    declared: list[_Declared] = []
    for number, line in enumerate(lines, 2):
        match line.split():
            case [] | ["comment" | "obj_info", *_]:
                continue
            case ["format", name, "1.0"] if name in _ORDERS and order is None:
                order = _ORDERS[name]
            case ["element", name, count] if _WHOLE.fullmatch(count):
                if any(name == before.name for before in declared):
                    raise UnusableFile(f"declares the element {name[:40]!r} twice (line {number})")
                declared.append(_Declared(name, int(count)))
            case ["property", type_, name] if declared and type_ in _TYPES:
                _declare(declared[-1], name, _TYPES[type_], number)
            case ["property", "list", length, type_, name] if (
                declared and type_ in _TYPES and _TYPES.get(length, "f")[0] != "f"
            ):
                _declare(declared[-1], name, (_TYPES[length], _TYPES[type_]), number)
            case _:
                raise UnusableFile(f"has a header that is no PLY's: line {number}, {line[:60]!r}")
    if order is None:
        raise UnusableFile("is no PLY: its header names no format that is known")
    for element in declared:
        if element.count and not element.properties:
            raise UnusableFile(f"declares an element {element.name[:40]!r} without properties")
    return order, declared, end.end()


def _declare(element: _Declared, name: str, type_: Type, line: int) -> None:
    if name in element.properties:
        raise UnusableFile(f"declares the property {name[:40]!r} twice (line {line})")
    element.properties[name] = type_


class _Body:
    """The rows behind the header, and how far they were read."""

    unit: str
    end: int
    at: int

    def least(self, type_: Type) -> int:
        """The least that a property of this type takes."""
        raise NotImplementedError

    def length(self, type_: tuple[str, str], at: int) -> int:
        """The length that a list at a place says it has."""
        raise NotImplementedError

    def places(self, declared: _Declared, at: int) -> tuple[list[tuple[int, int]], int]:
        """Where the lists of the row at a place begin, how many values each has, and its end."""
        found = []
        for type_ in declared.properties.values():
            if isinstance(type_, tuple):
                if at + self.least(type_) > self.end:
                    raise self.short(declared)
                length = self.length(type_, at)
                at += self.least(type_)
                found.append((at, length))
                at += length * self.least(type_[1])
            else:
                at += self.least(type_)
        if at > self.end:
            raise self.short(declared)
        if found and max(length for _, length in found) < 3:
            raise UnusableFile(
                f"has a row of {declared.name[:40]!r} whose list is shorter than 3: no face has "
                "fewer corners"
            )
        return found, at

    def short(self, declared: _Declared) -> UnusableFile:
        return UnusableFile(
            f"is cut off, or damaged: the {declared.count} rows of {declared.name[:40]!r} that its "
            "header says don't end where the file does"
        )

    def table(self, declared: _Declared, lengths: Iterable[int]) -> dict[str, Array] | None:
        """Views of all columns, where all rows have lists of these lengths; else None."""
        raise NotImplementedError

    def values(self, type_: tuple[str, str], begin: int, count: int) -> bytes:
        """The values of a list as bytes."""
        raise NotImplementedError

    def array(self, type_: tuple[str, str], values: bytearray) -> Array:
        """What `values` gave, joined, as numbers."""
        raise NotImplementedError


def _element(declared: _Declared, body: _Body) -> Element:
    """Read the rows of an element, all at once where all have lists of the same lengths."""
    least = declared.count * sum(map(body.least, declared.properties.values()))
    if least > body.end - body.at:
        raise UnusableFile(
            f"is cut off: its header says {declared.count} rows of {declared.name[:40]!r}, which "
            f"take at least {least} {body.unit}, and {body.end - body.at} are there"
        )
    lists = {n: type_ for n, type_ in declared.properties.items() if isinstance(type_, tuple)}
    if declared.count == 0:
        none = {name: np.zeros(0) for name in declared.properties if name not in lists}
        return Element(0, none, {name: (np.zeros(0, np.int64), np.zeros(0)) for name in lists})
    places, end = body.places(declared, body.at)
    first = [length for _, length in places]
    columns = None
    if declared.count * (end - body.at) <= body.end - body.at:
        columns = body.table(declared, first)
    if columns is None:
        return Element(declared.count, {}, _mixed(declared, lists, body))
    body.at += declared.count * (end - body.at)
    uniform = {
        name: (np.full(declared.count, length), columns.pop(name).reshape(-1))
        for name, length in zip(lists, first, strict=True)
    }
    return Element(declared.count, columns, uniform)


def _mixed(
    declared: _Declared, lists: Mapping[str, tuple[str, str]], body: _Body
) -> dict[str, tuple[Array, Array]]:
    """The lists of rows that differ in their lengths, one by one."""
    if not lists:
        raise body.short(declared)
    lengths = {name: array("q") for name in lists}
    values = {name: bytearray() for name in lists}
    for _ in range(declared.count):
        places, body.at = body.places(declared, body.at)
        for (name, type_), (begin, length) in zip(lists.items(), places, strict=True):
            lengths[name].append(length)
            values[name] += body.values(type_, begin, length)
    return {
        name: (np.array(lengths[name]), body.array(type_, values[name]))
        for name, type_ in lists.items()
    }


class _Binary(_Body):
    unit = "bytes"

    def __init__(self, data: bytes, start: int, order: str) -> None:
        self.data, self.at, self.end, self.order = data, start, len(data), order

    def least(self, type_: Type) -> int:
        return int((type_ if isinstance(type_, str) else type_[0])[1])

    def length(self, type_: tuple[str, str], at: int) -> int:
        length = int(np.frombuffer(self.data, self.order + type_[0], 1, at)[0])
        if length < 0:
            raise UnusableFile(f"is damaged: a list says that it has {length} values")
        return length

    def table(self, declared: _Declared, lengths: Iterable[int]) -> dict[str, Array] | None:
        fields: list[Any] = []
        given = iter(lengths)
        for k, type_ in enumerate(declared.properties.values()):
            if isinstance(type_, tuple):
                fields.append((f"n{k}", self.order + type_[0]))
                fields.append((f"v{k}", self.order + type_[1], (next(given),)))
            else:
                fields.append((f"v{k}", self.order + type_))
        rows = np.frombuffer(self.data, np.dtype(fields), declared.count, self.at)
        for name in rows.dtype.names or ():
            if name[0] == "n" and (rows[name] != rows[name][0]).any():
                return None
        return {name: rows[f"v{k}"] for k, name in enumerate(declared.properties)}

    def values(self, type_: tuple[str, str], begin: int, count: int) -> bytes:
        return self.data[begin : begin + count * int(type_[1][1])]

    def array(self, type_: tuple[str, str], values: bytearray) -> Array:
        return np.frombuffer(values, self.order + type_[1])


class _Text(_Body):
    unit = "numbers"

    def __init__(self, data: bytes, start: int) -> None:
        if len(data) > start and not data.endswith((b"\n", b"\r")):
            raise UnusableFile("is cut off: its last line has no end")
        self.numbers = numbers_in(data[start:], "its body")
        self.at, self.end = 0, len(self.numbers)

    def least(self, type_: Type) -> int:
        return 1

    def length(self, type_: tuple[str, str], at: int) -> int:
        length = float(self.numbers[at])
        if not (0 <= length <= self.end and length.is_integer()):
            raise UnusableFile(f"is damaged: a list says that it has {length:g} values")
        return int(length)

    def table(self, declared: _Declared, lengths: Iterable[int]) -> dict[str, Array] | None:
        given, columns, at = iter(lengths), {}, 0
        width = sum(1 for _ in declared.properties) + sum(lengths)
        rows = self.numbers[self.at : self.at + declared.count * width]
        rows = rows.reshape(declared.count, width)
        for name, type_ in declared.properties.items():
            if isinstance(type_, tuple):
                length = next(given)
                if (rows[:, at] != length).any():
                    return None
                columns[name] = rows[:, at + 1 : at + 1 + length]
                at += 1 + length
            else:
                columns[name] = rows[:, at]
                at += 1
        return columns

    def values(self, type_: tuple[str, str], begin: int, count: int) -> bytes:
        return self.numbers[begin : begin + count].tobytes()

    def array(self, type_: tuple[str, str], values: bytearray) -> Array:
        return np.frombuffer(values, np.float64)
