"""Native libraries that change the process as they are imported, kept from doing so.

pycolmap installs a crash handler of its logging library (glog) over the handlers that the program
has: SIGTERM then prints a stack trace and kills. The same library writes log files into the
temporary folder, readable by all and named after machine and user.
"""

from __future__ import annotations

import ctypes
import os
import signal
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec, PathFinder
from types import ModuleType
from typing import Any

from pipeline.process.signals import ENDING


def _log_to_stderr(pycolmap: Any) -> None:
    pycolmap.logging.logtostderr = True


def _nothing(library: Any) -> None:
    pass


#: Library -> what is done with it as soon as it is there. Those with nothing start threads, which
#: are not to hear of signals: the system gives one to any thread that does.
MEDDLERS: dict[str, Callable[[Any], None]] = {
    "pycolmap": _log_to_stderr, "numpy": _nothing, "scipy.linalg": _nothing, "cv2": _nothing,
}  # fmt: skip


#: Environment of a process that does small work beside others: the threads of these libraries wait
#: for work by going round in circles.
ONE_THREAD = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}


@contextmanager
def signals_held() -> Iterator[None]:
    """Signals to end that come meanwhile are heard afterwards; threads started inside hear none."""
    if os.name != "posix":
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, ENDING)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


@contextmanager
def handlers_kept() -> Iterator[None]:
    """Whatever is done inside, signals have the handlers afterwards that they had before.

    Through Python's own C functions, since `signal.signal` is for the main thread only and knows
    nothing of handlers that it did not set.
    """
    if os.name != "posix":
        yield
        return
    get, put = ctypes.pythonapi.PyOS_getsig, ctypes.pythonapi.PyOS_setsig
    get.argtypes, get.restype = [ctypes.c_int], ctypes.c_void_p
    put.argtypes, put.restype = [ctypes.c_int, ctypes.c_void_p], ctypes.c_void_p
    numbers = signal.valid_signals() - {signal.SIGKILL, signal.SIGSTOP}
    before = {number: get(number) for number in numbers}
    try:
        yield
    finally:
        for number, handler in before.items():
            if get(number) != handler:
                put(number, handler)


class _Watched(Loader):
    """Loads a library as its own loader does, between two looks at the signals."""

    def __init__(self, inner: Loader, name: str) -> None:
        self._inner = inner
        self._name = name

    def create_module(self, spec: ModuleSpec) -> ModuleType | None:
        with signals_held(), handlers_kept():  # where an extension's own libraries are loaded
            return self._inner.create_module(spec)

    def exec_module(self, module: ModuleType) -> None:
        os.environ.setdefault("GLOG_logtostderr", "1")  # read when the library is loaded
        with signals_held(), handlers_kept():
            self._inner.exec_module(module)
        MEDDLERS[self._name](module)

    def __getattr__(self, name: str) -> Any:  # what tools ask of a loader: sources, resources
        return getattr(self._inner, name)


class _Watcher(MetaPathFinder):
    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        if fullname not in MEDDLERS:
            return None
        spec = PathFinder.find_spec(fullname, path, target)
        if spec is not None and spec.loader is not None:
            spec.loader = _Watched(spec.loader, fullname)
        return spec


@contextmanager
def one_blas_thread() -> Iterator[None]:
    """OpenBLAS works in the calling thread alone.

    Our matrices are small, and our threads many: its own threads wait for work by spinning, and
    took 10 % of a run's processor time (much more where another program computes as well).
    """
    import scipy.linalg  # noqa: F401  -- only what is loaded can be told; it brings its own BLAS
    from threadpoolctl import threadpool_limits

    with threadpool_limits(1, "blas"):
        yield


def return_free_memory() -> None:
    """What was freed goes back to the system, where the C library can be told to.

    glibc keeps freed blocks of up to 32 MB for later ones, a heap for each thread: after a stage
    these are some 150 MB, on top of which the next one would take its own.
    """
    if sys.platform == "linux":
        trim = getattr(ctypes.CDLL(None), "malloc_trim", None)  # other C libraries have none
        if trim is not None:
            trim(0)


def watch_imports() -> None:
    """From now on, imports of libraries that meddle with the process are watched."""
    if not any(isinstance(finder, _Watcher) for finder in sys.meta_path):
        sys.meta_path.insert(0, _Watcher())
