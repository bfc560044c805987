"""A batch on a Dask scheduler: workers and schedulers are killed, and nothing is lost."""

from __future__ import annotations

import contextlib
import json
import os
import subprocess
import sys
import urllib.error
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import psutil
import pytest

from pipeline.studies.batch.cluster import slots
from tests.studies import toy_batch
from tests.studies.small_batch import wait_for

pytest.importorskip("distributed")


class Cluster:
    """A scheduler and workers, each a process, to be killed."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.file = folder / "scheduler.json"
        self.scheduler: subprocess.Popen[bytes] | None = None
        self.workers: list[subprocess.Popen[bytes]] = []

    def start(self) -> None:
        self.file.unlink(missing_ok=True)
        self.scheduler = self._process(
            sys.executable, "-m", "distributed.cli.dask_scheduler", "--no-dashboard", "--host",
            "127.0.0.1", "--port", "0", "--scheduler-file", str(self.file),
        )  # fmt: skip
        wait_for(lambda: self.file.exists() and self.file.stat().st_size > 0)

    def work(self) -> subprocess.Popen[bytes]:
        address = json.loads(self.file.read_text())["address"]
        self.workers.append(self._process(*toy_batch.COMMAND, "worker", address))
        return self.workers[-1]

    def batch(self, *arguments: str) -> subprocess.Popen[str]:
        (self.folder / "toy.yaml").write_text(f"stages: {toy_batch.ORDER}\nreport: false\n")
        return subprocess.Popen(
            [*toy_batch.COMMAND, "batch", "cases", "-o", "out", "-c", "toy.yaml", "--json",
             "--scheduler", str(self.file), *arguments],
            cwd=self.folder, env=self._environment(), text=True, stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
        )  # fmt: skip

    def stop(self) -> None:
        for process in (*self.workers, self.scheduler):
            if process is not None:
                process.kill()
                process.wait()

    def _process(self, *command: str) -> subprocess.Popen[bytes]:
        with (self.folder / "dask.log").open("a") as log:
            return subprocess.Popen(  # workers are started in any folder
                command, cwd="/", env=self._environment(), stdout=log, stderr=log
            )

    def _environment(self) -> dict[str, str]:
        return {**os.environ, "TOY_LOG": str(self.folder / "log.txt")}


@pytest.fixture
def cluster(tmp_path: Path) -> Iterator[Cluster]:
    made = Cluster(tmp_path)
    for name in ("a", "b", "c"):
        case = tmp_path / "cases" / name
        case.mkdir(parents=True)
        for value in (ord(name), ord(name) + 1):
            (case / f"{value}.jpg").write_text(str(value))
    made.start()
    yield made
    made.stop()


def lines(folder: Path, stage: str) -> list[list[Any]]:
    """What a stage has computed: its values, and in which process."""
    file = folder / "log.txt"
    told = map(json.loads, file.read_text().splitlines()) if file.exists() else iter(())
    return [entry[1:] for entry in told if entry[0] == stage]


def test_a_scheduler_that_went_while_it_was_asked_has_no_places() -> None:
    from distributed.comm import CommClosedError

    class Client:
        def nthreads(self) -> dict[str, int]:
            raise CommClosedError("reset by peer")

    assert slots(Client()) == 0


def test_a_killed_worker_and_a_killed_scheduler_lose_nothing(
    cluster: Cluster, tmp_path: Path
) -> None:
    cluster.work()
    batch = cluster.batch("--set", "fit.wait=2")
    wait_for(lambda: len(lines(tmp_path, "fit")) == 1)
    cluster.workers[0].kill()
    cluster.workers[0].wait()
    cluster.work()  # which does what the other had begun, and goes on
    wait_for(lambda: len(lines(tmp_path, "export")) == 1)
    assert cluster.scheduler is not None
    cluster.scheduler.kill()
    out, told = batch.communicate(timeout=60)
    assert batch.returncode == 2, told
    assert "scheduler is gone" in json.loads(out)["error"]
    cluster.stop()
    cluster.start()
    cluster.work()
    again = cluster.batch("--set", "fit.wait=0")
    out, told = again.communicate(timeout=60)
    assert again.returncode == 0, told
    assert json.loads(out)["counts"] == {"done": 3}
    # Every number was read once and every scene exported once; a fit that was killed ran again.
    assert len(lines(tmp_path, "views")) == 3 == len(lines(tmp_path, "export"))
    assert 4 <= len(lines(tmp_path, "fit")) <= 5


class LosingClient:
    """A Dask client whose worker dies with the first result, just when that is there."""

    status = "running"

    def __init__(self) -> None:
        self.given: list[str] = []

    def nthreads(self) -> dict[str, int]:
        return {"worker": 1}

    def submit(self, work: object, job: dict[str, Any], *, key: str, **_: object) -> Any:
        from pipeline.studies.batch.records import Case, new_record

        assert key not in self.given
        self.given.append(key)
        case = Case.from_dict(job["case"])
        record = new_record(case, "done", settings=job["settings"], session=job["session"])
        status = "lost" if len(self.given) == 1 else "finished"
        future = SimpleNamespace(key=key, status=status, result=lambda: record)
        future.add_done_callback = lambda call: call(future)
        return future


def test_a_result_that_went_with_its_worker_is_asked_for_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from pipeline.studies.batch import running

    for name in ("a", "b"):
        (tmp_path / "cases" / name).mkdir(parents=True)
        for number in "12":
            (tmp_path / "cases" / name / f"{number}.jpg").write_text(name + number)
    client = LosingClient()
    monkeypatch.setattr(running, "connected", lambda *_: contextlib.nullcontext(client))
    monkeypatch.setattr(running, "check_workers", lambda *_: None)
    results = running.batch(tmp_path / "cases", out=tmp_path / "out", scheduler="tcp://nobody:1")
    assert results["counts"] == {"done": 2}
    assert [key.rsplit("-", 2)[0] for key in client.given] == ["a", "a", "b"]


def test_a_batch_on_this_machine_can_be_asked_by_no_other() -> None:
    from pipeline.studies.batch.cluster import connected

    here = psutil.Process()
    before = {place for place in here.net_connections() if place.status == "LISTEN"}
    with connected(None, 2) as client:
        assert client.submit(sum, (1, 2)).result() == 3
        now = {place for place in here.net_connections() if place.status == "LISTEN"}
        for place in now - before:
            assert place.laddr.ip == "127.0.0.1"
            with pytest.raises(urllib.error.HTTPError, match="404"):
                urllib.request.urlopen(f"http://127.0.0.1:{place.laddr.port}/health", timeout=9)


def test_a_worker_that_does_not_see_the_folder_is_told_of(tmp_path: Path) -> None:
    from pipeline.studies.batch.task import look

    assert "does not see the folder" in look(str(tmp_path), "x")
    (tmp_path / "batch.json").write_text(json.dumps({"id": "x", "version": "0.0"}))
    assert "Install the same version" in look(str(tmp_path), "x")
    with contextlib.suppress(OSError):
        assert "does not see" in look(str(tmp_path), "y")
