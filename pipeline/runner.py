"""Plan -> reuse or run -> record: the one place where stages meet the store."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterable, Iterator

from pipeline import profiling
from pipeline.config import Config
from pipeline.errors import PICTURES, PipelineError, ReconstructionError, RequestError, StageError
from pipeline.kernels.news import told_to
from pipeline.kernels.rehearsals import Background
from pipeline.measure import Measurement
from pipeline.planning import (
    PlannedStage,
    Providers,
    changed_sources,
    plan_chain,
    plan_stage,
    resolve_chain,
)
from pipeline.process import signals
from pipeline.process.native import one_blas_thread, return_free_memory
from pipeline.running.context import RunContext
from pipeline.running.failing import explained
from pipeline.running.outcomes import RunSummary, StageOutcome, figures_of
from pipeline.running.reporter import Reporter
from pipeline.stage import get_stage, usable_stages
from pipeline.store import CorruptResultError, Result, Store
from pipeline.workspace import Request


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
        self._computing: Callable[[str], None] = lambda stage: None
        self.chain = resolve_chain(
            config, request.stages, request.from_stage, request.images_named, self.store,
            request.asked,
        )  # fmt: skip

    def plan(self) -> list[PlannedStage]:
        """Look at every stage without running any."""
        return plan_chain(self.chain, self.config, self.store, self.request.images)

    def run(
        self, *, force: bool = False, computing: Callable[[str], None] | None = None
    ) -> RunSummary:
        """Run the chain, reusing what is still valid.

        Args:
            computing: called with the name of each stage that begins to compute.

        Raises:
            RequestError: the request is wrong; nothing was written, or the disk is full.
            ReconstructionError: the data can't be reconstructed. StageError: a fault of ours.
        """
        planned = self.plan()  # a wrong request is refused before anything is written
        self.store.create(self.chain.names)
        self.request.save()
        self.reporter.start(list(self.chain.names))
        self._computing = computing or self._computing
        try:
            self.reporter.foreseen(self._foreseen(planned, force))
            for stage in planned:
                for note in stage.notes:
                    self.reporter.message(f"{stage.name}: {note}")
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
                    "Kernels are compiled for this processor, once: that takes up to two minutes, "
                    "which later runs save."
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
                reasons = [*stage.reasons, *(["goes on from its checkpoint"] * stage.resumable)]
            last = stage.result or self.store.current(stage.name)
            figures = {"wall_seconds": last.manifest["wall_seconds"]} if last else {}
            found.append(
                StageOutcome(
                    stage.name, action, reasons, stage.key, figures=figures, warnings=stage.notes
                )
            )
        return found

    def _check_upstream(self) -> None:
        """Warn where results taken as they are do not fit together, or what was asked for."""
        contents: dict[str, str] = {}
        for name in self.chain.upstream:
            given = any(setting.startswith(f"{name}.") for setting in self.request.asked)
            if given and self.store.current(name) is not None:
                self.reporter.message(
                    f"The settings given for '{name}' change nothing in this run: its result in "
                    f"use is taken as it is. Run with --from {name} to have it made with them."
                )
            if changed := changed_sources(name, self.config, self.store, self.request.images):
                self.reporter.message(
                    f"Since '{name}' read the photographs: {'; '.join(changed)}. What it read then "
                    f"is used. Name them, or run with --from {name}, to have them read again."
                )
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
            self._computing(name)
            previous = result
            result = self._compute(planned, reasons)
            self.store.use(result, reasons)
        figures = figures_of(result)
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
        figures = figures_of(result)
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
            with Measurement() as measurement, self._profiled(name), one_blas_thread():
                stage.run(context)
            return_free_memory()
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
        except (Exception, SystemExit) as error:  # a library's own command may exit
            signals.check()
            raise self._fail(error, name, key) from error

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

    def _fail(self, error: BaseException, name: str, key: str) -> PipelineError:
        """The failure as it is told; the store is left as it was, but for a record of it."""
        failure = explained(error, name, self.request.workspace, self._thrift())
        failure.stage = name
        with contextlib.suppress(OSError):  # the first error is the one to tell
            self.store.discard_outputs(name, key)
        if isinstance(failure, ReconstructionError):
            with contextlib.suppress(OSError):
                folder = self.store.failures.keep(name, failure.pictures, failure.artifacts)
                if failure.pictures:
                    failure.args = (f"{failure}{PICTURES}{folder}",)
        with contextlib.suppress(OSError):
            self.store.failures.record(name, key, str(failure))
        return failure
