"""dentalsplat: a 3D scene from a few unposed photographs of teeth.

    import pipeline
    summary = pipeline.run("photos/", overrides={"fit.iterations": 500})

`run`, `status`, `stages`, `settings`, `clean` and `doctor` are what the command line calls too.
They are imported on first use, so that ``import pipeline`` is quick.
"""

from __future__ import annotations

import importlib
from typing import Any

from pipeline.process.native import watch_imports

watch_imports()

_HOMES = {
    "run": "pipeline.front.commands",
    "status": "pipeline.workspace",
    "stages": "pipeline.front.commands",
    "clean": "pipeline.workspace",
    "doctor": "pipeline.front.checkup",
    "settings": "pipeline.front.settings",
    "benchmark": "pipeline.studies.benchmark.running",
    "batch": "pipeline.studies.batch.running",
    "run_report": "pipeline.studies.report",
    "compare": "pipeline.studies.compare.compare",
    "PipelineError": "pipeline.errors",
    "RequestError": "pipeline.errors",
    "ReconstructionError": "pipeline.errors",
    "StageError": "pipeline.errors",
}

__all__ = list(_HOMES)


def __getattr__(name: str) -> Any:
    if name in _HOMES:
        return getattr(importlib.import_module(_HOMES[name]), name)
    raise AttributeError(f"module 'pipeline' has no attribute '{name}'")
