"""A workspace: what was asked of it, how its stages stand, and cleaning it up."""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from pipeline.config import load_config
from pipeline.errors import RequestError
from pipeline.files import read_json, write_json
from pipeline.planning import plan_chain, resolve_chain
from pipeline.store import Store
from pipeline.untrusted.names import printable

#: Folders that say nothing about the case inside them; their parent's name does.
GENERIC_FOLDERS = {"images", "image", "frames", "photos", "photographs", "input", "inputs", "rgb"}


@dataclass(frozen=True)
class Request:
    """What the user asked for: photographs, preset and overrides, stages.

    Attributes:
        images: the photographs that the user named, or those that the workspace was last run on.
        images_named: whether the user named them.
    """

    workspace: Path
    images: tuple[str, ...]
    preset: str | None
    overrides: tuple[str, ...]
    stages: tuple[str, ...] | None
    from_stage: str | None = None
    images_named: bool = True

    def save(self) -> None:
        """Remember the request in the workspace, for `status` and for runs that name no images."""
        entry = {
            "images": list(self.images),
            "preset": self.preset,
            "overrides": list(self.overrides),
            "stages": list(self.stages) if self.stages else None,
            "from": self.from_stage,
        }
        path = self.workspace / "request.json"
        if read_json(path) != entry:
            write_json(path, entry)


def make_request(
    images: Sequence[str | Path] | str | Path = (),
    workspace: str | Path | None = None,
    preset: str | Path | None = None,
    overrides: Iterable[str] | Mapping[str, Any] = (),
    stages: Sequence[str] | None = None,
    from_stage: str | None = None,
) -> Request:
    """Complete what the user said with what the workspace remembers (its photographs)."""
    given = [images] if isinstance(images, str | Path) else list(images)
    if workspace is None:
        workspace = default_workspace(given)
    folder = Path(workspace)
    images_named = bool(given)
    if not given:
        remembered = read_json(folder / "request.json") or {}
        given = [p for p in remembered.get("images", []) if _still_there(p)]
    if isinstance(overrides, Mapping):
        overrides = [f"{key}={_yaml_value(value)}" for key, value in overrides.items()]
    return Request(
        workspace=folder,
        images=tuple(os.path.abspath(p) for p in given),  # noqa: PTH100 - keeps glob characters
        preset=str(preset) if preset is not None else None,
        overrides=tuple(overrides),
        stages=tuple(stages) if stages else None,
        from_stage=from_stage,
        images_named=images_named,
    )


def _still_there(path: str) -> bool:
    return any(c in path for c in "*?[") or Path(path).exists()


def _yaml_value(value: Any) -> str:
    import yaml

    text = yaml.safe_dump(value, default_flow_style=True, width=10**6)
    return text.removesuffix("\n").removesuffix("\n...")


def default_workspace(images: Sequence[str | Path]) -> Path:
    """``./runs/<name of the input>``; a folder called "images" or "frames" lends its parent's."""
    if not images:
        raise RequestError("Give the photographs (a folder, files or a video), or a workspace: -w.")
    first = Path(images[0])
    single = len(images) == 1
    if single and first.is_dir():
        folder = first.resolve()
    elif single and not any(c in first.name for c in "*?["):
        return Path("runs") / printable(first.stem)
    else:
        folder = first.resolve().parent
    name = folder.parent.name if folder.name.lower() in GENERIC_FOLDERS else folder.name
    return Path("runs") / (printable(name) or "case")


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
    store = Store(request.workspace)
    chain = resolve_chain(config, request.stages, request.from_stage, request.images_named, store)
    found = []
    for plan in plan_chain(chain, config, store, request.images):
        result = plan.result or store.current(plan.name)
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
