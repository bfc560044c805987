"""Work that goes on beside the caller's own, in one thread, piece after piece."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any, ParamSpec, Self, TypeVar

P = ParamSpec("P")
Result = TypeVar("Result")


class Beside:
    """What writes files while something else is computed: for libraries that let go of Python.

    Use as a context manager: it ends when all pieces are done, and raises what the first one that
    failed raised; an error of the caller's leaves out the pieces that have not begun.

    Args:
        threads: how many the caller may use. With one, each piece is done where it is given.
    """

    def __init__(self, threads: int) -> None:
        self._pool = ThreadPoolExecutor(1) if threads > 1 else None
        self._given: list[Future[Any]] = []

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: object, *_: object) -> None:
        if self._pool is not None:
            self._pool.shutdown(cancel_futures=kind is not None)
        if kind is None:
            for piece in self._given:
                piece.result()

    def give(
        self, work: Callable[P, Result], *args: P.args, **kwargs: P.kwargs
    ) -> Callable[[], Result]:
        """Do a piece of work after those given before; call what is returned for its result."""
        if self._pool is not None:
            piece = self._pool.submit(work, *args, **kwargs)
        else:
            piece = Future()
            piece.set_result(work(*args, **kwargs))
        self._given.append(piece)
        return piece.result
