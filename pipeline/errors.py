"""The errors that reach a user, each with its exit status.

Every message is one clear paragraph: what is wrong, where, and what to do about it.
"""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Mapping
from pathlib import PurePath
from typing import Any

from pipeline.untrusted.names import readable

#: Stands before the folder with which a failure's message ends, where the runner kept pictures.
PICTURES = " Pictures that show it: "


class PipelineError(Exception):
    """A failure that is explained to the user in one paragraph, never with a traceback.

    Attributes:
        stage: that it ended; empty: none had begun.
    """

    exit_status = 1
    stage = ""

    def __init__(self, message: str = "") -> None:
        super().__init__(readable(message))


class RequestError(PipelineError):
    """The request can't be served as made: wrong name or value, unreadable input, full disk."""

    exit_status = 2


class ReconstructionError(PipelineError):
    """The data can't be reconstructed. The message is the diagnosis: which views, what to do.

    Attributes:
        pictures: name -> [H, W, 3] uint8 image that shows what is wrong. The runner keeps them in
            the workspace and tells the user where.
        artifacts: kind -> artifact (`pipeline.artifacts`) that was made before it turned out not to
            be safe. The runner keeps them beside the pictures, for the page to put them right.
    """

    exit_status = 3

    def __init__(
        self,
        message: str,
        pictures: Mapping[str, Any] | None = None,
        artifacts: Mapping[str, Any] | None = None,
    ) -> None:
        super().__init__(message)
        self.pictures = dict(pictures or {})
        self.artifacts = dict(artifacts or {})


class StageError(PipelineError):
    """A fault of ours inside a stage; what the earlier stages computed stays in the store."""

    exit_status = 1


#: A longer name is nobody's slip, and comparing it would take its time.
LONGEST_GUESSED = 100


def shown(value: object, letters: int = 100) -> str:
    """A value as the user gave it, short enough for a message."""
    if isinstance(value, str | list | tuple | dict) and len(value) > 10 * letters:
        kind = {str: "text", dict: "mapping"}.get(type(value), "list")
        start = repr(value[:40]) if isinstance(value, str) else "..."
        return f"{start}... (a {kind} of length {len(value)})"
    try:
        text = repr(value)
    except (RecursionError, ValueError):  # nested too deep; a number of too many digits
        return f"a {type(value).__name__}"
    text = " ".join(text.split("\n"))  # as of an array
    return text if len(text) <= letters else f"{text[:letters]}..."


def nearest(name: str, allowed: Iterable[str]) -> str:
    """Return ``" Did you mean 'x'?"`` for the allowed name closest to `name`, or nothing.

    Capitals make no difference, but where names differ in these alone; nor does it count that both
    are names of files of one kind.
    """
    if len(name) > LONGEST_GUESSED:
        return ""
    names = list(allowed)
    suffix = PurePath(name.casefold()).suffix
    shared = any(each.casefold().endswith(suffix) for each in names)

    def plain(each: str) -> str:
        return each.casefold().removesuffix(suffix if shared else "")

    close = difflib.get_close_matches(plain(name), map(plain, names), n=1, cutoff=0.5)
    fitting = [each for each in names if plain(each) in close]
    best = difflib.get_close_matches(name, fitting, n=1, cutoff=0.0)
    return f" Did you mean '{best[0]}'?" if best else ""


def did_you_mean(wrong: str, names: Iterable[str], count: int = 5) -> str:
    """``" Did you mean fit.iterations, ... or fit.x?"``: the settings nearest to a wrong one."""
    if len(wrong) > LONGEST_GUESSED:
        return ""
    last = wrong.rpartition(".")[2]

    def likeness(name: str) -> float:
        whole = difflib.SequenceMatcher(None, wrong, name).ratio()
        return 2 * difflib.SequenceMatcher(None, last, name.rpartition(".")[2]).ratio() + whole

    close = sorted(names, key=lambda name: (-likeness(name), name))[:count]
    if not close:
        return ""
    *some, one = close
    return f" Did you mean {', '.join(some)}{' or ' if some else ''}{one}?"
