"""What a stage is, and the registry that finds the installed ones."""

from __future__ import annotations

import contextlib
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

from pydantic import BaseModel, ConfigDict, Field

from pipeline.artifacts import GROUP as ARTIFACTS
from pipeline.artifacts import KINDS, Artifact, artifact_class, kinds
from pipeline.errors import RequestError, nearest, shown
from pipeline.measure import usable_cores
from pipeline.plugins import Entries, check_name, load, registered

if TYPE_CHECKING:
    from pipeline.pages.case import Case
    from pipeline.pages.parts import Part

#: Entry points of this group are the stages.
GROUP = "dentalsplat.stages"
#: Names that mean something else in a preset or in a workspace.
TAKEN = ("compare", "extends", "report", "results", "run", "seed", "stages", "threads")

#: Name of a part of the page about a run -> what draws it.
Parts = Mapping[str, "Callable[[Case], Iterable[Part]]"]


class StageConfig(BaseModel):
    """Base of every stage's config: frozen, and unknown keys are refused."""

    model_config = ConfigDict(
        frozen=True, extra="forbid", validate_default=True, allow_inf_nan=False,
        coerce_numbers_to_str=True,  # a photograph may be called 1
    )  # fmt: skip


def runtime(default: Any, **constraints: Any) -> Any:
    """A config field that can't change the result (logging, preview intervals): not in the key."""
    return Field(default, json_schema_extra={"affects_result": False}, **constraints)


class StageContext(ABC):
    """What a running stage may touch: its config, its inputs, its outputs, and the user's screen.

    Attributes:
        config: the stage's validated config.
        seed: the one seed that all randomness comes from.
        threads: how many threads to use; never changes the result.
        scratch: a folder that survives a kill and is given again to the next run with the same key
            (checkpoints); deleted when the stage commits.
        sources: what `Stage.sources` named: label -> file.
    """

    config: Any
    seed: int
    threads: int
    scratch: Path
    sources: Mapping[str, Path]

    @abstractmethod
    def has(self, kind: str) -> bool:
        """Is there an input artifact of this kind? Always true for what the stage requires."""

    @abstractmethod
    def load(self, kind: str) -> Any:
        """Load the input artifact of a kind."""

    @abstractmethod
    def output(self, kind: str) -> Path:
        """The empty folder that will be the artifact `kind`, for stages that write the files."""

    def save(self, artifact: Artifact) -> None:
        """Write an output artifact."""
        artifact.save(self.output(artifact.kind))

    @abstractmethod
    def progress(self, step: str, done: int, total: int, **figures: float | int | str) -> None:
        """Tell how far the stage is: `done` of `total` in `step`, with figures such as the loss."""

    @abstractmethod
    def warn(self, message: str) -> None:
        """Tell the user something, now and in the manifest and the summary."""

    @abstractmethod
    def summarize(self, **figures: float | int | str) -> None:
        """Record figures for the run's summary and the manifest (counts, errors; no timings)."""


@dataclass
class Finding:
    """One thing that was checked.

    Attributes:
        level: ``ok``, ``note`` (works, but could be better) or ``problem`` (a run would fail).
        mend: what to do about it, where there is something to do.
    """

    name: str
    level: str
    detail: str
    mend: str = ""


class Stage(ABC):
    """One step of the pipeline: artifacts in, artifacts out.

    A subclass is the thin entry of a stage: it reads config and artifacts and calls plain
    functions. It must import fast; heavy libraries are imported inside `run`.

    Attributes:
        name: as on the command line and in the config.
        version: raised whenever the same config and input give another result.
        summary: one line for ``pipeline stages``.
        Config: the stage's config model.
        requires: artifact kinds it can't do without.
        optional: kinds it uses where an earlier stage provides them.
        provides: kinds it writes.
        may_provide: kinds that it writes only for some input.
        libraries: distributions whose versions can change the result, so that they enter the key.
        methods: value of the config field `method` -> one line about it, where there is a choice.
        uses_sources: True for a stage that reads the photographs (they are part of its key).
        rehearsals: functions, as ``module:name``, that run the stage's numba kernels on something
            tiny to have them compiled; called side by side, in processes of their own.
        prepares: True for a quick stage that only says more of the photographs: it runs whenever
            they are named, even where the stages named leave it out.
        thrift: what a user can do where memory runs out, in a sentence.
    """

    name: ClassVar[str]
    version: ClassVar[int]
    summary: ClassVar[str]
    Config: ClassVar[type[StageConfig]]
    requires: ClassVar[tuple[str, ...]] = ()
    optional: ClassVar[tuple[str, ...]] = ()
    provides: ClassVar[tuple[str, ...]] = ()
    may_provide: ClassVar[tuple[str, ...]] = ()
    libraries: ClassVar[tuple[str, ...]] = ()
    methods: ClassVar[Mapping[str, str]] = {}
    uses_sources: ClassVar[bool] = False
    rehearsals: ClassVar[tuple[str, ...]] = ()
    prepares: ClassVar[bool] = False
    thrift: ClassVar[str] = ""

    def sources(self, config: Any, request: Mapping[str, Any]) -> Mapping[str, Path]:
        """Name the user's files that the stage will read: their content enters its key.

        Args:
            config: the stage's validated config.
            request: what the user asked for (`images`: list of paths; `workspace`: its folder,
                which may hold files of the user's), and `tell`, where somebody hears it:
                called with what is to be said about that before anything runs.

        Returns:
            A stable label for each file (no folders: a moved case is the same case) -> its path.
        """
        return {}

    def findings(self) -> Iterable[Finding]:
        """What `pipeline doctor` should say of this stage: optional parts that are there or not."""
        return ()

    def report(self) -> Parts:
        """What the page about a run says of this stage (`pipeline.pages.parts`).

        Each part is drawn by itself, so that a damaged file costs no other. What draws them lies in
        a module of its own, imported here.
        """
        return {}

    def backend(self, config: Any) -> str:
        """Which of several ways to the result this machine takes, where results differ by it.

        It enters the key: what ``auto`` comes to is not said by the config.
        """
        return ""

    @abstractmethod
    def run(self, context: StageContext) -> None:
        """Do the work.

        Raises:
            RequestError: the input or a config value can't be used (exit status 2).
            ReconstructionError: the data can't be reconstructed (exit status 3).
        """


