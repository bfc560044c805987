"""A signal to end means one thing, whenever it comes and whatever runs: status 130, no mess."""

from __future__ import annotations

import contextlib
import os
import random
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
import toy
from toy import artifact_bytes

import pipeline
from pipeline.process import signals

TOY = Path(toy.__file__)
ROOT = Path(pipeline.__file__).parents[1]
RUN = ("run", "images", "-w", "w", "-c", "toy.yaml", "--set", "count.step_seconds=0.02")

pytestmark = pytest.mark.skipif(os.name != "posix", reason="signals are POSIX's")


@contextmanager
def started(command: list[str], cwd: Path) -> Iterator[subprocess.Popen[str]]:
    """A process that ignores no signal, whoever started the tests."""
    before = {number: signal.signal(number, signal.SIG_DFL) for number in signals.ENDING}
    try:
        process = subprocess.Popen(
            command, cwd=cwd, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
            env={**os.environ, "PYTHONPATH": str(ROOT)},
        )  # fmt: skip
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
    try:
        yield process
    finally:
        process.kill()
        process.communicate()


def ended(process: subprocess.Popen[str]) -> tuple[int, str]:
    _, told = process.communicate(timeout=30)
    return process.returncode, told


def script(body: str) -> list[str]:
    """A program that follows the rule, says that it is ready, and goes on with `body`."""
    lines = "\n    ".join(body.strip().splitlines())
    text = (
        "import os, sys, time, threading\n"
        "from pipeline.process import signals\n"
        f"def work():\n    print('ready', flush=True)\n    {lines}\n    return 0\n"
        "signals.run(work)\n"
    )
    return [sys.executable, "-c", text]


def wait_for(process: subprocess.Popen[str], word: str = "ready") -> None:
    assert process.stdout is not None
    assert process.stdout.readline().strip() == word


def eventually(is_so: Callable[[], bool], seconds: float = 10.0) -> bool:
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        if is_so():
            return True
        time.sleep(0.02)
    return False


def interrupted(status: int, told: str) -> None:
    assert status == 130, told
    assert told.count("Interrupted. Run the same command again") == 1
    assert "Traceback" not in told and "Exception ignored" not in told and "@  " not in told


def test_a_run_is_interrupted_and_goes_on(toys: Path) -> None:
    """By each signal in turn."""
    for count, number in enumerate(signals.ENDING):
        with started([sys.executable, str(TOY), *RUN], toys) as process:
            if count == 0:
                checkpoint = "w/count/*.partial/scratch/checkpoint.json"
                assert eventually(lambda pattern=checkpoint: any(toys.glob(pattern)))
            else:
                assert process.stderr is not None
                assert any("goes on from its checkpoint" in line for line in process.stderr)
            process.send_signal(number)
            interrupted(*ended(process))
    again = subprocess.run(
        [sys.executable, str(TOY), *RUN], cwd=toys, capture_output=True, text=True, timeout=60
    )
    assert again.returncode == 0
    assert "goes on from its checkpoint" in again.stderr
    assert not [p for p in (toys / "w").rglob("*") if p.name.endswith((".tmp", ".partial"))]


IMPORTS = """
import pipeline.cli, pipeline.front.commands, numpy, cv2, pycolmap, scipy.optimize
time.sleep(20)
"""


def test_at_any_moment_also_while_native_libraries_are_imported() -> None:
    moments = random.Random(0)
    for count in range(4):
        with started(script(IMPORTS), ROOT) as process:
            wait_for(process)
            time.sleep(moments.uniform(0, 0.8))
            process.send_signal(signals.ENDING[count % len(signals.ENDING)])
            interrupted(*ended(process))


