"""What a signal to end means: the one rule, for the command line and for the processes it starts.

SIGINT (Ctrl-C), SIGTERM (``kill``, a batch system) and SIGHUP (a closed terminal) mean the same:
`KeyboardInterrupt` in the main thread, "Interrupted" on standard error, exit status 130. What was
ignored when the program was started (``nohup``, ``&`` in a script) stays ignored. Further signals
while the first one is obeyed change nothing for `PATIENCE` seconds: they often come in twos; after
that the next one ends the process on the spot, which the store survives as it survives a kill.

A child process leaves the decision to its parent, and ends with it however the parent ends.
"""

from __future__ import annotations

import _thread
import atexit
import contextlib
import ctypes
import os
import signal
import sys
import threading
import time
from collections.abc import Callable
from typing import Any, NoReturn

#: Those that mean: come to an end. Not every system has all.
ENDING = tuple(
    getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)
)
STATUS = 130
#: Seconds that the process is given to obey before a further signal ends it on the spot.
PATIENCE = 5.0
#: Seconds after which a process that can't obey (native code that takes its time) is ended.
LAST_RESORT = 20.0

#: To a terminal: what a display that nobody stops any more leaves is wiped, and its cursor is back.
SHOWN_AGAIN = "\r\x1b[K\x1b[?25h"
TEXT = "Interrupted. Run the same command again to go on from here."

_asked_at: float | None = None


def install() -> None:
    """Make this process follow the rule; in the main thread, before anything slow is imported."""
    global _asked_at
    _asked_at = None
    for number in ENDING:
        if signal.getsignal(number) != signal.SIG_IGN:
            signal.signal(number, _obey)
    sys.unraisablehook = _unraisable
    heard, hear = os.pipe()
    os.set_blocking(hear, False)
    signal.set_wakeup_fd(hear, warn_on_full_buffer=False)
    _thread.start_new_thread(_end_if_stuck, (heard,))


def asked() -> bool:
    """Has a signal to end come? Some libraries swallow the exception that tells of it."""
    return _asked_at is not None


def check() -> None:
    """Where work is done in steps: end here if a signal to end came and got lost.

    Raises:
        KeyboardInterrupt: it did.
    """
    if asked() and threading.current_thread() is threading.main_thread():
        raise KeyboardInterrupt


def _obey(number: int, frame: Any) -> None:
    global _asked_at
    now = time.monotonic()
    if _asked_at is None:
        _asked_at = now
        raise KeyboardInterrupt
    if now - _asked_at > PATIENCE:
        end()


def _end_if_stuck(heard: int) -> None:
    """In a thread of its own: `_obey` has to wait until native code gives the main thread back."""
    if os.name == "posix":  # no handler of a library is ever to run here
        signal.pthread_sigmask(signal.SIG_BLOCK, ENDING)
    while not set(os.read(heard, 1)) & set(ENDING):
        pass
    time.sleep(LAST_RESORT)
    end()


def end() -> NoReturn:
    """End this process now as an interrupted one: no library gets to say anything any more."""
    shown = os.isatty(2) and os.environ.get("TERM", "dumb") != "dumb"
    with contextlib.suppress(OSError):
        os.write(2, f"{SHOWN_AGAIN if shown else ''}{TEXT}\n".encode())
    os._exit(STATUS)


def _unraisable(told: Any) -> None:
    """An interrupt that came inside a destructor or a callback would be printed and forgotten."""
    global _asked_at
    if not (isinstance(told.exc_value, KeyboardInterrupt) and asked()):
        sys.__unraisablehook__(told)
        return
    _asked_at = None
    _thread.start_new_thread(_ask_again, ())


def _ask_again() -> None:
    """From another thread, and a little later: the interrupt must not hit the same spot."""
    time.sleep(0.05)
    for number in ENDING:
        if signal.getsignal(number) is _obey:
            main = threading.main_thread().ident
            if main is not None:
                signal.pthread_kill(main, number)  # wakes it up as well, if it waits
            return


def run(command: Callable[[], int]) -> NoReturn:
    """The whole life of a program: `command` gives its exit status unless a signal ends it.

    Whatever exception escapes after a signal came is taken for its consequence: a native module
    whose import was interrupted raises anything.
    """
    try:
        _open_closed_streams()
        install()
        status = command()
        for number in ENDING:  # the status is known: a signal has nothing to add
            signal.signal(number, signal.SIG_IGN)
    except KeyboardInterrupt:
        status = STATUS
    except Exception:
        if not asked():
            raise
        status = STATUS
    if status == STATUS or (asked() and status):
        with contextlib.suppress(Exception):
            sys.stdout.flush()
        end()
    _leave(status)


def _open_closed_streams() -> None:
    """Where a stream was closed by who started this, the next file opened would be taken for it."""
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        if getattr(sys, name) is None:
            opened = os.open(os.devnull, os.O_RDWR)  # it gets the lowest number that is free
            os.set_inheritable(opened, True)
            setattr(sys, name, os.fdopen(opened, "w" if number else "r", encoding="utf-8"))


def _leave(status: int) -> NoReturn:
    """Exit as `sys.exit` does, but leave it to the system to take modules and memory apart.

    With a run's modules and arrays the interpreter takes up to half a second for that.
    """
    threading._shutdown()  # type: ignore[attr-defined]  # waits for threads, as an exit does
    atexit._run_exitfuncs()
    try:
        for stream in filter(None, (sys.stdout, sys.stderr)):
            stream.flush()
    except (OSError, ValueError):  # nobody listens any more: it has its own status for that
        sys.exit(status)
    os._exit(status)


def child(parent: int | None = None) -> None:
    """Make this process one that its parent decides about: call first thing.

    Ctrl-C and a closed terminal reach the whole group; only the parent obeys. SIGTERM ends it at
    once. It is killed when the parent ends, also where that was killed itself: by the system where
    it can (Linux), else within a second of the parent's end.

    Args:
        parent: its process number, where it is known.
    """
    parent = parent or os.getppid()
    for number in ENDING:
        signal.signal(number, signal.SIG_DFL if number == signal.SIGTERM else signal.SIG_IGN)
    if not _killed_with_parent():
        threading.Thread(target=_watch_parent, args=(parent,), daemon=True).start()
    elif os.getppid() != parent:  # it ended just before
        os._exit(1)


def _killed_with_parent() -> bool:
    """Ask Linux to kill this process when the thread that started it ends (prctl(2))."""
    if not sys.platform.startswith("linux"):
        return False
    set_death_signal = 1
    try:
        return ctypes.CDLL(None).prctl(set_death_signal, signal.SIGKILL, 0, 0, 0) == 0
    except (OSError, AttributeError):
        return False


def _watch_parent(parent: int) -> None:
    while os.getppid() == parent:
        time.sleep(1.0)
    os._exit(1)
