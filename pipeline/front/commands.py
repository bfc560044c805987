"""What the command line and `import pipeline` call: a run with its report, the stages there are."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from pipeline.config import Config, load_config
from pipeline.errors import (
    PICTURES,
    PipelineError,
    ReconstructionError,
    RequestError,
    StageError,
)
from pipeline.front.log import Log
from pipeline.front.pages import DrawnBeside, write_pages
from pipeline.pages.page import REPORT
from pipeline.process.privacy import Share, kept_for, share_for
from pipeline.runner import Runner
from pipeline.running.outcomes import RunSummary
from pipeline.running.reporter import Reporter
from pipeline.stage import get_stage, stage_names
from pipeline.untrusted.names import printable
from pipeline.workspace import Request, config_of, make_request, read_request, still_there


def run(
    images: Sequence[str | Path] | str | Path = (),
    *,
    workspace: str | Path | None = None,
    preset: str | Path | None = None,
    overrides: Iterable[str] | Mapping[str, Any] = (),
    stages: Sequence[str] | None = None,
    from_stage: str | None = None,
    force: bool = False,
    dry_run: bool = False,
    verify: bool = False,
    share: Share | None = None,
    profile: bool = False,
    reporter: Reporter | None = None,
) -> RunSummary:
    """Run the pipeline on photographs, reusing every result that is still valid.

    ``WORKSPACE/logs`` keeps a log of each of the last runs.

    Args:
        images: a folder, files, a glob pattern or one video; empty to go on with those that the
            workspace remembers, with the settings of its last run unless a preset is named.
        workspace: where results are kept; default ``./runs/<name of the input>``.
        preset: name or YAML file of a preset.
        overrides: ``{"sap.quantile": 0.99}``, ``["sap.quantile=0.99"]`` or ``"sap.quantile=0.99"``;
            see `settings`.
        stages: names of the stages to run, in order, or ``"init,sap"``; default all of the preset.
        from_stage: begin here, with what the workspace holds from before.
        force: compute the stages anew although a valid result exists.
        dry_run: only say what would be done.
        verify: read every byte of the results, and not only of those that seem to have changed.
        share: who may read the workspace: ``nobody`` else, or the owner's ``group``; None: as it is
            said of the workspace already. Until the run ends, all that this process writes is kept
            from others (`pipeline.process.privacy`).
        profile: write ``profile/STAGE.html`` into the workspace for each stage that runs: where its
            time went. Needs the extra ``profile``.
        reporter: hears of the progress.

    Returns:
        What each stage did, and the folder of the results (`results`).

    Raises:
        RequestError: the request is wrong. ReconstructionError: the photographs can't be put
        together; the message says why and what to do. StageError: a fault of ours.
    """
    request = make_request(
        images, workspace, preset, overrides, stages, from_stage, as_before=True
    )  # fmt: skip
    config = config_of(request)
    reporter = reporter or Reporter()
    if request.taken_over:
        reporter.message(
            f"As in the last run of this workspace: {request.typed_before} "
            "(-c dentalsplat starts from the defaults instead)."
        )
    if request.left_out:
        reporter.message(
            f"Left out, since the stage is not installed here: {' '.join(request.left_out)}."
        )
    if workspace is None and (others := _others_before(request)):
        reporter.message(
            f"{request.workspace} is also where other photographs go that are called so, those in "
            f"{others}; it shows what was run last. To keep both, give each a folder: -w."
        )
    log = None if dry_run else Log(request, reporter)
    reporter = log or reporter
    runner = Runner(request, config, reporter, verify=verify, profile=profile)
    if dry_run:
        return runner.dry_run(force=force)
    with kept_for(share_for(request.workspace, share)):
        return _logged(log, lambda: _run(runner, request.workspace, config, reporter, force))


def _others_before(request: Request) -> str:
    """The folder of the photographs that a workspace was last run on, if that is another one and
    they are still there; else nothing."""
    if not request.images_named:
        return ""
    try:
        before = read_request(request.workspace)["images"]
    except RequestError:  # it is none yet, or it is told later
        return ""
    earlier, now = ({_folder_of(path) for path in paths} for paths in (before, request.images))
    if not earlier.isdisjoint(now) or not any(map(still_there, before)):
        return ""
    return printable(str(min(earlier)))


def _folder_of(path: str) -> Path:
    """Of a photograph, or a pattern that may name folders."""
    real = Path(os.path.realpath(path))  # a link in a circle is told later
    folders = (folder for folder in (real, *real.parents) if os.path.isdir(folder))  # noqa: PTH112
    return next(folders)


def _logged(log: Log | None, work: Callable[[], RunSummary]) -> RunSummary:
    """Do it, and write into the log how it ends."""
    if log is None:
        return work()
    try:
        summary = work()
    except BaseException as error:
        log.failed(error)
        raise
    log.done()
    return summary


def _run(
    runner: Runner, workspace: Path, config: Config, reporter: Reporter, force: bool
) -> RunSummary:
    with DrawnBeside(workspace, config, runner.chain.names) as drawing:
        try:
            summary = runner.run(force=force, computing=drawing.stage_started)
        except (ReconstructionError, StageError) as error:
            report, check = write_pages(workspace, config, reporter, drawing)
            if report is not None:
                reporter.message(f"What came of it so far: {report}")
            if check and isinstance(error, ReconstructionError) and error.artifacts:
                why, shown, pictures = str(error).partition(PICTURES)
                way = f"To put it right, open {check} in a browser."
                error.args = (f"{why} {way}{shown}{pictures}",)
            raise
        except RequestError as error:
            if error.stage and (workspace / REPORT).is_file():  # it shows an earlier run
                write_pages(workspace, config, reporter, drawing)
            raise
        summary.report, summary.check = write_pages(workspace, config, reporter, drawing)
    return summary


def stages() -> list[dict[str, Any]]:
    """The registered stages: what each requires and provides, its methods and its settings."""
    order = list(load_config().run.stages)
    names = sorted(stage_names(), key=lambda n: (order.index(n) if n in order else len(order), n))
    found: list[dict[str, Any]] = []
    for name in names:
        try:
            stage = get_stage(name)
        except PipelineError as error:
            found.append({"name": name, "error": str(error)})
            continue
        found.append(
            {
                "name": name,
                "summary": stage.summary,
                "version": stage.version,
                "requires": list(stage.requires),
                "optional": list(stage.optional),
                "provides": list(stage.provides),
                "may_provide": list(stage.may_provide),
                "methods": dict(stage.methods),
                "settings": stage.Config.model_json_schema(),
            }
        )
    return found
