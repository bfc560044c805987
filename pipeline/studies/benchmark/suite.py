"""What a benchmark measures: a YAML file of scenes, methods and tables, validated."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, field_validator

from pipeline.config import DEFAULT_PRESET, read_yaml, validate
from pipeline.errors import RequestError, nearest, shown
from pipeline.installed import shipped_configs
from pipeline.studies.benchmark.paper import ROWS
from pipeline.untrusted.paths import user_path

#: Names become names of folders and files.
Name = Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]*$", max_length=60)]

#: View counts of the paper's tables 1 and 3.
VIEW_COUNTS = {"views": (3, 6, 9, 12), "photos": (), "ablations": (6,)}


class SuiteModel(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class Scene(SuiteModel):
    """Photographs of one scene, and what is known about it. Paths are relative to the data."""

    name: Name = Field(description="what the tables call it")
    images: tuple[str, ...] = Field(
        min_length=1, description="folder, glob pattern or files: its photographs"
    )
    ground_truth: str | None = Field(
        None, description="transforms.json or COLMAP model with the cameras of the photographs"
    )
    masks: str | None = Field(None, description="folder of masks of the teeth, for scoring")
    mesh: str | None = Field(None, description="true surface, .ply, in the frame of ground_truth")
    overrides: dict[str, Any] = Field({}, description="settings for this scene, stage.key: value")

    @field_validator("images", mode="before")
    @classmethod
    def _one_or_more(cls, value: object) -> object:
        return (value,) if isinstance(value, str) else value


class Method(SuiteModel):
    """A preset, perhaps with changes."""

    name: Name = Field(description="what the files call it")
    preset: str = Field(DEFAULT_PRESET, description="name of a preset, or a YAML file")
    title: str = Field("", description="what the tables call it; its name, where not given")
    paper: str | None = Field(
        None, description="the row of the paper's tables whose figures stand beside it"
    )
    overrides: dict[str, Any] = Field({}, description="settings for this method, stage.key: value")
    note: str = Field("", description="what a reader must know about it")


class TableSpec(SuiteModel):
    """One table: which methods on which photographs."""

    name: Name = Field(description="what the files call it")
    form: Literal["views", "photos", "ablations"] = Field(
        description="as the paper's table 1 (views x methods), 2 (three photographs) or 3"
    )
    title: str = Field("", description="its heading")
    note: str = Field("", description="what a reader must know about it")
    protocol: Literal["video24", "test_every", "all"] | None = Field(
        None,
        description="which photographs are input: of 24 frames as in the paper; all but every n-th "
        "(test_every); or all, and the input itself is scored. Default: all for photos, else "
        "video24",
    )
    test_every: int = Field(
        2, ge=2, le=100, description="protocol test_every: each so manieth is held out"
    )
    views: tuple[Annotated[int, Field(ge=2, le=1000)], ...] | None = Field(
        None, description="numbers of input views; default: the paper's"
    )
    methods: tuple[str, ...] | None = Field(None, description="names; default: all")
    scenes: tuple[str, ...] | None = Field(None, description="names; default: all")
    known_cameras: bool = Field(
        False, description="give every method the true cameras of the input, and keep them"
    )
    ours: str | None = Field(
        None, description="the method that should win, for the conclusions; default: the first"
    )

    @property
    def split(self) -> str:
        """The protocol, with the paper's as default."""
        return self.protocol or ("all" if self.form == "photos" else "video24")

    @property
    def view_counts(self) -> tuple[int | None, ...]:
        """Numbers of input views; None stands for all photographs."""
        if self.split == "all":
            return (None,)
        return self.views if self.views is not None else VIEW_COUNTS[self.form]


class Suite(SuiteModel):
    """Everything that a benchmark measures."""

    title: str = Field(description="its heading")
    note: str = Field("", description="what a reader must know about the data")
    data: str | None = Field(
        None, description="where the scenes' paths begin, relative to this file; --data overrides"
    )
    scenes: tuple[Scene, ...] = Field(min_length=1)
    methods: tuple[Method, ...] = Field(min_length=1)
    tables: tuple[TableSpec, ...] = Field(min_length=1)
    seeds: tuple[Annotated[int, Field(ge=0, lt=2**32)], ...] = Field((0,), min_length=1)
    overrides: dict[str, Any] = Field({}, description="settings for all cells, stage.key: value")

    def scene(self, name: str) -> Scene:
        return next(scene for scene in self.scenes if scene.name == name)

    def method(self, name: str) -> Method:
        return next(method for method in self.methods if method.name == name)


