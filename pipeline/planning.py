"""Which stages a request means, what each would compute from, and why a cached result is stale."""

from __future__ import annotations

import hashlib
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from shlex import quote
from typing import Any

from pipeline import installed
from pipeline.config import Config, flattened, result_fields, yaml_value
from pipeline.errors import PipelineError, RequestError, StageError, nearest
from pipeline.files import canonical_json, sha256_text
from pipeline.stage import Stage, get_stage, usable_stages
from pipeline.store import MANIFEST, Result, Store
from pipeline.untrusted.files import ANY, UnusableFile, opened


@dataclass(frozen=True)
class Input:
    """Where one input artifact comes from; `result` is None while its stage has yet to run."""

    stage: str
    kind: str
    result: Result | None

    @property
    def content(self) -> str | None:
        """Hash of the artifact's names and bytes."""
        return self.result.contents[self.kind] if self.result else None


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


@dataclass(frozen=True)
class Chain:
    """The stages to run, in order, and what they take from the workspace as it is.

    Attributes:
        names: the stages of this run.
        upstream: stages before the first one named, whose results in use are taken as they are.
        implicit: those of `names` that run only because photographs were given.
        standing: `upstream` and `implicit`, in the order of the config.
    """

    names: tuple[str, ...]
    upstream: tuple[str, ...] = ()
    implicit: tuple[str, ...] = ()
    standing: tuple[str, ...] = ()


def resolve_chain(
    config: Config,
    stages: Sequence[str] | None,
    from_stage: str | None,
    images_named: bool,
    store: Store,
    asked: Collection[str] = (),
) -> Chain:
    """Turn ``--stages`` and ``--from`` into the list of stages to run.

    Named stages run in the order given and take their input from each other; what the first of them
    needs from before comes from the workspace as it is in use. A stage that reads the photographs
    runs first whenever photographs are named; otherwise what it read before is taken as it is,
    unless that was read with other settings than this run's.

    Args:
        asked: settings that this very request gives, such as ``views.masks``.

    Raises:
        RequestError: an unknown stage, or one named twice.
    """
    order = config.run.stages
    names = tuple(stages) if stages else order
    for name in names:
        get_stage(name)
    if len(set(names)) < len(names):
        raise RequestError(f"A stage is named twice: {','.join(names)}.")
    if from_stage is not None:
        if from_stage not in names:
            raise RequestError(
                f"--from {from_stage}: the stages of this run are {', '.join(names)}."
                f"{nearest(str(from_stage), names)}"
            )
        names = names[names.index(from_stage) :]
    usable = usable_stages()
    readers = tuple(name for name in order if name in usable and usable[name].uses_sources)
    implicit = tuple(name for name in readers if name not in names)
    if images_named:
        names = (*implicit, *names)
        prepared = tuple(n for n in order if n not in names and _prepares(n, names, usable))
        after = max((names.index(name) + 1 for name in readers if name in names), default=0)
        names = (*names[:after], *prepared, *names[after:])
        implicit += prepared
    elif not stages and not from_stage:
        kept = {n for n in readers if _read_as_set(n, config, store, asked)}
        names = tuple(n for n in names if n not in kept)
    first = next((name for name in names if name not in implicit), names[0])
    position = order.index(first) if first in order else len(order)
    upstream = tuple(name for name in order[:position] if name not in names)
    standing = tuple(name for name in order if name in upstream or name in implicit)
    return Chain(names, upstream, implicit, standing)


def _read_as_set(name: str, config: Config, store: Store, asked: Collection[str]) -> bool:
    """Has a stage a result in use that was made with these settings, as far as it knew them?

    Of files that settings name it knows no path: one that is asked for counts as another.
    """
    result = store.current(name)
    if result is None:
        return False
    before, now = result.manifest["key_material"]["config"], result_fields(config.sections[name])
    others = {setting.split(".")[1] for setting in asked if setting.startswith(f"{name}.")}
    same = all(before[field] == now[field] for field in before.keys() & now.keys())
    return same and others <= before.keys()


def _prepares(name: str, names: Sequence[str], usable: Mapping[str, Stage]) -> bool:
    """Does a quick stage that nobody named say something that stages named can use?"""
    if name not in usable or not usable[name].prepares:
        return False
    wanted = {
        kind
        for other in names
        if other in usable
        for kind in (*usable[other].requires, *usable[other].optional)
    }
    return bool(wanted & set(usable[name].provides))


