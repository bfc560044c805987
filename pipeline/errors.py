"""The errors that reach a user, each with its exit status.

Every message is one clear paragraph: what is wrong, where, and what to do about it.
"""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Mapping
from typing import Any


class PipelineError(Exception):
    """A failure that is explained to the user in one paragraph, never with a traceback."""

    exit_status = 1


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


def nearest(name: str, allowed: Iterable[str]) -> str:
    """Return ``" Did you mean 'x'?"`` for the allowed name closest to `name`, or nothing."""
    close = difflib.get_close_matches(name, list(allowed), n=1, cutoff=0.5)
    return f" Did you mean '{close[0]}'?" if close else ""
