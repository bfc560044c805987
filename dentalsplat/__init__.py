"""dentalsplat: a 3D scene from a few unposed photographs of teeth.

    import dentalsplat
    summary = dentalsplat.run("photos/", overrides={"fit.iterations": 500})

What the command line does, these functions do too, under the same names (but for `register`,
`dicom` and `warmup`). They are imported when they are asked for, so that ``import dentalsplat`` is
quick, from the packages behind them: `pipeline` (the engine) and `stages` (the algorithms).
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from pipeline.errors import PipelineError, ReconstructionError, RequestError, StageError
    from pipeline.front.checkup import doctor
    from pipeline.front.commands import run, stages
    from pipeline.front.settings import settings
    from pipeline.studies.batch.running import batch
    from pipeline.studies.benchmark.running import benchmark
    from pipeline.studies.compare.compare import compare
    from pipeline.studies.report import run_report as report
    from pipeline.workspace import clean, status

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


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module 'dentalsplat' has no attribute '{name}'")
    from dentalsplat.names import check_names

    check_names()
    engine = importlib.import_module("pipeline")
    return getattr(engine, "run_report" if name == "report" else name)


def __dir__() -> list[str]:
    return sorted([*__all__, "__version__"])
