"""Read a file of the user's in a process of its own, which may crash, hang or run out of memory.

Decoders of films and of some pictures are large programs in C that meet whatever a file holds. In a
child that no longer may open any file, has so much memory and so much time, the worst file costs
the run that file. What comes back are JSON values and arrays of numbers: nothing that could run.
"""

from __future__ import annotations

import contextlib
import importlib
import json
import math
import os
import queue
import signal
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, NoReturn, Self

import numpy as np
import numpy.typing as npt

from pipeline.measure import confine
from pipeline.process.native import ONE_THREAD
from pipeline.untrusted.files import UnusableFile

Values = dict[str, Any]
Arrays = list[npt.NDArray[Any]]
Reply = tuple[Values, Arrays]
#: What is run in a child: called with a request's values and arrays, it yields replies.
Work = Callable[[Values, Arrays], Iterator[Reply]]

#: A child that says nothing for so long hangs: decoders report every few frames.
SILENCE = 120.0
_LENGTH = struct.Struct(">Q")
_MOST_JSON = 1 << 24
#: Only what arithmetic can do nothing wrong with.
_TYPES = {"|u1": np.uint8, "|b1": np.bool_, "<f4": np.float32}


def seconds_for(size: int) -> float:
    """How long a file may be worked on, from its bytes: ten times what slow machines need."""
    return 600.0 + size / 250_000


class Child:
    """A process that answers requests, one at a time, with one function.

    Args:
        work: ``module:function``, a `Work`; its module is imported before limits are set.
        memory: bytes that it may take beyond what it has after its imports.
        files: descriptors that it inherits.
    """

    def __init__(self, work: str, memory: int, files: Sequence[int] = ()) -> None:
        home = str(Path(__file__).resolve().parents[2])
        environment = {
            **os.environ,
            "PYTHONPATH": os.pathsep.join([home, *filter(None, sys.path)]),
            # each arena and each thread's stack would count as memory
            "MALLOC_ARENA_MAX": "2", **ONE_THREAD,
        }  # fmt: skip
        self._process = subprocess.Popen(
            [sys.executable, "-P", "-m", "pipeline.untrusted.child", work, str(memory)],
            env=environment, pass_fds=tuple(files), bufsize=0,
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL,
        )  # fmt: skip
        assert self._process.stdin is not None and self._process.stdout is not None
        self._to: Any = self._process.stdin
        self._from: Any = self._process.stdout
        #: Is it waiting for a request?
        self.idle = True

    def ask(
        self, values: Mapping[str, Any], arrays: Sequence[npt.NDArray[Any]] = (),
        seconds: float = 300.0,
    ) -> Iterator[Reply]:  # fmt: skip
        """Send a request, and yield the replies as they come.

        Args:
            values: JSON values.
            arrays: of bytes, booleans or float32.
            seconds: for all of it.

        Raises:
            UnusableFile: it said so, died, took too long or too much memory.
        """
        assert self.idle, "a request is being worked on"
        self.idle = False
        watch = _Watch(seconds, self.stop)
        try:
            for part in _parts(dict(values), arrays):
                self._write(part)
            while True:
                reply, found = self._receive(watch)
                state = reply.pop("state")
                if state == "more":
                    yield reply, found
                    continue
                if state == "fault":
                    raise RuntimeError(f"in the process that reads files: {reply['text']}")
                self.idle = True
                if state == "unusable":
                    raise UnusableFile(str(reply["text"]))
                return
        except _DiedError:
            self.close()
            late = "took too long to decode, as files do that are damaged or made to do harm"
            why = late if watch.late else _why(self._process.returncode)
            raise UnusableFile(why) from None
        finally:
            watch.end()
            if not self.idle:
                self.close()

    def stop(self) -> None:
        """End it at once; whoever waits for a reply is told. Any thread may call this."""
        with contextlib.suppress(ProcessLookupError):
            self._process.kill()

    def close(self) -> None:
        """End it, and let go of what was held for it."""
        self.idle = False
        self.stop()
        for stream in (self._process.stdin, self._process.stdout):
            assert stream is not None
            with contextlib.suppress(OSError):
                stream.close()
        self._process.wait()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:  # fmt: skip
        self.close()

    def _write(self, data: memoryview) -> None:
        try:
            while data:
                data = data[self._to.write(data) :]
        except OSError as error:
            self._mourn(error)

    def _read(self, view: memoryview, watch: _Watch) -> None:
        while view:
            count = self._from.readinto(view[: 1 << 24])
            if not count:
                self._mourn(None)
            watch.heard()
            view = view[count:]

    def _receive(self, watch: _Watch) -> Reply:
        length = bytearray(_LENGTH.size)
        self._read(memoryview(length), watch)
        (size,) = _LENGTH.unpack(length)
        if size > _MOST_JSON:
            raise _DiedError
        text = bytearray(size)
        self._read(memoryview(text), watch)
        try:
            values = json.loads(text)
            arrays = list(_empty(values.pop("arrays")))
            values["state"] = str(values["state"])
        except (ValueError, TypeError, LookupError, AttributeError) as error:
            raise _DiedError from error  # what spoke there was not our code any more
        for array in arrays:
            self._read(_bytes_of(array), watch)
        return values, arrays

    def _mourn(self, error: OSError | None) -> NoReturn:
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(1)  # it has closed its end: its status is about to be known
        raise _DiedError from error


