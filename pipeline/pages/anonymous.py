"""Take out of a case what says whose it is: names of files, folders, the host and the user."""

from __future__ import annotations

import contextlib
import getpass
import re
import socket
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, fields, is_dataclass, replace
from functools import cached_property
from pathlib import Path, PurePath
from typing import Any

from pydantic import BaseModel

from pipeline.config import parse_override
from pipeline.errors import RequestError
from pipeline.pages.case import Case, StageRecord
from pipeline.untrusted.paths import matching

#: Words that photographs, folders and users are called by and that tell nobody's name.
WORDS = frozenset({
    "admin", "app", "buccal", "camera", "case", "cases", "center", "centre", "clinic", "data",
    "debian", "dental", "desktop", "documents", "downloads", "exports", "file", "files", "frame",
    "frames", "front", "frontal", "home", "image", "images", "img", "input", "inputs", "left",
    "local", "lower", "main", "mask", "masks", "media", "middle", "mnt", "model", "models",
    "occlusal", "opt", "output", "patient", "patients", "photo", "photograph", "photographs",
    "photos", "picture", "pictures", "project", "projects", "rgb", "right", "root", "runs", "scan",
    "scans", "share", "shared", "side", "srv", "teeth", "tmp", "tooth", "ubuntu", "upper", "user",
    "users", "usr", "var", "video", "view", "volume", "volumes", "work", "workspace",
})  # fmt: skip
#: So many digits are no number that photographs are counted by.
LONG = 6
#: Where a path begins: at a root (with a drive's letter), or at a home.
_ROOT = r"(?:[A-Za-z]:|~\w*)?[/\\]"
#: A path from there up to what ends it in a sentence or, where it stands in quotes, to their end.
_PATHS = re.compile(
    rf"(?<=['\"]){_ROOT}(?:[^/\\'\"\n]+[/\\])+[^'\"\n]*(?=['\"])"
    rf"|(?<![\w.<]){_ROOT}(?:[^\s/\\'\"<>:,;)]+[/\\])+[^\s'\"<>:,;)]*"
)
#: What stands in the place of a path, and of a name.
PATH, NAME = "[path]", "[name]"
#: How a path goes on that begins with a known one.
_GOES_ON = r"[^\s'\"<>:,;)]*"


@dataclass(frozen=True)
class Secrets:
    """What is not to be told, and what stands in its place.

    Attributes:
        places: text -> what is written instead; longer ones are looked for first.
    """

    places: Mapping[str, str]

    def hide(self, value: Any) -> Any:
        """A value with all texts in it made neutral: JSON-like, or made of parts of a page.

        Pictures and drawings are left as they are.
        """
        if isinstance(value, str):
            return value if value.startswith(("data:image/", "<svg ")) else self._hide(value)
        if is_dataclass(value) and not isinstance(value, type):
            own = [entry.name for entry in fields(value) if entry.init]
            return replace(value, **{name: self.hide(getattr(value, name)) for name in own})
        if isinstance(value, Mapping):
            return {self.hide(key): self.hide(entry) for key, entry in value.items()}
        if isinstance(value, list | tuple):
            return type(value)(self.hide(entry) for entry in value)
        return value

    @cached_property
    def _longest_first(self) -> list[tuple[str, str, str]]:
        """What is looked for in small letters, what finds it, and what is written instead."""
        found = []
        for secret in sorted(self.places, key=len, reverse=True):
            instead = self.places[secret].replace("\\", "")
            end = _GOES_ON if instead == PATH else r"(?![^\W_])"
            found.append((secret.lower(), rf"(?<![^\W_]){re.escape(secret)}{end}", instead))
        return found

    def _hide(self, text: str) -> str:
        for secret, pattern, instead in self._longest_first:
            if secret in text.lower():
                text = re.sub(pattern, instead, text, flags=re.IGNORECASE)
        return _PATHS.sub(PATH, text)


def secrets_of(case: Case) -> Secrets:
    """Names of the photographs with and without suffix, the paths of the request and the settings
    with the folders on the way there, and the names of this computer and its user."""
    places: dict[str, str] = {}
    named = [*_user(), socket.gethostname(), *_lying_there(case.request.get("images") or ())]
    for path in dict.fromkeys(_paths(case)):
        parts = [part for part in re.split(r"[/\\]", path) if part]
        named += [*parts, *(PurePath(part).stem for part in parts[-1:])]
        places |= {written: PATH for place in _on_the_way(path) for written in _written(place)}
    places |= {written: NAME for name in dict.fromkeys(named) for written in _written(name)}
    for kind in ("views", "held_out"):
        artifact = case.latest(kind)
        for view in artifact.views if artifact else ():
            source = PurePath(view.source_name.partition("#")[0])
            places |= dict.fromkeys((view.source_name, source.stem, *source.parts), view.name)
    known = WORDS | {name.lower() for name in _own_words(case)}
    return Secrets({text: places[text] for text in places if _tells(text, known)})


