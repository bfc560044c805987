"""Compiled kernels: kept, found again, never older than their source, wherever they can be kept."""

from __future__ import annotations

import importlib
import os
import subprocess
import sys
import threading
import warnings
from pathlib import Path

import cv2
import numpy as np
import pytest
from numba.core.dispatcher import Dispatcher

from pipeline.kernels import cache, folder, kernel, kernel_threads, news, rehearsals
from pipeline.kernels import each as each_piece
from pipeline.kernels.threads import in_threads, opencv_threads, side_by_side
from pipeline.stage import get_stage

ROOT = Path(__file__).resolve().parents[2]
KERNELS = """
from pipeline.kernels import kernel
from sums.parts import FACTOR, weighted

@kernel()
def total(values):
    result = 0.0
    for value in values:
        result += weighted(value) * FACTOR
    return result
"""
HELPERS = """
from pipeline.kernels import helper

FACTOR = 10

@helper
def weighted(value):
    return 2 * value
"""
RUN = """
import numpy as np
from pipeline.kernels import news
from sums.kernels import total

compiled = []
with news.told_to(compiled.append):
    print(total(np.arange(4.0)), len(compiled))
"""
#: What the project's kernels do beyond sums, and how a process that compiles nothing does it.
MORE = """
import math
import numpy as np
from numba import prange
from pipeline.kernels import kernel

@kernel(parallel=True)
def rooted(values):
    found = np.empty_like(values)
    for i in prange(len(values)):
        found[i] = math.sqrt(values[i])
    return found

@kernel(nogil=True)
def solved(matrix, values):
    if len(values) == 0:
        raise ValueError("nothing to solve")
    return np.linalg.solve(matrix, values), np.dot(values, values), np.sort(values)[0]
"""
RUN_MORE = """
import sys
import numpy as np
from pipeline.kernels import news
from sums.more import rooted, solved

compiled = []
with news.told_to(compiled.append):
    assert rooted(np.array([4.0, 9.0])).tolist() == [2, 3]
    found, square, least = solved(2 * np.eye(2), np.array([4.0, 2.0]))
    assert (found.tolist(), square, least) == ([2, 1], 20, 2)
    try:
        solved(np.eye(2), np.empty(0))
    except ValueError as error:
        assert "nothing to solve" in str(error)
    else:
        raise AssertionError
print(len(compiled), "numba.typed.typeddict" in sys.modules)
"""
#: A kernel that calls another, which is kept already; both with types said ahead.
LINKED = """
from pipeline.kernels import kernel

@kernel("float64(float64)", linked=True)
def squared(value):
    return value * value
"""
CALLER = """
from pipeline.kernels import kernel
from sums.linked import squared

@kernel("float64(float64)")
def and_one(value):
    return squared(value) + 1
"""
RUN_LINKED = """
from pipeline.kernels import news

compiled = []
with news.told_to(compiled.append):
    from sums.caller import and_one, squared
print(squared(3.0), and_one(3.0), len(compiled))
"""


@pytest.fixture
def sums(tmp_path):
    """A package with a kernel in one file and its helper in another."""
    package = tmp_path / "sums"
    package.mkdir()
    for name, text in (("__init__", ""), ("kernels", KERNELS), ("parts", HELPERS)):
        (package / f"{name}.py").write_text(text)
    return package


def started(package: Path, code: str = RUN) -> subprocess.Popen[str]:
    environment = {
        **os.environ,
        "PYTHONPATH": f"{package.parent}{os.pathsep}{ROOT}", "PYTHONDONTWRITEBYTECODE": "1",
        "NUMBA_CACHE_DIR": str(package.parent / "cache"),
    }  # fmt: skip
    return subprocess.Popen(
        [sys.executable, "-c", code], env=environment, stdout=subprocess.PIPE, text=True
    )


def run(package: Path) -> tuple[float, int]:
    """What the kernel says in a process of its own, and how often it had to be compiled."""
    value, compiled = started(package).communicate(timeout=120)[0].split()
    return float(value), int(compiled)


def is_compiled(value: object) -> bool:
    return isinstance(value, Dispatcher)


def is_kernel(value: object) -> bool:
    return is_compiled(value) and isinstance(value._cache, cache.KernelCache)


def kept(package: Path) -> list[str]:
    return sorted(p.name for p in (package.parent / "cache" / "dentalsplat").iterdir())


