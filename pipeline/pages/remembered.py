"""What is slow to draw is drawn once by a process that makes a page twice: ahead, at the end."""

from __future__ import annotations

import functools
import hashlib
import pickle
from collections.abc import Callable
from typing import Any, ParamSpec, TypeVar

Asked = ParamSpec("Asked")
Drawn = TypeVar("Drawn")

_kept: dict[bytes, Any] | None = None


def remember() -> None:
    """From now on, this process keeps what `remembered` functions return."""
    global _kept
    _kept = {}


def remembered(draw: Callable[Asked, Drawn]) -> Callable[Asked, Drawn]:
    """Let a function that depends on nothing but its arguments draw the same once only.

    Without `remember` it is called each time, and nothing is kept.
    """

    @functools.wraps(draw)
    def drawn(*args: Asked.args, **kwargs: Asked.kwargs) -> Drawn:
        if _kept is None:
            return draw(*args, **kwargs)
        asked = pickle.dumps((draw.__module__, draw.__qualname__, args, kwargs), protocol=5)
        key = hashlib.sha256(asked).digest()
        if key not in _kept:
            _kept[key] = draw(*args, **kwargs)
        found: Drawn = _kept[key]
        return found

    return drawn
