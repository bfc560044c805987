"""Who hears that kernels are being compiled: a first run spends most of its time on it."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator

_listener: Callable[[str], None] | None = None


def compiling(kernel: str) -> None:
    """A kernel is not there yet, and somebody waits for it."""
    if _listener is not None:
        _listener(kernel)


@contextlib.contextmanager
def told_to(listener: Callable[[str], None]) -> Iterator[None]:
    """Call `listener` with the name of each kernel that has to be compiled, until the end."""
    global _listener
    before, _listener = _listener, listener
    try:
        yield
    finally:
        _listener = before
