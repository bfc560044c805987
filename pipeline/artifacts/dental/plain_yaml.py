"""YAML from outside: small, plain, read in a moment or refused.

Anchors, aliases and tags are refused, keys are text and stand once, numbers are decimal and words
are words: `007`, `on` and `12:30` are text, as people mean them.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from pipeline.errors import RequestError

#: Bytes, entries and levels of a file that is read at all.
MOST_BYTES, MOST_EVENTS, MOST_DEPTH = 2**20, 50_000, 8

_WORDS = {"": None, "~": None, "null": None, "true": True, "false": False}
_WHOLE = re.compile(r"-?(?:0|[1-9]\d{0,11})")
_DECIMAL = re.compile(r"-?(?:0|[1-9]\d{0,11})\.\d{0,20}(?:[eE][-+]?\d{1,2})?")


@dataclass
class _Open:
    """A mapping or list that is being read, and the key whose value comes next."""

    value: dict[str, Any] | list[Any]
    key: str | None = None


def read_plain_yaml(path: Path) -> Any:
    """The content of a YAML file; None for one without any.

    Raises:
        RequestError: it can't be read, is too large or nested too deep, is not YAML, or says the
            same key twice.
    """
    text = _read(path)
    loader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
    try:
        return _build(yaml.parse(text, Loader=loader), path)
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        where = f", line {mark.line + 1}" if mark else ""
        problem = getattr(error, "problem", None) or "it holds characters that YAML doesn't allow"
        raise RequestError(f"{path}{where} is not YAML: {problem}.") from error


def _read(path: Path) -> str:
    try:
        if not path.is_file():
            raise RequestError(f"{path} can't be read: there is no such file.")
        with path.open("rb") as stream:
            data = stream.read(MOST_BYTES + 1)
    except OSError as error:
        raise RequestError(f"{path} can't be read ({error.strerror}).") from error
    if len(data) > MOST_BYTES:
        raise RequestError(f"{path} is larger than 1 MB; that can't be what was meant.")
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise RequestError(f"{path} is not text in UTF-8 (byte {error.start}).") from error


def _build(events: Iterable[Any], path: Path) -> Any:
    """Values from the parser's events; no constructor of the YAML library has a say."""
    found: list[Any] = []
    open_: list[_Open] = []
    for count, event in enumerate(events):
        where = f"{path}, line {event.start_mark.line + 1}"
        if count > MOST_EVENTS:
            raise RequestError(f"{where}: more entries than can be meant.")
        if isinstance(event, yaml.AliasEvent) or getattr(event, "anchor", None):
            raise RequestError(f"{where}: anchors and aliases (& and *) are not taken here.")
        if getattr(event, "tag", None):
            raise RequestError(f"{where}: tags ({_short(event.tag)}) are not taken here.")
        if isinstance(event, yaml.MappingStartEvent | yaml.SequenceStartEvent):
            if len(open_) >= MOST_DEPTH:
                raise RequestError(f"{where}: nested deeper than can be meant.")
            value: dict[str, Any] | list[Any]
            value = {} if isinstance(event, yaml.MappingStartEvent) else []
            _add(value, open_, found, where)
            open_.append(_Open(value))
        elif isinstance(event, yaml.MappingEndEvent | yaml.SequenceEndEvent):
            open_.pop()
        elif isinstance(event, yaml.ScalarEvent):
            if open_ and isinstance(open_[-1].value, dict) and open_[-1].key is None:
                open_[-1].key = event.value
            else:
                plain = bool(event.implicit[0])
                _add(_scalar(event.value) if plain else event.value, open_, found, where)
    if len(found) > 1:
        raise RequestError(f"{path} holds several documents (---); only one is taken.")
    return found[0] if found else None


def _add(value: Any, open_: list[_Open], found: list[Any], where: str) -> None:
    """Put a value where the parser stands."""
    if not open_:
        found.append(value)
        return
    inside = open_[-1]
    if isinstance(inside.value, list):
        inside.value.append(value)
        return
    if inside.key is None:
        raise RequestError(f"{where}: a key must be a word, not a list or a mapping.")
    if inside.key in inside.value:
        raise RequestError(f"{where}: '{_short(inside.key)}' is said twice.")
    inside.value[inside.key] = value
    inside.key = None


def _scalar(text: str) -> Any:
    if text in _WORDS:
        return _WORDS[text]
    if _WHOLE.fullmatch(text):
        return int(text)
    return float(text) if _DECIMAL.fullmatch(text) else text


def _short(text: str) -> str:
    return text if len(text) <= 40 else f"{text[:40]}…"
