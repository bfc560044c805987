"""What a result is cached by, and why one that is cached is stale."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any

from pipeline import installed
from pipeline.config import Config, flattened, result_fields, yaml_value
from pipeline.errors import RequestError
from pipeline.files import canonical_json, sha256_text
from pipeline.planning.chain import Input
from pipeline.stage import Stage
from pipeline.untrusted.files import ANY, UnusableFile, opened


def key_material(
    stage: Stage,
    config: Config,
    inputs: Mapping[str, Input],
    sources: Mapping[str, str],
) -> dict[str, Any]:
    """Everything that can change the stage's result; the key is the hash of it.

    docs/architecture.md says why, under "The store".
    """
    section = config.sections[stage.name]
    material = {
        "stage": stage.name,
        "version": stage.version,
        "config": result_fields(section),
        "seed": config.run.seed,
        "inputs": {kind: entry.content for kind, entry in sorted(inputs.items())},
        "sources": [[label, digest] for label, digest in sources.items()],
        "libraries": {name: library_version(name) for name in _libraries(stage)},
    }
    backend = stage.backend(section)
    return {**material, "backend": backend} if backend else material


def _libraries(stage: Stage) -> tuple[str, ...]:
    """Those that a stage names, and llvmlite, which makes the code of numba's kernels."""
    return (*stage.libraries, *(("llvmlite",) if "numba" in stage.libraries else ()))


def key_of(material: dict[str, Any]) -> str:
    return sha256_text(canonical_json(material))


@cache
def library_version(name: str) -> str:
    """Version of an installed distribution, ``"missing"`` where there is none."""
    return installed.library_version(name)


def hash_source(label: str, path: Path) -> str:
    try:
        stat = path.stat()
        return _hash_once(path, stat.st_size, stat.st_mtime_ns)
    except (OSError, UnusableFile) as error:
        why = f"can't be read ({error.strerror})" if isinstance(error, OSError) else str(error)
        raise RequestError(f"{label} {why}. Mend or remove it.") from error


@cache
def _hash_once(path: Path, size: int, mtime_ns: int) -> str:
    """A video is looked at several times in one process, but read once."""
    with opened(path, ANY) as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def explain(
    old: Mapping[str, Any], new: Mapping[str, Any], inputs: Mapping[str, Input]
) -> list[str]:
    """Name each difference between two key materials, for people."""
    reasons = []
    stage = new["stage"]
    before, after = flattened(old["config"]), flattened(new["config"])
    for name in sorted(before.keys() | after.keys()):
        if before.get(name) != after.get(name):
            reasons.append(f"{stage}.{name} {_show(before, name)} → {_show(after, name)}")
    for kind in sorted(old["inputs"].keys() | new["inputs"].keys()):
        was, now = old["inputs"].get(kind), new["inputs"].get(kind)
        if was == now:
            continue
        origin = f" (from {inputs[kind].stage})" if kind in inputs else ""
        verb = "is new" if was is None else "is no longer used" if now is None else "changed"
        reasons.append(f"input {kind}{origin} {verb}")
    reasons += explain_sources(dict(old["sources"]), dict(new["sources"]))
    for name in sorted(old["libraries"].keys() | new["libraries"].keys()):
        was, now = old["libraries"].get(name), new["libraries"].get(name)
        if was != now:
            reasons.append(f"library {name} {was} → {now}")
    for name in ("version", "seed", "backend"):
        if old.get(name) != new.get(name):
            was, now = (entry.get(name, "(unknown)") for entry in (old, new))
            reasons.append(f"{stage} {name} {was} → {now}")
    if old["sources"] != new["sources"] and not reasons:
        reasons.append("the order of the photographs changed")
    return reasons


def explain_sources(old: Mapping[str, str], new: Mapping[str, str]) -> list[str]:
    reasons = []
    for verb, labels in (
        ("added", [label for label in new if label not in old]),
        ("removed", [label for label in old if label not in new]),
        ("changed", [label for label in new if label in old and old[label] != new[label]]),
    ):
        if labels:
            shown = ", ".join(labels[:3]) + (f" and {len(labels) - 3} more" if labels[3:] else "")
            reasons.append(f"input file {verb}: {shown}")
    return reasons


def _show(flat: Mapping[str, Any], name: str) -> str:
    """A value of a setting, as one would type it."""
    return yaml_value(flat[name]) if name in flat else "(absent)"
