"""Every setting: its name on the command line, what it may be, its default and its meaning.

All of it is read from the config models, so that it can't be out of date.
"""

from __future__ import annotations

import types
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, Union, get_args, get_origin

from pydantic import BaseModel
from pydantic_core import PydanticUndefined, to_jsonable_python

from pipeline.config import RunConfig, load_config, model_in
from pipeline.errors import RequestError, did_you_mean, nearest, shown
from pipeline.stage import usable_stages

_SIGNS = {"ge": "≥", "gt": ">", "le": "≤", "lt": "<"}
_LENGTHS = {"min_length": "at least {} of them", "max_length": "at most {} of them"}
_WORDS = {int: "whole number", float: "number", bool: "true or false", str: "text", Path: "path"}


@dataclass(frozen=True)
class Setting:
    """One setting.

    Attributes:
        name: as ``--set`` takes it: ``fit.iterations``.
        allowed: its type and range, in words.
        default: as JSON; None where it is `required` or null.
        required: it has no default: an entry of a list that holds it has to name it.
        meaning: one line.
        in_key: whether its value is part of the key of a result; not so for what changes nothing in
            it, and for paths, whose content counts instead.
    """

    name: str
    allowed: str
    default: Any
    required: bool
    meaning: str
    in_key: bool


def settings(stage: str | None = None) -> list[Setting]:
    """List every setting, those of the run first, or some.

    Args:
        stage: name of a stage, or ``run``; or the beginning of names, up to a dot or the end, as
            ``init.dense`` or ``fit.iterations``.

    Raises:
        RequestError: there are none of this name.
    """
    if not isinstance(stage, str | None):
        raise RequestError(f"settings are those of a stage's name; this is {shown(stage)}.")
    models = config_models()
    known = [found for name, model in models.items() for found in model_settings(model, name)]
    if stage is None:
        return known
    chosen = [found for found in known if f"{found.name}.".startswith(f"{stage}.")]
    if chosen or stage in models:
        return chosen
    near = nearest(stage, models)
    if not near:
        section = stage.partition(".")[0]
        names = [found.name for found in known]
        near = did_you_mean(
            stage, [name for name in names if name.startswith(f"{section}.")] or names
        )
    raise RequestError(
        f"There are no settings of {shown(stage)}. There are those of {', '.join(models)}.{near}"
    )


def config_models() -> dict[str, type[BaseModel]]:
    """``run`` and the stages in their order -> the model of their settings."""
    usable = usable_stages()
    order = [name for name in load_config().run.stages if name in usable]
    order += [name for name in usable if name not in order]
    return {"run": RunConfig, **{name: usable[name].Config for name in order}}


def model_settings(model: type[BaseModel], prefix: str) -> Iterator[Setting]:
    """The settings of a model and of the models in it."""
    for name, field in model.model_fields.items():
        dotted = f"{prefix}.{name}" if prefix else name
        inner = model_in(field.annotation)
        if inner is None or inner is not field.annotation:
            extra = field.json_schema_extra
            default = field.get_default(call_default_factory=True)
            required = default is PydanticUndefined
            yield Setting(
                name=dotted,
                allowed=in_words(field.annotation, field.metadata),
                default=None if required else to_jsonable_python(default),
                required=required,
                meaning=field.description or "",
                in_key=not (isinstance(extra, dict) and not extra.get("affects_result", 1)),
            )
        if inner is not None:
            yield from model_settings(inner, dotted)


def in_words(annotation: Any, metadata: Sequence[Any] = ()) -> str:
    """A type and its bounds in words: ``whole number ≥ 0, ≤ 50``."""
    bounds = []
    for entry in metadata:
        for name, sign in _SIGNS.items():
            if getattr(entry, name, None) is not None:
                bounds.append(f"{sign} {getattr(entry, name)}")
        for name, text in _LENGTHS.items():
            if getattr(entry, name, None) is not None:
                bounds.append(text.format(getattr(entry, name)))
    told = _type_in_words(annotation).removesuffix(" | null")
    told += f" {', '.join(bounds)}" if bounds else ""
    return f"{told} | null" if type(None) in get_args(annotation) else told


def _type_in_words(annotation: Any) -> str:
    origin, inside = get_origin(annotation), get_args(annotation)
    if hasattr(annotation, "__metadata__"):  # Annotated, with bounds of its own
        own = [m for entry in annotation.__metadata__ for m in getattr(entry, "metadata", [entry])]
        return in_words(inside[0], own)
    if origin is Literal:
        return " | ".join(map(str, inside))
    if origin in (Union, types.UnionType):
        parts = ["null" if part is type(None) else in_words(part) for part in inside]
        return " | ".join(sorted(parts, key="null".__eq__))
    if origin is dict:
        return f"map of {in_words(inside[0])} to {in_words(inside[1])}"
    if origin in (tuple, list):
        kinds = list(dict.fromkeys(in_words(part) for part in inside if part is not Ellipsis))
        several = Ellipsis in inside or origin is list
        count = "list" if several else f"list of {len(inside)}"
        return f"{count}: {kinds[0]}" if len(kinds) == 1 else f"{count}: {', '.join(kinds)}"
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return "a section"
    return _WORDS.get(annotation, getattr(annotation, "__name__", str(annotation)))
