"""A small pipeline of toy stages, to test the engine without any geometry.

read (files with a number each) -> scale -> count (slow, with checkpoints) -> publish
"""

from __future__ import annotations

import json
import os
import time
from pathlib import Path
from typing import Any, ClassVar, Self

import numpy as np
from pydantic import Field

import pipeline.stage
from pipeline.artifacts import KINDS, Artifact
from pipeline.errors import ReconstructionError, RequestError
from pipeline.stage import Stage, StageConfig, StageContext, runtime


class Numbers(Artifact):
    kind: ClassVar[str] = "numbers"

    def __init__(self, values: list[float]) -> None:
        self.values = values

    def save(self, folder: Path) -> None:
        (folder / "numbers.json").write_text(json.dumps(self.values))

    @classmethod
    def load(cls, folder: Path) -> Self:
        return cls(json.loads((folder / "numbers.json").read_text()))


class ReadStage(Stage):
    name, version, summary = "read", 1, "reads a number from each file"
    provides = ("numbers",)
    uses_sources = True

    class Config(StageConfig):
        keep: int = 99

    def sources(self, config: Any, request: Any) -> dict[str, Path]:
        files = [Path(p) for p in request["images"]]
        files = sorted(files[0].iterdir()) if len(files) == 1 and files[0].is_dir() else files
        if not files:
            raise RequestError("There are no numbers. Give files with a number each.")
        return {path.name: path for path in files}

    def run(self, context: StageContext) -> None:
        values = [float(path.read_text()) for path in context.sources.values()]
        context.save(Numbers(values[: context.config.keep]))
        context.summarize(views=len(values))


class ScaleStage(Stage):
    name, version, summary = "scale", 1, "multiplies"
    requires = ("numbers",)
    provides = ("numbers",)
    may_provide = ("metrics",)
    libraries = ("numpy",)

    class Config(StageConfig):
        factor: float = Field(2.0, gt=0, lt=10, description="what to multiply with")
        round: bool = False
        note: bool = False
        log_every: int = runtime(1)

    def run(self, context: StageContext) -> None:
        factor = round(context.config.factor) if context.config.round else context.config.factor
        if context.config.note:
            (context.output("metrics") / "metrics.json").write_text('{"note": 1}')
        context.save(Numbers([value * factor for value in context.load("numbers").values]))


class CountStage(Stage):
    name, version, summary = "count", 1, "adds up, slowly, with checkpoints"
    requires = ("numbers",)
    optional = ("metrics",)
    provides = ("metrics",)
    methods: ClassVar = {"plain": "one by one"}

    class Config(StageConfig):
        steps: int = Field(30, ge=1)
        step_seconds: float = runtime(0.0)
        fail: str = ""

    def run(self, context: StageContext) -> None:
        config = context.config
        checkpoint = context.scratch / "checkpoint.json"
        state = {"step": 0, "total": 0.0}
        if checkpoint.exists():
            state = json.loads(checkpoint.read_text())
        values = context.load("numbers").values
        out = context.output("metrics")
        while state["step"] < config.steps:
            state["step"] += 1
            state["total"] += sum(values) / state["step"]
            (out / f"step_{state['step'] % 5}.txt").write_text("half-written")
            time.sleep(config.step_seconds)
            temporary = checkpoint.with_suffix(".tmp")
            temporary.write_text(json.dumps(state))
            temporary.replace(checkpoint)
            context.progress("adding", state["step"], config.steps, loss=1 / state["step"])
            if state["step"] == config.steps // 2:
                self._maybe_fail(config.fail)
        for index in range(5):
            (out / f"step_{index}.txt").write_text(f"{state['total']:.6f} {index}\n" * 500)
        (out / "metrics.json").write_text(json.dumps({"total": state["total"]}))
        context.warn("this is only a toy")
        context.summarize(total=state["total"])

    def _maybe_fail(self, how: str) -> None:
        if how == "data":
            raise ReconstructionError(
                "Photos 'a' and 'b' share too little; add one between them.",
                {"pair": np.full((4, 6, 3), 77, np.uint8)},
            )
        if how == "bug":
            raise ZeroDivisionError("oops")
        if how == "exit":
            raise SystemExit(7)
        if how == "disk":
            raise OSError(28, "No space left on device")
        if how == "interrupt":
            raise KeyboardInterrupt


class PublishStage(Stage):
    name, version, summary = "publish", 1, "writes a page"
    requires = ("metrics",)
    provides = ("exports",)

    class Config(StageConfig):
        title: str = "toy"

    def run(self, context: StageContext) -> None:
        total = context.load("metrics").figures["total"]
        (context.output("exports") / "viewer.html").write_text(f"{context.config.title}: {total}")


class ToyEntryPoint:
    def __init__(self, stage: type[Stage]) -> None:
        self.value, self._stage = stage.__qualname__, stage

    def load(self) -> type[Stage]:
        return self._stage


STAGES = {s.name: [ToyEntryPoint(s)] for s in (ReadStage, ScaleStage, CountStage, PublishStage)}
ORDER = ["read", "scale", "count", "publish"]


def artifact_bytes(workspace: Path) -> dict[str, bytes]:
    """Bytes of all artifacts of all committed results; the manifests hold timings."""
    return {
        str(path.relative_to(workspace)): path.read_bytes()
        for path in sorted(workspace.rglob("*"))
        if path.is_file() and len(path.relative_to(workspace).parts) > 3
    }


def install() -> None:
    """Replace the registered stages of this process by the toys."""
    KINDS["numbers"] = "toy:Numbers"
    pipeline.stage._entry_points = lambda: STAGES  # type: ignore[assignment]
    pipeline.stage.get_stage.cache_clear()


if __name__ == "__main__":  # the command line, on toy stages: python toy.py run ...
    import sys

    sys.modules["toy"] = sys.modules["__main__"]
    install()
    os.environ.setdefault("COLUMNS", "200")
    from pipeline.cli import program
    from pipeline.process import signals

    signals.run(program)
