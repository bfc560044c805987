"""The process that reads what may be made to do harm: what it can't do, and how it ends."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from pipeline.untrusted.child import Child, Children, Values
from pipeline.untrusted.files import UnusableFile

HERE = Path(__file__).parent
ROOT = HERE.parents[1]
WORK = "child_work:work"

PARENT = """
import sys, signal
from pipeline.untrusted.child import Child
def stop(*_): raise KeyboardInterrupt
signal.signal(signal.SIGTERM, stop)
signal.signal(signal.SIGINT, stop)  # a shell ignores it for what it starts with &
with Child("child_work:work", 1 << 28) as child:
    for reply, _ in child.ask({"do": "hang"}):
        print(reply["pid"], flush=True)
"""


@pytest.fixture
def child(monkeypatch: pytest.MonkeyPatch) -> Iterator[Child]:
    monkeypatch.syspath_prepend(str(HERE))
    with Child(WORK, 1 << 28) as made:
        yield made


def test_arrays_come_back_as_they_went(child: Child) -> None:
    random = np.random.default_rng(0)
    sent = [
        random.integers(0, 255, (301, 203, 3), np.uint8),
        random.normal(size=(5, 7)).astype(np.float32),
        random.normal(size=(3, 0)) > 0,
    ]
    for _ in range(2):
        [(reply, found)] = child.ask({"do": "echo"}, sent)
        for a, b in zip(sent, found, strict=True):
            assert a.dtype == b.dtype
            np.testing.assert_array_equal(a, b)
    assert child.idle
    heavy = {"numba", "pycolmap", "open3d", "torch", "cv2", "av", "pydantic", "scipy"}
    assert not heavy & set(reply["modules"])


@pytest.mark.parametrize(
    ("do", "says"),
    [
        ("crash", r"crash \(SIGSEGV\)"),
        ("memory", "memory"),
        ("garbage", "stop"),
        ("refuse", "is not wanted"),
    ],
)
def test_its_end_is_the_file_s_fault(child: Child, do: str, says: str) -> None:
    with pytest.raises(UnusableFile, match=says):
        list(child.ask({"do": do}))


def test_it_can_open_no_file(child: Child) -> None:
    with pytest.raises(RuntimeError, match="Too many open files"):
        list(child.ask({"do": "open"}))


def test_it_has_so_much_time(child: Child) -> None:
    with pytest.raises(UnusableFile, match="took too long"):
        list(child.ask({"do": "hang"}, seconds=0.5))
    assert not child.idle


def test_a_pool_replaces_those_that_died(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(HERE))
    pool = Children(WORK, 1 << 28)

    def answer() -> Values:
        [(reply, _)] = pool.ask({"do": "echo"})
        return reply

    try:
        pids = [answer()["pid"] for _ in range(2)]
        assert pids[0] == pids[1]
        with pytest.raises(UnusableFile):
            list(pool.ask({"do": "crash"}))
        assert answer()["pid"] != pids[0]
    finally:
        pool.close()


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGKILL])
def test_it_ends_with_its_parent(number: signal.Signals) -> None:
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT), str(HERE)])}
    with subprocess.Popen(
        [sys.executable, "-c", PARENT], env=environment, text=True,
        stdout=subprocess.PIPE, stderr=subprocess.DEVNULL,
    ) as parent:  # fmt: skip
        assert parent.stdout is not None
        pid = int(parent.stdout.readline())
        parent.send_signal(number)
        parent.wait(10)
    for _ in range(100):
        try:
            state = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
        except FileNotFoundError:
            return
        if state == "Z":
            return
        time.sleep(0.05)
    pytest.fail("the child is still there")
