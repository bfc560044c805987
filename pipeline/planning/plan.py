"""What each stage of a request would compute from, and whether its result is there."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from shlex import quote
from typing import Any

from pipeline.config import Config
from pipeline.errors import PipelineError, RequestError, StageError
from pipeline.planning.chain import Chain, Input, Providers, read_as_set, stage_inputs
from pipeline.planning.keys import explain, explain_sources, hash_source, key_material, key_of
from pipeline.stage import Stage, get_stage, usable_stages
from pipeline.store import MANIFEST, Result, Store


@dataclass
class PlannedStage:
    """One stage of a request, as far as it can be known before running.

    Attributes:
        state: ``cached``, ``stale`` (a result exists, made from something else), ``missing``,
            ``failed`` or ``pending`` (can't be known before an earlier stage has run).
        reasons: what differs from the result in use.
        key: None while pending.
        material: what the key is the hash of.
        sources: label -> file, for a stage that reads the user's files.
        notes: what there is to say about the request.
    """

    name: str
    state: str
    inputs: dict[str, Input]
    reasons: list[str] = field(default_factory=list)
    key: str | None = None
    material: dict[str, Any] = field(default_factory=dict)
    sources: Mapping[str, Path] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
    result: Result | None = None
    failure: str | None = None
    resumable: bool = False


def plan_stage(
    name: str,
    config: Config,
    store: Store,
    table: Mapping[str, Input],
    images: Sequence[str | Path],
) -> PlannedStage:
    """Find out whether a stage's result exists, and if not, why not.

    Args:
        table: artifact kind -> provider, of all stages before this one.
        images: what the user gave.

    Raises:
        RequestError: the photographs can't be found or read, or none are named; another file that
            the settings name is wrong.
    """
    stage = get_stage(name)
    inputs = stage_inputs(stage, table)
    pointer = store.pointer(name)
    failure = store.failures.of(name)
    waiting = sorted({entry.stage for entry in inputs.values() if entry.result is None})
    notes: list[str] = []
    request = {"images": list(images), "workspace": store.root, "tell": notes.append}
    if waiting:
        if not stage.uses_sources:
            _sources(stage, config, request)  # what is wrong there is said before the others run
        state = "pending" if pointer else "missing"
        reasons = [f"depends on {' and '.join(waiting)}"]
        return PlannedStage(name, state, inputs, reasons, notes=notes)
    if stage.uses_sources and not images:
        raise RequestError(
            f"No photographs are named, and {store.root} remembers none: no run was started there. "
            f"Name them as well: pipeline run PHOTOGRAPHS -w {quote(str(store.root))}"
        )
    sources = _sources(stage, config, request)
    hashes = {label: hash_source(label, path) for label, path in sources.items()}
    material = key_material(stage, config, inputs, hashes)
    key = key_of(material)
    planned = PlannedStage(name, "cached", inputs, [], key, material, sources, notes)
    planned.result = store.find(name, key)
    if planned.result is None:
        current = store.current(name)
        planned.state = "stale" if current else "missing"
        planned.reasons = (
            explain(current.manifest["key_material"], material, inputs) if current else []
        )
        planned.resumable = store.has_checkpoint(name, key)
        if failure and failure.get("key") == key:
            planned.state, planned.failure = "failed", failure["message"]
    elif pointer and pointer["key"] == key:
        planned.reasons = list(pointer.get("reasons", []))
    return planned


def _sources(stage: Stage, config: Config, request: Mapping[str, Any]) -> Mapping[str, Path]:
    """The files that a stage will read, as it names them.

    Raises:
        StageError: it fails in that.
    """
    try:
        found = stage.sources(config.sections[stage.name], request)
        return {label: Path(path) for label, path in found.items()}
    except (PipelineError, OSError):
        raise
    except Exception as error:
        raise StageError(
            f"The stage '{stage.name}' failed where it names the files that it reads, which is a "
            f"mapping of labels to paths: {type(error).__name__}: {error}."
        ) from error


def plan_chain(
    chain: Chain, config: Config, store: Store, images: Sequence[str | Path]
) -> list[PlannedStage]:
    """Look at every stage of a chain without running any.

    Args:
        images: what the user gave.

    Raises:
        RequestError: a needed kind is nowhere, or the photographs can't be found or read.
    """
    providers = Providers(chain, store)
    planned = []
    for name in chain.names:
        stage = plan_stage(name, config, store, providers.of(name), images)
        planned.append(stage)
        if stage.result is not None:
            made = tuple(stage.result.contents)
        else:
            made = (*get_stage(name).provides, *get_stage(name).may_provide)
        providers.enter(name, made, stage.result)
    return planned


def changed_sources(
    name: str, config: Config, store: Store, images: Sequence[str | Path]
) -> list[str]:
    """What has become of the user's files since a stage read them; nothing where they are away, or
    where it read them with other settings. Only those that the disk says have changed are read."""
    stage, result = usable_stages().get(name), store.current(name)
    if stage is None or not stage.uses_sources or result is None:
        return []
    if not read_as_set(name, config, store, ()):
        return []
    request = {"images": list(images), "workspace": store.root}
    before: dict[str, str] = dict(result.manifest["key_material"]["sources"])
    try:
        found = stage.sources(config.sections[name], request)
        written = (result.folder / MANIFEST).stat().st_mtime_ns
        new = [k for k, path in found.items() if path.stat().st_ctime_ns > written]
        changed = {k: hash_source(k, found[k]) for k in new if k in before}
    except (RequestError, OSError):
        return []
    return explain_sources(before, {k: changed.get(k, before.get(k, "")) for k in found})
