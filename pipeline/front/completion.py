"""What the shell completes: stages, presets, settings. Every call imports this: it imports late."""

from __future__ import annotations

from collections.abc import Iterator


def stage(incomplete: str) -> list[str]:
    """Names of stages."""
    from pipeline.stage import stage_names

    return sorted(name for name in stage_names() if name.startswith(incomplete))


def stages(incomplete: str) -> list[str]:
    """A list with commas: its last name is completed, and none is offered twice."""
    before, comma, last = incomplete.rpartition(",")
    named = before.split(",")
    return [f"{before}{comma}{name}" for name in stage(last) if name not in named]


def preset(incomplete: str) -> list[str]:
    """Names of presets; the shell itself completes files."""
    from pipeline.config import presets

    return sorted(name for name in presets() if name.startswith(incomplete))


def setting(incomplete: str) -> list[tuple[str, str]]:
    """``fit.iterations=`` and its meaning; after the sign, the words that it may be."""
    from pipeline.errors import PipelineError
    from pipeline.front.settings import settings

    name, sign, value = incomplete.partition("=")
    section = name.partition(".")[0] if "." in name else None
    try:
        known = settings(section)
    except PipelineError:  # no such section
        return []
    if sign:
        words = [word for entry in known if entry.name == name for word in _words(entry.allowed)]
        return [(f"{name}={word}", "") for word in words if word.startswith(value)]
    return [
        (f"{entry.name}=", entry.meaning) for entry in known if entry.name.startswith(incomplete)
    ]


def _words(allowed: str) -> Iterator[str]:
    """Those values that are single words: ``auto | mouth | upright``, ``true or false``."""
    if allowed == "true or false":
        yield from ("true", "false")
    else:
        for part in allowed.split(" | "):
            if part.isidentifier() and part not in ("text", "path", "number", "null"):
                yield part