def test_native_libraries_leave_the_handlers_alone() -> None:
    """pycolmap's would print a stack trace and kill."""
    body = """
import signal
before = {n: signal.getsignal(n) for n in signals.ENDING}
import pycolmap, cv2, numba, av, open3d, pymeshlab
print('loaded', flush=True)
time.sleep(20)
"""
    with started(script(body), ROOT) as process:
        wait_for(process)
        assert process.stdout is not None
        assert "loaded\n" in iter(process.stdout.readline, "")
        process.send_signal(signal.SIGTERM)
        interrupted(*ended(process))


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
def test_no_thread_of_a_native_library_hears_a_signal() -> None:
    """One that does may hear it while the handler of pycolmap is there."""
    body = """
import signal
import numpy, scipy.linalg, scipy.optimize, cv2, pycolmap, numba, av, open3d, pymeshlab, torch
threads = [int(name) for name in os.listdir('/proc/self/task')]
for thread in threads:
    status = open(f'/proc/self/task/{thread}/status').read()
    held = int(status.split('SigBlk:')[1].split()[0], 16)
    hears = [n for n in signals.ENDING if not held >> (n - 1) & 1]
    if bool(hears) != (thread == os.getpid()):
        print('hears' if hears else 'is deaf', flush=True)
print(len(threads), 'threads', flush=True)
"""
    with started(script(body), ROOT) as process:
        wait_for(process)
        told, errors = process.communicate(timeout=60)
    assert process.returncode == 0, errors
    assert "hears" not in told and "is deaf" not in told
    if len(os.sched_getaffinity(0)) > 1:
        assert int(told.split()[0]) >= 3  # OpenBLAS has come with its own


def test_many_signals_are_one() -> None:
    """Also while what the first one interrupted is being put in order."""
    body = """
try:
    print('inside', flush=True)
    time.sleep(20)
finally:
    print('cleaning', flush=True)
    time.sleep(0.5)
    print('clean', flush=True)
"""
    with started(script(body), ROOT) as process:
        wait_for(process)
        wait_for(process, "inside")
        for count in range(20):
            process.send_signal(signals.ENDING[count % len(signals.ENDING)])
            time.sleep(0.02)
        out, told = process.communicate(timeout=30)
        interrupted(process.returncode, told)
        assert out.split() == ["cleaning", "clean"]


def test_who_does_not_obey_in_time_is_ended_by_the_next_signal() -> None:
    body = """
signals.PATIENCE = 0.3
try:
    time.sleep(20)
finally:
    time.sleep(20)
"""
    with started(script(body), ROOT) as process:
        wait_for(process)
        time.sleep(0.2)
        process.send_signal(signal.SIGTERM)
        time.sleep(0.6)
        process.send_signal(signal.SIGTERM)
        interrupted(*ended(process))


def test_native_code_that_never_comes_back_is_ended() -> None:
    body = """
import ctypes
signals.LAST_RESORT = 0.3
ctypes.CDLL(None).system(b'sleep 2')
"""
    with started(script(body), ROOT) as process:
        wait_for(process)
        time.sleep(0.2)
        begin = time.monotonic()
        process.send_signal(signal.SIGTERM)
        process.wait(timeout=10)
        assert time.monotonic() - begin < 1.5
        assert process.returncode == 130


def test_a_run_whose_streams_are_closed_ends_well(toys: Path) -> None:
    """Nor does a library write into the file that would have got the number of a stream."""
    for closed in ((2,), (0, 1, 2)):
        done = subprocess.run(
            [sys.executable, str(TOY), *RUN, "--set", f"scale.factor={1 + len(closed)}"], cwd=toys,
            env={**os.environ, "PYTHONPATH": str(ROOT)}, stdout=subprocess.DEVNULL,
            preexec_fn=lambda closed=closed: [os.close(number) for number in closed],
        )  # fmt: skip
        assert done.returncode == 0


def test_a_terminal_has_its_cursor_back_after_a_forced_end() -> None:
    body = """
import ctypes
from pipeline.front.progress import LiveReporter
signals.LAST_RESORT = 0.3
LiveReporter().start([])
ctypes.CDLL(None).system(b'sleep 9')
"""
    import pty  # POSIX's

    main, terminal = pty.openpty()
    process = subprocess.Popen(
        script(body), cwd=ROOT, stderr=terminal, stdout=subprocess.DEVNULL,
        env={**os.environ, "PYTHONPATH": str(ROOT), "TERM": "xterm"},
    )  # fmt: skip
    os.close(terminal)
    told = b""
    with contextlib.suppress(OSError):  # EIO: nobody has the terminal any more
        while more := os.read(main, 9999):
            told += more
            if b"\x1b[?25l" in more:
                process.terminate()
    assert process.wait(timeout=10) == 130
    assert told.count(b"\x1b[?25l") == told.count(b"\x1b[?25h") == 1


