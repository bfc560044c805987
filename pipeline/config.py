"""Presets and overrides -> one validated, frozen config per stage.

A preset is a YAML file with a section per stage; `extends:` names the preset that it changes.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import Any, TypeVar

import yaml
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from pipeline.errors import RequestError, nearest
from pipeline.stage import StageConfig, get_stage, stage_names, usable_stages

DEFAULT_PRESET = "dentalsplat"

Model = TypeVar("Model", bound=BaseModel)


class RunConfig(BaseModel):
    """What is not the business of one stage alone.

    Attributes:
        stages: the stages of a whole run, in order.
        seed: all randomness comes from it.
        threads: 0 means all cores that the process may use. Never changes the result.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")
    stages: tuple[str, ...] = Field(min_length=1)
    seed: int = Field(0, ge=0, lt=2**32)
    threads: int = Field(0, ge=0, le=1024)


@dataclass(frozen=True)
class Config:
    """The resolved config of a run: `run` for all stages, `sections` one per registered stage."""

    run: RunConfig
    sections: Mapping[str, StageConfig]

    @property
    def threads(self) -> int:
        return self.run.threads or len(os.sched_getaffinity(0))


def load_config(
    preset: str | Path | None = None,
    overrides: Iterable[str] | Mapping[str, Any] = (),
) -> Config:
    """Resolve a preset and overrides into a validated config.

    Args:
        preset: name of a preset that comes with dentalsplat, or a YAML file; None for the default.
        overrides: ``"sap.quantile=0.99"`` strings, or a mapping ``{"sap.quantile": 0.99}``.

    Raises:
        RequestError: unknown preset, stage or key (with the nearest match), or a value that is not
            allowed.
    """
    tree = _read_preset(preset or DEFAULT_PRESET, seen=())
    pairs = overrides.items() if isinstance(overrides, Mapping) else map(_parse_override, overrides)
    for key, value in pairs:
        _set(tree, key, value)
    run_fields = set(RunConfig.model_fields)
    sections = set(stage_names())
    for name in tree:
        if name not in run_fields | sections:
            known = sorted(run_fields | sections)
            raise RequestError(
                f"'{name}' is neither a stage nor a setting of a run; known are "
                f"{', '.join(known)}.{nearest(name, known)}"
            )
    run = _validate(RunConfig, {k: v for k, v in tree.items() if k in run_fields}, "")
    for name in run.stages:
        if name not in sections:
            get_stage(name)  # raises, naming the nearest
    return Config(
        run=run,
        sections={
            name: _validate(stage.Config, tree.get(name) or {}, name)
            for name, stage in usable_stages().items()
        },
    )


def result_fields(config: BaseModel) -> dict[str, Any]:
    """The config fields that can change the result, as JSON values: what enters the key."""
    kept = {}
    for name, field in type(config).model_fields.items():
        extra = field.json_schema_extra
        if isinstance(extra, dict) and extra.get("affects_result") is False:
            continue
        value = getattr(config, name)
        is_model = isinstance(value, BaseModel)
        kept[name] = result_fields(value) if is_model else config.model_dump(mode="json")[name]
    return kept


def presets() -> dict[str, Path]:
    """The presets that come with dentalsplat: name -> file."""
    beside = Path(__file__).resolve().parents[1] / "configs"
    folder = beside if beside.is_dir() else Path(str(files("pipeline.presets")))
    return {path.stem: path for path in sorted(folder.glob("*.yaml"))}


def _read_preset(preset: str | Path, seen: tuple[Path, ...]) -> dict[str, Any]:
    path = _find_preset(preset, seen)
    if path in seen:
        chain = " -> ".join(entry.name for entry in (*seen, path))
        raise RequestError(f"The presets extend each other in a circle: {chain}.")
    try:
        tree = _yaml(path.read_text())
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        raise RequestError(f"The preset {path} can't be read: {error}") from error
    if not isinstance(tree, dict):
        raise RequestError(f"The preset {path} must be a mapping with a section per stage.")
    base = tree.pop("extends", None)
    if base is None:
        return tree
    return _merge(_read_preset(str(base), (*seen, path)), tree)


