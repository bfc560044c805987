"""dentalsplat: a few unposed photographs of teeth in, a 3D scene to look at out.

    import dentalsplat
    summary = dentalsplat.run("photos/", overrides={"fit.iterations": 500})

What the command line does, these functions do too, under the same names. What they need is
imported when they are called, so that ``import dentalsplat`` is quick. Behind them are the
packages `pipeline` (the engine) and `stages` (the algorithms).
"""

from __future__ import annotations

import importlib
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

if TYPE_CHECKING:
    from pipeline.errors import PipelineError, ReconstructionError, RequestError, StageError
    from pipeline.front.settings import Setting
    from pipeline.process.privacy import Share
    from pipeline.running.outcomes import RunSummary
    from pipeline.running.reporter import Reporter
    from pipeline.stage import Finding
    from pipeline.workspace import StageStatus

__version__ = "0.1.0"

__all__ = [
    "PipelineError",
    "ReconstructionError",
    "RequestError",
    "StageError",
    "batch",
    "benchmark",
    "clean",
    "compare",
    "doctor",
    "report",
    "run",
    "settings",
    "stages",
    "status",
]

#: Of the package `pipeline`: what to catch, each with its `exit_status`.
_ERRORS = ("PipelineError", "ReconstructionError", "RequestError", "StageError")

Settings = Iterable[str] | Mapping[str, Any]


def run(
    images: Sequence[str | Path] | str | Path = (),
    *,
    workspace: str | Path | None = None,
    preset: str | Path | None = None,
    overrides: Settings = (),
    stages: Sequence[str] | None = None,
    from_stage: str | None = None,
    force: bool = False,
    dry_run: bool = False,
    verify: bool = False,
    share: Share | None = None,
    profile: bool = False,
    reporter: Reporter | None = None,
) -> RunSummary:
    """Make a scene of photographs; every stage's result is kept and used again while it is valid.

    Args:
        images: a folder, files, a glob pattern or one video; empty to go on with the photographs
            that the workspace remembers.
        workspace: where results are kept; default ``./runs/<name of the input>``.
        preset: name or YAML file of a preset.
        overrides: ``{"sap.quantile": 0.99}`` or ``["sap.quantile=0.99"]``; see `settings`.
        stages: names of the stages to run, in order; default all of the preset.
        from_stage: begin here, with what the workspace holds from before.
        force: compute the stages anew although a valid result exists.
        dry_run: only say what would be done.
        verify: read every byte of the results, and not only of those that seem to have changed.
        share: who else may read the workspace: ``nobody`` or the owner's ``group``; None: as its
            folder is already. Until the run ends, all that this process writes is kept from others.
        profile: write ``profile/STAGE.html`` into the workspace for each stage that runs: where its
            time went. Needs the extra ``profile``.
        reporter: hears of the progress.

    Returns:
        What each stage did, and the folder of the results (`results`).

    Raises:
        RequestError: the request is wrong. ReconstructionError: the photographs can't be put
        together; the message says why and what to do. StageError: a fault of ours.
    """
    return _engine().run(
        images, workspace=workspace, preset=preset, overrides=overrides, stages=stages,
        from_stage=from_stage, force=force, dry_run=dry_run, verify=verify, share=share,
        profile=profile,
        reporter=reporter,
    )  # fmt: skip


def status(
    images: Sequence[str | Path] | str | Path = (),
    *,
    workspace: str | Path | None = None,
    preset: str | Path | None = None,
    overrides: Settings = (),
    stages: Sequence[str] | None = None,
    verify: bool = False,
) -> list[StageStatus]:
    """Tell each stage of a workspace: cached, stale (and why), missing or failed.

    Given a preset, overrides or stages, it tells what a run with them would find. `verify` reads
    every byte of the results again.

    Raises:
        RequestError: there is no such workspace, or the request is wrong.
    """
    return _engine().status(
        images, workspace=workspace, preset=preset, overrides=overrides, stages=stages,
        verify=verify,
    )  # fmt: skip


def stages() -> list[dict[str, Any]]:
    """List the registered stages: what each requires and provides, its methods and settings."""
    return _engine().stages()


def settings(stage: str | None = None) -> list[Setting]:
    """List every setting, or those of one stage: its type and range, default and meaning.

    Raises:
        RequestError: there is no such stage.
    """
    return _engine().settings(stage)


def report(workspace: str | Path) -> Path:
    """Write ``WORKSPACE/report.html`` again; returns the file.

    Raises:
        RequestError: the folder is not a workspace, or can't be written to.
    """
    return _engine().run_report(workspace)