class Providers:
    """Where each kind of artifact comes from, for one stage of a chain after the other.

    A stage takes what the last one before it made, in the order of the config. `init` turns the
    photographs that `views` reads: a fit that is run again with the photographs named, so that
    `views` runs first, takes those of `init`, as it did the first time.
    """

    def __init__(self, chain: Chain, store: Store) -> None:
        """
        Raises:
            RequestError: a needed kind is provided by no earlier stage and the workspace has none,
                or it can't be told which result is in use.
        """
        self._chain = chain
        self._upstream = {name: store.in_use(name) for name in chain.upstream}
        self._table: dict[str, Input] = {}
        results = [result for result in self._upstream.values() if result]
        available = {kind for result in results for kind in result.contents}
        for name in chain.names:
            stage = get_stage(name)
            lacking = [kind for kind in stage.requires if kind not in available]
            if lacking:
                raise RequestError(_nobody_provides(name, lacking, chain, available))
            available |= set(stage.provides)

    def of(self, name: str) -> Mapping[str, Input]:
        """Artifact kind -> where the next stage of the chain takes it from."""
        standing = self._chain.standing
        first = standing[: standing.index(name)] if name in self._chain.implicit else standing
        for other in first:
            result = self._upstream.pop(other, None)
            self.enter(other, result.contents if result else (), result)
        return self._table

    def enter(self, name: str, kinds: Iterable[str], result: Result | None) -> None:
        """What a stage has made, or will make."""
        self._table |= {kind: Input(name, kind, result) for kind in kinds}


def _nobody_provides(name: str, kinds: Sequence[str], chain: Chain, held: set[str]) -> str:
    """All that a stage lacks, who would make it, what there is, and where to begin instead."""
    usable = usable_stages()
    others = {n: stage for n, stage in usable.items() if n != name}
    makers = {kind: [n for n, s in others.items() if kind in s.provides] for kind in kinds}
    later = chain.names[chain.names.index(name) + 1 :]
    late = [maker for maker in later if any(maker in makers[kind] for kind in kinds)]
    if late:
        return (
            f"The stage '{name}' needs what {' and '.join(late)} would make, which --stages "
            f"{','.join(chain.names)} names after it. Stages run in the order given: name "
            f"{' and '.join(late)} before {name}."
        )
    if all(makers[kind] for kind in kinds) and all(
        usable[maker].uses_sources for names in makers.values() for maker in names
    ):
        return f"The stage '{name}' needs photographs: give a folder, files, a glob or a video."
    wanted = [
        f"{kind} ({' or '.join(makers[kind])} would make them)" if makers[kind] else kind
        for kind in kinds
    ]
    has = f" It holds {', '.join(sorted(held))}." if held else " It holds nothing yet."
    start = _first_to_run(kinds, chain, held, others)
    advice = f"Begin there: --from {start}." if start else "Add such a stage to --stages."
    return (
        f"The stage '{name}' needs {' and '.join(wanted)}, which no earlier stage of this run "
        f"provides and this workspace does not hold.{has} {advice}"
    )


def _first_to_run(
    kinds: Sequence[str], chain: Chain, held: set[str], others: Mapping[str, Stage]
) -> str | None:
    """The earliest stage before the chain that has to run for these kinds; None: there is none."""
    wanted, first = set(kinds), None
    for name in reversed(chain.upstream):
        stage = others.get(name)
        if stage is not None and wanted & set(stage.provides):
            first = name
            wanted |= {kind for kind in stage.requires if kind not in held}
    return first


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


def stage_inputs(stage: Stage, table: Mapping[str, Input]) -> dict[str, Input]:
    """The part that a stage takes of what `Providers.of` offers."""
    return {k: table[k] for k in (*stage.requires, *stage.optional) if k in table}


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
        RequestError: the photographs can't be found or read, or none are named.
    """
    stage = get_stage(name)
    inputs = stage_inputs(stage, table)
    pointer = store.pointer(name)
    failure = store.failures.of(name)
    waiting = sorted({entry.stage for entry in inputs.values() if entry.result is None})
    if waiting:
        state = "pending" if pointer else "missing"
        return PlannedStage(name, state, inputs, [f"depends on {' and '.join(waiting)}"])
    if stage.uses_sources and not images:
        raise RequestError(
            f"No photographs are named, and {store.root} remembers none: no run was started there. "
            f"Name them as well: pipeline run PHOTOGRAPHS -w {quote(str(store.root))}"
        )
    notes: list[str] = []
    request = {"images": list(images), "workspace": store.root, "tell": notes.append}
    sources = _sources(stage, config, request)
    hashes = {label: _hash_source(label, path) for label, path in sources.items()}
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


def _hash_source(label: str, path: Path) -> str:
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
    reasons += _explain_sources(dict(old["sources"]), dict(new["sources"]))
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


def changed_sources(
    name: str, config: Config, store: Store, images: Sequence[str | Path]
) -> list[str]:
    """What has become of the user's files since a stage read them; nothing where they are away, or
    where it read them with other settings. Only those that the disk says have changed are read."""
    stage, result = usable_stages().get(name), store.current(name)
    if stage is None or not stage.uses_sources or result is None:
        return []
    if not _read_as_set(name, config, store, ()):
        return []
    request = {"images": list(images), "workspace": store.root}
    before: dict[str, str] = dict(result.manifest["key_material"]["sources"])
    try:
        found = stage.sources(config.sections[name], request)
        written = (result.folder / MANIFEST).stat().st_mtime_ns
        new = [k for k, path in found.items() if path.stat().st_ctime_ns > written]
        changed = {k: _hash_source(k, found[k]) for k in new if k in before}
    except (RequestError, OSError):
        return []
    return _explain_sources(before, {k: changed.get(k, before.get(k, "")) for k in found})


def _explain_sources(old: Mapping[str, str], new: Mapping[str, str]) -> list[str]:
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
