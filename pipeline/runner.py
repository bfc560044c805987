"""Plan -> reuse or run -> record: the one place where stages meet the store."""

from __future__ import annotations

import contextlib
import shutil
import traceback
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from pipeline import profiling
from pipeline.config import Config
from pipeline.errors import PipelineError, ReconstructionError, RequestError, StageError
from pipeline.kernels.news import told_to
from pipeline.kernels.rehearsals import Background
from pipeline.measure import Measurement
from pipeline.planning import (
    PlannedStage,
    Providers,
    plan_chain,
    plan_stage,
    resolve_chain,
)
from pipeline.process import signals
from pipeline.stage import StageContext, get_stage, usable_stages
from pipeline.store import CorruptResultError, Result, Store, file_in_the_way, is_disk_full
from pipeline.untrusted.names import readable
from pipeline.workspace import Request

Figure = float | int | str


class Reporter:
    """Hears what happens in a run. This one says nothing; the others show it."""

    def start(self, stages: list[str]) -> None:
        """A run of these stages begins."""

    def foreseen(self, stages: list[StageOutcome]) -> None:
        """What is going to be done, before it starts (as `Runner.dry_run` tells it)."""

    def stage_started(self, stage: str, reasons: list[str], resumed: bool) -> None:
        """A stage begins to compute."""

    def progress(self, stage: str, step: str, done: int, total: int, **figures: Figure) -> None:
        """A stage has come to `done` of `total` in `step`."""

    def stage_finished(self, stage: str, cached: bool, figures: dict[str, Any]) -> None:
        """A stage's result is in the store."""

    def message(self, text: str) -> None:
        """Something that the user should know."""

    def stop(self) -> None:
        """The run is over, well or not."""


@dataclass
class StageOutcome:
    """What a run did about one stage.

    Attributes:
        action: ``ran``, ``resumed`` (ran, from a checkpoint) or ``cached``; in a dry run ``would
            run`` or ``unknown`` (depends on what an earlier stage will give).
        reasons: why it ran.
        figures: wall_seconds, cpu_seconds, peak_memory_mb of when it was computed, and `summary`;
            before it runs, wall_seconds of its last time alone, if there was one.
    """

    name: str
    action: str
    reasons: list[str] = field(default_factory=list)
    key: str | None = None
    folder: Path | None = None
    figures: dict[str, Any] = field(default_factory=dict)
    warnings: list[str] = field(default_factory=list)


@dataclass
class RunSummary:
    """What a run did, and where its outputs lie."""

    workspace: Path
    stages: list[StageOutcome] = field(default_factory=list)
    results: Path | None = None
    report: Path | None = None
    check: Path | None = None

    def to_dict(self) -> dict[str, Any]:
        """As JSON values."""
        return {
            "workspace": str(self.workspace),
            "results": str(self.results) if self.results else None,
            "report": str(self.report) if self.report else None,
            "check": str(self.check) if self.check else None,
            "stages": [
                {**vars(s), "folder": str(s.folder) if s.folder else None} for s in self.stages
            ],
        }


class RunContext(StageContext):
    """The context of a stage that runs for the store."""

    def __init__(
        self, planned: PlannedStage, config: Config, store: Store, folder: Path, reporter: Reporter
    ) -> None:
        self.config = config.sections[planned.name]
        self.seed = config.run.seed
        self.threads = config.threads
        self.scratch = folder / "scratch"
        self.sources = planned.sources
        self.warnings: list[str] = []
        self.figures: dict[str, Any] = {}
        self.outputs: list[str] = []
        self._planned = planned
        self._store = store
        self._folder = folder
        self._reporter = reporter

    def has(self, kind: str) -> bool:
        return kind in self._planned.inputs

    def load(self, kind: str) -> Any:
        entry = self._planned.inputs.get(kind)
        if entry is None or entry.result is None:
            raise StageError(
                f"The stage '{self._planned.name}' asks for {kind}, which it was not given. "
                "Name it in `requires`, or in `optional` and ask `has` first."
            )
        return self._store.load(entry.result, kind)

    def output(self, kind: str) -> Path:
        stage = get_stage(self._planned.name)
        if kind not in (*stage.provides, *stage.may_provide):
            raise StageError(
                f"The stage '{stage.name}' writes {kind} without saying so. Name it in `provides` "
                "or `may_provide`."
            )
        path = self._folder / kind
        path.mkdir(exist_ok=True)
        if kind not in self.outputs:
            self.outputs.append(kind)
        return path

    def progress(self, step: str, done: int, total: int, **figures: float | int | str) -> None:
        signals.check()
        self._reporter.progress(self._planned.name, step, done, total, **figures)

    def warn(self, message: str) -> None:
        message = readable(message)
        self.warnings.append(message)
        self._reporter.message(f"{self._planned.name}: {message}")

    def summarize(self, **figures: float | int | str) -> None:
        self.figures.update(figures)


