"""The state of a workspace, the registered stages, and cleaning up."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from pipeline.config import load_config
from pipeline.errors import PipelineError, RequestError
from pipeline.files import read_json
from pipeline.progress import Reporter
from pipeline.request import make_request
from pipeline.runner import Runner
from pipeline.stage import get_stage, stage_names
from pipeline.store import Store


@dataclass
class StageStatus:
    """State of one stage.

    Attributes:
        state: ``cached``, ``stale``, ``missing``, ``failed``, or ``pending`` (an earlier stage must
            run before this one's state is known).
        reasons: for a stale stage, the field or the input that made it stale; for a cached one, why
            it was computed last.
    """

    name: str
    state: str
    reasons: list[str] = field(default_factory=list)
    key: str | None = None
    folder: str | None = None
    failure: str | None = None
    resumable: bool = False
    summary: dict[str, Any] = field(default_factory=dict)


def status(
    images: Sequence[str | Path] | str | Path = (),
    *,
    workspace: str | Path | None = None,
    preset: str | Path | None = None,
    overrides: Iterable[str] | Mapping[str, Any] = (),
    stages: Sequence[str] | None = None,
) -> list[StageStatus]:
    """Compare a workspace with a request, by default the one it was last asked for.

    Given a preset, overrides or stages, it tells what a run with them would find stale.

    Raises:
        RequestError: there is no such workspace, or the request is wrong.
    """
    request = make_request(images, workspace, preset, overrides, stages)
    remembered = read_json(request.workspace / "request.json")
    if not isinstance(remembered, dict):
        raise RequestError(
            f"{request.workspace} is not a workspace: no run has been started there. Give the "
            "folder that 'pipeline run' named, with -w."
        )
    request = make_request(
        request.images,
        request.workspace,
        preset if preset is not None else remembered["preset"],
        [*(remembered["overrides"] if preset is None else []), *request.overrides],
        stages or remembered["stages"],
    )
    config = load_config(request.preset, request.overrides)
    runner = Runner(request, config, Reporter())
    found = []
    for plan in runner.plan():
        result = plan.result or runner.store.current(plan.name)
        found.append(
            StageStatus(
                name=plan.name,
                state=plan.state,
                reasons=plan.reasons,
                key=plan.key,
                folder=str(result.folder) if result else None,
                failure=plan.failure,
                resumable=plan.resumable,
                summary=result.manifest["summary"] if result else {},
            )
        )
    return found


def stages() -> list[dict[str, Any]]:
    """The registered stages: what each requires and provides, its methods and its settings."""
    order = list(load_config().run.stages)
    names = sorted(stage_names(), key=lambda n: (order.index(n) if n in order else len(order), n))
    found: list[dict[str, Any]] = []
    for name in names:
        try:
            stage = get_stage(name)
        except PipelineError as error:
            found.append({"name": name, "error": str(error)})
            continue
        found.append(
            {
                "name": name,
                "summary": stage.summary,
                "version": stage.version,
                "requires": list(stage.requires),
                "optional": list(stage.optional),
                "provides": list(stage.provides),
                "may_provide": list(stage.may_provide),
                "methods": dict(stage.methods),
                "settings": stage.Config.model_json_schema(),
            }
        )
    return found


def clean(workspace: str | Path, *, keep: int = 0) -> tuple[list[str], int]:
    """Delete the results that are not in use, but for the `keep` newest of each stage.

    Returns:
        What was deleted (``stage/key``), and the bytes freed.

    Raises:
        RequestError: there is no such workspace.
    """
    folder = Path(workspace)
    if read_json(folder / "request.json") is None:
        raise RequestError(f"{folder} is not a workspace, so nothing in it was deleted.")
    return Store(folder).clean(keep)