@dataclass(frozen=True)
class LoadedSuite:
    """A suite with paths that hold on this machine.

    Attributes:
        path: the file that it was read from.
        suite: as read, with paths relative to the data.
        data: the folder where the scenes' paths begin.
    """

    path: Path
    suite: Suite
    data: Path

    def file(self, path: str) -> Path:
        """A path of a scene as an absolute one. It may hold the characters of a pattern."""
        return Path(self.data, user_path(path, f"the suite {self.path.name}"))

    def images(self, scene: Scene) -> list[Path]:
        """What a scene names as its photographs, absolute: folders, files or patterns."""
        return [self.file(path) for path in scene.images]

    def preset(self, method: Method) -> str:
        """A preset's name, or its YAML file, looked for beside the suite."""
        beside = self.path.parent / user_path(method.preset, "the preset")
        is_file = beside.suffix in (".yaml", ".yml") and beside.is_file()
        return str(beside) if is_file else method.preset


def suites() -> dict[str, Path]:
    """The suites that come with dentalsplat: name -> file."""
    return {path.stem: path for path in sorted(shipped_configs().glob("suites/*.yaml"))}


def load_suite(suite: str | Path, data: str | Path | None = None) -> LoadedSuite:
    """Read and check a suite.

    Args:
        suite: name of one that comes with dentalsplat, or a YAML file.
        data: folder where the scenes' paths begin, instead of the one that the suite names.

    Raises:
        RequestError: there is no such suite, it has an unknown or wrong entry, a table names a
            scene or a method that there isn't, or the data are missing.
    """
    path = _find_suite(suite)
    tree = read_yaml(path, "suite")
    if not isinstance(tree, dict):
        raise RequestError(f"The suite {path} must be a mapping with scenes, methods and tables.")
    try:
        read = validate(Suite, tree, "")
    except RequestError as error:
        raise RequestError(f"The suite {path} can't be used: {error}") from None
    _check_names(path, read)
    root = Path(data) if data is not None else path.parent / (read.data or "")
    loaded = LoadedSuite(path, read, root.resolve())
    _check_data(loaded, given=data is not None)
    return loaded


def _find_suite(suite: str | Path) -> Path:
    known = suites()
    path = user_path(suite, "the suite")
    if path.suffix in (".yaml", ".yml") and path.is_file():
        return path.resolve()
    if str(suite) in known:
        return known[str(suite)]
    raise RequestError(
        f"There is no suite {shown(str(suite))}. The suites are {', '.join(known)}; or "
        f"give a YAML file."
        f"{nearest(path.stem, known)}"
    )


def _check_names(path: Path, suite: Suite) -> None:
    scenes = [scene.name for scene in suite.scenes]
    methods = [method.name for method in suite.methods]
    tables = [table.name for table in suite.tables]
    for what, names in (("scenes", scenes), ("methods", methods), ("tables", tables)):
        twice = [name for name, count in Counter(names).items() if count > 1]
        if twice:
            raise RequestError(f"The suite {path} has two {what} called '{twice[0]}'.")
    for method in suite.methods:
        _check_known(
            f"The method '{method.name}' of the suite {path}",
            "row of the paper's tables", [method.paper] if method.paper else [], ROWS,
        )  # fmt: skip
    for table in suite.tables:
        where = f"The table '{table.name}' of the suite {path}"
        _check_known(where, "scene", table.scenes or (), scenes)
        _check_known(where, "method", table.methods or (), methods)
        _check_known(where, "method", [table.ours] if table.ours else [], table.methods or methods)
        if table.split == "all" and table.views is not None:
            raise RequestError(
                f"{where} takes all photographs as input (protocol: all), so that it can't have "
                "numbers of views too. Leave `views` out, or choose the protocol test_every."
            )
        if not table.view_counts:
            raise RequestError(
                f"{where} has no numbers of views, so that it measures nothing. Say them, as in "
                "views: [3]."
            )
        if table.known_cameras:
            blind = [n for n in table.scenes or scenes if suite.scene(n).ground_truth is None]
            if blind:
                raise RequestError(
                    f"{where} uses known cameras, but the scene '{blind[0]}' has no ground_truth."
                )


def _check_known(where: str, what: str, names: Iterable[str], known: Sequence[str]) -> None:
    for name in names:
        if name not in known:
            raise RequestError(
                f"{where} names the {what} '{name}', which there isn't; known are "
                f"{', '.join(known)}.{nearest(name, known)}"
            )


def _check_data(loaded: LoadedSuite, given: bool) -> None:
    """Say what is missing before anything runs."""
    advice = (
        "Check the folder given with --data."
        if given
        else "Say with --data where the suite's data are."
    )
    for scene in loaded.suite.scenes:
        wanted = [("images", path) for path in scene.images]
        wanted += [(name, getattr(scene, name)) for name in ("ground_truth", "masks", "mesh")]
        for field, path in wanted:
            if path is None or any(character in path for character in "*?["):
                continue
            if not loaded.file(path).exists():
                raise RequestError(
                    f"The scene '{scene.name}' of the suite {loaded.path.name} needs {field} "
                    f"{loaded.file(path)}, which is not there. {advice}"
                )
