"""YAML from outside: small, plain, read in a moment or refused.

Tags are refused, aliases too where they aren't asked for, keys are text and stand once, numbers are
decimal and words are words: `007`, `on` and `12:30` are text, as people mean them.
"""

from __future__ import annotations

import copy
import re
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from pipeline.errors import RequestError
from pipeline.untrusted.files import SETTINGS, UnusableFile, read

#: Entries and levels of a text that is read at all.
MOST_EVENTS, MOST_DEPTH = 50_000, 12

_WORDS = {
    "": None, "~": None, "null": None, "Null": None, "NULL": None,
    "true": True, "True": True, "TRUE": True, "false": False, "False": False, "FALSE": False,
}  # fmt: skip
#: As YAML 1.1 has them, which is what writes values for the command line, but in tens only.
_WHOLE = re.compile(r"[-+]?(?:0|[1-9]\d{0,999})")
_DECIMAL = re.compile(r"[-+]?(?:(?:0|[1-9]\d{0,400})\.\d{0,400}|\.\d{1,400})(?:[eE][-+]\d{1,4})?")
_ENDLESS = re.compile(r"([-+]?)\.(inf|Inf|INF)|\.(?:nan|NaN|NAN)")


@dataclass
class _Open:
    """A mapping or list that is being read, and the key whose value comes next.

    Attributes:
        anchor: its name, for aliases; begin: entries before it.
    """

    value: dict[str, Any] | list[Any]
    anchor: str | None = None
    begin: int = 0
    key: str | None = None


def read_plain_yaml(path: Path, aliases: bool = False) -> Any:
    """The content of a YAML file; None for one without any.

    Args:
        aliases: anchors and aliases (& and *) are taken; all that they stand for counts.

    Raises:
        RequestError: it can't be read, is too large or nested too deep, is not YAML, or says the
            same key twice.
    """
    try:
        data = read(path, SETTINGS)
    except UnusableFile as error:
        raise RequestError(f"{path} {error}.") from error
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise RequestError(f"{path} is not text in UTF-8 (byte {error.start}).") from error
    return plain_yaml(text, str(path), aliases)


def plain_yaml(text: str, where: str, aliases: bool = False) -> Any:
    """What a YAML text says.

    Args:
        where: it stands, for messages; aliases: as above.

    Raises:
        RequestError: as `read_plain_yaml`.
    """
    if len(text) > SETTINGS.most_bytes:
        raise RequestError(f"{where} is longer than can be meant.")
    loader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
    try:
        return _build(yaml.parse(text, Loader=loader), where, aliases)
    except (yaml.YAMLError, UnicodeError) as error:
        mark = getattr(error, "problem_mark", None)
        line = f", line {mark.line + 1}" if mark else ""
        problem = getattr(error, "problem", None) or "it holds characters that YAML doesn't allow"
        lines = text.splitlines()[mark.line :] if mark else []
        if lines and re.match(r" *\t", lines[0]):
            problem = "it is indented by a tab, where YAML has spaces"
        raise RequestError(f"{where}{line} is not YAML: {problem}.") from error


def _build(events: Iterable[Any], source: str, aliases: bool) -> Any:
    """Values from the parser's events; no constructor of the YAML library has a say."""
    found: list[Any] = []
    open_: list[_Open] = []
    named: dict[str, tuple[Any, int]] = {}  # anchor -> what it stands for, and its entries
    count = 0
    for event in events:
        where = f"{source}, line {event.start_mark.line + 1}"
        count += 1
        anchor = getattr(event, "anchor", None)
        if anchor and not aliases:
            raise RequestError(f"{where}: anchors and aliases (& and *) are not taken here.")
        if getattr(event, "tag", None):
            raise RequestError(f"{where}: tags ({_short(event.tag)}) are not taken here.")
        if isinstance(event, yaml.AliasEvent):
            if not anchor or anchor not in named:
                raise RequestError(
                    f"{where}: *{_short(anchor or '')} stands for nothing before it."
                )
            value, entries = named[anchor]
            count += entries
        if count > MOST_EVENTS:
            raise RequestError(f"{where}: more entries than can be meant.")
        if isinstance(event, yaml.AliasEvent):
            _add(copy.deepcopy(value), open_, found, where)
        elif isinstance(event, yaml.MappingStartEvent | yaml.SequenceStartEvent):
            if len(open_) >= MOST_DEPTH:
                raise RequestError(f"{where}: nested deeper than can be meant.")
            inner: dict[str, Any] | list[Any]
            inner = {} if isinstance(event, yaml.MappingStartEvent) else []
            _add(inner, open_, found, where)
            open_.append(_Open(inner, anchor, count))
        elif isinstance(event, yaml.MappingEndEvent | yaml.SequenceEndEvent):
            closed = open_.pop()
            if closed.anchor:
                named[closed.anchor] = (closed.value, count - closed.begin)
        elif isinstance(event, yaml.ScalarEvent):
            if open_ and isinstance(open_[-1].value, dict) and open_[-1].key is None:
                open_[-1].key = event.value
            else:
                scalar = _scalar(event.value) if event.implicit[0] else event.value
                _add(scalar, open_, found, where)
                if anchor:
                    named[anchor] = (scalar, 1)
    if len(found) > 1:
        raise RequestError(f"{source} holds several documents (---); only one is taken.")
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
    if endless := _ENDLESS.fullmatch(text):
        return float(f"{endless[1]}inf") if endless[2] else float("nan")
    return float(text) if _DECIMAL.fullmatch(text) else text


def _short(text: str) -> str:
    return text if len(text) <= 40 else f"{text[:40]}…"
