"""JSON from outside: each key once, finite numbers, no deeper and no more than can be meant."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from pipeline.untrusted.files import Kind, UnusableFile, read

#: Lists and mappings, and values, of a file: each costs some sixty bytes of memory.
_MOST_OPEN, _MOST_VALUES = 2_000_000, 8_000_000


def read_plain_json(path: Path, kind: Kind) -> Any:
    """The content of a JSON file.

    Raises:
        UnusableFile: it can't be read, is no JSON, nested too deep, says a key twice, or holds a
            number that is none.
    """
    data = read(path, kind)
    if data.count(b"{") + data.count(b"[") > _MOST_OPEN or data.count(b",") > _MOST_VALUES:
        raise UnusableFile("holds more entries than can be meant")
    try:
        return json.loads(
            data.decode("utf-8-sig"), parse_constant=_constant, object_pairs_hook=_pairs,
            parse_float=_decimal,
        )  # fmt: skip
    except UnicodeDecodeError as error:
        raise UnusableFile(f"is not text in UTF-8 (byte {error.start})") from error
    except RecursionError:
        raise UnusableFile("is nested deeper than can be meant") from None
    except json.JSONDecodeError as error:
        raise UnusableFile(
            f"can't be read as JSON ({error.msg}, line {error.lineno}, column {error.colno})"
        ) from error
    except ValueError as error:  # whole numbers of more digits than Python reads
        raise UnusableFile("holds a number of too many digits") from error


def _constant(name: str) -> float:
    raise UnusableFile(f"holds {name}, which is no number")


def _decimal(text: str) -> float:
    value = float(text)
    if value in (float("inf"), float("-inf")):
        raise UnusableFile(f"holds {text[:40]}, which is larger than any number can be")
    return value


def _pairs(pairs: Sequence[tuple[str, Any]]) -> dict[str, Any]:
    found = dict(pairs)
    if len(found) < len(pairs):
        names = [name for name, _ in pairs]
        twice = next(name for name in names if names.count(name) > 1)
        raise UnusableFile(f"says {twice[:40]!a} twice")
    return found
