"""What a run has left in its workspace, for the benchmarks that look at it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from pipeline.artifacts.views import View
from pipeline.store import Store


def load(workspace: Path, stage: str, kind: str) -> Any:
    """An artifact of the result of a stage that is in use; ends the program where there is none."""
    store = Store(workspace)
    result = store.in_use(stage)
    if result is None:
        raise SystemExit(f"{workspace} has no result of {stage}: run it at least that far first.")
    return store.load(result, kind)


def views(workspace: Path) -> dict[str, View]:
    """The photographs by name, masked where `init` has masked them."""
    placed = Store(workspace).in_use("init")
    masked = placed is not None and (placed.folder / "views").is_dir()
    found = load(workspace, "init" if masked else "views", "views").views
    return {view.name: view for view in found}