@dataclass
class LocalContext(StageContext):
    """A context without a store: runs one stage on artifacts in memory (scripts and tests)."""

    config: Any
    folder: Path
    inputs: Mapping[str, Artifact] = field(default_factory=dict)
    sources: Mapping[str, Path] = field(default_factory=dict)
    seed: int = 0
    threads: int = field(default_factory=usable_cores)
    figures: dict[str, Any] = field(default_factory=dict)
    warnings: list[str] = field(default_factory=list)
    on_progress: Callable[..., None] | None = None

    def __post_init__(self) -> None:
        self.scratch = self.folder / "scratch"
        self.scratch.mkdir(parents=True, exist_ok=True)

    def has(self, kind: str) -> bool:
        return kind in self.inputs

    def load(self, kind: str) -> Any:
        return self.inputs[kind]

    def output(self, kind: str) -> Path:
        path = self.folder / kind
        path.mkdir(parents=True, exist_ok=True)
        return path

    def progress(self, step: str, done: int, total: int, **figures: float | int | str) -> None:
        if self.on_progress:
            self.on_progress(step, done, total, **figures)

    def warn(self, message: str) -> None:
        self.warnings.append(message)

    def summarize(self, **figures: float | int | str) -> None:
        self.figures.update(figures)

    def result(self, kind: str) -> Any:
        """Load an artifact that the stage wrote."""
        return artifact_class(kind).load(self.folder / kind)


def _entry_points() -> Entries:
    return registered(GROUP)


def stage_names() -> list[str]:
    """Names of the registered stages (entry points of the group `dentalsplat.stages`)."""
    return sorted(_entry_points())


def usable_stages() -> dict[str, Stage]:
    """The registered stages that can be imported; a broken one only harms who asks for it."""
    found = {}
    for name in stage_names():
        with contextlib.suppress(RequestError):
            found[name] = get_stage(name)
    return found


@cache
def get_stage(name: str) -> Stage:
    """Return the registered stage of a name.

    Raises:
        RequestError: there is none, two packages register it, or it can't be used.
    """
    found = _entry_points()
    if not found:
        raise RequestError(
            "No stages are registered: dentalsplat is not installed in this Python environment. "
            "Install it with 'pip install .' in its folder."
        )
    if name not in found:
        known = ", ".join(sorted(found))
        raise RequestError(
            f"Unknown stage {shown(name)}. The stages are {known}.{nearest(name, found)}"
        )
    stage: type[Stage]
    stage, where = load(f"stage '{name}'", found[name], Stage)
    _check(stage, name, where)
    try:
        return stage()
    except Exception as error:
        raise RequestError(
            f"{where} can't be made: {type(error).__name__}: {error}. A stage is made without "
            "arguments, and does nothing yet."
        ) from error


def _check(stage: type[Stage], name: str, where: str) -> None:
    """Does a stage say of itself all that the engine asks?

    Raises:
        RequestError: it does not; `where` begins the message.
    """
    check_name(where, "name", getattr(stage, "name", None), name, TAKEN)
    asked = {"version": (int, "a whole number"), "summary": (str, "one line of text")}
    for attribute, (kind, told) in asked.items():
        if not isinstance(getattr(stage, attribute, None), kind):
            raise RequestError(f"{where} has no {attribute}. Set it to {told} in the class.")
    config = getattr(stage, "Config", None)
    if not (isinstance(config, type) and issubclass(config, StageConfig)):
        raise RequestError(
            f"{where} has no Config. Set it to its settings, a class derived from "
            "pipeline.stage.StageConfig."
        )
    for setting, field_info in config.model_fields.items():
        if field_info.is_required():
            raise RequestError(
                f"{where} has the setting '{setting}' without a default. Give it one: runs without "
                "this stage have settings for it too."
            )
    known = kinds()
    for attribute in ("requires", "optional", "provides", "may_provide"):
        named = getattr(stage, attribute)
        if isinstance(named, str) or not all(isinstance(kind, str) for kind in named):
            raise RequestError(
                f"{where} has {attribute} = {named!r}. Set it to a tuple of kinds of artifact."
            )
        for kind in named:
            if kind not in known:
                raise RequestError(
                    f"{where} names '{kind}' in {attribute}, a kind of artifact that nobody "
                    f"registered; the kinds are {', '.join(known)}.{nearest(kind, known)} Register "
                    f"its class under that name in the entry points of '{ARTIFACTS}'."
                )
            if kind not in KINDS or len(known[kind]) > 1:
                artifact_class(kind)  # one that can't be used is said before any work is done
