"""The arithmetic of the fit: arrays in, arrays out. Its modules are loaded when they are needed."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from stages.fit.numerics import (  # noqa: F401
        background,
        colours,
        density,
        detail,
        harmonics,
        light,
        moments,
        objectives,
        photometry,
        surface,
        total_variation,
    )


def __getattr__(name: str) -> Any:
    if name.startswith("_"):
        raise AttributeError(name)
    return import_module(f"{__name__}.{name}")