class Runner:
    """One request on one workspace."""

    def __init__(
        self,
        request: Request,
        config: Config,
        reporter: Reporter,
        *,
        verify: bool = False,
        profile: bool = False,
    ) -> None:
        """
        Args:
            profile: write a page about where the time of each stage goes that runs.

        Raises:
            RequestError: the request is wrong, or the profiler is not installed.
        """
        if profile:
            profiling.require_profiler()
        self.profile = profile
        self.request = request
        self.config = config
        self.reporter = reporter
        self.store = Store(request.workspace, verify=verify)
        self.chain = resolve_chain(
            config, request.stages, request.from_stage, request.images_named, self.store
        )

    def plan(self) -> list[PlannedStage]:
        """Look at every stage without running any."""
        return plan_chain(self.chain, self.config, self.store, self.request.images)

    def run(self, *, force: bool = False) -> RunSummary:
        """Run the chain, reusing what is still valid.

        Raises:
            RequestError: the request is wrong; nothing was written, or the disk is full.
            ReconstructionError: the data can't be reconstructed. StageError: a fault of ours.
        """
        planned = self.plan()  # a wrong request is refused before anything is written
        self.store.create(self.chain.names)
        self.request.save()
        self.reporter.start(list(self.chain.names))
        try:
            self.reporter.foreseen(self._foreseen(planned, force))
            with self._kernels(stage.name for stage in planned if force or stage.result is None):
                return self._run_all(force)
        finally:
            self.reporter.stop()

    @contextlib.contextmanager
    def _kernels(self, stages: Iterable[str]) -> Iterator[None]:
        """Compile kernels of later stages beside the earlier ones, and say it where one waits."""
        background = Background()
        told: set[str] = set()

        def tell(kernel: str) -> None:
            if not told:
                self.reporter.message(
                    "Kernels are compiled for this processor, once: this run takes up to a minute "
                    "longer than the next."
                )
            told.add(kernel)

        try:
            with told_to(tell):
                if self.config.threads > 1:
                    background.start(stages, processes=self.config.threads)
                yield
        finally:
            background.stop()

    def dry_run(self, *, force: bool = False) -> RunSummary:
        """Only say what would be done."""
        return RunSummary(self.request.workspace, self._foreseen(self.plan(), force))

    def _foreseen(self, planned: Iterable[PlannedStage], force: bool) -> list[StageOutcome]:
        found = []
        for stage in planned:
            forced = force and stage.name not in self.chain.implicit
            if stage.state == "cached":
                action, reasons = ("would run", ["--force"]) if forced else ("cached", [])
            else:
                action = "unknown" if stage.state == "pending" else "would run"
                reasons = stage.reasons
            last = stage.result or self.store.current(stage.name)
            figures = {"wall_seconds": last.manifest["wall_seconds"]} if last else {}
            found.append(StageOutcome(stage.name, action, reasons, stage.key, figures=figures))
        return found

    def _check_upstream(self) -> None:
        """Warn where the results taken as they are do not fit together, or the photographs."""
        contents: dict[str, str] = {}
        for name in self.chain.standing:
            result = self.store.current(name)
            if result is None:
                continue
            made_from = result.manifest["key_material"]["inputs"]
            for kind, content in made_from.items():
                if name in self.chain.upstream and contents.get(kind, content) != content:
                    self.reporter.message(
                        f"The result of '{name}' in use was computed from other {kind} than those "
                        f"now in use; it is taken as it is. Run with --from {name} to renew it."
                    )
            contents.update(result.contents)

    def _run_all(self, force: bool) -> RunSummary:
        done: set[str] = set()  # forced stages are forced once, also after a repair
        for _ in range(len(self.chain.names) + 2):
            try:
                return self._run_once(force, done)
            except CorruptResultError as error:
                if error.stage not in self.chain.names:
                    raise RequestError(
                        f"The cached result of '{error.stage}' is damaged ({error}) and was moved "
                        f"aside. Run again with --from {error.stage} to make it anew."
                    ) from None
        raise StageError("Cached results were found damaged again and again; is the disk sound?")

    def _run_once(self, force: bool, done: set[str]) -> RunSummary:
        summary = RunSummary(self.request.workspace)
        providers = Providers(self.chain, self.store)
        named = [name for name in self.chain.names if name not in self.chain.implicit]
        for name in self.chain.names:
            if not done.intersection(named) and name in named[:1]:
                self._check_upstream()  # now that those before have run
            table = providers.of(name)
            planned = plan_stage(name, self.config, self.store, table, self.request.images)
            must = force and name not in done and name not in self.chain.implicit
            outcome, result = self._reuse_or_run(planned, must)
            done.add(name)
            summary.stages.append(outcome)
            providers.enter(name, result.contents, result)
            if "exports" in result.contents:
                summary.results = self.store.link_results(result, "exports")
        return summary

    def _reuse_or_run(self, planned: PlannedStage, force: bool) -> tuple[StageOutcome, Result]:
        name, key = planned.name, planned.key
        assert key is not None, f"{name} was planned before its inputs were there"
        signals.check()
        if planned.result is not None and not force:
            self.store.use(planned.result, planned.reasons)
            return self._cached(planned.result), planned.result
        with self.store.lock(name, self.reporter.message):
            result = self.store.find(name, key)
            if result is not None and not force:  # another process has just made it
                self.store.use(result, planned.reasons)
                return self._cached(result), result
            resumed = self.store.has_checkpoint(name, key)
            reasons = ["--force"] if force and planned.state == "cached" else planned.reasons
            self.reporter.stage_started(name, reasons, resumed)
            previous = result
            result = self._compute(planned, reasons)
            self.store.use(result, reasons)
        figures = _figures(result)
        self.reporter.stage_finished(name, False, figures)
        if previous is not None and previous.contents != result.contents:
            self.reporter.message(
                f"{name}: computing again gave other bytes than before; please report this."
            )
        outcome = StageOutcome(
            name, "resumed" if resumed else "ran", reasons, key, result.folder, figures,
            result.manifest["warnings"],
        )  # fmt: skip
        return outcome, result

    def _cached(self, result: Result) -> StageOutcome:
        figures = _figures(result)
        self.reporter.stage_finished(result.stage, True, figures)
        return StageOutcome(
            result.stage, "cached", [], result.key, result.folder, figures,
            result.manifest["warnings"],
        )  # fmt: skip

    def _compute(self, planned: PlannedStage, reasons: list[str]) -> Result:
        name, key = planned.name, planned.key
        assert key is not None
        stage = get_stage(name)
        try:
            folder = self.store.begin(name, key)
            context = RunContext(planned, self.config, self.store, folder, self.reporter)
            with Measurement() as measurement, self._profiled(name):
                stage.run(context)
            missing = [kind for kind in stage.provides if kind not in context.outputs]
            if missing:
                raise StageError(f"The stage '{name}' ended without writing {', '.join(missing)}.")
            manifest = {
                "key_material": planned.material,
                "config": self.config.sections[name].model_dump(mode="json"),
                "seed": self.config.run.seed,
                "inputs": {
                    kind: {"stage": entry.stage, "content": entry.content}
                    for kind, entry in planned.inputs.items()
                },
                "reasons": reasons,
                "threads": self.config.threads,
                "summary": context.figures,
                "warnings": context.warnings,
                **measurement.figures,
            }
            return self.store.commit(name, key, manifest, context.outputs)
        except CorruptResultError:
            raise
        except Exception as error:
            signals.check()
            raise self._explain_failure(error, name, key) from error

    @contextlib.contextmanager
    def _profiled(self, name: str) -> Iterator[None]:
        """Where the time of a stage goes, if that was asked for."""
        if not self.profile:
            yield
            return
        page = self.request.workspace / profiling.FOLDER / f"{name}.html"
        with profiling.profiled(page):
            yield
        self.reporter.message(f"{name}: where its time went: {page}")

    def _thrift(self) -> list[str]:
        """What the stages of this run know to do where memory runs out."""
        found = usable_stages()
        names = (*self.chain.upstream, *self.chain.names)
        return [found[name].thrift for name in names if name in found and found[name].thrift]

    def _explain_failure(self, error: Exception, name: str, key: str) -> PipelineError:
        """Turn any failure into one paragraph, and leave the store as it was."""
        if is_disk_full(error, self.request.workspace):
            free = shutil.disk_usage(self.request.workspace).free / 2**20
            failure: PipelineError = RequestError(
                f"The disk that holds the workspace {self.request.workspace} is full ({free:.1f} "
                f"MB left); the stage '{name}' could not write its result. Nothing computed before "
                "is lost: make room ('pipeline clean' deletes results that are not in use) and run "
                "the same command again."
            )
        elif isinstance(error, PipelineError):
            failure = error
        elif told := file_in_the_way(error, self.request.workspace):
            failure = told
        elif isinstance(error, MemoryError):
            failure = StageError(
                " ".join([f"The stage '{name}' needs more memory than there is.", *self._thrift()])
            )
        else:
            where = traceback.extract_tb(error.__traceback__)[-1]
            failure = StageError(
                f"The stage '{name}' failed with a fault of ours: {type(error).__name__}: {error} "
                f"({Path(where.filename).name}, line {where.lineno}). What earlier stages computed "
                "is kept. Run again with --debug for the whole trace, and please report it."
            )
        with contextlib.suppress(OSError):  # the first error is the one to tell
            self.store.discard_outputs(name, key)
        if isinstance(failure, ReconstructionError):
            folder = self.store.failures.keep(name, failure.pictures, failure.artifacts)
            if failure.pictures:
                failure.args = (f"{failure} Pictures that show it: {folder}",)
        with contextlib.suppress(OSError):
            self.store.failures.record(name, key, str(failure))
        return failure


def _figures(result: Result) -> dict[str, Any]:
    names = ("wall_seconds", "cpu_seconds", "peak_memory_mb", "summary")
    return {name: result.manifest[name] for name in names}
