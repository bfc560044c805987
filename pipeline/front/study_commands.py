"""The commands that do something with whole runs: compare, benchmark, batch, dicom, register."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Annotated

import typer

from pipeline.front.options import (
    AsJson,
    OldWorkspace,
    Overrides,
    Preset,
    Quiet,
    Sharing,
    Stages,
    Verbose,
    answer,
    one_of,
    only_the_answer,
    only_workspace,
    out_option,
    path,
    sharing,
)


def compare_command(
    workspace: OldWorkspace = None,
    colmap: Annotated[
        Path | None,
        typer.Option(
            "--colmap",
            metavar="FOLDER",
            parser=path,
            help="Folder of a COLMAP model of the same photographs.",
        ),
    ] = None,
    run_colmap: Annotated[
        bool, typer.Option("--run-colmap", help="Run COLMAP here, with two settings.")
    ] = False,
    ground_truth: Annotated[
        Path | None,
        typer.Option(
            "--ground-truth",
            metavar="FILE|FOLDER",
            parser=path,
            help="True cameras: transforms.json or a COLMAP model; default: what the run was "
            "evaluated with.",
        ),
    ] = None,
    mesh: Annotated[
        Path | None,
        typer.Option(
            "--mesh",
            metavar="FILE",
            parser=path,
            help="True surface, in the frame of --ground-truth; default: evaluate.mesh.",
        ),
    ] = None,
    fit: Annotated[
        bool, typer.Option("--fit/--no-fit", help="Also fit from COLMAP's cameras and points.")
    ] = True,
    threads: Annotated[int, typer.Option("--threads", min=0, help="0: all cores.")] = 0,
    as_json: AsJson = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """Set the cameras, points and fit of a run beside COLMAP's on the same views.

    To run the pipeline itself on COLMAP's results: --set init.cameras=MODEL takes its cameras from
    the start (init.points=model: its points too), and --stages views,init,align,swap,sap,flow,fit
    --set swap.cameras=MODEL puts them in place of ours after any stage; fit.optimize_poses=false
    keeps them. Results: WORKSPACE/compare/comparison.json, comparison.md and report.html.
    """
    from pipeline.front.progress import make_reporter
    from pipeline.studies.compare.compare import compare
    from pipeline.studies.compare.tables import print_tables, tables_of

    with only_the_answer(as_json):
        found = compare(
            workspace or only_workspace(), colmap=colmap, run_colmap=run_colmap,
            ground_truth=ground_truth, mesh=mesh, fit=fit, threads=threads,
            reporter=make_reporter(quiet=quiet, verbose=verbose),
        )  # fmt: skip

    def show() -> None:
        print_tables(tables_of(found.figures))
        print(f"\nResults: {found.folder}/")

    answer(lambda: found.figures, show, as_json=as_json, quiet=quiet)


def benchmark_command(
    suite: Annotated[str, typer.Argument(metavar="SUITE", help="A suite's name, or a YAML file.")],
    out: Annotated[Path | None, out_option("./runs/benchmark_SUITE")] = None,
    data: Annotated[
        Path | None,
        typer.Option(
            "--data",
            metavar="FOLDER",
            parser=path,
            help="Where the suite's data are, if not where it says.",
        ),
    ] = None,
    jobs: Annotated[
        int, typer.Option("--jobs", min=1, help="Workspaces at a time; they share the cores.")
    ] = 1,
    overrides: Overrides = None,
    share: Sharing = None,
    as_json: AsJson = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """Compare methods on scenes and numbers of views, and write the paper's tables of them.

    For example: pipeline benchmark smoke -o runs/smoke; or, with the data of a suite elsewhere:
    pipeline benchmark configs/suites/paper.yaml --data DATA --jobs 2. Finished cells are not run
    again. Results: tables.md, tables.csv, results.json and report.html.
    """
    from pipeline.front.progress import LineReporter
    from pipeline.studies.benchmark.running import benchmark
    from pipeline.studies.benchmark.writing import markdown

    results = benchmark(
        suite, out=out, data=data, jobs=jobs, overrides=overrides or [],
        share=sharing(share), say=None if quiet else LineReporter().message, verbose=verbose,
    )  # fmt: skip
    answer(
        lambda: results, lambda: print(markdown(results), end=""), as_json=as_json, quiet=quiet
    )  # fmt: skip
    if results["problems"]:
        print("\n" + "\n".join(results["problems"]), file=sys.stderr)
        faults = any(cell["status"] == "fault" for cell in results["cells"])
        raise typer.Exit(1 if faults else 2)


def batch_command(
    cases: Annotated[
        Path,
        typer.Argument(
            metavar="CASES",
            parser=path,
            help="A folder that holds a folder of photographs (or one film) for each case, or a "
            "CSV file with the columns name, photographs, settings.",
        ),
    ],
    out: Annotated[Path | None, out_option("./runs/batch_CASES")] = None,
    jobs: Annotated[
        int, typer.Option("--jobs", min=1, help="Cases at a time here; they share the cores.")
    ] = 1,
    scheduler: Annotated[
        str | None,
        typer.Option(
            "--scheduler",
            metavar="tcp://HOST:PORT|FILE",
            help="Run on the workers of this Dask scheduler.  [default: on this machine]",
        ),
    ] = None,
    config: Preset = None,
    stages: Stages = None,
    overrides: Overrides = None,
    retry: Annotated[
        list[str] | None,
        typer.Option("--retry", help="'failed', or a case's name: run it again. May be repeated."),
    ] = None,
    keep: Annotated[
        str,
        typer.Option(
            "--keep",
            metavar="[workspace|results]",
            help="What stays of a case that went well: all, or its results (at most 8 to 12 MB).",
        ),
    ] = "workspace",
    memory: Annotated[
        float | None,
        typer.Option(
            "--memory",
            min=0,
            help="GB that one case may take; 0: no limit.  [default: an equal share]",
        ),
    ] = None,
    minutes: Annotated[
        float | None, typer.Option("--minutes", min=0.01, help="Time that one case may take.")
    ] = None,
    share: Sharing = None,
    as_json: AsJson = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """Run many cases, each in a process of its own, and keep a table of what came of them.

    For example: pipeline batch cases/ -o runs/clinic --jobs 2. Killed, interrupted, disk full? The
    same command goes on; finished cases are not run again. FOLDER/summary.html and summary.csv say
    at every moment how all stand. Exit status: 0 all cases are done; 3 some could not be
    reconstructed or used; 1 some were killed, or failed by a fault of ours; 2 the request is wrong.
    """
    from pipeline.studies.batch.progress import by_state, make_progress
    from pipeline.studies.batch.running import KEEPS, batch, exit_status

    results = batch(
        cases, out=out, jobs=jobs, scheduler=scheduler, preset=config, overrides=overrides or [],
        stages=stages, retry=retry or [], keep=one_of("--keep", keep, KEEPS),
        memory=memory, minutes=minutes, share=sharing(share),
        progress=make_progress(quiet=quiet, verbose=verbose),
    )  # fmt: skip
    told = f"{by_state(results['counts'])}\nSummary: {results['folder']}/summary.html"
    answer(lambda: results, lambda: print(told), as_json=as_json, quiet=quiet)
    if status := exit_status(results):
        raise typer.Exit(status)


def dicom_command(
    workspace: OldWorkspace = None,
    out: Annotated[Path | None, out_option("WORKSPACE/dicom")] = None,
    patient_id: Annotated[str | None, typer.Option("--patient-id", help="PatientID.")] = None,
    patient_name: Annotated[
        str | None, typer.Option("--patient-name", help="PatientName, as Family^Given.")
    ] = None,
    birth_date: Annotated[
        str | None, typer.Option("--birth-date", help="PatientBirthDate, as YYYYMMDD.")
    ] = None,
    sex: Annotated[str | None, typer.Option("--sex", help="PatientSex: M, F or O.")] = None,
    accession: Annotated[
        str | None, typer.Option("--accession", help="AccessionNumber of the request.")
    ] = None,
    study_uid: Annotated[
        str | None,
        typer.Option("--study-uid", help="StudyInstanceUID of a study that they are to join."),
    ] = None,
    views: Annotated[
        int, typer.Option("--views", min=0, max=100, help="How many views of the scene to render.")
    ] = 5,
    unscaled: Annotated[
        bool, typer.Option("--unscaled", help="Also write a mesh whose scale is not known.")
    ] = False,
    as_json: AsJson = False,
) -> None:
    """Write pictures of the scene and its meshes as DICOM files, for an archive (PACS).

    Pictures are Secondary Capture, meshes Encapsulated STL in millimetres. Without any option about
    the patient the files say of nobody whose teeth they show. The same run and options give the
    same bytes.
    """
    from pipeline.studies.dicom import write_dicom

    given = {
        "PatientID": patient_id, "PatientName": patient_name, "PatientBirthDate": birth_date,
        "PatientSex": sex, "AccessionNumber": accession, "StudyInstanceUID": study_uid,
    }  # fmt: skip
    written = write_dicom(
        workspace or only_workspace(), out, views=views, unscaled=unscaled,
        patient={key: value for key, value in given.items() if value is not None},
    )  # fmt: skip
    if as_json:
        found = {**vars(written), "folder": str(written.folder)}
        print(json.dumps(found, indent=1))
    else:
        for name, title in written.files.items():
            print(f"{written.folder / name}: {title}")
        for name, why in written.left_out.items():
            print(f"{name} was not written: {why}")
        for name in written.removed:
            print(f"{name}, of an earlier call, was removed.")
    if written.problems:
        print("\n".join(written.problems), file=sys.stderr)
        raise typer.Exit(1)


def register_command(
    first: Annotated[
        Path, typer.Argument(metavar="A", parser=path, help="Workspace of the first visit.")
    ],
    second: Annotated[
        Path, typer.Argument(metavar="B", parser=path, help="Workspace of the second visit.")
    ],
    out: Annotated[Path | None, out_option("B/register")] = None,
    live: Annotated[
        bool,
        typer.Option(
            help="Both scenes to turn on the page, or only pictures of them: a small page."
        ),
    ] = True,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """Two visits of one patient in one frame: which teeth moved, how far and which way."""
    from pipeline.front.progress import make_reporter
    from pipeline.studies.register import run_register

    page, said = run_register(
        first, second, out, live=live, reporter=make_reporter(quiet=quiet, verbose=verbose)
    )
    if not quiet:
        size = page.stat().st_size / 1e6
        print(f"{said}\n\nLook at it: open {page} ({size:.1f} MB) in a browser.")


def register_studies(app: typer.Typer) -> None:
    """Make these commands part of the command line."""
    app.command("compare")(compare_command)
    app.command("benchmark")(benchmark_command)
    app.command("batch")(batch_command)
    app.command("dicom")(dicom_command)
    app.command("register")(register_command)
