"""Paths and patterns that a user names."""

from __future__ import annotations

import glob
import os
from pathlib import Path
from typing import Annotated, TypeVar, get_args

from pydantic import AfterValidator
from pydantic.fields import FieldInfo
from pydantic_core import PydanticCustomError

from pipeline.errors import RequestError, shown

Given = TypeVar("Given", str, Path)


def user_path(text: str | Path, setting: str) -> Path:
    """The path that a setting names, with `~` and `~name` replaced.

    Args:
        text: as given; it need not be there.
        setting: its name, for the message.

    Raises:
        RequestError: there is no such user, or no file system has such a name.
    """
    trouble = _trouble(text)
    if trouble is not None:
        raise RequestError(f"{setting}: {_shown(text)} {trouble}.")
    return Path(text).expanduser()


def given_path(value: object, what: str) -> Path:
    """A path that a caller gives, with `~` and `~name` replaced (`home_told`).

    Args:
        what: what it is called, to begin messages with.

    Raises:
        RequestError: it is no path; an empty one is none either, which pathlib takes for the
            current folder.
    """
    text = os.fspath(value) if isinstance(value, str | os.PathLike) else None
    if not isinstance(text, str) or "\0" in text:
        raise RequestError(f"{what} is to be a text or a pathlib.Path, not {shown(value)}.")
    if not text:
        raise RequestError(f"{what} is empty. The current folder is called '.'.")
    return Path(home_told(text))


def home_told(path: str | Path) -> str:
    """A path with `~` and `~name` replaced, which a shell leaves as they are in quotes and after
    ``--option=``; where there is no such user it stays as it is."""
    return os.path.expanduser(path)  # noqa: PTH111 - Path.expanduser fails there


def matching(pattern: str | Path) -> list[Path]:
    """The files and folders that a pattern fits, such as ``clinic [2024]/anna/*.jpg``.

    Folders on the way that are there mean themselves, also with letters that a pattern gives
    another meaning.
    """
    there, rest = _known_part(Path(pattern))
    found = glob.glob(os.path.join(glob.escape(str(there)), str(rest)), recursive=True)  # noqa: PTH118, PTH207
    return [Path(match) for match in found]


def names_folder(pattern: str | Path, folder: Path) -> bool:
    """Does a pattern that fits something in a folder name that folder, and not only match it?"""
    there, rest = _known_part(Path(pattern))
    return there.is_relative_to(folder) or folder.name in rest.parts


def _known_part(pattern: Path) -> tuple[Path, Path]:
    """The folder on the way of a pattern that is there, and what the pattern says from there on."""
    there = next((p for p in pattern.parents if os.path.isdir(p)), Path())  # noqa: PTH112 - never raises
    return there, pattern.relative_to(there)


def _trouble(text: str | Path) -> str | None:
    try:
        os.lstat(Path(text).expanduser())
    except FileNotFoundError:
        return None
    except RuntimeError:  # expanduser: ~nobody
        return "begins with the home of a user that there isn't. Give the whole path"
    except (OSError, ValueError) as error:  # too long, or a zero byte
        reason = getattr(error, "strerror", None) or str(error)
        return f"can't be looked for ({reason.lower()}). Check the path"
    return None


def _possible(text: Given) -> Given:
    trouble = _trouble(text)
    if trouble is not None:
        raise PydanticCustomError("path", "{why}", {"why": f"it {trouble}"})
    return text


#: For settings that are paths: what no file can be called is refused before anything runs. Whether
#: it is there is told by the stage that wants it.
POSSIBLE = AfterValidator(_possible)
GivenPath = Annotated[str, POSSIBLE]


def names_path(field: FieldInfo) -> bool:
    """Is a setting a path?"""
    return POSSIBLE in field.metadata or any(
        POSSIBLE in get_args(part) for part in get_args(field.annotation)
    )


def _shown(text: str | Path) -> str:
    name = str(text)
    return ascii(name if len(name) <= 80 else f"{name[:40]}...{name[-30:]}")
