"""What the shell completes: stages, presets, settings. Every call imports this: it imports late."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator

#: What stands before the part of a word that bash asks for: ``fit.light=``.
_before = ""


def suit_shell() -> None:
    """Ask and answer as the shells mean it.

    To fish each line is an answer: meanings must not wrap. To bash ``--set fit.light=no`` is four
    words, and it asks for the last of them alone: put together what belongs together, and remember
    what stands before the part that is asked for.
    """
    global _before
    if "_TYPER_COMPLETE_ARGS" in os.environ:
        os.environ["COLUMNS"] = "9999"
    given = os.environ.get("COMP_WORDS", "").split("\n")
    if "=" not in given:
        return
    words: list[str] = []
    in_parts = False
    for word in given[: int(os.environ["COMP_CWORD"]) + 1]:
        in_parts = bool(words) and (word == "=" or words[-1].endswith("="))
        words.append(words.pop() + word if in_parts else word)
    if in_parts:
        last = words.pop()
        if last.startswith("--"):  # --set=fit.light=no
            option, _, last = last.partition("=")
            words.append(option)
        before, sign, asked = last.rpartition("=")
        _before = before + sign
        words.append(asked)
    os.environ |= {"COMP_WORDS": "\n".join(words), "COMP_CWORD": str(len(words) - 1)}


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
    """``fit.iterations=`` and its meaning; after the sign, the words that it may be.

    One that is alone comes with its default as well: a shell adds a space to what is alone.
    """
    from pipeline.errors import PipelineError
    from pipeline.front.settings import settings

    name, sign, value = f"{_before}{incomplete}".partition("=")
    section = name.partition(".")[0] if "." in name else None
    try:
        known = [entry for entry in settings(section) if entry.name.startswith(name)]
    except PipelineError:  # no such section
        return []
    if sign:
        before = "" if _before else f"{name}="
        words = [word for entry in known if entry.name == name for word in _words(entry.allowed)]
        return [(f"{before}{word}", "") for word in words if word.startswith(value)]
    found = [(f"{entry.name}=", entry.meaning) for entry in known]
    if len(found) == 1 and not known[0].required:
        default = known[0].default
        text = default if isinstance(default, str) else json.dumps(default, separators=(",", ":"))
        found.append((f"{known[0].name}={text}", "as it is"))
    return found


def _words(allowed: str) -> Iterator[str]:
    """Those values that are single words: ``auto | mouth | upright``, ``true or false``.

    Not the entries of a list: ``auto | list: light | flow``.
    """
    for part in allowed.partition("list")[0].split(" | "):
        if part == "true or false":
            yield from ("true", "false")
        elif part.isidentifier() and part not in ("text", "path", "number", "null"):
            yield part
