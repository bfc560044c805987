"""The machines that a batch runs on: this one, or those of a Dask scheduler."""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from pipeline.errors import RequestError
from pipeline.files import read_json
from pipeline.installed import require
from pipeline.studies.batch.task import look

#: Seconds to find a scheduler in.
PATIENCE = 15
#: Where only this machine listens, at a port that is free.
NOWHERE = "127.0.0.1:0"


def require_dask() -> None:
    """Make sure that Dask is there.

    Raises:
        RequestError: it is not; how to install it.
    """
    require("pipeline batch", "batch", "dask", "distributed")


@contextlib.contextmanager
def connected(scheduler: str | None, jobs: int) -> Iterator[Any]:
    """A Dask client.

    Here, all is one process with `jobs` threads: what needs to be apart is the cases, and each has
    a process of its own. No other machine can ask it anything: Dask's web servers, which can't be
    left out, have no pages, and this machine alone reaches them.

    Args:
        scheduler: address (``tcp://host:8786``) or file of a scheduler; None: this machine.

    Raises:
        RequestError: there is no such scheduler.
    """
    import dask
    from distributed import Client, LocalCluster

    for name in ("distributed", "distributed.core", "tornado.application", "asyncio"):
        logging.getLogger(name).setLevel(logging.CRITICAL)  # what matters is said by the batch
    if scheduler is None:
        settings = {
            "distributed.admin.system-monitor.gil.enabled": False,
            "distributed.scheduler.http.routes": [],
            "distributed.worker.http.routes": [],
        }
        with (
            dask.config.set(settings),
            LocalCluster(
                n_workers=1, threads_per_worker=jobs, processes=False, memory_limit=0,
                dashboard_address=None, scheduler_kwargs={"dashboard_address": NOWHERE},
                worker_dashboard_address=NOWHERE, silence_logs=logging.CRITICAL,
            ) as cluster,
            Client(cluster, set_as_default=False) as client,
        ):  # fmt: skip
            yield client
        return
    address = _address(scheduler)
    try:
        client = Client(address, timeout=PATIENCE, set_as_default=False)
    except (OSError, TimeoutError, ValueError) as error:
        raise RequestError(
            f"There is no Dask scheduler at {address} ({_first_line(error)}). Start one with "
            "'dask scheduler', and give the address that it names, or its --scheduler-file."
        ) from error
    try:
        yield client
    finally:
        with contextlib.suppress(Exception):  # it may be gone
            client.close(timeout=2)


def check_workers(client: Any, out: Path, batch: str) -> None:
    """Make sure that all workers that are there now can work on a batch.

    Raises:
        RequestError: one doesn't see the folder, or has another version, or no dentalsplat.
    """
    found = client.run(look, str(out), batch, on_error="return")
    for worker, answer in found.items():
        if isinstance(answer, BaseException):
            raise RequestError(
                f"The worker {worker} can't run cases: {_first_line(answer)}. Install dentalsplat "
                "with the same version on all machines (pip install 'dentalsplat[batch]')."
            )
        if answer:
            raise RequestError(answer)


def slots(client: Any) -> int:
    """How many cases can run at a time, as far as is known now; 0 if nobody answers.

    A scheduler that has gone just now is missed by the client before long, which then says so.
    """
    try:
        return sum(client.nthreads().values())
    except (OSError, TimeoutError):  # a connection that is closed is an OSError of dask's
        return 0


def _address(scheduler: str) -> str:
    if "://" in scheduler:
        return scheduler
    path = Path(scheduler)
    if not path.is_file():
        raise RequestError(
            f"--scheduler {scheduler} is neither an address (tcp://HOST:PORT) nor a file that "
            "'dask scheduler --scheduler-file FILE' has written."
        )
    try:
        found = read_json(path)
    except OSError as error:
        raise RequestError(f"--scheduler {scheduler} can't be read ({error.strerror}).") from error
    address = found.get("address") if isinstance(found, dict) else None
    if not isinstance(address, str):
        raise RequestError(f"--scheduler {scheduler}: the file names no address of a scheduler.")
    return address


def _first_line(error: BaseException) -> str:
    text = str(error).strip().splitlines()
    return text[0].rstrip(".") if text else type(error).__name__
