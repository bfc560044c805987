"""How numba kernels are compiled, and kept so that they never outlive their source.

    @kernel(parallel=True)      called from Python; kept on disk
    def add(values, sums): ...

    @helper                     called by kernels, and compiled with each of them
    def _add_row(row): ...

numba's own cache asks whether the file of a kernel has changed, and not those of its helpers. Here
the name of a compiled kernel is a hash of all sources that it comes from (`folder.source_digest`),
of the versions of Python, numba and llvmlite, of the processor, and of the types of its arguments.
numba itself is imported with the first kernel.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from typing import Any

Function = Callable[..., Any]


def kernel(
    signature: str | None = None, *, parallel: bool = False, fastmath: bool = False,
    nogil: bool = False, linked: bool = False,
) -> Any:  # fmt: skip
    """Decorator for a function that is called from Python: compiled at its first call, and kept.

    Args:
        signature: the types that are taken, other numbers converted; compiled at once, on import.
        parallel: `prange` runs on all threads. Such a function should be small, and call a helper
            for each piece of work: what it contains is compiled twice, and by slower passes.
        fastmath: sums may be taken in any order.
        nogil: other threads of Python run meanwhile.
        linked: other kernels call it too. What they need for that takes most of the time in which
            a kernel is read from the disk; without it, they can't.
    """
    from pipeline.kernels.cache import KernelCache

    options = {"parallel": parallel, "fastmath": fastmath, "nogil": nogil}

    def decorate(function: Function) -> Any:
        compiled = _compiler(no_cfunc_wrapper=True, **options)(function)
        compiled._cache = KernelCache(function, options | {"linked": linked})
        if signature is not None:
            compiled.compile(signature)
            compiled.disable_compile()
        return compiled

    return decorate


def helper(function: Function | None = None, *, fastmath: bool = False) -> Any:
    """Decorator for a function that only kernels call."""
    # what calls it from Python and from C need not be compiled
    decorate = _compiler(fastmath=fastmath, no_cpython_wrapper=True, no_cfunc_wrapper=True)
    return decorate if function is None else decorate(function)


def inlined(function: Function) -> Any:
    """Decorator for a short one: its code takes the place of the call before types are known."""
    return _compiler(inline="always")(function)


def _compiler(**options: Any) -> Any:
    import numba

    untyped: Any = numba.njit  # it takes more than its types say
    return untyped(error_model="numpy", **options)


def each(nogil_kernel: Function, pieces: int, *arguments: Any) -> None:
    """Call a kernel as `kernel(piece, *arguments)` for every piece 0, 1, 2... of some work.

    On as many threads as kernels may use: for work of milliseconds a piece, `prange` without what
    its compilation costs. No piece may need what another one does.

    Args:
        nogil_kernel: a kernel with `nogil`.
        pieces: how many.
    """
    from concurrent.futures import ThreadPoolExecutor

    import numba

    numbers = iter(range(pieces))  # each number goes to one thread

    def work() -> None:
        for piece in numbers:
            nogil_kernel(piece, *arguments)

    workers = min(numba.get_num_threads(), pieces)
    if workers <= 1:
        work()
        return
    with ThreadPoolExecutor(workers) as pool:
        for done in [pool.submit(work) for _ in range(workers)]:
            done.result()


@contextlib.contextmanager
def kernel_threads(number: int) -> Iterator[None]:
    """Let kernels use `number` threads (at most those that there are), until the end."""
    import numba

    config: Any = numba.config
    before, available = numba.get_num_threads(), int(config.NUMBA_NUM_THREADS)
    numba.set_num_threads(max(1, min(number, available)))
    try:
        yield
    finally:
        numba.set_num_threads(before)