LOST = {
    "in a destructor": """
class Slow:
    def __del__(self):
        time.sleep(0.5)
slow = Slow()
del slow
time.sleep(20)
""",
    "by a library": """
try:
    time.sleep(20)
except BaseException:
    pass
signals.check()
time.sleep(20)
""",
    "as another error": """
try:
    time.sleep(20)
except BaseException:
    raise ImportError('initialization failed')
""",
    "as a failure": """
try:
    time.sleep(20)
except BaseException:
    return 1
""",
}


@pytest.mark.parametrize("how", LOST)
def test_an_interrupt_that_gets_lost_comes_again(how: str) -> None:
    with started(script(LOST[how]), ROOT) as process:
        wait_for(process)
        time.sleep(0.2)
        process.send_signal(signal.SIGTERM)
        interrupted(*ended(process))


def test_what_is_done_is_done() -> None:
    """A signal after the work: its status stands."""
    body = """
import atexit
atexit.register(lambda: (print('leaving', flush=True), time.sleep(0.6)))
return 3
"""
    with started(script(body), ROOT) as process:
        wait_for(process)
        wait_for(process, "leaving")
        process.send_signal(signal.SIGTERM)
        process.send_signal(signal.SIGINT)
        status, told = ended(process)
        assert (status, told) == (3, "")


def test_what_was_ignored_stays_ignored() -> None:
    command = script("time.sleep(0.8)")
    with started(["nohup", *command], ROOT) as process:
        wait_for(process)
        process.send_signal(signal.SIGHUP)
        status, told = ended(process)
        assert status == 0 and "Interrupted" not in told


def alive(process: int) -> bool:
    try:
        state = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0]
    except OSError:
        return False
    return state != "Z"


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="reads /proc")
@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGTERM])
@pytest.mark.parametrize("system_helps", [True, False])
def test_children_end_with_their_parent(number: int, system_helps: bool) -> None:
    """A module of ours in a process of its own, as COLMAP's and a benchmark's cells are."""
    helped = "" if system_helps else "signals._killed_with_parent = lambda: False; "
    body = f"""
import subprocess
ours = os.getpid()
code = ("from pipeline.process import signals; {helped}signals.child(" + str(ours) + "); "
        "import pycolmap, time; print('up', flush=True); time.sleep(60)")
child = subprocess.Popen([sys.executable, '-c', code], stdout=subprocess.PIPE, text=True)
child.stdout.readline()
print(child.pid, flush=True)
child.wait()
"""
    with started(script(body), ROOT) as process:
        wait_for(process)
        assert process.stdout is not None
        child = int(process.stdout.readline())
        for harmless in (signal.SIGINT, signal.SIGHUP):  # as a terminal sends to all
            os.kill(child, harmless)
        time.sleep(0.1)
        assert alive(child)
        process.send_signal(number)
        process.wait(timeout=30)
        assert eventually(lambda: not alive(child))


def test_kills_by_any_signal_change_no_byte(toys: Path) -> None:
    whole = subprocess.run(
        [sys.executable, str(TOY), "run", "images", "-w", "whole", "-c", "toy.yaml"], cwd=toys,
        capture_output=True, timeout=60,
    )  # fmt: skip
    assert whole.returncode == 0
    moments = random.Random(1)
    numbers = (signal.SIGKILL, *signals.ENDING)
    for count in range(5):
        with started([sys.executable, str(TOY), *RUN], toys) as process:
            assert process.stderr is not None
            process.stderr.readline()  # before the rule holds, a signal does what it always does
            time.sleep(moments.uniform(0, 0.5))
            process.send_signal(numbers[count % 4])
            status, told = ended(process)
            if numbers[count % 4] != signal.SIGKILL and status != 0:
                interrupted(status, told)
    last = subprocess.run([sys.executable, str(TOY), *RUN], cwd=toys, capture_output=True)
    assert last.returncode == 0
    assert artifact_bytes(toys / "w") == artifact_bytes(toys / "whole")
    assert not [p for p in (toys / "w").rglob("*") if p.name.endswith((".tmp", ".partial"))]
