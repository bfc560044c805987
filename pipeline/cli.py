"""The command line: ``pipeline run photos/`` and what goes with it."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import os
import sys
from pathlib import Path
from typing import Annotated, NoReturn

import typer

from pipeline.errors import PipelineError, RequestError
from pipeline.front import completion
from pipeline.front.options import (
    AsJson,
    Images,
    OldWorkspace,
    Overrides,
    Preset,
    Quiet,
    Sharing,
    Stages,
    Verbose,
    Verify,
    Workspace,
    answer,
    only_the_answer,
    only_workspace,
    sharing,
)
from pipeline.front.study_commands import register_studies
from pipeline.process import signals
from pipeline.process.privacy import private_from_now_on
from pipeline.untrusted.names import let_streams_show_all

EXAMPLES = """\
dentalsplat turns a few photographs of teeth into a 3D scene that you can turn around and look at.

  pipeline run photos/                      a folder of photographs (3 are enough), the whole job
  pipeline run film.mp4 --frames 12         a short video, 12 frames of it
  pipeline run photos/ -w cases/anna        keep everything of this case in a folder of your choice
  pipeline run photos/ --set views.long_side=768 --set fit.iterations=2000
  pipeline run photos/ --stages init,sap,fit        only some stages
  pipeline run -w cases/anna --from fit             again from a stage on

  pipeline status -w cases/anna             what is cached, what is stale and why
  pipeline report -w cases/anna             one page about all of it (a run writes it as well)
  pipeline stages                           the stages and their methods
  pipeline settings fit                     what can be set in a stage, and what it means
  pipeline compare -w cases/anna --run-colmap       beside COLMAP on the same photographs
  pipeline register cases/may cases/june    two visits of one patient: which teeth moved
  pipeline benchmark smoke                  methods side by side, in the paper's tables
  pipeline batch cases/ --jobs 2            many cases, a folder each, and a table of them
  pipeline dicom -w cases/anna              pictures and mesh as DICOM files
  pipeline doctor                           is everything installed?
  pipeline warmup                           compile the kernels ahead (for an image)
  pipeline clean -w cases/anna              delete results that are not in use

When a run ends, open WORKSPACE/results/viewer.html in a browser. 'pipeline run --help' says more.
"""

app = typer.Typer(
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
    help="A 3D scene from photographs of teeth; no GPU, no downloads, no network.",
)


@app.callback(invoke_without_command=True)
def root(
    context: typer.Context,
    debug: Annotated[
        bool,
        typer.Option(
            "--debug", help="Show the whole trace of an error. May also stand after any command."
        ),
    ] = False,
    version: Annotated[bool, typer.Option("--version", help="Print the version.")] = False,
) -> None:
    if version:
        from importlib.metadata import version as version_of

        print(version_of("dentalsplat"))
    elif context.invoked_subcommand is None:
        print(EXAMPLES, end="")


@app.command("run")
def run_command(
    images: Images = None,
    workspace: Workspace = None,
    config: Preset = None,
    stages: Stages = None,
    overrides: Overrides = None,
    frames: Annotated[
        int | None,
        typer.Option(
            "--frames", metavar="N", help="Use so many, spread out; default: all, 24 of a video."
        ),
    ] = None,
    from_stage: Annotated[
        str | None,
        typer.Option(
            "--from",
            metavar="STAGE",
            autocompletion=completion.stage,
            help="Begin at this stage; take the rest as it is.",
        ),
    ] = None,
    force: Annotated[bool, typer.Option("--force", help="Compute anew what is cached.")] = False,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Only say what would run.")] = False,
    verify: Verify = False,
    share: Sharing = None,
    profile: Annotated[
        bool, typer.Option("--profile", help="Write WORKSPACE/profile/STAGE.html: where time goes.")
    ] = False,
    as_json: AsJson = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """Reconstruct a scene from photographs; every stage's result is cached."""
    from pipeline.front.commands import run
    from pipeline.front.progress import make_reporter
    from pipeline.front.summary import print_dry_run, print_summary

    changes = list(overrides or [])
    if frames is not None:
        changes.append(f"views.frames={frames}")
    with only_the_answer(as_json):
        summary = run(
            images or [],
            workspace=workspace,
            preset=config,
            overrides=changes,
            stages=stages,
            from_stage=from_stage,
            force=force,
            dry_run=dry_run,
            verify=verify,
            share=sharing(share),
            profile=profile,
            reporter=make_reporter(quiet=quiet or dry_run, verbose=verbose),
        )
    show = print_dry_run if dry_run else print_summary
    answer(
        summary.to_dict, lambda: show(summary), as_json=as_json, quiet=quiet and not dry_run
    )  # fmt: skip


