"""Names of files and folders as text that can be shown and stored.

A name is bytes. Python gives those that are no UTF-8 as lone surrogates, which no terminal prints,
no JSON or HTML file takes and no hash is made of; others hold line ends or control codes, which
would act on a terminal. Whatever shows or stores a name of the user's shows `printable` of it;
whatever opens a file takes the name itself.
"""

from __future__ import annotations

import codecs
import io
import os
import sys
import unicodedata

#: Control codes, surrogates, and marks that turn the direction of the text around them.
_UNSHOWN = {"Cc", "Cs"}
_TURNING = set("\u202a\u202b\u202c\u202d\u202e\u2066\u2067\u2068\u2069\u2028\u2029")


def printable(name: str | os.PathLike[str]) -> str:
    """A name as text: what is none is written as in Python, ``\\xff`` for a byte of that value.

    Equal to the name wherever that is ordinary text.
    """
    text = os.fspath(name)
    if text.isascii() and text.isprintable():
        return text
    return "".join(_shown(character) for character in text)


def readable(text: str) -> str:
    """A text that may hold names: as `printable`, with its line ends."""
    return "\n".join(map(printable, text.split("\n")))


def storable(text: str) -> str:
    """A text with its surrogates written as JSON does (``\\udcff``): a reader of JSON gets them
    back, and every other file can hold it."""
    return text.encode("utf-8", "backslashreplace").decode("utf-8")


def let_streams_show_all() -> None:
    """Make standard output and error take any text: what their encoding lacks is written out.

    Where a locale is no UTF-8, or a name is none, printing would end a run that went well.
    """
    codecs.register_error("written_out", _write_out)
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="written_out")


def _write_out(error: UnicodeError) -> tuple[str, int]:
    if not isinstance(error, UnicodeEncodeError):
        raise error
    lost = error.object[error.start : error.end]
    return "".join(
        _shown(c) if 0xDC80 <= ord(c) <= 0xDCFF else c.encode("ascii", "backslashreplace").decode()
        for c in lost
    ), error.end


def _shown(character: str) -> str:
    code = ord(character)
    if 0xDC80 <= code <= 0xDCFF:  # a byte that is no UTF-8
        return f"\\x{code - 0xDC00:02x}"
    if unicodedata.category(character) in _UNSHOWN or character in _TURNING:
        return character.encode("unicode_escape").decode("ascii")
    return character