def compare(
    workspace: str | Path,
    *,
    colmap: str | Path | None = None,
    run_colmap: bool = False,
    ground_truth: str | Path | None = None,
    mesh: str | Path | None = None,
    fit: bool = True,
    threads: int = 0,
    reporter: Reporter | None = None,
) -> Any:
    """Set a workspace's cameras, points and fit beside COLMAP's on the same views.

    Args:
        workspace: of a run; its results in use are compared as they are.
        colmap: folder of a COLMAP model of the same photographs.
        run_colmap: run COLMAP here, with its defaults and with a setting for few views.
        ground_truth: transforms.json or COLMAP model with the true cameras.
        mesh: true surface in the frame of `ground_truth`.
        fit: also fit from COLMAP's cameras and points.
        threads: 0 means all cores.
        reporter: hears of the progress.

    Returns:
        `figures`, and the `folder` that they were written to.

    Raises:
        RequestError: no such workspace or files, or nothing to compare with.
    """
    return _engine().compare(
        workspace, colmap=colmap, run_colmap=run_colmap, ground_truth=ground_truth, mesh=mesh,
        fit=fit, threads=threads, reporter=reporter,
    )  # fmt: skip


def benchmark(
    suite: str | Path,
    *,
    out: str | Path | None = None,
    data: str | Path | None = None,
    jobs: int = 1,
    overrides: Settings = (),
    share: Share | None = None,
    say: Callable[[str], None] | None = None,
    verbose: bool = False,
) -> dict[str, Any]:
    """Run scenes x methods x view counts, and write tables of them.

    Args:
        suite: name of a suite that comes with dentalsplat, or a YAML file.
        out: folder for workspaces and results; default ``./runs/benchmark_<suite>``.
        data: folder where the scenes' paths begin, instead of the one that the suite names.
        jobs: workspaces at a time; the cores are divided between them.
        overrides: settings for all cells.
        share: who else may read the folder; see `run`.
        say: hears a line per cell. None: nothing is said, of what goes on in the cells neither.
        verbose: the cells' processes say each step, keys and memory on standard error.

    Returns:
        What ``results.json`` holds.

    Raises:
        RequestError: the suite is wrong, its data are missing, or `out` can't be used.
    """
    return _engine().benchmark(
        suite, out=out, data=data, jobs=jobs, overrides=overrides, share=share, say=say,
        verbose=verbose,
    )  # fmt: skip


def batch(
    cases: str | Path,
    *,
    out: str | Path | None = None,
    jobs: int = 1,
    scheduler: str | None = None,
    preset: str | Path | None = None,
    overrides: Settings = (),
    stages: Sequence[str] | None = None,
    retry: Sequence[str] = (),
    keep: Literal["workspace", "results"] = "workspace",
    memory: float | None = None,
    minutes: float | None = None,
    share: Share | None = None,
) -> dict[str, Any]:
    """Run many cases, each in a process of its own; finished ones are not run again.

    Args:
        cases: a folder with a folder of photographs (or a film) for each case, or a CSV file.
        out: folder for workspaces and summary; default ``./runs/batch_<name of the cases>``.
        jobs: cases at a time on this machine; the cores are divided between them.
        scheduler: address or file of a Dask scheduler, to run on its workers instead.
        preset, overrides, stages: as for `run`, for all cases.
        retry: ``failed``, or names of cases: run these again though they came to an end.
        keep: ``results``: of a case that went well only these are kept, at most 8 to 12 MB.
        memory: gigabytes that one case may take; None: an equal share; 0: no limit.
        minutes: that one case may take; None: as many as it needs.
        share: who else may read the folder; see `run`.

    Returns:
        ``{"folder", "cases": [record, ...], "counts": {state: number}, "seconds"}``.

    Raises:
        RequestError: the request is wrong, another batch works in the folder, the disk is full, or
            the scheduler is gone.
    """
    return _engine().batch(
        cases, out=out, jobs=jobs, scheduler=scheduler, preset=preset, overrides=overrides,
        stages=stages, retry=retry, keep=keep, memory=memory, minutes=minutes, share=share,
    )  # fmt: skip


def clean(
    workspace: str | Path, *, keep: int = 0, everything: bool = False
) -> tuple[list[str], int]:
    """Delete the results that are not in use, but for the `keep` newest of each stage.

    What a stopped run can go on from stays, unless it is of no use to the last request, or
    `everything` is asked for.

    Returns:
        What was deleted (``stage/key``), and the bytes freed.

    Raises:
        RequestError: there is no such workspace.
    """
    return _engine().clean(workspace, keep=keep, everything=everything)


def doctor() -> list[Finding]:
    """Check libraries, processor, GPU, disk and installation; nothing is changed."""
    return _engine().doctor()


def _engine() -> Any:
    from dentalsplat.names import check_names

    check_names()
    return importlib.import_module("pipeline")


def __getattr__(name: str) -> Any:
    if name in _ERRORS:
        return getattr(_engine(), name)
    raise AttributeError(f"module 'dentalsplat' has no attribute '{name}'")


def __dir__() -> list[str]:
    return sorted([*__all__, "__version__"])