@app.command("status")
def status_command(
    images: Images = None,
    workspace: OldWorkspace = None,
    config: Preset = None,
    stages: Stages = None,
    overrides: Overrides = None,
    verify: Verify = False,
    as_json: AsJson = False,
) -> None:
    """Show each stage: cached, stale (and which field or input changed), missing or failed."""
    from pipeline.front.summary import print_status
    from pipeline.workspace import status

    found = status(
        images or [],
        workspace=workspace if workspace or images else only_workspace(),
        preset=config,
        overrides=overrides or [],
        stages=stages,
        verify=verify,
    )
    if as_json:
        print(json.dumps([dataclasses.asdict(entry) for entry in found], indent=1))
    else:
        print_status(found)


@app.command("report")
def report_command(
    workspace: OldWorkspace = None,
    anonymous: Annotated[
        bool,
        typer.Option(
            "--anonymous",
            help="Write report_anonymous.html, without names and dates, to be passed on.",
        ),
    ] = False,
) -> None:
    """Write WORKSPACE/report.html: what came out, how sure it is, and everything behind it."""
    from pipeline.studies.report import run_report

    print(run_report(workspace or only_workspace(), anonymous=anonymous))


@app.command("stages")
def stages_command(as_json: AsJson = False) -> None:
    """List the registered stages and methods, with what they require and provide."""
    from pipeline.front.commands import stages
    from pipeline.front.summary import print_stages

    found = stages()
    if as_json:
        print(json.dumps(found, indent=1))
    else:
        print_stages(found)


