"""Take out of a case what says whose it is: names of files, folders, the host and the user."""

from __future__ import annotations

import getpass
import re
import socket
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, fields, is_dataclass, replace
from pathlib import Path, PurePath
from typing import Any

from pipeline.pages.case import Case, StageRecord

#: Words that photographs, folders and users are called by and that tell nobody's name.
WORDS = frozenset({
    "admin", "buccal", "case", "cases", "center", "centre", "data", "debian", "frame", "frames",
    "front", "frontal", "home", "image", "images", "img", "input", "inputs", "left", "lower",
    "middle", "occlusal", "photo", "photograph", "photographs", "photos", "picture", "pictures",
    "rgb", "right", "root", "runs", "side", "tmp", "ubuntu", "upper", "user", "video", "view",
})  # fmt: skip
#: A path from a root (with a drive's letter, or of a home), up to what ends it in a sentence.
_PATHS = re.compile(
    r"(?<![\w.<])(?:[A-Za-z]:|~\w*)?[/\\](?:[^\s/\\'\"<>:,;)]+[/\\])+[^\s'\"<>:,;)]*"
)


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
            return value if value.startswith(("data:", "<")) else self._hide(value)
        if is_dataclass(value) and not isinstance(value, type):
            own = [entry.name for entry in fields(value) if entry.init]
            return replace(value, **{name: self.hide(getattr(value, name)) for name in own})
        if isinstance(value, Mapping):
            return {self.hide(key): self.hide(entry) for key, entry in value.items()}
        if isinstance(value, list | tuple):
            return type(value)(self.hide(entry) for entry in value)
        return value

    def _hide(self, text: str) -> str:
        for secret in sorted(self.places, key=len, reverse=True):
            if secret.lower() in text.lower():
                found = rf"(?<![^\W_]){re.escape(secret)}(?![^\W_])"
                instead = self.places[secret].replace("\\", "")
                text = re.sub(found, instead, text, flags=re.IGNORECASE)
        return _PATHS.sub("[path]", text)


def secrets_of(case: Case) -> Secrets:
    """Names of the photographs with and without suffix, of the folders that they and the workspace
    lie in, and of this computer and its user."""
    named = [*_user(), socket.gethostname(), case.workspace.resolve().name]
    for text in (*(case.request.get("images") or ()), case.request.get("preset") or ""):
        path = Path(text)
        named += [path.name, path.stem, path.parent.name]
    places = dict.fromkeys(named, "[name]")
    for kind in ("views", "held_out"):
        artifact = case.latest(kind)
        for view in artifact.views if artifact else ():
            source = PurePath(view.source_name.partition("#")[0])
            places |= dict.fromkeys((view.source_name, source.stem, *source.parts), view.name)
    neutral = {name for name in places if name.lower() in WORDS or not re.search(r"[^\W\d_]", name)}
    return Secrets({name: places[name] for name in places if name not in neutral})


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
