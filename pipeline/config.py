"""Presets and overrides -> one validated, frozen config per stage.

A preset is a YAML file with a section per stage; `extends:` names the preset that it changes.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar, get_args

from pydantic import BaseModel, ConfigDict, Field, ValidationError
from pydantic.fields import FieldInfo

from pipeline.errors import RequestError, did_you_mean, nearest, shown
from pipeline.installed import shipped_configs
from pipeline.measure import usable_cores
from pipeline.stage import StageConfig, get_stage, stage_names, usable_stages
from pipeline.untrusted.paths import names_path, user_path
from pipeline.untrusted.plain_yaml import plain_yaml, read_plain_yaml

DEFAULT_PRESET = "dentalsplat"
#: Parts and letters of a setting's name; presets that extend each other; faults that are explained.
_MOST_PARTS, _LONGEST_NAME, _LONGEST_CHAIN, _MOST_FAULTS = 8, 200, 20, 5
#: pydantic's names of what a value may be, in the place of a fault
_ALTERNATIVE = re.compile(
    r"((literal|tuple)\[.*\]|constrained-\w+|function-.*|int|float|bool|str|none)$"
)
#: pydantic's name of a fault -> what a value may be, where its own words are Python's
_MAY_BE = {
    "tuple_type": "a list, as in [a, b]", "list_type": "a list, as in [a, b]",
    "dict_type": "entries, as in {a: b}", "model_type": "a section, as in {name: value}",
    "path_type": "a path", "string_type": "text", "bool_type": "true or false",
    "bool_parsing": "true or false", "int_type": "a whole number", "int_parsing": "a whole number",
    "int_from_float": "a whole number", "float_type": "a number", "float_parsing": "a number",
}  # fmt: skip

Model = TypeVar("Model", bound=BaseModel)


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
    for name, field in type(config).model_fields.items():
        extra = field.json_schema_extra
        if isinstance(extra, dict) and extra.get("affects_result") is False:
            continue
        value = getattr(config, name)
        if isinstance(value, str) and names_path(field):  # its content counts, not its place
            kept[name] = "a file"
            continue
        is_model = isinstance(value, BaseModel)
        kept[name] = result_fields(value) if is_model else config.model_dump(mode="json")[name]
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
    tree |= {
        n: _section(stages[n].Config, tree[n], path.parent) for n in tree.keys() & stages.keys()
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
        field = _field_at(get_stage(section).Config, parts)
        value = plain_yaml(text, "it")
    except RequestError:
        return change
    if type(value) in (int, float):  # a folder may be called 2024
        value = text.strip()
    whole = _whole(field, value, begin)
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


def yaml_value(value: Any) -> str:
    """A value as --set has it, also that of a path or of numpy."""
    import yaml

    if isinstance(value, os.PathLike):
        value = os.fspath(value)
    elif hasattr(value, "item"):
        value = value.item()
    text = yaml.safe_dump(value, default_flow_style=True, width=10**6)
    return text.removesuffix("\n").removesuffix("\n...")


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
    if len(parents) >= _MOST_PARTS or len(dotted) > _LONGEST_NAME:
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
    tree[last] = value


def validate(model: type[Model], values: Any, section: str) -> Model:
    """Values as read from YAML -> a model.

    Args:
        section: where the values stand, for the error message.

    Raises:
        RequestError: with a sentence per wrong field, and the nearest match of an unknown one.
    """
    if not isinstance(values, dict):
        raise RequestError(f"The section '{section}' must hold key: value pairs.")
    try:
        read = model.model_validate(values)
    except ValidationError as error:
        faults = _one_each(error.errors())
        said = [_explain(model, section, fault) for fault in faults[:_MOST_FAULTS]]
        more = len(faults) - len(said)
        said += [f"{more} more settings are wrong."] if more else []
        raise RequestError(" ".join(said)) from None
    for dotted, value in _whole_numbers(read, section):
        if abs(value) >= 2**63:
            raise RequestError(f"{dotted}={shown(value)} is not allowed: no count is so large.")
    for dotted in _truths_as_numbers(values, read, section):
        raise RequestError(f"{dotted} is not allowed: it is a number.")
    return read


def _truths_as_numbers(given: Any, read: Any, dotted: str) -> Iterator[str]:
    """Dotted name and value of each true or false that was taken for 1 or 0."""
    if isinstance(given, bool) and type(read) in (int, float):
        yield f"{dotted}={str(given).lower()}"
    elif isinstance(given, dict) and isinstance(read, BaseModel):
        for name, value in given.items():
            inner = ".".join(filter(None, (dotted, name)))
            yield from _truths_as_numbers(value, getattr(read, name, None), inner)
    elif isinstance(given, list | tuple) and isinstance(read, list | tuple):
        for entries in zip(given, read, strict=False):
            yield from _truths_as_numbers(*entries, dotted)


def _whole_numbers(value: Any, dotted: str) -> Iterator[tuple[str, int]]:
    """Dotted name and value of each whole number in a model."""
    if isinstance(value, int):
        yield dotted, value
    elif isinstance(value, list | tuple):
        for entry in value:
            yield from _whole_numbers(entry, dotted)
    elif isinstance(value, dict | BaseModel):
        for name, entry in value.items() if isinstance(value, dict) else value:
            yield from _whole_numbers(entry, f"{dotted}.{name}" if dotted else str(name))


def _unknown_section(
    name: str, value: Any, run_fields: set[str], sections: set[str]
) -> RequestError:
    """The error of a setting whose first part is no stage."""
    known = sorted(run_fields | sections)
    near = nearest(name, known)
    if not near:  # the stage left out, as in --set iterations=500
        dotted = f"{name}.{next(iter(value))}" if isinstance(value, dict) and value else name
        names = [
            entry
            for stage, usable in usable_stages().items()
            for entry in _setting_names(usable.Config, stage)
        ]
        near = did_you_mean(dotted, names)
    return RequestError(
        f"{shown(name)} is neither a stage nor a setting of a run; known are "
        f"{', '.join(known)}.{near}"
    )


def _one_each(faults: Sequence[Any]) -> list[Any]:
    """What is wrong with a value that may be one thing or another, said of both at once.

    Of a list with a wrong entry it is not said that it might have been something else.
    """
    found: dict[tuple[Any, ...], Any] = {}
    for fault in faults:
        place = tuple(part for part in fault["loc"] if not _ALTERNATIVE.match(str(part)))
        other = _MAY_BE.get(fault["type"], str(fault["msg"]).removeprefix("Input should be "))
        said = f"Input should be {other}" if fault["type"] in _MAY_BE else fault["msg"]
        first = found.setdefault(place, {**fault, "loc": place, "msg": said})
        if other not in first["msg"]:
            first["msg"] = f"{first['msg']}, or {other}"
    wholes = {place[:n] for place in found for n in range(len(place))}
    return [fault for place, fault in found.items() if place not in wholes]


def _explain(model: type[BaseModel], section: str, error: Any) -> str:
    """Say in one sentence which field is wrong, what is allowed, and what it is for."""
    location = [
        str(part) if len(str(part)) <= _LONGEST_NAME else shown(part) for part in error["loc"]
    ]
    why = error["msg"].removeprefix("Value error, ").replace("Tuple should", "List should")
    if error["type"] == "missing" and location[-1].isdigit():
        location, why = location[:-1], "There are too few values"
    dotted = ".".join(filter(None, [section, *location]))
    if error["type"] == "extra_forbidden":
        if section not in stage_names():  # a suite, say: few enough to name them all
            fields = _fields_at(model, location[:-1])
            return (
                f"'{dotted}' is not a setting.{nearest(location[-1], fields)} The settings are "
                f"{', '.join(fields)}."
            )
        names = list(_setting_names(model, section))
        return (
            f"'{dotted}' is not a setting.{did_you_mean(dotted, names)} 'pipeline settings "
            f"{section}' lists all {len(names)} with their meaning."
        )
    about = _description(model, location)
    return (
        f"{dotted}={shown(error.get('input'))} is not allowed: {why}."
        f"{f' It means: {about}' if about else ''}"
    )


def _fields_at(model: type[BaseModel], location: list[str]) -> list[str]:
    inner: type[BaseModel] | None = model
    for part in location:
        if part.isdigit():  # an entry of a list
            continue
        if inner is None or part not in inner.model_fields:
            return []
        inner = model_in(inner.model_fields[part].annotation)
    return list(inner.model_fields) if inner else []


def _description(model: type[BaseModel], location: list[str]) -> str | None:
    """What the innermost field at a location is for."""
    about = None
    inner: type[BaseModel] | None = model
    for part in location:
        if part.isdigit():  # an entry of a list
            continue
        if inner is None or part not in inner.model_fields:
            break
        about = inner.model_fields[part].description
        inner = model_in(inner.model_fields[part].annotation)
    return about


def _setting_names(model: type[BaseModel], prefix: str) -> Iterator[str]:
    """Dotted names of a model's settings and of those of the models in it."""
    for name, field in model.model_fields.items():
        inner = model_in(field.annotation)
        if inner is None or inner is not field.annotation:
            yield f"{prefix}.{name}"
        if inner is not None:
            yield from _setting_names(inner, f"{prefix}.{name}")


def model_in(annotation: Any) -> type[BaseModel] | None:
    """The model that a field holds, directly, optionally or as a list of it."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation
    return next(filter(None, map(model_in, get_args(annotation))), None)