@app.command("settings")
def settings_command(
    stage: Annotated[
        str | None,
        typer.Argument(
            metavar="STAGE|SETTING",
            autocompletion=completion.stage,
            help="Only those of this stage, as fit, or this one, as fit.iterations.",
        ),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """List every setting: what it may be, its default and its meaning."""
    from pipeline.front.settings import settings
    from pipeline.front.summary import print_settings

    found = settings(stage)
    if as_json:
        print(json.dumps([dataclasses.asdict(entry) for entry in found], indent=1))
    else:
        print_settings(found)


@app.command("doctor")
def doctor_command(as_json: AsJson = False) -> None:
    """Check the installation and say how to mend what is wrong."""
    from pipeline.front.checkup import doctor
    from pipeline.front.summary import print_findings

    found = doctor()
    if as_json:
        print(json.dumps([dataclasses.asdict(entry) for entry in found], indent=1))
    else:
        print_findings(found)
    if any(entry.level == "problem" for entry in found):
        raise typer.Exit(1)


@app.command("warmup")
def warmup_command() -> None:
    """Compile the kernels of the usual settings ahead, as for an image; a run does it by itself.

    They are kept beside the program where that can be written, so that all users have them.
    """
    from pipeline.config import load_config
    from pipeline.kernels import folder
    from pipeline.kernels.rehearsals import Background
    from pipeline.measure import usable_cores
    from pipeline.stage import usable_stages

    # in the order of a run: the longest come before those that have to wait for their kernels
    stages = dict.fromkeys([*load_config().run.stages, *usable_stages()])
    background = Background()
    try:
        background.start(stages, processes=usable_cores())
        well = background.wait()
    finally:
        background.stop()
    print(f"Compiled kernels: {folder.writable()}")
    if not well:
        raise typer.Exit(1)


register_studies(app)


@app.command("clean")
def clean_command(
    workspace: OldWorkspace = None,
    keep: Annotated[
        int, typer.Option("--keep", min=0, help="Keep this many unused results of each stage.")
    ] = 0,
    everything: Annotated[
        bool, typer.Option("--all", help="Also delete what a stopped run would go on from.")
    ] = False,
    as_json: AsJson = False,
) -> None:
    """Delete results that are not in use; what a stopped run can go on from is kept."""
    from pipeline.store.cleaning import checkpoints
    from pipeline.workspace import clean

    folder = workspace or only_workspace()
    removed, freed = clean(folder, keep=keep, everything=everything)
    kept = checkpoints(folder)
    if as_json:
        print(json.dumps({"removed": removed, "bytes": freed, "checkpoints": kept}, indent=1))
    else:
        deletes = "another process is working there" if everything else "--all deletes it"
        for name, size in kept.items():
            print(f"kept {name}, {size / 2**20:.1f} MB: a run goes on from it ({deletes})")
        for name in removed:
            print(f"deleted {name}")
        print(f"{len(removed)} results deleted, {freed / 2**20:.1f} MB freed")


def program() -> int:
    """The program itself: what it writes, photographs of patients, is its user's alone."""
    private_from_now_on()
    return command_line()


def main() -> NoReturn:
    """Run the command line in this process and exit; its signals and file mask stay as they are."""
    status = command_line()
    if status == signals.STATUS:
        print(signals.TEXT, file=sys.stderr)
    sys.exit(status)


def command_line() -> int:
    """Run the command line; every outcome has its exit status (docs/first_case.md)."""
    let_streams_show_all()
    completion.suit_shell()
    words = [word for word in sys.argv[1:] if word != "--debug"]
    debug = len(words) < len(sys.argv) - 1
    try:
        status = app(words, standalone_mode=False)
        sys.stdout.flush()  # an answer that finds no room is said now, not as the interpreter ends
    except PipelineError as error:
        status = signals.STATUS if signals.asked() else _fail(error, error.exit_status, debug)
    except (KeyboardInterrupt, typer.Abort):
        status = signals.STATUS
    except SystemExit as error:  # typer turns an interrupt into one of these
        status = error.code if isinstance(error.code, int) else int(bool(error.code))
    except BrokenPipeError:
        _let_go_of_answer()
        status = 0
    except Exception as error:
        status = signals.STATUS if signals.asked() else _unexpected(error, debug)
    try:
        sys.stdout.flush()
    except OSError:
        _let_go_of_answer()
    return status if isinstance(status, int) else 0


def _let_go_of_answer() -> None:
    """What could not be written is not tried again at the end (which has a status of its own)."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _fail(error: BaseException, status: int, debug: bool) -> int:
    if debug:
        import traceback

        traceback.print_exception(error)
    print(f"\n{error}", file=sys.stderr)
    if "--json" in sys.argv:
        with contextlib.suppress(OSError):  # it may be what could not be written to
            print(json.dumps({"error": str(error), "exit_status": status}))
    return status


def _unexpected(error: Exception, debug: bool) -> int:
    if hasattr(error, "format_message") and hasattr(error, "exit_code"):  # click's usage errors
        text = error.format_message()
        if text.startswith("No such command"):
            names = ", ".join(str(command.name) for command in app.registered_commands)
            text += f" The commands are {names}. To make a scene: pipeline run PHOTOGRAPHS"
        return _fail(RequestError(text), 2, debug)
    from pipeline.store import file_in_the_way, is_disk_full

    try:
        here = Path.cwd()
    except OSError:
        gone = 'The folder that this was called in is not there any more. Enter it anew: cd "$PWD"'
        return _fail(RequestError(gone), 2, debug)
    if is_disk_full(error, here):
        return _fail(
            RequestError("The disk is full. Make room and run the same command again."), 2, debug
        )
    if told := file_in_the_way(error):
        return _fail(told, 2, debug)
    text = f"A fault of ours: {type(error).__name__}: {error}. Run again with --debug to see where."
    if debug:
        raise error
    return _fail(PipelineError(text), 1, debug)


if __name__ == "__main__":
    signals.run(program)