class Children:
    """Children that do the same work, started as they are needed, for threads to share.

    Args:
        work, memory: as `Child`.
    """

    def __init__(self, work: str, memory: int) -> None:
        self._work, self._memory = work, memory
        self._lock = threading.Lock()
        self._all: list[Child] = []
        self._idle: list[Child] = []
        self._stopped = False

    def ask(
        self, values: Mapping[str, Any], arrays: Sequence[npt.NDArray[Any]] = (),
        seconds: float = 300.0,
    ) -> Iterator[Reply]:  # fmt: skip
        """As `Child.ask`, by one that is idle or new."""
        with self._lock:
            if self._stopped:
                raise UnusableFile("was not read: the run was stopped")
            child = self._idle.pop() if self._idle else None
            if child is None:
                child = Child(self._work, self._memory)
                self._all.append(child)
        try:
            yield from child.ask(values, arrays, seconds)
        finally:
            with self._lock:
                if child.idle:
                    self._idle.append(child)
                else:
                    child.close()

    def stop(self) -> None:
        """End all of them at once; threads that wait for one are told."""
        with self._lock:
            self._stopped = True
            for child in self._all:
                child.stop()

    def close(self) -> None:
        """End all of them, when no thread asks any more."""
        with self._lock:
            for child in self._all:
                child.close()
            self._all.clear()
            self._idle.clear()


class _DiedError(Exception):
    pass


class _Watch:
    """Ends what takes too long, or says nothing for too long.

    Args:
        seconds: for all of it.
        stop: called, by a thread, when they are over.
    """

    def __init__(self, seconds: float, stop: Callable[[], None]) -> None:
        self._last, self._stop = time.monotonic() + seconds, stop
        self._done = threading.Event()
        #: Was it stopped?
        self.late = False
        self.heard()
        threading.Thread(target=self._wait, daemon=True).start()

    def heard(self) -> None:
        """It has said something."""
        self._silent_since = time.monotonic()

    def end(self) -> None:
        """It is done."""
        self._done.set()

    def _wait(self) -> None:
        while True:
            left = min(self._last, self._silent_since + SILENCE) - time.monotonic()
            if left <= 0:
                self.late = True
                self._stop()
                return
            if self._done.wait(left):
                return


def _why(status: int | None) -> str:
    if status == -signal.SIGKILL:
        return "needs more memory to decode than there is"
    if status is not None and status < 0:
        return (
            f"makes its decoder crash ({signal.Signals(-status).name}): it is damaged, or made to "
            "do harm"
        )
    return "makes its decoder stop: it is damaged, or made to do harm"


def _parts(values: Values, arrays: Sequence[npt.NDArray[Any]]) -> Iterator[memoryview]:
    """The bytes of a message: length of the JSON text, the text, the arrays."""
    arrays = [np.ascontiguousarray(array) for array in arrays]
    shapes = [[array.dtype.str, list(array.shape)] for array in arrays]
    text = json.dumps({**values, "arrays": shapes}).encode()
    yield memoryview(_LENGTH.pack(len(text)) + text)
    for array in arrays:
        yield _bytes_of(array)


def _bytes_of(array: npt.NDArray[Any]) -> memoryview:
    flat: Any = array.reshape(-1).view(np.uint8)
    return memoryview(flat)


def _empty(shapes: Any) -> Iterator[npt.NDArray[Any]]:
    """Arrays to fill, of the kinds and sizes that a message names."""
    for kind, shape in shapes:
        if math.prod(shape) > 1 << 33:
            raise _DiedError
        yield np.empty(tuple(int(side) for side in shape), _TYPES[kind])


def serve(work: Work, memory: int) -> None:
    """What the child does: answer requests until its parent is gone."""
    answers = os.fdopen(os.dup(1), "wb", buffering=0)
    os.dup2(2, 1)  # what a library prints goes nowhere
    requests: queue.SimpleQueue[Reply] = queue.SimpleQueue()
    # The parent decides (pipeline.process.signals). It may be any of its threads that started this
    # process, so that it must not end with that thread: `_listen` ends it with the parent.
    for name in ("SIGINT", "SIGHUP"):
        if hasattr(signal, name):
            signal.signal(getattr(signal, name), signal.SIG_IGN)
    confine(memory)
    threading.Thread(target=_listen, args=(requests,), daemon=True).start()
    while True:
        values, arrays = requests.get()
        state: Values = {"state": "end"}
        try:
            for reply, found in work(values, arrays):
                _send(answers, {**reply, "state": "more"}, found)
        except UnusableFile as error:
            state = {"state": "unusable", "text": str(error)}
        except MemoryError:
            state = {"state": "unusable", "text": "needs more memory to decode than a file may"}
        except Exception as error:
            state = {"state": "fault", "text": f"{type(error).__name__}: {error}"}
        del values, arrays
        _send(answers, state, [])


def _send(stream: Any, values: Values, arrays: Arrays) -> None:
    for part in _parts(values, arrays):
        while part:
            part = part[stream.write(part) :]


def _listen(requests: queue.SimpleQueue[Reply]) -> None:
    """Take requests from standard input; where that ends, the parent is gone: so does this."""
    stream: Any = os.fdopen(0, "rb", buffering=1 << 20)

    def fill(view: memoryview) -> None:
        while view:
            count = stream.readinto(view)
            if not count:
                os._exit(0)
            view = view[count:]

    while True:
        length = bytearray(_LENGTH.size)
        fill(memoryview(length))
        text = bytearray(_LENGTH.unpack(length)[0])
        fill(memoryview(text))
        values = json.loads(text)
        arrays = []
        for array in _empty(values.pop("arrays")):
            fill(_bytes_of(array))
            arrays.append(array)
        requests.put((values, arrays))


def main(work: str, memory: str) -> None:
    module, _, function = work.partition(":")
    serve(getattr(importlib.import_module(module), function), int(memory))


if __name__ == "__main__":
    main(*sys.argv[1:])
