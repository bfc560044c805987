"""Toy stages with the settings that benchmarks use, to test these without any geometry.

``python toy_bench.py benchmark ...`` is the command line on them, ``python toy_bench.py worker``
the process of one cell. Every stage that computes adds a line to the file $TOY_LOG. Charts of the
report, which take longer than all the rest, are drawn where $TOY_CHARTS says so.
"""

from __future__ import annotations

import contextlib
import json
import os
import sys
import time
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[1] / "pipeline"))

import toy
from toy import Numbers, ToyEntryPoint

import pipeline.runner
import pipeline.stage
from pipeline.artifacts import KINDS
from pipeline.errors import ReconstructionError, RequestError
from pipeline.stage import Stage, StageConfig, StageContext, runtime

COMMAND = (sys.executable, str(Path(__file__).resolve()))


def log(stage: Stage, context: StageContext, **more: object) -> None:
    with Path(os.environ["TOY_LOG"]).open("a") as stream:
        stream.write(json.dumps([stage.name, {**context.config.model_dump(), **more}]) + "\n")


class ViewsStage(Stage):
    name, version, summary = "views", 1, "reads a number from each file"
    provides = ("numbers",)
    uses_sources = True

    class Config(StageConfig):
        held_out: tuple[str, ...] = ()
        masks: str | None = runtime(None)

    def sources(self, config: Any, request: Any) -> dict[str, Path]:
        if config.masks is not None and not Path(config.masks).is_dir():
            raise RequestError(f"There is no folder {config.masks}.")
        return {Path(p).name: Path(p) for p in request["images"]}

    def run(self, context: StageContext) -> None:
        held = context.config.held_out
        files = [path for label, path in context.sources.items() if label not in held]
        log(self, context, files=[path.name for path in files])
        context.save(Numbers([float(path.read_text()) for path in files]))


class InitStage(Stage):
    name, version, summary = "init", 1, "needs enough of them"
    requires = ("numbers",)
    provides = ("numbers",)

    class Config(StageConfig):
        method: str = "auto"
        cameras: str | None = None
        needs: int = 1
        unplaced: int = 0

    def run(self, context: StageContext) -> None:
        log(self, context)
        values = context.load("numbers").values
        if len(values) < context.config.needs:
            raise ReconstructionError("COLMAP could not place the photographs.")
        context.save(Numbers(values))


class FitStage(Stage):
    name, version, summary = "fit", 1, "adds quality"
    requires = ("numbers",)
    provides = ("numbers",)

    class Config(StageConfig):
        quality: float = 1.0
        optimize_poses: bool = True
        step_seconds: float = runtime(0.0)
        fail: str = ""

    def run(self, context: StageContext) -> None:
        log(self, context)
        values = context.load("numbers").values
        time.sleep(context.config.step_seconds)
        if context.config.fail == "bug":
            raise ZeroDivisionError("oops")
        if context.config.fail == "request":
            raise RequestError("This can't be done.")
        if context.config.fail == "killed":
            os.kill(os.getpid(), 9)
        context.save(Numbers([len(values) + context.config.quality + context.seed]))


class EvaluateStage(Stage):
    name, version, summary = "evaluate", 1, "scores"
    requires = ("numbers",)
    provides = ("metrics",)

    class Config(StageConfig):
        ground_truth: str | None = runtime(None)
        masks: str | None = runtime(None)
        mesh: str | None = runtime(None)
        broken: bool = False

    def run(self, context: StageContext) -> None:
        log(self, context)
        (quality,) = context.load("numbers").values
        figures: dict[str, Any] = {
            "mean": {"psnr": 30 + quality, "ssim": 0.9, "lpips": None},
            "views_unplaced": [],
            "gaussians": 100,
        }
        if context.config.broken:
            figures = {}
        if context.config.ground_truth:
            mean = {"psnr": 20 + quality, "ssim": 0.5 + quality / 100, "lpips": None}
            better = {**mean, "psnr": mean["psnr"] + 1}
            figures["held_out"] = {
                "registered": {"protocol": "", "views": {}, "mean": mean, "worst": {}},
                "refined": {"protocol": "", "views": {}, "mean": better, "worst": {}},
            }
            figures["poses"] = {"rotation_deg": {"median": 0.5}, "alignment": "similarity"}
        (context.output("metrics") / "metrics.json").write_text(json.dumps(figures))


class ExportStage(Stage):
    name, version, summary = "export", 1, "writes a page"
    requires = ("numbers",)
    provides = ("exports",)

    class Config(StageConfig):
        pass

    def run(self, context: StageContext) -> None:
        raise AssertionError("a benchmark exports nothing")


ORDER = ["views", "init", "fit", "export", "evaluate"]
TOYS = (ViewsStage, InitStage, FitStage, ExportStage, EvaluateStage)
STAGES = {stage.name: [ToyEntryPoint(stage)] for stage in TOYS}


def no_report(results: dict[str, Any], out: Path) -> Path:
    """In place of the benchmark's report, where nobody asks for it."""
    return out / "report.html"


def install() -> None:
    """Replace the registered stages of this process by the toys."""
    KINDS["numbers"] = "toy:Numbers"
    pipeline.stage._entry_points = lambda: STAGES  # type: ignore[assignment]
    pipeline.stage.get_stage.cache_clear()
    pipeline.runner.one_blas_thread = contextlib.nullcontext  # they know no matrices


def start_toys() -> None:
    """Cells that this process starts are of toys, too."""
    from pipeline.studies.benchmark import running

    running.WORKER = (*COMMAND, "worker")
    if "TOY_CHARTS" not in os.environ:
        running.benchmark_report = no_report


if __name__ == "__main__":
    sys.modules["toy_bench"] = sys.modules["__main__"]
    assert toy.Numbers is Numbers
    install()
    if sys.argv[1] == "worker":
        from pipeline.studies.benchmark.worker import main as worker

        worker()
    else:
        from pipeline.cli import main

        start_toys()
        main()
