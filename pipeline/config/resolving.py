"""Presets and overrides -> one validated, frozen config per stage.

A preset is a YAML file with a section per stage; `extends:` names the preset that it changes.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping, Sequence, Set
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ConfigDict, Field
from pydantic.fields import FieldInfo

from pipeline.config.validating import LONGEST_NAME, model_in, setting_names, validate
from pipeline.errors import RequestError, did_you_mean, nearest, shown
from pipeline.installed import shipped_configs
from pipeline.measure import usable_cores
from pipeline.stage import StageConfig, get_stage, stage_names, usable_stages
from pipeline.untrusted.paths import names_path, user_path
from pipeline.untrusted.plain_yaml import plain_yaml, read_plain_yaml

DEFAULT_PRESET = "dentalsplat"
#: Parts of a setting's name; presets that extend each other.
_MOST_PARTS, _LONGEST_CHAIN = 8, 20


class RunConfig(BaseModel):
    """What is not the business of one stage alone."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)
    stages: tuple[str, ...] = Field(
        min_length=1, description="the stages of a whole run, in order (the preset says them)"
    )
    seed: int = Field(0, ge=0, lt=2**32, description="all randomness comes from it")
    threads: int = Field(
        0, ge=0, le=1024, json_schema_extra={"affects_result": False},
        description="cores to use; 0: all that the process may use",
    )  # fmt: skip
    report: bool = Field(
        True, json_schema_extra={"affects_result": False},
        description="write report.html into the workspace when a run ends",
    )  # fmt: skip


@dataclass(frozen=True)
class Config:
    """The resolved config of a run: `run` for all stages, `sections` one per registered stage."""

    run: RunConfig
    sections: Mapping[str, StageConfig]

    @property
    def threads(self) -> int:
        return self.run.threads or usable_cores()


def load_config(
    preset: str | Path | None = None,
    overrides: Iterable[str] | Mapping[str, Any] = (),
) -> Config:
    """Resolve a preset and overrides into a validated config.

    Args:
        preset: name of a preset that comes with dentalsplat, or a YAML file; None for the default.
        overrides: ``"sap.quantile=0.99"`` strings, or a mapping ``{"sap.quantile": 0.99}``;
            settings of the run as ``threads=2`` or ``run.threads=2``.

    Raises:
        RequestError: unknown preset, stage or key (with the nearest match), or a value that is not
            allowed.
    """
    tree = _read_preset(preset or DEFAULT_PRESET, seen=())
    pairs = overrides.items() if isinstance(overrides, Mapping) else map(parse_override, overrides)
    for key, value in pairs:
        _set(tree, key, value)
    run_fields = set(RunConfig.model_fields)
    sections = set(stage_names())
    for name in tree:
        if name not in run_fields | sections:
            raise _unknown_section(name, tree[name], run_fields, sections)
    if "stages" not in tree:
        raise RequestError(
            f"The preset {preset} names no stages. Let it begin with 'extends: {DEFAULT_PRESET}', "
            "which it then changes, or give it a list of them: 'stages: [views, init, ...]'."
        )
    run = validate(RunConfig, {k: v for k, v in tree.items() if k in run_fields}, "")
    for name in run.stages:
        if name not in sections:
            get_stage(name)  # raises, naming the nearest
    return Config(
        run=run,
        sections={
            name: validate(stage.Config, tree.get(name) or {}, name)
            for name, stage in usable_stages().items()
        },
    )


def result_fields(config: BaseModel) -> dict[str, Any]:
    """The config fields that can change the result, as JSON values: what enters the key."""
    kept: dict[str, Any] = {}
    dumped = config.model_dump(mode="json")
    for name, field in type(config).model_fields.items():
        extra = field.json_schema_extra
        if isinstance(extra, dict) and extra.get("affects_result") is False:
            continue
        value = getattr(config, name)
        if isinstance(value, str) and names_path(field):  # its content counts, not its place
            kept[name] = "a file"
            continue
        if isinstance(value, BaseModel):
            kept[name] = result_fields(value)
        else:  # a set has another order in every process
            plain = dumped[name]
            kept[name] = sorted(plain, key=repr) if isinstance(value, Set) else plain
    return kept


