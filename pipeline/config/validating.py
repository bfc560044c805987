"""Values as read from YAML -> a validated model, or what is wrong with them in plain words."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from typing import Any, TypeVar, get_args

from pydantic import BaseModel, ValidationError

from pipeline.errors import RequestError, did_you_mean, nearest, shown
from pipeline.stage import stage_names

#: Letters of a setting's name; faults that are explained.
LONGEST_NAME, _MOST_FAULTS = 200, 5
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
        str(part) if len(str(part)) <= LONGEST_NAME else shown(part) for part in error["loc"]
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
        names = list(setting_names(model, section))
        return (
            f"'{dotted}' is not a setting.{did_you_mean(dotted, names)} 'pipeline settings "
            f"{section}' lists all {len(names)} with their meaning."
        )
    about = _description(model, location)
    given = error.get("input")
    if isinstance(given, dict) and error["type"] not in _MAY_BE and _fields_at(model, location):
        return f"{dotted}: {why}.{f' It means: {about}' if about else ''}"  # settings together
    hint = ""
    if isinstance(given, str) and why.startswith("Input should be '"):
        hint = nearest(given, re.findall("'([^']*)'", why))
    return (
        f"{dotted}={'null' if given is None else shown(given)} is not allowed: {why}.{hint}"
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


def setting_names(model: type[BaseModel], prefix: str) -> Iterator[str]:
    """Dotted names of a model's settings and of those of the models in it."""
    for name, field in model.model_fields.items():
        inner = model_in(field.annotation)
        if inner is None or inner is not field.annotation:
            yield f"{prefix}.{name}"
        if inner is not None:
            yield from setting_names(inner, f"{prefix}.{name}")


def model_in(annotation: Any) -> type[BaseModel] | None:
    """The model that a field holds, directly, optionally or as a list of it."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation
    return next(filter(None, map(model_in, get_args(annotation))), None)
