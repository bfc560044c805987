"""How a setting is said: once, with its type, range, default and meaning, and what `auto` is."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import TYPE_CHECKING, Annotated, Any, Literal

from pydantic import (
    ConfigDict,
    Field,
    ValidationInfo,
    ValidatorFunctionWrapHandler,
    field_validator,
)

from pipeline.stage import StageConfig

AUTO: Any = "auto"
#: of a view, where a setting that grows with it says nothing of its size
PIXELS = 512 * 384

Share = Annotated[float, Field(ge=0, le=1)]
Weight = Annotated[float, Field(ge=0)]
Positive = Annotated[float, Field(gt=0)]
Count = Annotated[int, Field(ge=1)]
Whole = Annotated[int, Field(ge=0)]
Pair = tuple[float, float]
Colour = tuple[Share, Share, Share]
if TYPE_CHECKING:  # code meets settings whose "auto" has become a value
    AutoBool = bool
    AutoInt = int
    AutoFloat = float
    AutoColour = Colour
else:
    AutoBool = Literal["auto"] | bool
    AutoInt = Literal["auto"] | int
    AutoFloat = Literal["auto"] | float
    AutoColour = Literal["auto"] | Colour


def automatic(
    views: Mapping[int, Any] | str,
    *,
    held: Any = None,
    grows: bool = False,
    ge: float | None = 0,
    **bounds: Any,
) -> Any:
    """A setting that is found where the user says nothing of it.

    Args:
        views: what it comes to at so many views, in order; between them it follows the count. Or
            in words, where no table says it.
        held: what it comes to on a held surface, if that is something else.
        grows: `held` is for views of `PIXELS`, and grows with their width.
        ge, **bounds: of what the user may say, if that is a number.
    """
    if isinstance(views, str):
        extra: dict[str, Any] = {"auto": views}
    else:
        extra = {
            "auto": _told(views, held) + (" of 512 px (more on wider views)" if grows else ""),
            "views": dict(views), "held": held, "grows": grows,
        }  # fmt: skip
    switch = not isinstance(views, str) and isinstance(next(iter(views.values())), bool)
    return Field(AUTO, json_schema_extra=extra, ge=None if switch else ge, **bounds)


def _told(views: Mapping[int, Any], held: Any) -> str:
    """What a rule says, in words, and as a user would say it."""
    (first, least), *others = ((count, json.dumps(value)) for count, value in views.items())
    words = [f"{least} up to {first} views" if others else f"{least}"]
    words += [f"{value} at {count}" for count, value in others[:-1]]
    between = "" if least in ("true", "false") else ", in proportion between them"
    words += [f"{value} from {count}{between}" for count, value in others[-1:]]
    return ", ".join(words) + ("" if held is None else f"; {json.dumps(held)} on a held surface")


def by_rule(views: Mapping[int, Any], count: int) -> Any:
    """What a table of `automatic` has for so many views; whole numbers are the nearest ones."""
    low = max((known for known in views if known <= count), default=min(views))
    high = min((known for known in views if known >= count), default=max(views))
    if low >= high:
        return views[min(low, high) if count < high else max(low, high)]
    share = (count - low) / (high - low)
    value = views[low] + (views[high] - views[low]) * share
    return type(views[low])(round(value)) if isinstance(views[low], int) else value


class PartSettings(StageConfig):
    """Fields followed by what they mean; of what is automatic, bounds hold for what a user says."""

    model_config = ConfigDict(use_attribute_docstrings=True)

    @classmethod
    def __pydantic_init_subclass__(cls, **_: Any) -> None:
        for name in cls.__annotations__.keys() & cls.model_fields.keys():
            field = cls.model_fields[name]
            extra = field.json_schema_extra
            auto = extra.get("auto") if isinstance(extra, dict) else None
            field.description = " ".join(str(field.description).split()).rstrip(".")
            field.description += f" (auto: {auto})" if auto else ""

    @field_validator("*", mode="wrap")
    @classmethod
    def _or_auto(cls, value: Any, check: ValidatorFunctionWrapHandler, info: ValidationInfo) -> Any:
        extra = cls.model_fields[str(info.field_name)].json_schema_extra
        free = isinstance(extra, dict) and "auto" in extra
        return value if free and isinstance(value, str) and value == AUTO else check(value)