def _tells(text: str, known: frozenset[str]) -> bool:
    """Could it tell who somebody is? A letter alone and short numbers could not; a date, the number
    of a patient and the UID of a picture could."""
    letters, digits = re.search(r"[^\W\d_]", text), len(re.findall(r"\d", text))
    return len(text) > 1 and text.lower() not in known and (bool(letters) or digits >= LONG)


def _paths(case: Case) -> Iterator[str]:
    """The paths that the user named, and the workspace."""
    request = case.request
    yield from map(str, (case.workspace, case.workspace.absolute(), case.workspace.resolve()))
    yield from request.get("images") or ()
    preset = request.get("preset") or ""
    yield preset if PurePath(preset).suffix else ""  # those that come with the program have none
    for text in request.get("overrides") or ():
        try:
            _, value = parse_override(text)
        except RequestError:
            value = text.partition("=")[2]
        yield from _paths_in(value)
    models = [*case.settings.values(), *([case.run_settings] if case.run_settings else [])]
    yield from _paths_in([model.model_dump() for model in models])
    yield from _paths_in([record.manifest.get("config") for record in case.stages])


def _lying_there(images: Iterable[str]) -> Iterator[str]:
    """Names of the files in a folder or of a pattern that was given, also of those that no stage
    could use; none if they are gone."""
    for text in images:
        with contextlib.suppress(OSError, ValueError):
            folder = Path(text)
            for path in folder.iterdir() if folder.is_dir() else matching(text):
                if path.is_file():
                    yield from (path.name, path.stem)


def _paths_in(value: Any) -> Iterator[str]:
    """All texts of a JSON-like value that may be paths."""
    if isinstance(value, str | Path):
        if re.search(r"[/\\]", str(value)):
            yield str(value)
    elif isinstance(value, Mapping):
        yield from _paths_in(list(value.values()))
    elif isinstance(value, list | tuple):
        for entry in value:
            yield from _paths_in(entry)


def _on_the_way(path: str) -> Iterator[str]:
    """A path and, if it leads from a root, the folders on the way to what it names."""
    if not re.search(r"[/\\]", path):
        return
    yield path.rstrip("/\\")
    if re.match(_ROOT, path):
        yield from (path[: found.start()] for found in re.finditer(r"[/\\]", path))


def _written(text: str) -> set[str]:
    """A text as it is, and as YAML writes it in quotes."""
    return {text, text.replace("'", "''"), text.encode("unicode_escape").decode()}


def _own_words(case: Case) -> Iterator[str]:
    """Names of stages and settings."""
    yield from (record.name for record in case.stages)
    for section, model in case.settings.items():
        yield section
        yield from _names_in(model)
    if case.run_settings is not None:
        yield from _names_in(case.run_settings)


def _names_in(model: BaseModel) -> Iterator[str]:
    for name in type(model).model_fields:
        yield name
        value = getattr(model, name)
        if isinstance(value, BaseModel):
            yield from _names_in(value)


def _user() -> Iterator[str]:
    try:
        yield getpass.getuser()
    except (OSError, KeyError):  # a container's user that has no name
        return


def anonymous(case: Case) -> Case:
    """The case without these names; whatever is drawn from it has none."""
    hide = secrets_of(case).hide
    loaded = {}
    for record in case.stages:
        for kind in record.result.contents if record.result else ():
            artifact = case.load(record.name, kind) if kind in ("views", "held_out") else None
            if artifact is not None:
                nameless = tuple(replace(view, source_name="") for view in artifact.views)
                loaded[record.name, kind] = replace(artifact, views=nameless)
    return Case(
        case.workspace, hide(case.request), tuple(_without(r, hide) for r in case.stages),
        case.settings, case.run_settings, hide(case.notes), loaded, hide,
    )  # fmt: skip


def _without(record: StageRecord, hide: Any) -> StageRecord:
    result = record.result
    if result is not None:
        told = {name: hide(result.manifest.get(name)) for name in ("summary", "warnings", "config")}
        given = {name: value for name, value in told.items() if value is not None}
        result = replace(result, manifest={**result.manifest, **given})
    return replace(
        record, result=result, reasons=tuple(hide(list(record.reasons))),
        failure=hide(record.failure),
    )  # fmt: skip
