"""The small files of a workspace: JSON with a checksum of its own, and what each must say.

The checksum is the last entry and covers every byte before it, so that a file is still plain JSON
to any other tool. Files of earlier versions have none; those are held to what they must say.
"""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any, Literal, TypeVar

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from pipeline.files import sha256_text, write_atomic
from pipeline.untrusted.files import Kind, UnusableFile, read

MANIFEST = "manifest.json"
#: Manifests of 10,000 files have 2 MB.
RECORD = Kind("a record of the workspace", 1 << 26)

_SEAL = re.compile(r',\n "checksum": "([0-9a-f]{64})"\n\}\n\Z')

Model = TypeVar("Model", bound="Record")


class DamagedError(Exception):
    """A record is not what was written; the text says in what way."""


class Record(BaseModel):
    """Base of what records say: no other types than these, no other entries."""

    model_config = ConfigDict(strict=True, extra="forbid", frozen=True)


class Pointer(Record):
    """`current.json`: the key of the result in use, and why it came to be."""

    key: str
    reasons: list[str] = []


class Failure(Record):
    """`failure.json`: the key that the last try was for, and what it said."""

    key: str
    message: str


class Owner(Record):
    """`.owner.json`: who holds the lock of a stage."""

    pid: int
    host: str
    since: str


class SavedRequest(Record):
    """`request.json`: what was asked for last."""

    images: list[str]
    preset: str | None
    overrides: list[str]
    stages: list[str] | None
    from_stage: str | None = Field(alias="from")


class FileEntry(Record):
    size: int
    sha256: str


class Output(Record):
    content: str
    files: dict[str, FileEntry]


class KeyMaterial(Record):
    model_config = ConfigDict(extra="allow")
    stage: str
    config: dict[str, Any]
    inputs: dict[str, str]
    sources: list[list[str]]
    libraries: dict[str, str]


class InputEntry(Record):
    stage: str
    content: str


class EarlierManifest(Record):
    """`manifest.json` of a version that put no checksum into it."""

    model_config = ConfigDict(extra="allow")
    format: Literal[1]
    stage: str
    key: str
    key_material: KeyMaterial
    config: dict[str, Any]
    seed: int
    inputs: dict[str, InputEntry]
    outputs: dict[str, Output]
    reasons: list[str]
    summary: dict[str, Any]
    warnings: list[str]
    wall_seconds: float
    cpu_seconds: float
    peak_memory_mb: float
    threads: int


def write_sealed(path: Path, value: dict[str, Any]) -> None:
    """Replace a record in one step. `value` holds JSON values and is not empty."""
    try:
        body = _body(value, plain=False)
        body.encode()
    except UnicodeEncodeError:  # the name of a file in no known script
        body = _body(value, plain=True)
    write_atomic(path, f'{body},\n "checksum": "{sha256_text(body)}"\n}}\n')


def _body(value: dict[str, Any], *, plain: bool) -> str:
    return json.dumps(value, indent=1, ensure_ascii=plain).removesuffix("\n}")


def read_sealed(path: Path) -> tuple[dict[str, Any], bool] | None:
    """Read a record.

    Returns:
        What it says, and whether it has a checksum; None: there is no such file.

    Raises:
        DamagedError: it is not what was written, or can't be read.
    """
    try:
        path.lstat()  # a link that leads nowhere is there
    except (FileNotFoundError, NotADirectoryError):
        return None
    except OSError as error:
        raise DamagedError(error.strerror or str(error)) from error
    try:
        text = read(path, RECORD).decode()
        value = json.loads(text)
    except UnusableFile as error:
        raise DamagedError(f"it {error}") from error
    except OSError as error:
        raise DamagedError(f"it can't be read ({error.strerror or error})") from error
    except (ValueError, RecursionError) as error:
        raise DamagedError("it is no JSON") from error
    if not isinstance(value, dict):
        raise DamagedError("it holds no entries")
    seal = _SEAL.search(text)
    if seal is None:
        if "checksum" in value:
            raise DamagedError("its checksum is not where it was")
        return value, False
    if sha256_text(text[: seal.start()]) != seal[1]:
        raise DamagedError("its checksum does not fit")
    del value["checksum"]
    return value, True


def read_record(path: Path, model: type[Model]) -> Model | None:
    """Read a record that says what `model` has; None: there is no such file.

    Raises:
        DamagedError: it is not what was written, or can't be read.
    """
    found = read_sealed(path)
    return None if found is None else validated(found[0], model)


def validated(value: dict[str, Any], model: type[Model]) -> Model:
    """Values as a model.

    Raises:
        DamagedError: an entry is missing, unknown or of another type.
    """
    try:
        return model.model_validate(value)
    except (ValidationError, RecursionError) as error:
        where = ""
        if isinstance(error, ValidationError):
            first = error.errors()[0]
            where = f" ({'.'.join(map(str, first['loc']))}: {first['msg']})"
        raise DamagedError(f"it does not say what it should{where}") from error


def read_manifest(path: Path) -> dict[str, Any] | None:
    """Read a result's manifest; None: there is none.

    Raises:
        DamagedError: it is not what was written, or can't be read.
    """
    found = read_sealed(path)
    if found is None:
        return None
    value, sealed = found
    if not sealed:
        validated(value, EarlierManifest)
    return value


def read_own(path: Path) -> dict[str, Any] | None:
    """A record with a checksum, as it was written; None: there is none, or it is damaged."""
    try:
        found = read_sealed(path)
    except DamagedError:
        return None
    return found[0] if found and found[1] else None