def _find_preset(preset: str | Path, seen: tuple[Path, ...]) -> Path:
    known = presets()
    if str(preset) in known:
        return known[str(preset)]
    path = Path(preset)
    if seen and not path.is_absolute():  # a file beside the one that extends it
        path = seen[-1].parent / path
    if path.suffix in (".yaml", ".yml") and path.is_file():
        return path.resolve()
    raise RequestError(
        f"There is no preset '{preset}'. The presets are {', '.join(known)}; or give a YAML file."
        f"{nearest(str(preset), known)}"
    )


class _YamlLoader(yaml.SafeLoader):
    """YAML 1.2 booleans: ``on`` and ``off`` are words (several settings have them as values)."""


_YamlLoader.yaml_implicit_resolvers = {
    first: [(tag, pattern) for tag, pattern in rules if tag != "tag:yaml.org,2002:bool"]
    for first, rules in yaml.SafeLoader.yaml_implicit_resolvers.items()
}
_YamlLoader.add_implicit_resolver(
    "tag:yaml.org,2002:bool", re.compile(r"^(?:true|True|TRUE|false|False|FALSE)$"), list("tTfF")
)


def _yaml(text: str) -> Any:
    return yaml.load(text, _YamlLoader)  # a SafeLoader


def _merge(base: dict[str, Any], changes: dict[str, Any]) -> dict[str, Any]:
    merged = dict(base)
    for key, value in changes.items():
        both = isinstance(value, dict) and isinstance(merged.get(key), dict)
        merged[key] = _merge(merged[key], value) if both else value
    return merged


def _parse_override(text: str) -> tuple[str, Any]:
    key, equals, value = text.partition("=")
    if not equals or not key.strip():
        raise RequestError(
            f"--set takes stage.key=value, as in --set sap.quantile=0.99; this is '{text}'."
        )
    try:
        return key.strip(), _yaml(value)
    except yaml.YAMLError as error:
        raise RequestError(f"The value of --set {text} can't be read: {error}") from error


def _set(tree: dict[str, Any], dotted: str, value: Any) -> None:
    *parents, last = dotted.split(".")
    for name in parents:
        child = tree.get(name)
        if not isinstance(child, dict):
            child = {}
        tree[name] = child = dict(child)
        tree = child
    tree[last] = value


def _validate(model: type[Model], values: Any, section: str) -> Model:
    if not isinstance(values, dict):
        raise RequestError(f"The section '{section}' must hold key: value pairs.")
    try:
        return model.model_validate(values)
    except ValidationError as error:
        raise RequestError(" ".join(_explain(model, section, e) for e in error.errors())) from None


def _explain(model: type[BaseModel], section: str, error: Any) -> str:
    """Say in one sentence which field is wrong, what is allowed, and what it is for."""
    location = [str(part) for part in error["loc"] if not str(part).startswith("function-")]
    dotted = ".".join(filter(None, [section, *location]))
    if error["type"] == "extra_forbidden":
        fields = _fields_at(model, location[:-1])
        prefix = ".".join(filter(None, [section, *location[:-1]]))
        return (
            f"'{dotted}' is not a setting.{nearest(location[-1], fields)} The settings"
            f"{' of ' + prefix if prefix else ''} are {', '.join(fields)}."
        )
    about = _description(model, location)
    return (
        f"{dotted}={error.get('input')!r} is not allowed: {error['msg']}."
        f"{f' It means: {about}' if about else ''}"
    )


def _description(model: type[BaseModel], location: list[str]) -> str | None:
    """What the innermost field at a location is for."""
    about = None
    for part in location:
        if part not in model.model_fields:
            break
        about = model.model_fields[part].description
        inner = model.model_fields[part].annotation
        if not (isinstance(inner, type) and issubclass(inner, BaseModel)):
            break
        model = inner
    return about


def _fields_at(model: type[BaseModel], location: list[str]) -> list[str]:
    for part in location:
        inner = model.model_fields[part].annotation
        if not (isinstance(inner, type) and issubclass(inner, BaseModel)):
            return []
        model = inner
    return list(model.model_fields)
