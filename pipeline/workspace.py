"""A workspace: what was asked of it, how its stages stand, and cleaning it up."""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from shlex import quote
from typing import Any

from pipeline.config import Config, RunConfig, anchored, load_config
from pipeline.config.asked import anchored_preset, each_override, each_stage
from pipeline.errors import PipelineError, RequestError, shown
from pipeline.planning import plan_chain, resolve_chain
from pipeline.stage import stage_names
from pipeline.store import Store, partial_name
from pipeline.store.cleaning import checkpoints
from pipeline.store.places import is_folder, set_aside
from pipeline.store.records import DamagedError, SavedRequest, read_record, write_sealed
from pipeline.untrusted.names import printable
from pipeline.untrusted.own import BATCH, REQUEST
from pipeline.untrusted.paths import given_path, home_told

#: Folders that say nothing about the case inside them; their parent's name does.
GENERIC_FOLDERS = {"images", "image", "frames", "photos", "photographs", "input", "inputs", "rgb"}


@dataclass(frozen=True)
class Request:
    """What the user asked for: photographs, preset and overrides, stages.

    Attributes:
        images: the photographs that the user named, or those that the workspace was last run on.
        images_named: whether the user named them.
        taken_over: what of preset and overrides is the last run's, as the command line has it.
        left_out: settings of the last run for stages that are not installed here.
    """

    workspace: Path
    images: tuple[str, ...]
    preset: str | None
    overrides: tuple[str, ...]
    stages: tuple[str, ...] | None
    from_stage: str | None = None
    images_named: bool = True
    taken_over: tuple[str, ...] = ()
    left_out: tuple[str, ...] = ()

    @property
    def asked(self) -> frozenset[str]:
        """Settings that the user gave this time, such as ``views.masks``."""
        before = {change.removeprefix("--set ") for change in self.taken_over}
        return frozenset(c.partition("=")[0].strip() for c in self.overrides if c not in before)

    @property
    def typed_before(self) -> str:
        """What is the last run's, as one types it."""
        options = (option.partition(" ") for option in self.taken_over)
        return " ".join(f"{name} {quote(value)}" for name, _, value in options)

    def save(self) -> None:
        """Remember the request in the workspace, for `status` and for runs that name no images."""
        entry: dict[str, Any] = {
            "images": list(self.images),
            "preset": self.preset,
            "overrides": list(self.overrides),
            "stages": list(self.stages) if self.stages else None,
            "from": self.from_stage,
        }
        path = self.workspace / REQUEST
        try:
            found = read_record(path, SavedRequest)
        except DamagedError:
            found = None
        if found is None or found.model_dump(by_alias=True) != entry:
            if is_folder(path):
                set_aside(path)
            write_sealed(path, entry)


def is_workspace(folder: Path) -> bool:
    """Has a run been started there, whatever has become of it?

    Raises:
        RequestError: this user may not look into it.
    """
    path = folder / REQUEST
    try:
        path.lstat()
        closed = os.access(path, os.F_OK) and not os.access(path, os.R_OK)
    except PermissionError:
        closed = True
    except (OSError, ValueError):
        return False
    if closed:
        raise RequestError(
            f"{path} can't be read: permission denied. A workspace is its owner's alone, and its "
            "group's where its owner has run it with --share group. Ask for that, or choose "
            "another workspace."
        )
    return True


def _what_instead(folder: Path) -> str:
    """What a folder is that is no workspace, and which one to give."""
    if (folder / BATCH).is_file():
        return (
            "it is the folder of a batch. Each of its cases is a workspace: give one, "
            f"-w {quote(str(folder / 'cases'))}/NAME. {folder / 'summary.html'} tells of all."
        )
    return "no run has been started there. Give the folder that 'pipeline run' named, with -w."


