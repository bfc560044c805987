"""What a case is computed from: settings, photographs, and the other files that its stages read."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from pipeline.config import load_config, result_fields
from pipeline.files import canonical_json, sha256_text
from pipeline.installed import ROOT
from pipeline.planning import library_version, resolve_chain
from pipeline.stage import StageConfig, get_stage
from pipeline.store import Store
from pipeline.studies.batch.records import Case, Other
from pipeline.untrusted.files import ANY, UnusableFile, opened

#: What comes with us: the version says which it is.
_OWN = ROOT / "stages"


@dataclass(frozen=True)
class Settings:
    """What a case is run with.

    Attributes:
        key: hash of all that decides what comes of given files.
        sections: each stage that is run -> its settings.
    """

    key: str
    sections: Mapping[str, StageConfig]


def settings_of(
    preset: str | None, overrides: tuple[str, ...], stages: tuple[str, ...] | None
) -> Settings:
    """What these settings come to, for a case whose photographs are named.

    Raises:
        RequestError: a setting is wrong.
    """
    config = load_config(preset, overrides)
    # what a workspace holds is not asked where photographs are named
    names = resolve_chain(config, stages, None, True, Store(Path())).names
    sections = {name: config.sections[name] for name in names}
    told = {
        "stages": {
            name: [get_stage(name).version, result_fields(section)]
            for name, section in sections.items()
        },
        "order": list(names),
        "seed": config.run.seed,
        "version": library_version("dentalsplat"),
    }
    return Settings(sha256_text(canonical_json(told)), sections)


def with_others(case: Case, settings: Settings, workspace: Path) -> Case:
    """A case with the files that its stages read besides the photographs.

    What is wrong with such a file is said by the run itself; here it counts as what is read.

    Args:
        workspace: that of the case, which may hold files of the user's.
    """
    photographs = {path for path, _, _ in case.files}
    request = {"images": list(case.images), "workspace": workspace}
    named: list[Other] = []
    put: list[Other] = []
    for name, section in settings.sections.items():
        try:
            found = get_stage(name).sources(section, request)
        except Exception as error:
            named.append((f"{name}: {error}", "", 0, 0))
            continue
        for label, given in found.items():
            path = given.absolute()
            if str(path) in photographs or path.is_relative_to(_OWN):
                continue
            others = put if path.is_relative_to(workspace) else named
            others.append((f"{name}: {label}", str(path), *_stamp(path)))
    return replace(case, named=tuple(named), put=tuple(put))


def contents_of(others: Sequence[Other]) -> list[str]:
    """What each file is for, and the hash of its bytes; or what is wrong with it."""
    return [f"{label} {_hash(Path(path))}" if path else label for label, path, _, _ in others]


def _stamp(path: Path) -> tuple[int, int]:
    try:
        entry = path.stat()
    except OSError:
        return 0, 0
    return entry.st_size, entry.st_mtime_ns


def _hash(path: Path) -> str:
    try:
        with opened(path, ANY) as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except (OSError, UnusableFile) as error:
        return str(error)
