"""Entries of COLMAP's files, text or binary, one after the other, as numbers and words.

Both forms hold the same in the same order, so that what reads them need not know which it is.
"""

from __future__ import annotations

import re
import struct
from codecs import BOM_UTF8
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from pipeline.untrusted.files import MODEL, Kind, UnusableFile, read
from pipeline.untrusted.scenes.numerals import numbers_in

Array = npt.NDArray[np.float64]

_NO_POINT = 2**64 - 1
_LONGEST_NAME = 4096
#: What the files without keypoints and points may have: an object is made of each entry.
_SMALL = Kind("a list of cameras", 1 << 25)


def rows_of(path: Path, at_least: int) -> Iterator[Row]:
    """What stands in a file, one after the other, each read to its end before the next."""
    try:
        data = read(path, MODEL if path.stem in ("images", "points3D") else _SMALL)
    except UnusableFile as error:
        raise UnusableFile(f"can't be read: {path.name} {error}") from error
    if path.suffix == ".txt":
        return _text_rows(path.name, data)
    return _binary_rows(path.name, data, at_least)


class Row:
    """One entry of a file: what is taken from it comes in the order of the file."""

    file: str
    where: str
    number: int = 0

    def take(self, form: str) -> tuple[Any, ...]:
        """Numbers in the form of `struct`: I, Q and B whole, d finite or not."""
        raise NotImplementedError

    def word(self, words: Mapping[int, str]) -> str:
        """One of some words."""
        raise NotImplementedError

    def name(self) -> str:
        raise NotImplementedError

    def keypoints(self) -> npt.NDArray[np.bool_]:
        """[K] those that observe a point."""
        raise NotImplementedError

    def track(self) -> npt.NDArray[np.uint32]:
        """[L] numbers of the images in a track."""
        raise NotImplementedError

    def wrong(self, what: str) -> UnusableFile:
        return UnusableFile(f"can't be read: {self.file} is damaged: {what} ({self.where})")

    def cut(self) -> UnusableFile:
        return UnusableFile(f"can't be read: {self.file} is cut off or damaged ({self.where})")


class _BinaryRow(Row):
    def __init__(self, file: str, data: bytes) -> None:
        self.file, self.data, self.at, self.where = file, data, 0, "at its beginning"

    def take(self, form: str) -> tuple[Any, ...]:
        form = f"<{form}"
        size = struct.calcsize(form)
        if self.at + size > len(self.data):
            raise self.cut()
        values = struct.unpack_from(form, self.data, self.at)
        self.at += size
        return values

    def word(self, words: Mapping[int, str]) -> str:
        (number,) = self.take("i")
        if number not in words:
            raise self.wrong(f"a model or sensor of the unknown kind {number}")
        return words[number]

    def name(self) -> str:
        end = self.data.find(b"\0", self.at, self.at + _LONGEST_NAME + 1)
        if end < 0:
            raise self.wrong("a name that does not end")
        name, self.at = self.data[self.at : end], end + 1
        return _decoded(self, name)

    def _counted(self, dtype: Any) -> Any:
        (count,) = self.take("Q")
        if count * dtype.itemsize > len(self.data) - self.at:
            raise UnusableFile(
                f"can't be read: {self.file} is cut off or damaged: {self.where} says that it has "
                f"{count} parts, and the file ends before"
            )
        values = np.frombuffer(self.data, dtype, count, self.at)
        self.at += values.nbytes
        return values

    def keypoints(self) -> npt.NDArray[np.bool_]:
        found = self._counted(np.dtype([("xy", "<f8", 2), ("point", "<u8")]))
        return np.asarray(found["point"] != _NO_POINT)

    def track(self) -> npt.NDArray[np.uint32]:
        found = self._counted(np.dtype([("image", "<u4"), ("keypoint", "<u4")]))
        return np.ascontiguousarray(found["image"], np.uint32)


def _binary_rows(file: str, data: bytes, at_least: int) -> Iterator[Row]:
    row = _BinaryRow(file, data)
    (count,) = row.take("Q")
    if count * at_least > len(data) - 8:
        raise UnusableFile(
            f"can't be read: {file} is cut off or damaged: it says {count} entries, which take at "
            f"least {count * at_least} bytes, and {len(data) - 8} are there"
        )
    for number in range(count):
        row.where = f"entry {number + 1} of {count}"
        yield row
    if row.at != len(data):
        raise UnusableFile(f"can't be read: {file} is longer than its {count} entries")


