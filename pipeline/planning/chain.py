"""Which stages a request means, and what each takes from those before it."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass

from pipeline.config import Config, result_fields
from pipeline.errors import RequestError, nearest
from pipeline.stage import Stage, get_stage, usable_stages
from pipeline.store import Result, Store


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
        kept = {n for n in readers if read_as_set(n, config, store, asked)}
        names = tuple(n for n in names if n not in kept)
    first = next((name for name in names if name not in implicit), names[0])
    position = order.index(first) if first in order else len(order)
    upstream = tuple(name for name in order[:position] if name not in names)
    standing = tuple(name for name in order if name in upstream or name in implicit)
    return Chain(names, upstream, implicit, standing)


def read_as_set(name: str, config: Config, store: Store, asked: Collection[str]) -> bool:
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


def stage_inputs(stage: Stage, table: Mapping[str, Input]) -> dict[str, Input]:
    """The part that a stage takes of what `Providers.of` offers."""
    return {k: table[k] for k in (*stage.requires, *stage.optional) if k in table}


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
