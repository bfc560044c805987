"""Compiled kernels on disk, and how numba asks for them."""

from __future__ import annotations

import contextlib
import hashlib
import os
import pickle
import sys
import warnings
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import llvmlite
import numba
from filelock import FileLock, Timeout
from llvmlite.binding import parse_assembly
from numba.core import config
from numba.core.caching import _Cache
from numba.core.compiler import CompileResult
from numba.core.runtime.nrt import rtsys
from numba.core.serialize import dumps

from pipeline.kernels import folder as places
from pipeline.kernels import news
from pipeline.kernels.folder import SUFFIX

#: seconds after which a process no longer waits for another that compiles the same
PATIENCE = 120.0


class KernelCache(_Cache):
    """Compiled versions of one kernel on disk, a file each; what numba calls a cache.

    A file is written under another name first and read with its checksum: neither a second process
    nor a kill can leave half of one. While a process compiles, others that need the same wait.
    """

    def __init__(self, function: Callable[..., Any], options: Mapping[str, bool]) -> None:
        self._function = function
        self._options = options
        self._linked = options["linked"]
        self._name = f"{function.__module__}.{function.__qualname__}".replace("<locals>", "")
        self._enabled = True
        self._lock: FileLock | None = None

    @property
    def cache_path(self) -> str | None:
        folder = places.writable()
        return str(folder) if folder else None

    def enable(self) -> None:
        self._enabled = True

    def disable(self) -> None:
        self._enabled = False

    def flush(self) -> None:
        for folder in places.readable():
            for path in folder.glob(f"{self._name}-*{SUFFIX}"):
                path.unlink(missing_ok=True)

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """The kernel for the types of its arguments, or None: compile it, then `save_overload`.

        numba's own caches load all that compiling needs first, .4 s; its compiler does so itself.
        What is compiled already needs numba's memory alone.
        """
        rtsys.initialize(target_context)
        if not self._enabled:
            return None
        name = self._file(sig, target_context.codegen())
        found = _find(name, target_context)
        if found is not None:
            return found
        folder = _writable()
        if folder is not None:
            self._wait(folder / f"{name}.lock")
            found = _find(name, target_context)
        if found is not None:
            self._go_on()
        else:
            news.compiling(self._name)
        return found

    def save_overload(self, sig: Any, data: Any) -> None:
        """Keep what was compiled; a full disk or a folder that has gone only costs time."""
        folder = _writable()
        try:
            if (
                self._enabled
                and folder
                and not data.lifted
                and not data.library.has_dynamic_globals
            ):
                name = self._file(sig, data.codegen)
                parts = data._reduce()
                with contextlib.suppress(OSError):
                    _write(folder / name, dumps(parts if self._linked else _unlinked(parts)))
                    places.tidy(folder, self._name)
        finally:
            self._go_on()

    def _file(self, sig: Any, codegen: Any) -> str:
        sources = places.source_digest(self._function.__module__)
        # the types' names say all about them
        made_of = (
            self._name,
            sorted(self._options.items()),
            sources,
            versions(),
            str(sig),
            codegen.magic_tuple(),
        )
        digest = hashlib.sha256(repr(made_of).encode()).hexdigest()
        return f"{self._name}-{sources[:12]}-{digest[:24]}{SUFFIX}"

    def _wait(self, path: Path) -> None:
        self._go_on()
        lock = FileLock(path)
        with contextlib.suppress(OSError, NotImplementedError, Timeout):
            try:
                lock.acquire(timeout=0)
            except Timeout:
                news.compiling(self._name)
                lock.acquire(timeout=PATIENCE)
            self._lock = lock

    def _go_on(self) -> None:
        """Let other processes have what this one has compiled."""
        lock, self._lock = self._lock, None
        if lock is not None:
            with contextlib.suppress(OSError):
                Path(lock.lock_file).unlink()
            lock.release()


def versions() -> tuple[Any, ...]:
    """What else can change compiled code: versions, and numba's settings."""
    settings = ("OPT", "LOOP_VECTORIZE", "SLP_VECTORIZE", "USING_SVML", "BOUNDSCHECK")
    return (
        sys.version_info[:2], numba.__version__, llvmlite.__version__,
        tuple(str(getattr(config, name, None)) for name in settings),
    )  # fmt: skip


def _find(name: str, target_context: Any) -> Any:
    for folder in places.readable():
        try:
            checksum, data = _split((folder / name).read_bytes())
        except OSError:
            continue
        if checksum == hashlib.sha256(data).digest():
            return CompileResult._rebuild(target_context, *pickle.loads(data))
    return None


def _unlinked(parts: tuple[Any, ...]) -> tuple[Any, ...]:
    """What a kernel is rebuilt from, with the name alone of what others would be linked with.

    numba looks up what it calls from Python only if the bitcode defines it.
    """
    (name, kind, (machine_code, _)), description, *rest = parts
    stub = f'define void @"{description.llvm_cpython_wrapper_name}"() {{ ret void }}'
    bitcode = parse_assembly(stub).as_bitcode()
    return (name, kind, (machine_code, bitcode)), description, *rest


def _split(content: bytes) -> tuple[bytes, bytes]:
    return content[:32], content[32:]


def _write(path: Path, data: bytes) -> None:
    part = path.with_name(f"{path.name}.{os.getpid()}.part")
    try:
        part.write_bytes(hashlib.sha256(data).digest() + data)
        places.for_all(part)
        part.replace(path)
    finally:
        part.unlink(missing_ok=True)


_told: list[bool] = []


def _writable() -> Path | None:
    folder = places.writable()
    if folder is None and not _told:
        _told.append(True)
        tried = ", ".join(map(str, places.folders()))
        warnings.warn(
            f"Compiled kernels can't be kept, and every run compiles them anew: none of {tried} "
            "can be written. NUMBA_CACHE_DIR=FOLDER names another place.",
            RuntimeWarning,
            stacklevel=2,
        )
    return folder
