"""Toy stages that do what cases of a batch do: well, badly, for long, with much memory.

``python toy_batch.py child`` is the process of one case, ``python toy_batch.py worker ADDRESS`` a
Dask worker, and ``python toy_batch.py batch ...`` the command line on them. Every stage that
computes adds a line to the file $TOY_LOG.
"""

from __future__ import annotations

import contextlib
import json
import os
import sys
import time
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[2]))
sys.path.insert(0, str(Path(__file__).parents[1] / "pipeline"))

from PIL import Image
from toy import Numbers, ToyEntryPoint

import pipeline.runner
import pipeline.stage
from pipeline.artifacts import KINDS
from pipeline.errors import ReconstructionError
from pipeline.stage import Stage, StageConfig, StageContext, runtime

COMMAND = (sys.executable, str(Path(__file__).resolve()))
ORDER = ["views", "fit", "export"]


def log(stage: Stage, context: StageContext) -> None:
    with Path(os.environ["TOY_LOG"]).open("a") as stream:
        values = context.load("numbers").values if context.has("numbers") else []
        stream.write(json.dumps([stage.name, values, os.getpid()]) + "\n")


class ViewsStage(Stage):
    name, version, summary = "views", 1, "reads a number from each file"
    provides = ("numbers",)
    uses_sources = True

    class Config(StageConfig):
        pass

    def sources(self, config: Any, request: Any) -> dict[str, Path]:
        (given, *more) = map(Path, request["images"])
        files = sorted(given.glob("*.jpg")) if given.is_dir() else [given, *more]
        return {path.name: path for path in files}

    def run(self, context: StageContext) -> None:
        log(self, context)
        context.save(Numbers([float(path.read_text()) for path in context.sources.values()]))
        context.summarize(views_total=len(context.sources))


class FitStage(Stage):
    name, version, summary = "fit", 1, "does what it is told"
    requires = ("numbers",)
    provides = ("numbers",)

    class Config(StageConfig):
        fail: str = ""
        wait: float = runtime(0.0)
        megabytes: int = 0
        file: str = runtime("")

    def sources(self, config: Any, request: Any) -> dict[str, Path]:
        found = {"file": Path(config.file)} if config.file else {}
        said = Path(request["workspace"]) / "teeth.yaml"
        return found | ({"teeth.yaml": said} if said.exists() else {})

    def run(self, context: StageContext) -> None:
        log(self, context)
        values = context.load("numbers").values
        held = bytearray(os.urandom(1)) * (context.config.megabytes << 20)
        time.sleep(context.config.wait)
        if context.config.fail == "refused":
            raise ReconstructionError("These photographs share nothing.")
        if context.config.fail == "fault":
            raise ZeroDivisionError("oops")
        if context.config.fail == "killed":
            os.kill(os.getpid(), 9)
        if context.config.fail == "full":
            raise OSError(28, "No space left on device")
        del held
        context.save(Numbers([sum(values)]))
        context.summarize(views_registered=len(values), psnr=30.0 + len(values))


class ExportStage(Stage):
    name, version, summary = "export", 1, "writes files, small and large"
    requires = ("numbers",)
    provides = ("exports",)

    class Config(StageConfig):
        pass

    def run(self, context: StageContext) -> None:
        log(self, context)
        folder = context.output("exports")
        overjet = {
            "name": "overjet", "value": -1.25, "uncertainty": 0.5, "unit": "mm", "estimated": None,
        }  # fmt: skip
        hidden = {**overjet, "name": "overbite", "value": None}
        found = {"teeth": [11, 12, 13], "measurements": [overjet, hidden]}
        (folder / "teeth.json").write_text(json.dumps(found))
        (folder / "viewer.html").write_text("<p>a scene")
        (folder / "README.txt").write_text("viewer.html, splats.ply\n")
        Image.new("RGB", (8, 6), "red").save(folder / "preview.png")
        (folder / "splats.ply").write_bytes(bytes(9_000_000))
        (folder / "mesh.ply").write_bytes(bytes(1000))
        (folder / "colmap").mkdir()
        (folder / "colmap" / "images.bin").write_bytes(bytes(1000))


TOYS = (ViewsStage, FitStage, ExportStage)
STAGES = {stage.name: [ToyEntryPoint(stage)] for stage in TOYS}


def install() -> None:
    """Replace the registered stages of this process, and of cases that it starts, by the toys."""
    from pipeline.studies.batch import task

    KINDS["numbers"] = "toy:Numbers"
    pipeline.stage._entry_points = lambda: STAGES  # type: ignore[assignment]
    pipeline.stage.get_stage.cache_clear()
    pipeline.runner.one_blas_thread = contextlib.nullcontext  # they know no matrices
    task.COMMAND = (*COMMAND, "child")


def worker(address: str) -> None:
    """One Dask worker with one slot, in this process; it ends when it is killed."""
    import asyncio

    from distributed import Worker

    async def serve() -> None:
        async with Worker(address, nthreads=1, memory_limit=0, dashboard=False) as made:
            await made.finished()

    asyncio.run(serve())


if __name__ == "__main__":
    install()
    if sys.argv[1] == "child":
        from pipeline.process.signals import child
        from pipeline.studies.batch.child import main as case

        child()
        case()
    elif sys.argv[1] == "worker":
        worker(sys.argv[2])
    else:
        from pipeline.cli import program
        from pipeline.process import signals

        signals.run(program)
