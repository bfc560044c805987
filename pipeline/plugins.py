"""Plug-ins: classes that this project and others register as entry points, and what is wrong with
one that can't be used."""

from __future__ import annotations

import inspect
import re
from collections.abc import Collection, Mapping, Sequence
from functools import cache
from importlib.metadata import EntryPoint, entry_points
from typing import Any

from pipeline.errors import RequestError

Entries = Mapping[str, Sequence[EntryPoint]]

_NAME = re.compile(r"[a-z][a-z0-9_]*")


@cache
def registered(group: str) -> Entries:
    """Name -> the entry points of a group under that name; two that mean the same count once."""
    found: dict[str, list[EntryPoint]] = {}
    for entry in entry_points(group=group):
        same = found.setdefault(entry.name, [])
        if entry.value not in [other.value for other in same]:
            same.append(entry)
    return found


def origin(entry: EntryPoint) -> str:
    """Where a plug-in comes from: its class, and the package that registers it."""
    package = getattr(entry, "dist", None)
    return f"{entry.value}, of {package.name} {package.version}" if package else entry.value


def load(what: str, entries: Sequence[EntryPoint], base: type[Any]) -> tuple[type[Any], str]:
    """Import the class that a name stands for.

    Args:
        what: for messages, such as ``stage 'fit'``.
        entries: all that are registered under the name.
        base: what the class must be derived from.

    Returns:
        The class, and `what` with its origin, to begin further messages with.

    Raises:
        RequestError: the name is taken twice, or it stands for no such class.
    """
    entry, *others = entries
    if others:
        told = " and ".join(f"({origin(each)})" for each in entries)
        raise RequestError(
            f"The {what} is registered twice: {told}. Uninstall one of the packages, or give its "
            "plug-in another name."
        )
    where = f"The {what} ({origin(entry)})"
    try:
        found = entry.load()
    except (Exception, SystemExit) as error:
        raise RequestError(
            f"{where} can't be imported: {type(error).__name__}: {error}. Mend or uninstall its "
            "package; 'pipeline doctor' says what else is missing."
        ) from error
    if not (isinstance(found, type) and issubclass(found, base)):
        raise RequestError(
            f"{where} is not a class derived from {base.__module__}.{base.__qualname__}. Let its "
            "entry point name such a class."
        )
    if inspect.isabstract(found):
        missing = ", ".join(sorted(getattr(found, "__abstractmethods__", ())))
        raise RequestError(f"{where} lacks {missing}. Define it in the class.")
    return found, where


def check_name(where: str, attribute: str, said: object, name: str, taken: Collection[str]) -> None:
    """Does a class call itself as it is registered, by a name that can be a folder's?

    Args:
        where: begins the messages.
        attribute: of the class that holds its name, and `said` its value.
        name: under which it is registered.
        taken: names that mean something else.

    Raises:
        RequestError: it does not.
    """
    if said != name:
        raise RequestError(
            f"{where} has {attribute} = {said!r}. Set it to '{name}', the name of its entry point."
        )
    if name in taken or not _NAME.fullmatch(name):
        raise RequestError(
            f"{where} can't have this name: it must be lower-case letters, digits and underscores, "
            f"and none of {', '.join(taken)}. Choose another."
        )