class TestSource:
    def test_a_kernel_is_compiled_once(self, sums):
        assert run(sums) == (120.0, 1)
        assert run(sums) == (120.0, 0)
        (file,) = (sums.parent / "cache" / "dentalsplat").iterdir()
        file.write_bytes(file.read_bytes()[:-100])  # half a file is none
        assert run(sums) == (120.0, 1)
        assert run(sums) == (120.0, 0)
        assert len(kept(sums)) == 1

    def test_kernels_that_are_kept_need_no_compiler(self, sums):
        """And work all the same: threads, errors, memory, linear algebra."""
        (sums / "more.py").write_text(MORE)
        for said in ("2 True", "0 False"):
            process = started(sums, RUN_MORE)
            assert process.communicate(timeout=120)[0].strip() == said
            assert process.returncode == 0

    def test_a_linked_one_is_called_by_others_also_when_it_was_kept(self, sums):
        (sums / "linked.py").write_text(LINKED)
        for number, compiled in ((1, 2), (2, 1), (2, 0)):
            (sums / "caller.py").write_text(CALLER.replace("+ 1", f"+ {number}"))
            process = started(sums, RUN_LINKED)
            said = process.communicate(timeout=120)[0].split()
            assert said == ["9.0", f"{9.0 + number}", str(compiled)]

    def test_what_kernels_call_is_linked(self):
        """Or a helper: what is kept of other kernels can't be linked with."""
        files = [path for home in ("pipeline", "stages") for path in (ROOT / home).rglob("*.py")]
        found = []
        for file in (path for path in files if "\n@kernel" in path.read_text()):
            module = ".".join(file.relative_to(ROOT).with_suffix("").parts)
            known = vars(importlib.import_module(module))
            for caller in filter(is_compiled, known.values()):
                code, names = caller.py_func.__code__, caller.py_func.__globals__
                found += [names[name] for name in code.co_names if is_kernel(names.get(name))]
        assert found
        assert all(called._cache._linked for called in found)

    def test_an_edited_helper_counts_and_old_states_are_deleted(self, sums):
        edits = [("10", "10"), ("2 * value", "3 * value")]
        edits += [("10", str(factor)) for factor in range(folder.KEPT)]
        values = [120.0, 180.0, *(12.0 * factor for factor in range(folder.KEPT))]
        for edit, value in zip(edits, values, strict=True):
            (sums / "parts.py").write_text(HELPERS.replace(*edit))
            assert run(sums) == (value, 1)
        assert len(kept(sums)) == folder.KEPT
        (sums / "parts.py").write_text(HELPERS.replace(*edits[-2]))
        assert run(sums) == (values[-2], 0)

    def test_two_processes_at_once(self, sums):
        both = [started(sums) for _ in range(2)]
        values = [process.communicate(timeout=120)[0].split()[0] for process in both]
        assert values == ["120.0", "120.0"]
        assert len(kept(sums)) == 1


def twice(values):
    return values * 2


class TestPlace:
    @pytest.fixture
    def nowhere(self, tmp_path):
        """A folder that nobody can make, root included."""
        (tmp_path / "file").touch()
        return tmp_path / "file" / "kernels"

    def test_first_that_can_be_written(self, tmp_path, nowhere, monkeypatch):
        monkeypatch.setattr(folder, "folders", lambda: [nowhere, nowhere, tmp_path / "kernels"])
        assert folder.writable() == tmp_path / "kernels"
        assert (tmp_path / "kernels").stat().st_mode & 0o777 == 0o700
        compiled = []
        with news.told_to(compiled.append):
            assert kernel()(twice)(3) == 6
            assert kernel()(twice)(4) == 8  # from the disk
        assert len(compiled) == 1

    def test_none_can_be_written(self, nowhere, monkeypatch):
        monkeypatch.setattr(folder, "folders", lambda: [nowhere])
        monkeypatch.setattr(cache, "_told", [])
        with pytest.warns(RuntimeWarning, match="can't be kept"):
            assert kernel()(twice)(3) == 6
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            assert kernel()(twice)(4) == 8

    def test_a_home_that_is_not_there(self, nowhere, tmp_path, monkeypatch):
        monkeypatch.delenv("NUMBA_CACHE_DIR", raising=False)
        monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
        monkeypatch.setenv("HOME", str(nowhere))
        monkeypatch.setattr(folder.tempfile, "gettempdir", lambda: str(tmp_path))
        package, *others = folder.folders()
        assert package.is_relative_to(ROOT)
        monkeypatch.setattr(folder, "folders", lambda: [nowhere, *others])
        assert folder.writable() == tmp_path / f"dentalsplat-kernels-{os.getuid()}"

    def test_a_system_without_user_ids(self, nowhere, tmp_path, monkeypatch):
        monkeypatch.delenv("NUMBA_CACHE_DIR", raising=False)
        monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
        monkeypatch.delattr(os, "getuid")
        cache_of_user = folder.folders()[-1]
        assert cache_of_user == tmp_path / "dentalsplat" / "kernels"
        monkeypatch.setattr(folder, "folders", lambda: [nowhere, cache_of_user])
        assert folder.writable() == cache_of_user

    def test_what_others_can_write_is_not_read(self, tmp_path, nowhere, monkeypatch):
        shared = tmp_path / "shared"
        shared.mkdir()
        shared.chmod(0o777)
        monkeypatch.setattr(folder, "folders", lambda: [nowhere, shared])
        assert folder.writable() is None
        assert folder.readable() == []


