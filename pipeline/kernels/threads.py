"""Threads that change nothing but the time."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

Item = TypeVar("Item")
Result = TypeVar("Result")


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
