"""What a caller asks of a run, as texts: settings, stages, a preset."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

from pipeline.config.resolving import yaml_value
from pipeline.errors import RequestError, shown
from pipeline.untrusted.paths import given_path


def each_override(overrides: Iterable[str] | Mapping[str, object]) -> list[str]:
    """Settings as ``--set`` has them, each; one alone may be given as it is.

    Raises:
        RequestError: they are none, or a value is of a kind that no setting has.
    """
    if isinstance(overrides, Mapping):
        return [_typed(key, value) for key, value in overrides.items()]
    listed = [overrides] if isinstance(overrides, str) else overrides
    texts = list(listed) if isinstance(listed, Iterable) else [listed]
    for text in texts:
        if not isinstance(text, str):
            raise RequestError(
                "overrides are a mapping {name: value}, or texts 'name=value'; this is "
                f"{shown(overrides)}."
            )
    return texts


def _typed(key: object, value: object) -> str:
    try:
        return f"{key}={yaml_value(value)}"
    except TypeError as error:
        raise RequestError(f"overrides: {shown(key)}: {error}.") from error


def each_stage(stages: Sequence[str] | None) -> tuple[str, ...] | None:
    """Names of stages, each; a string has them as ``--stages``, with commas between them; None for
    none.

    Raises:
        RequestError: they are no names.
    """
    if isinstance(stages, str):
        stages = [name.strip() for name in stages.split(",") if name.strip()]
    names = tuple(stages or ()) if isinstance(stages, Iterable | None) else (stages,)
    if not all(isinstance(name, str) for name in names):
        raise RequestError(
            f"stages are names in a list, or in a text with commas; this is {shown(stages)}."
        )
    return names or None


def anchored_preset(preset: str | Path | None) -> str | None:
    """A preset as it is named in every folder: a file by its whole path.

    Raises:
        RequestError: it is no name and no path.
    """
    if preset is None:
        return None
    path = given_path(preset, "preset")
    is_file = path.suffix in (".yaml", ".yml") and path.is_file()
    return str(path.absolute() if is_file else preset)
