"""One thread for numpy's matrix products, while we run our own threads around them."""

from __future__ import annotations

import ctypes
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path

import numpy as np

#: Names that the function has in the OpenBLAS of numpy's wheels, and in a system's.
_NAMES = (
    "scipy_openblas_{}_num_threads64_",
    "openblas_{}_num_threads64_",
    "openblas_{}_num_threads",
)


@contextmanager
def one_blas_thread() -> Iterator[None]:
    """Keep OpenBLAS from starting threads; with another library do nothing.

    Its threads wait for work by spinning: two of our threads calling it took 2.6 times the CPU
    time. What the products give does not depend on this.
    """
    functions = _thread_functions()
    if functions is None:
        yield
        return
    get_threads, set_threads = functions
    before = get_threads()
    set_threads(1)
    try:
        yield
    finally:
        set_threads(before)


@cache
def _thread_functions() -> tuple[ctypes._NamedFuncPointer, ctypes._NamedFuncPointer] | None:
    package = Path(np.__file__).parent
    folders = (package.parent / "numpy.libs", package / ".dylibs")
    for path in sorted(path for folder in folders for path in folder.glob("*openblas*")):
        with suppress(OSError):
            library = ctypes.CDLL(str(path))  # the copy that numpy has loaded
            for name in _NAMES:
                with suppress(AttributeError):
                    return library[name.format("get")], library[name.format("set")]
    return None
