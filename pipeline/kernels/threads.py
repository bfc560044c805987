"""Threads that change nothing but the time."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import TypeVar

Item = TypeVar("Item")
Result = TypeVar("Result")
Other = TypeVar("Other")


@contextmanager
def opencv_threads(number: int) -> Iterator[None]:
    """Let OpenCV use so many threads, until the end.

    With one, its optical flow is the same on every machine: it works in stripes, as many as there
    are threads.
    """
    import cv2

    before = cv2.getNumThreads()
    cv2.setNumThreads(number)
    try:
        yield
    finally:
        cv2.setNumThreads(before)


def in_threads(
    function: Callable[[Item], Result],
    items: Iterable[Item],
    threads: int,
    progress: Callable[[int], None] = lambda done: None,
) -> list[Result]:
    """Map in threads; the results come in the order of the items."""
    results = []
    with ThreadPoolExecutor(max(threads, 1)) as pool:
        for result in pool.map(function, items):
            results.append(result)
            progress(len(results))
    return results


def side_by_side(
    main: Callable[[], Result], beside: Callable[[], Other], threads: int
) -> tuple[Result, Other]:
    """What two functions return; `beside` runs in a thread of its own if there are two or more."""
    if threads < 2:
        return main(), beside()
    with ThreadPoolExecutor(1) as pool:
        other = pool.submit(beside)
        return main(), other.result()