class TestThreads:
    def test_each_piece_once(self):
        done = np.zeros(100, np.int64)

        def piece(k, step):
            done[k] += step

        each_piece(piece, 100, 3)
        assert (done == 3).all()

    def test_a_failure_is_passed_on(self):
        def piece(k):
            raise ValueError("no")

        with pytest.raises(ValueError, match="no"):
            each_piece(piece, 4)

    def test_number_is_put_back(self):
        import numba

        before = numba.get_num_threads()
        with kernel_threads(1):
            assert numba.get_num_threads() == 1
        assert numba.get_num_threads() == before


class TestRehearsals:
    def test_held_once(self, tmp_path, monkeypatch):
        monkeypatch.setattr(folder, "folders", lambda: [tmp_path])
        before = rehearsals.missing(["flow"])
        assert before == ["stages.flow.rehearsal:splatting"]
        rehearsals.hold(before[0])
        assert rehearsals.missing(["flow"]) == []

    @pytest.mark.parametrize("stage", ["init", "align", "flow", "fit", "export", "evaluate"])
    def test_every_one_can_be_held(self, stage):
        """One that fails in its process is not heard of: kernels are compiled later."""
        for name in get_stage(stage).rehearsals:
            module, _, function = name.partition(":")
            getattr(importlib.import_module(module), function)()

    def test_processes_share_them_and_leave_none(self, tmp_path, monkeypatch):
        (tmp_path / "toys.py").write_text(
            "import os, pathlib, time\n"
            "def note(name):\n"
            "    time.sleep(0.2)\n"
            "    pathlib.Path(name).write_text(str(os.getpid()))\n"
            "def a(): note('a')\n"
            "def much_longer(): note('much_longer')\n"
            "def c(): note('c')\n"
        )
        monkeypatch.chdir(tmp_path)
        monkeypatch.syspath_prepend(tmp_path)
        monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "kept"))
        names = ["toys:a", "toys:much_longer", "toys:c"]
        monkeypatch.setattr(rehearsals, "missing", lambda stages: names)
        background = rehearsals.Background()
        background.start(["toys"], processes=2)
        assert background.wait()
        held_by = [Path(name.partition(":")[2]).read_text() for name in names]
        assert len(set(held_by)) == 2
        assert len(list((tmp_path / "kept" / "dentalsplat").glob("rehearsed.toys.*"))) == 3

    def test_processes_end_with_the_run(self, tmp_path, monkeypatch):
        monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
        background = rehearsals.Background()
        background.start(["init", "fit"], processes=2)
        processes = list(background._running)
        assert len(processes) == 2
        background.stop()
        assert all(process.poll() is not None for process in processes)


def test_opencv_has_its_threads_back_whatever_happened():
    before = cv2.getNumThreads()
    cv2.setNumThreads(3)
    try:
        with opencv_threads(1):
            assert cv2.getNumThreads() == 1
        assert cv2.getNumThreads() == 3
        with pytest.raises(KeyError), opencv_threads(1):
            raise KeyError
        assert cv2.getNumThreads() == 3
    finally:
        cv2.setNumThreads(before)


def test_what_threads_find_comes_in_the_order_of_the_items():
    done = []
    assert in_threads(lambda k: k * k, range(7), 3, done.append) == [k * k for k in range(7)]
    assert done == list(range(1, 8))


@pytest.mark.parametrize("threads", [1, 2])
def test_two_functions_run_side_by_side_where_there_are_threads(threads):
    def here():
        return threading.get_ident()

    main, beside = side_by_side(here, here, threads)
    assert main == here()
    assert (beside == here()) is (threads == 1)

    def wrong():
        raise ValueError("wrong")

    for pair in ((wrong, here), (here, wrong)):
        with pytest.raises(ValueError, match="wrong"):
            side_by_side(*pair, threads)