def read_request(folder: Path) -> dict[str, Any]:
    """What a workspace was asked for last: images, preset, overrides, stages, from.

    Raises:
        RequestError: it is no workspace, not for this user to read, or what it was asked for is not
            known any more.
    """
    found = None
    try:
        if is_workspace(folder):
            found = read_record(folder / REQUEST, SavedRequest)
    except DamagedError as error:
        raise RequestError(
            f"{folder / REQUEST} is damaged ({error}): what this workspace was made from is not "
            "known any more. What was computed is kept and used again. Name the photographs and "
            f"settings once more: pipeline run PHOTOGRAPHS -w {quote(str(folder))}"
        ) from error
    results = folder / "results"
    if found is None and is_folder(results) and (results / "scene.json").is_file():
        raise RequestError(
            f"{folder} holds results alone, as 'pipeline batch --keep results' leaves a case: what "
            "they were made from is gone. To have it again, run the case once more without --keep "
            f"results (--retry), or by itself: pipeline run PHOTOGRAPHS -w {quote(str(folder))}"
        )
    if found is None:
        raise RequestError(f"{folder} is not a workspace: {_what_instead(folder)}")
    return found.model_dump(by_alias=True)


def make_request(
    images: Sequence[str | Path] | str | Path = (),
    workspace: str | Path | None = None,
    preset: str | Path | None = None,
    overrides: Iterable[str] | Mapping[str, Any] = (),
    stages: Sequence[str] | None = None,
    from_stage: str | None = None,
    *,
    as_before: bool = False,
) -> Request:
    """Complete what the user said with what the workspace remembers (its photographs).

    Args:
        as_before: where no photographs are named, go on with the preset and the overrides of the
            last run; those given now come on top. A preset that is named starts from that.
    """
    given = _each_image(images)
    folder = default_workspace(given) if workspace is None else given_path(workspace, "workspace")
    begun = is_workspace(folder)
    images_named = bool(given)
    taken_over: tuple[str, ...] = ()
    left_out: list[str] = []
    overrides = [anchored(change) for change in each_override(overrides)]
    named_preset = anchored_preset(preset)
    if not given:
        remembered = read_request(folder) if begun else {}
        if as_before and named_preset is None and remembered:
            now = list(overrides)
            named = {change.partition("=")[0].strip() for change in now}
            kept = [c for c in remembered["overrides"] if c.partition("=")[0].strip() not in named]
            kept, left_out = installed_here(kept)
            named_preset, overrides = remembered["preset"], [*kept, *now]
            taken_over = _as_options(named_preset, kept)
        given = remembered.get("images", [])
    return Request(
        workspace=folder,
        images=tuple(os.path.abspath(p) for p in given),  # noqa: PTH100 - keeps glob characters
        preset=named_preset,
        overrides=tuple(overrides),
        stages=each_stage(stages),
        from_stage=from_stage,
        images_named=images_named,
        taken_over=taken_over,
        left_out=tuple(left_out),
    )


def _each_image(images: Sequence[str | Path] | str | Path) -> list[str]:
    """Photographs as the user names them, `~` replaced.

    Raises:
        RequestError: what is given names none.
    """
    alone = isinstance(images, str | bytes | os.PathLike) or not isinstance(images, Iterable)
    listed: list[Any] = [images] if alone else list(images)  # type: ignore[arg-type]
    for image in listed:
        given_path(image, "The name of a photograph or folder")
    return [home_told(image) for image in listed]


def _as_options(preset: str | Path | None, overrides: Iterable[str]) -> tuple[str, ...]:
    """A preset and settings as the command line has them."""
    return (*([f"-c {preset}"] if preset else []), *(f"--set {change}" for change in overrides))


def installed_here(settings: Iterable[str]) -> tuple[list[str], list[str]]:
    """Settings that a workspace remembers: those of stages that are installed, and the others."""
    known = {"run", *RunConfig.model_fields, *stage_names()}
    kept: list[str] = []
    others: list[str] = []
    for change in settings:
        section = change.partition("=")[0].partition(".")[0].strip()
        (kept if section in known else others).append(change)
    return kept, others


def config_of(request: Request) -> Config:
    """The config that a request comes to.

    Raises:
        RequestError: it is wrong; where it is the last run's, that is said.
    """
    try:
        return load_config(request.preset, request.overrides)
    except RequestError as error:
        before = [c.removeprefix("--set ") for c in request.taken_over if c.startswith("--set ")]
        if not request.taken_over or _can_be_read(request.preset, before):
            raise
        raise RequestError(
            f"{request.workspace} was run with {request.typed_before} last, which can't be "
            f"used any more. {error} To start from the defaults instead, add -c dentalsplat."
        ) from error


