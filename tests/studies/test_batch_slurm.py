"""The recipe for SLURM of docs/batch.md, on a SLURM of one node that the test starts and stops."""

from __future__ import annotations

import getpass
import os
import shutil
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.studies.small_batch import ROOT, SETTINGS, block, summary, wait_for, write_cases

pytest.importorskip("dask_jobqueue")
if not all(map(shutil.which, ("slurmctld", "slurmd", "sbatch", "scancel"))):
    pytest.skip("needs slurm-wlm (make clusters)", allow_module_level=True)

#: Nobody has to prove who he is on the test's own SLURM, and eight cores are claimed: two jobs.
CONF = """
ClusterName=test
SlurmctldHost={host}
SlurmctldPort={controller}
SlurmdPort={node}
SlurmUser={user}
SlurmdUser={user}
AuthType=auth/none
CredType=cred/none
StateSaveLocation={folder}/state
SlurmdSpoolDir={folder}/spool
SlurmctldPidFile={folder}/slurmctld.pid
SlurmdPidFile={folder}/slurmd.pid
ProctrackType=proctrack/linuxproc
SelectType=select/cons_tres
SelectTypeParameters=CR_CPU
SlurmdParameters=config_overrides
NodeName={host} NodeAddr=127.0.0.1 CPUs=8 RealMemory=32000
PartitionName=normal Nodes=ALL Default=YES MaxTime=INFINITE State=UP
"""


def free_port() -> int:
    with socket.socket() as opened:
        opened.bind(("127.0.0.1", 0))
        return int(opened.getsockname()[1])


def asked(*command: str) -> str:
    return subprocess.run(command, capture_output=True, text=True, check=False).stdout


@pytest.fixture
def slurm(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """A controller and one node with the partition `normal`."""
    conf = tmp_path / "slurm.conf"
    conf.write_text(
        CONF.format(
            host=socket.gethostname().partition(".")[0], user=getpass.getuser(), folder=tmp_path,
            controller=free_port(), node=free_port(),
        )
    )  # fmt: skip
    monkeypatch.setenv("SLURM_CONF", str(conf))
    for name in ("state", "spool"):
        (tmp_path / name).mkdir()
    with (tmp_path / "slurm.log").open("w") as log:
        daemons = [
            subprocess.Popen([name, "-D"], stdout=log, stderr=log)
            for name in ("slurmctld", "slurmd")
        ]
    try:
        wait_for(lambda: "idle" in asked("sinfo", "-h", "-o", "%t"))
        yield
    finally:
        for daemon in reversed(daemons):
            daemon.send_signal(signal.SIGTERM)
            daemon.wait(30)


def recipe(folder: Path) -> str:
    """The program on the page, with this environment's Python and the test's folders."""
    code = block("python")
    for there, here in (
        ('"/shared/dentalsplat/.venv/bin/python"', repr(sys.executable)),
        ('"pipeline",', f"{sys.executable!r}, '-m', 'dentalsplat',"),
        ('"/shared/cases"', repr(str(folder / "cases"))),
        ('"/shared/out",', ", ".join(map(repr, (str(folder / "out"), *SETTINGS))) + ","),
    ):
        assert code.count(there) == 1, there
        code = code.replace(there, here)
    return code


@pytest.mark.usefixtures("slurm")
def test_cases_go_through_slurm_and_a_cancelled_job_loses_none(tmp_path: Path) -> None:
    write_cases(tmp_path / "cases")
    program = tmp_path / "recipe.py"
    program.write_text(recipe(tmp_path))
    with (tmp_path / "recipe.log").open("w") as log:
        batch = subprocess.Popen(
            [sys.executable, str(program)], cwd=tmp_path, stdout=log, stderr=log,
            env={**os.environ, "PYTHONPATH": str(ROOT)}, start_new_session=True,
        )  # fmt: skip
        try:
            wait_for(lambda: list((tmp_path / "out" / "cases").glob("*")), 120)
            running = asked("squeue", "-h", "-t", "R", "-o", "%A").split()
            assert 1 <= len(running) <= 2  # jobs of four cores on eight
            subprocess.run(["scancel", *running], check=True)
            batch.wait(300)
        finally:
            if batch.poll() is None:
                os.killpg(batch.pid, signal.SIGKILL)
    said = (tmp_path / "recipe.log").read_text()
    rows = summary(tmp_path / "out")
    assert [row["state"] for row in rows] == ["done"] * 4, said
    assert max(int(row["attempts"]) for row in rows) == 2, said
    wait_for(lambda: not asked("squeue", "-h"))  # the recipe leaves no job behind
