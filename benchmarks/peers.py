"""Another program on the same photographs and cameras: its cost, and its scene through our eyes.

    python benchmarks/peers.py -w WORKSPACE --name NAME [--iterations N] [--threads 2]
        [--ply PATTERN] [--background R G B] [--out DIR] -- COMMAND ...

WORKSPACE is of a run that has ended with `export`. In the words of COMMAND these are replaced:
{colmap} a COLMAP project (images/, sparse/0/), {results} a folder with transforms.json as
nerfstudio wants it, {ply} the file to write, {folder} an empty folder, {iterations}, {threads}. Of
a program that names its .ply itself, --ply is the pattern in {folder}; the newest file counts. Two
programs in turn: sh -c '... && ...'.

The command has as many cores and threads as --threads says. Its CPU seconds and peak memory are
what the system counts for it and the processes that it waits for: reading, training and writing.
Ours are those of the stage `fit`, as its manifest says. Then the stages `splats` and `evaluate`
score the peer's scene with the settings that the workspace was made with, beside our own.
`benchmarks/peers.md` says what may be compared.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:  # what is large is imported after the measurement: see `measured`
    from pipeline.running.outcomes import RunSummary

#: What the libraries of peers ask for the number of threads.
THREADS = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS", "RAYON_NUM_THREADS")
COLUMNS = (
    "", "Gaussians", "CPU s", "CPU s an iteration", "wall s", "peak MB", "PSNR / SSIM, input views",
    "held out, registered", "held out, refined",
)  # fmt: skip


@dataclass(frozen=True)
class Cost:
    """What a program took.

    Attributes:
        cpu_seconds: user and system, of all its threads and of the processes it waited for.
        wall_seconds: from start to end.
        peak_mb: most memory that one of its processes held, MiB.
    """

    cpu_seconds: float
    wall_seconds: float
    peak_mb: float


def measured(command: Sequence[str], log: Path, threads: int) -> Cost:
    """Run a command to its end; its output goes to a file.

    On Linux a new process counts the memory of the one that started it as its own peak until it has
    more. So this program imports nothing large before (it has some 15 MB then).

    Raises:
        SystemExit: it can't be run, or ends with another status than 0.
    """
    environment = {**os.environ, **dict.fromkeys(THREADS, str(threads))}
    if hasattr(os, "sched_setaffinity"):  # children inherit it
        os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[:threads])
    with log.open("wb") as output:
        start = time.perf_counter()
        try:
            child = subprocess.Popen(
                command, stdin=subprocess.DEVNULL, stdout=output, stderr=subprocess.STDOUT,
                env=environment,
            )  # fmt: skip
        except OSError as error:
            raise SystemExit(f"{command[0]} can't be run: {error.strerror}") from error
        _, status, usage = os.wait4(child.pid, 0)
        wall = time.perf_counter() - start
    child.returncode = os.waitstatus_to_exitcode(status)
    if child.returncode:
        raise SystemExit(f"{command[0]} ended with status {child.returncode}; see {log}")
    peak = usage.ru_maxrss / (2**20 if sys.platform == "darwin" else 2**10)  # bytes there, else KiB
    return Cost(usage.ru_utime + usage.ru_stime, wall, peak)


def filled(words: Sequence[str], values: Mapping[str, object]) -> list[str]:
    """The words of a command with ``{name}`` replaced by its value; other braces stay."""
    found = []
    for word in words:
        for name, value in values.items():
            word = word.replace(f"{{{name}}}", str(value))
        found.append(word)
    return found


def newest(folder: Path, pattern: str) -> Path:
    """The file of a pattern that was written last.

    Raises:
        SystemExit: there is none.
    """
    found = [path for path in folder.glob(pattern) if path.is_file()]
    if not found:
        raise SystemExit(f"The command has written no {pattern} into {folder}.")
    return max(found, key=lambda path: path.stat().st_mtime_ns)


def scored(
    workspace: Path,
    request: Mapping[str, Any],
    ply: Path | None = None,
    background: Sequence[float] | None = None,
) -> RunSummary:
    """Score our scene, or that of a file, with the settings of the workspace.

    Args:
        background: behind the file's scene; None: as the file says.
    """
    import dentalsplat

    stages, overrides = ["evaluate"], list(request["overrides"])
    if ply is not None:
        stages = ["splats", "evaluate"]
        overrides.append(f"splats.file={json.dumps(str(ply))}")
        if background is not None:
            overrides.append(f"splats.background={[*background]}")
    return dentalsplat.run(
        workspace=workspace, preset=request["preset"], overrides=overrides, stages=stages
    )


def row(name: str, summary: RunSummary, cost: Cost, iterations: int | None) -> str:
    """A row of the table."""
    from pipeline.artifacts.metrics import Metrics

    folder = summary.stages[-1].folder
    assert folder is not None
    metrics = Metrics.load(folder / "metrics")
    scores = [metrics.input, *(metrics.held_out.get(p) for p in ("registered", "refined"))]
    cells = [
        name,
        f"{metrics.figures['gaussians']:,}",
        f"{cost.cpu_seconds:.1f}",
        f"{cost.cpu_seconds / iterations:.3f}" if iterations else "",
        f"{cost.wall_seconds:.1f}",
        f"{cost.peak_mb:.0f}",
        *(f"{s.mean['psnr']:.2f} / {s.mean['ssim']:.4f}" if s else "" for s in scores),
    ]
    return f"| {' | '.join(cells)} |"


def compared(
    workspace: Path, name: str, ply: Path, cost: Cost, iterations: int | None,
    background: Sequence[float] | None,
) -> list[str]:  # fmt: skip
    """The rows of our scene and of the peer's; the workspace is left as it was found."""
    import dentalsplat
    from pipeline.store import Store
    from pipeline.workspace import read_request

    request = read_request(workspace)
    fit = Store(workspace).current("fit")
    rows = []
    try:
        if fit is not None:
            did = fit.manifest
            ours = Cost(did["cpu_seconds"], did["wall_seconds"], did["peak_memory_mb"])
            summary = scored(workspace, request)
            rows.append(row("ours (fit)", summary, ours, did["summary"].get("iterations")))
        rows.append(row(name, scored(workspace, request, ply, background), cost, iterations))
    finally:  # all of it is cached
        dentalsplat.run(
            request["images"], workspace=workspace, preset=request["preset"],
            overrides=request["overrides"], stages=request["stages"], from_stage=request["from"],
        )  # fmt: skip
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("-w", "--workspace", type=Path, help="of a run that ended with export")
    parser.add_argument("--name", default="peer", help="of the program, for the table")
    parser.add_argument("--iterations", type=int, help="that the command is told to run")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--ply", help="pattern of the .ply, where the program names it itself")
    parser.add_argument("--background", type=float, nargs=3, help="default: what the .ply says")
    parser.add_argument("--out", type=Path, help="default: runs/peers/NAME")
    parser.add_argument("command", nargs="*", help="after --")
    options = parser.parse_args()
    if options.workspace is None or not options.command:
        print("benchmarks/peers.py: nothing to do without -w WORKSPACE and -- COMMAND")
        return
    results = (options.workspace / "results").resolve()
    if not (results / "colmap" / "sparse" / "0").is_dir():
        raise SystemExit(f"{results} holds no COLMAP model. Run the stage export there first.")
    out = (options.out or Path("runs") / "peers" / options.name).resolve()
    folder = out / "output"
    if folder.exists():
        raise SystemExit(f"{folder} is there already: delete it, or name another folder with --out")
    folder.mkdir(parents=True)
    values = {
        "colmap": results / "colmap", "results": results, "ply": folder / "splats.ply",
        "folder": folder, "iterations": options.iterations, "threads": options.threads,
    }  # fmt: skip
    cost = measured(filled(options.command, values), out / "log.txt", options.threads)
    ply = newest(folder, options.ply or "splats.ply")
    from pipeline.errors import PipelineError

    try:
        rows = compared(
            options.workspace, options.name, ply, cost, options.iterations, options.background
        )
    except PipelineError as error:  # a scene in another frame, or of another format
        raise SystemExit(str(error)) from error
    table = [f"| {' | '.join(COLUMNS)} |", "|---|" + "---:|" * (len(COLUMNS) - 1), *rows]
    print("\n".join(table))
    (out / "table.md").write_text("\n".join(table) + "\n")


if __name__ == "__main__":
    main()