def presets() -> dict[str, Path]:
    """The presets that come with dentalsplat: name -> file."""
    return {path.stem: path for path in sorted(shipped_configs().glob("*.yaml"))}


def _read_preset(preset: str | Path, seen: tuple[Path, ...]) -> dict[str, Any]:
    path = _find_preset(preset, seen)
    if path in seen:
        chain = " -> ".join(entry.name for entry in (*seen, path))
        raise RequestError(f"The presets extend each other in a circle: {chain}.")
    if len(seen) > _LONGEST_CHAIN:
        raise RequestError(f"More than {_LONGEST_CHAIN} presets extend each other, up to {path}.")
    tree = read_yaml(path, "preset")
    if not isinstance(tree, dict):
        raise RequestError(f"The preset {path} must be a mapping with a section per stage.")
    base = tree.pop("extends", None)
    stages = usable_stages()
    tree |= {  # a section whose lines are all comments says nothing
        n: {} if tree[n] is None else _section(stages[n].Config, tree[n], path.parent)
        for n in tree.keys() & stages.keys()
    }
    if base is None:
        return tree
    return _merge(_read_preset(str(base), (*seen, path)), tree)


def _find_preset(preset: str | Path, seen: tuple[Path, ...]) -> Path:
    known = presets()
    if str(preset) in known:
        return known[str(preset)]
    path = user_path(preset, "the preset")
    if seen and not path.is_absolute():  # a file beside the one that extends it
        path = seen[-1].parent / path
    if path.suffix in (".yaml", ".yml") and path.is_file():
        return path.resolve()
    raise RequestError(
        f"There is no preset {shown(str(preset))}. The presets are {', '.join(known)}; or "
        f"give a YAML file."
        f"{nearest(str(preset), known)}"
    )


def read_yaml(path: Path, what: str) -> Any:
    """The content of a YAML file.

    Args:
        what: what the file is, for the error message.

    Raises:
        RequestError: it can't be read.
    """
    try:
        return read_plain_yaml(path, aliases=True)
    except RequestError as error:
        raise RequestError(f"The {what} can't be read: {error}") from error