#: `# Number of images: 3, mean ...`
_SAID = re.compile(rb"#\s*Number of \w+ ?\w*: (\d{1,18})\b")
#: The first words of a file that COLMAP wrote.
_TITLE = re.compile(rb"# ?(Camera|Image|3D point|Rig|Frame)")
_WHOLE = re.compile(rb"-?\d{1,20}")
_RANGES = {"I": 2**32, "Q": 2**64, "B": 2**8}


class _TextRow(Row):
    def __init__(self, file: str, number: int, line: bytes, following: bytes | None) -> None:
        self.file, self.where = file, f"line {number}"
        self.rest, self.following = line, following

    def _next(self) -> bytes:
        word, *rest = self.rest.split(None, 1) or [b""]
        if not word:
            raise self.wrong("the line is too short")
        self.rest = rest[0] if rest else b""
        return word

    def take(self, form: str) -> tuple[Any, ...]:
        match = re.fullmatch(r"(\d*)([IQBd])", form)
        assert match is not None
        return tuple(self._number(match[2]) for _ in range(int(match[1] or 1)))

    def _number(self, kind: str) -> float:
        word = self._next()
        if kind != "d":
            if not (_WHOLE.fullmatch(word) and 0 <= int(word) < _RANGES[kind]):
                raise self.wrong(f"{shown(word)} stands where a count or number should")
            return int(word)
        try:
            return float(word)
        except ValueError:
            raise self.wrong(f"{shown(word)} stands where a number should") from None

    def word(self, words: Mapping[int, str]) -> str:
        word = self._next().decode("latin-1")
        if word not in words.values():
            raise self.wrong(f"{shown(word)} is a model or sensor of no known kind")
        return word

    def name(self) -> str:
        name, self.rest = self.rest.strip(), b""
        if len(name) > _LONGEST_NAME:
            raise self.wrong("a name that does not end")
        return _decoded(self, name)

    def keypoints(self) -> npt.NDArray[np.bool_]:
        if self.following is None:
            raise self.cut()
        values = self._numbers(self.following, 3)
        return np.asarray(values.reshape(-1, 3)[:, 2] >= 0)

    def track(self) -> npt.NDArray[np.uint32]:
        values = self._numbers(self.rest, 2).reshape(-1, 2)[:, 0]
        self.rest = b""
        if not ((values >= 0) & (values < 2**32) & (values == np.floor(values))).all():
            raise self.wrong("a track of no whole numbers")
        return values.astype(np.uint32)

    def _numbers(self, text: bytes, parts: int) -> Array:
        try:
            values = numbers_in(text, self.where)
        except UnusableFile as error:
            raise UnusableFile(f"can't be read: {self.file} {error}") from None
        if len(values) % parts:
            raise self.wrong(f"{len(values)} numbers, which don't go by {parts}")
        return values


def _text_rows(file: str, data: bytes) -> Iterator[Row]:
    data = data.removeprefix(BOM_UTF8)
    if data and not data.endswith((b"\n", b"\r")):
        raise UnusableFile(f"can't be read: {file} is cut off: its last line has no end")
    pairs = file.startswith("images")
    said, count = None, 0
    lines = _lines(data)
    for number, line in lines:
        match = _SAID.match(line)
        said = int(match[1]) if match else said
        # What comes after an image is its keypoints, also where that line is empty.
        if not line.strip() or line.startswith(b"#"):
            continue
        row = _TextRow(file, number, line, next(lines, (0, None))[1] if pairs else None)
        count += 1
        yield row
        if row.rest.strip():
            raise row.wrong("the line is too long")
    if said is None and not count and _TITLE.match(data):
        raise UnusableFile(f"can't be read: {file} is cut off in its first lines")
    if said is not None and said != count:
        raise UnusableFile(
            f"can't be read: {file} is cut off or damaged: it says {said} in its comment, and "
            f"{count} are there (if you took some out, put that number right)"
        )


def _lines(data: bytes) -> Iterator[tuple[int, bytes]]:
    """Number and text of each line, without all of them in memory at once."""
    begin, number = 0, 0
    while begin < len(data):
        end = data.find(b"\n", begin)
        end = len(data) if end < 0 else end
        number += 1
        yield number, data[begin:end]
        begin = end + 1


def _decoded(row: Row, name: bytes) -> str:
    try:
        text = name.decode()
    except UnicodeDecodeError:
        raise row.wrong(f"the name {shown(name)} is not in UTF-8") from None
    if not text or any(ord(character) < 32 for character in text):
        raise row.wrong(f"the name {shown(name)} is empty or can't be printed")
    return text


def shown(text: bytes | str) -> str:
    """A piece of a file for a message."""
    return ascii(text[:40].decode("latin-1") if isinstance(text, bytes) else text[:40])