def _can_be_read(preset: str | None, overrides: Iterable[str]) -> bool:
    try:
        load_config(preset, overrides)
    except RequestError:
        return False
    return True


def still_there(path: str) -> bool:
    """Are there photographs where a request has them? Of a pattern it is not asked."""
    try:
        return any(c in path for c in "*?[") or Path(path).exists()
    except OSError:  # too long a name, a folder of somebody else's
        return False


def default_workspace(images: Sequence[str | Path]) -> Path:
    """``./runs/<name of the input>``; a folder called "images" or "frames" lends its parent's."""
    if not images:
        raise RequestError("Give the photographs (a folder, files or a video), or a workspace: -w.")
    first = Path(images[0])
    single = len(images) == 1
    if single and os.path.isdir(first):  # noqa: PTH112 - of a closed folder, it is told later
        folder = first.resolve()
    elif single and (os.path.exists(first) or not any(c in str(first) for c in "*?[")):  # noqa: PTH110
        return Path("runs") / printable(first.stem)
    else:  # a pattern may begin with the folders
        folder = next(p for p in first.resolve().parents if os.path.isdir(p))  # noqa: PTH112
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
    verify: bool = False,
) -> list[StageStatus]:
    """Tell each stage of a workspace: cached, stale (and why), missing or failed.

    It is compared with what it was last asked for. Given a preset, overrides or stages, it tells
    what a run with them would find.

    Args:
        verify: read every byte of the results, and not only of those that seem to have changed.

    Raises:
        RequestError: there is no such workspace, or the request is wrong.
    """
    stages = each_stage(stages)
    request = make_request(images, workspace, preset, overrides, stages)
    remembered = read_request(request.workspace)
    if not stages:
        stages = remembered["stages"]
        for name in stages or ():
            if name not in stage_names():
                raise RequestError(
                    f"{request.workspace} was run with the stage '{name}' last, which is not "
                    "installed here any more. Install its package again, or say with --stages "
                    "which others to look at."
                )
    kept: list[str] = []
    taken_over: tuple[str, ...] = ()
    if preset is None:
        preset, (kept, _) = remembered["preset"], installed_here(remembered["overrides"])
        taken_over = _as_options(preset, kept)
    images = request.images
    there = [path for path in images if request.images_named or still_there(path)]
    request = make_request(there, request.workspace, preset, [*kept, *request.overrides], stages)
    config = config_of(replace(request, taken_over=taken_over))
    store = Store(request.workspace, verify=verify)
    chain = resolve_chain(config, request.stages, request.from_stage, request.images_named, store)
    found = []
    for plan in plan_chain(chain, config, store, request.images if there else images):
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


def clean(
    workspace: str | Path, *, keep: int = 0, everything: bool = False
) -> tuple[list[str], int]:
    """Delete the results that are not in use, but for the `keep` newest of each stage.

    What a stopped run can go on from stays, unless the last request has no use for it.

    Args:
        everything: delete that too.

    Returns:
        What was deleted (``stage/key``), and the bytes freed.

    Raises:
        RequestError: there is no such workspace.
    """
    folder = given_path(workspace, "workspace")
    if not isinstance(keep, int) or keep < 0:
        raise RequestError(f"keep is a number of results, 0 or more; this is {shown(keep)}.")
    if not is_workspace(folder):
        raise RequestError(
            f"{folder} is not a workspace, so nothing in it was deleted: {_what_instead(folder)}"
        )
    store = Store(folder)
    return store.clean(keep, () if everything else _useful(folder, checkpoints(folder)))


def _useful(folder: Path, found: Iterable[str]) -> list[str]:
    """Those checkpoints that the last request would go on from, or may: all where it can't be
    told what it would compute."""
    names = list(found)
    if not names:
        return []
    try:
        stages = {entry.name: entry for entry in status(workspace=folder)}
    except PipelineError:
        return names
    return [name for name in names if _may_need(stages, name)]


def _may_need(stages: Mapping[str, StageStatus], name: str) -> bool:
    entry = stages.get(name.partition("/")[0])
    if entry is None:
        return False
    return entry.key is None or (entry.resumable and partial_name(entry.key) in name)