def flattened(tree: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """``{"fit": {"iterations": 5}}`` or ``{"fit.iterations": 5}`` -> the latter."""
    flat: dict[str, Any] = {}
    for name, value in tree.items():
        if isinstance(value, Mapping):
            flat |= flattened(value, f"{prefix}{name}.")
        else:
            flat[f"{prefix}{name}"] = value
    return flat


def _merge(base: dict[str, Any], changes: dict[str, Any]) -> dict[str, Any]:
    merged = dict(base)
    for key, value in changes.items():
        both = isinstance(value, dict) and isinstance(merged.get(key), dict)
        merged[key] = _merge(merged[key], value) if both else value
    return merged


def parse_override(text: str) -> tuple[str, Any]:
    key, equals, value = text.partition("=")
    if not equals or not key.strip():
        raise RequestError(
            f"--set takes stage.key=value, as 'pipeline settings' has them; this is {shown(text)}."
        )
    try:
        return key.strip(), plain_yaml(value, "it")
    except RequestError as error:
        raise RequestError(f"The value of --set {shown(text)} can't be read: {error}") from error


def anchored(change: str, begin: str | Path = "") -> str:
    """An override as it holds in every folder: a path in whole, which begins at this one.

    What can't be read stays as it is; `load_config` says what is wrong with it.
    """
    name, _, text = change.partition("=")
    try:
        section, *parts = name.strip().split(".")
        model = get_stage(section).Config
        value = plain_yaml(text, "it")
    except RequestError:
        return change
    if type(value) in (int, float):  # a folder may be called 2024
        value = text.strip()
    field = _field_at(model, parts)
    whole = _whole(field, value, begin) if parts else _section(model, value, begin)
    return change if whole == value else f"{name}={yaml_value(whole)}"


def _whole(field: FieldInfo | None, value: Any, begin: str | Path) -> Any:
    """The value of a setting; where that is a path, all of it."""
    if isinstance(value, dict) and field is not None:
        return _section(model_in(field.annotation), value, begin)
    if field is None or not names_path(field) or not isinstance(value, str):
        return value
    return value if value[:1] in ("", "~") else os.path.abspath(Path(begin, value))  # noqa: PTH100


def _section(model: type[BaseModel] | None, values: Any, begin: str | Path) -> Any:
    """The values of a model, paths in whole."""
    if model is None or not isinstance(values, dict):
        return values
    return {n: _whole(model.model_fields.get(n), value, begin) for n, value in values.items()}


def yaml_value(value: object) -> str:
    """A value as --set has it; paths and what numpy has, also in lists and mappings, as others.

    Raises:
        TypeError: there is something else in it; the message says what.
    """
    import yaml

    text = yaml.safe_dump(_plain(value), default_flow_style=True, width=10**6)
    return text.removesuffix("\n").removesuffix("\n...")


def _plain(value: Any) -> Any:
    """A value without types of libraries."""
    if isinstance(value, Mapping):
        return {_plain(name): _plain(entry) for name, entry in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(entry) for entry in value]
    if isinstance(value, os.PathLike):
        return os.fspath(value)
    if hasattr(value, "tolist"):  # of numpy or torch
        return value.tolist()
    if value is not None and type(value) not in (bool, int, float, str):
        raise TypeError(f"{shown(value)} is a value of a kind that no setting has")
    return value


def _field_at(model: type[BaseModel] | None, parts: Sequence[str]) -> FieldInfo | None:
    field = None
    for part in parts:
        if model is None or part not in model.model_fields:
            return None
        field = model.model_fields[part]
        model = model_in(field.annotation)
    return field


def _set(tree: dict[str, Any], dotted: str, value: Any) -> None:
    *parents, last = dotted.removeprefix("run.").split(".")
    if len(parents) >= _MOST_PARTS or len(dotted) > LONGEST_NAME:
        raise RequestError(
            f"{shown(dotted)} is no setting: none has a name of so many parts or letters. "
            "'pipeline settings' lists all."
        )
    for name in parents:
        child = tree.get(name)
        if not isinstance(child, dict):
            child = {}
        tree[name] = child = dict(child)
        tree = child
    whole = isinstance(value, dict) and isinstance(tree.get(last), dict) and _is_section(dotted)
    tree[last] = _merge(tree[last], value) if whole else value


def _is_section(dotted: str) -> bool:
    """Is it the name of a stage, or of a section in one, and not that of a setting?"""
    name, *parts = dotted.split(".")
    stage = usable_stages().get(name)
    if stage is None or not parts:
        return stage is not None
    field = _field_at(stage.Config, parts)
    return field is not None and model_in(field.annotation) is field.annotation


def _unknown_section(
    name: str, value: Any, run_fields: set[str], sections: set[str]
) -> RequestError:
    """The error of a setting whose first part is no stage."""
    if name.partition(".")[0] in {"run", *sections}:
        return RequestError(
            f"{shown(name)}: a preset has a section for each stage, as in 'fit: {{near: .1}}', "
            "and settings of a run stand by themselves, as in 'seed: 3'."
        )
    known = sorted(run_fields | sections)
    near = nearest(name, known)
    if not near:  # the stage left out, as in --set iterations=500
        dotted = f"{name}.{next(iter(value))}" if isinstance(value, dict) and value else name
        names = [
            entry
            for stage, usable in usable_stages().items()
            for entry in setting_names(usable.Config, stage)
        ]
        near = did_you_mean(dotted, names)
    return RequestError(
        f"{shown(name)} is neither a stage nor a setting of a run; known are "
        f"{', '.join(known)}.{near}"
    )
