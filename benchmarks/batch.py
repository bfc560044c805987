"""A batch of synthetic mouths: throughput, memory over time, killed workers, the same bytes.

    python benchmarks/batch.py --cases 950 --kills 20 --folder runs/batch_benchmark

Makes so many cases of three or four photographs (`data_samples/mouths`; those that are there are
taken), and runs with small settings:

1. some of them one by one, each with its own `pipeline run`;
2. the same ones as a batch with one job, and with two;
3. all of them on a Dask scheduler with two workers, of which one after the other is killed.

Prints seconds per case of each, the memory of the batch's own process over time, and whether what
came of the cases of 1. has the same bytes in 2. and 3.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import random
import shutil
import statistics
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import psutil

ROOT = Path(__file__).resolve().parents[1]
PIPELINE = (sys.executable, "-m", "dentalsplat")
#: Small settings: what is measured is the batch, not the stages.
SETTINGS = ("--stages", "views,teeth", "--set", "views.long_side=128", "--set", "report=false")
WIDTH = 128


def make_case(job: tuple[Path, int]) -> None:
    """Write the photographs of one mouth."""
    folder, number = job
    case = folder / f"case_{number:04d}"
    if case.is_dir():
        return
    sys.path.insert(0, str(ROOT / "data_samples"))
    import cv2
    from mouths import mouth
    from mouths.batch import photographs_of

    cv2.setNumThreads(1)
    mouth.RAYS = 3  # coarse shadows: nobody looks at them
    part = folder / f".{case.name}.part"
    shutil.rmtree(part, ignore_errors=True)
    part.mkdir()
    for k, (_, photo) in enumerate(photographs_of(number, 1, WIDTH)):
        cv2.imwrite(str(part / f"{k}.jpg"), photo.image[..., ::-1])
    part.rename(case)


def environment() -> dict[str, str]:
    return {**os.environ, "PYTHONPATH": str(ROOT)}


def one_by_one(cases: list[Path], out: Path) -> float:
    """Seconds of a case that is run by itself, its process included."""
    start = time.perf_counter()
    for case in cases:
        subprocess.run(
            [*PIPELINE, "run", str(case), "-w", str(out / "cases" / case.name), *SETTINGS,
             "--set", "threads=1"],
            check=True, capture_output=True, env=environment(),
        )  # fmt: skip
    return (time.perf_counter() - start) / len(cases)


def batch(cases: Path, out: Path, *options: str) -> subprocess.Popen[str]:
    """Start a batch; what it prints goes into files, as a pipe would be full before it ends."""
    with (
        (out.parent / f"{out.name}.log").open("a") as log,
        printed(out).open("w") as results,
    ):
        return subprocess.Popen(
            [*PIPELINE, "batch", str(cases), "-o", str(out), "--json", *SETTINGS, *options],
            stdout=results, stderr=log, text=True, env=environment(),
        )  # fmt: skip


def printed(out: Path) -> Path:
    """The file with what a batch printed."""
    return out.parent / f"{out.name}.json"


def contents(out: Path, case: str) -> dict[str, Any]:
    """Stage -> hashes of what it computed."""
    found = {}
    for path in sorted((out / "cases" / case).glob("*/*/manifest.json")):
        manifest = json.loads(path.read_text())
        found[manifest["stage"]] = {k: v["content"] for k, v in manifest["outputs"].items()}
    return found


def with_kills(cases: Path, out: Path, kills: int, total: int) -> dict[str, Any]:
    """All cases on two Dask workers, of which so many are killed on the way."""
    out.mkdir(parents=True, exist_ok=True)
    file = out / "scheduler.json"
    file.unlink(missing_ok=True)
    quiet: dict[str, Any] = {
        "stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL, "env": environment(),
    }  # fmt: skip
    cli = (sys.executable, "-m")
    scheduler = subprocess.Popen(
        [*cli, "distributed.cli.dask_scheduler", "--no-dashboard", "--host", "127.0.0.1",
         "--port", "0", "--scheduler-file", str(file)], **quiet,
    )  # fmt: skip
    while not file.exists():
        time.sleep(0.1)
    nannies = [
        subprocess.Popen(
            [*cli, "distributed.cli.dask_worker", "--scheduler-file", str(file), "--nthreads", "1",
             "--no-dashboard", "--memory-limit", "4GB"], **quiet,
        )
        for _ in range(2)
    ]  # fmt: skip
    rng = random.Random(1)
    # Each at its time on the way: when so many cases have ended.
    due = sorted(rng.uniform(0.02, 0.95) * total for _ in range(kills))
    start = time.perf_counter()
    process = batch(cases, out, "--scheduler", str(file))
    memory: list[tuple[float, float]] = []
    killed = 0
    try:
        while process.poll() is None:
            time.sleep(0.5)
            ended = len(list((out / "thumbnails").glob("*.jpg")))
            with_memory = psutil.Process(process.pid)
            memory.append((time.perf_counter() - start, with_memory.memory_info().rss / 2**20))
            if due and ended >= due[0]:
                workers = [
                    child for nanny in nannies for child in psutil.Process(nanny.pid).children()
                    if "spawn_main" in " ".join(child.cmdline())
                ]  # fmt: skip
                if workers:
                    rng.choice(workers).kill()
                    killed += 1
                    due.pop(0)
        results = json.loads(printed(out).read_text() or "{}")
    finally:
        for each in (process, *nannies, scheduler):
            each.terminate()
            each.wait()
    if "counts" not in results:
        sys.exit(
            f"The batch stopped on its way: {results.get('error', 'see ' + str(out) + '.log')}"
        )
    quarter = max(1, len(memory) // 4)
    return {
        "counts": results["counts"],
        "seconds_per_case": results["seconds"] / total,
        "workers_killed": killed,
        "begun_more_than_once": sum(case["attempts"] > 1 for case in results["cases"]),
        "memory_mb_second_quarter": statistics.median(m for _, m in memory[quarter : 2 * quarter]),
        "memory_mb_last_quarter": statistics.median(m for _, m in memory[-quarter:]),
        "memory_mb_of_a_case": statistics.median(
            case["peak_memory_mb"] for case in results["cases"] if case["peak_memory_mb"]
        ),
    }


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--cases", type=int, default=40)
    parser.add_argument("--kills", type=int, default=5)
    parser.add_argument("--some", type=int, default=10, help="cases of 1. and 2.")
    parser.add_argument("--folder", type=Path, default=Path("runs/batch_benchmark"))
    options = parser.parse_args()
    folder = options.folder.resolve()
    cases, some = folder / "cases", folder / "some"
    cases.mkdir(parents=True, exist_ok=True)
    with multiprocessing.get_context("spawn").Pool(2) as pool:
        pool.map(make_case, [(cases, number) for number in range(options.cases)], chunksize=1)
    shutil.rmtree(some, ignore_errors=True)
    some.mkdir()
    chosen = sorted(path for path in cases.iterdir() if path.name[0] != ".")[: options.some]
    for case in chosen:
        (some / case.name).symlink_to(case)
    for name in ("alone", "one_job", "two_jobs", "killed"):
        shutil.rmtree(folder / name, ignore_errors=True)
    figures: dict[str, Any] = {"cases": options.cases, "some": len(chosen)}
    figures["alone_seconds_per_case"] = one_by_one(chosen, folder / "alone")
    for name, jobs in (("one_job", 1), ("two_jobs", 2)):
        batch(some, folder / name, "--jobs", str(jobs)).wait()
        results = json.loads(printed(folder / name).read_text())
        assert results["counts"] == {"done": len(chosen)}, results["counts"]
        figures[f"{name}_seconds_per_case"] = results["seconds"] / len(chosen)
    figures |= with_kills(cases, folder / "killed", options.kills, options.cases)
    figures["same_bytes"] = {
        name: sum(
            contents(folder / "alone", case.name) == contents(folder / name, case.name) != {}
            for case in chosen
        )
        for name in ("one_job", "two_jobs", "killed")
    }
    (folder / "figures.json").write_text(json.dumps(figures, indent=1) + "\n")
    print(json.dumps(figures, indent=1))


if __name__ == "__main__":
    main()
