"""The recipes of docs/batch.md as far as they can be read without SLURM and Kubernetes."""

from __future__ import annotations

import re
from typing import Any

import pytest
import yaml

from tests.studies.small_batch import PAGE, block


def test_the_slurm_job_has_one_slot_and_four_cores(capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("dask_jobqueue")
    code = block("python").partition("cluster.scale")[0]
    place: dict[str, Any] = {}
    exec(code, place)
    place["cluster"].close()
    script = capsys.readouterr().out
    for part in (
        "#SBATCH --cpus-per-task=4", "#SBATCH -t 04:00:00", "#SBATCH -p normal", "--nthreads 1",
        "--memory-limit 7.45GiB", "--lifetime 230m",
        "/shared/dentalsplat/.venv/bin/python -m distributed.cli.dask_worker tcp://",
    ):  # fmt: skip
        assert part in script, part


def test_the_pods_have_the_shared_volume_and_leave_the_entry_point_of_the_image_out() -> None:
    manifest = yaml.safe_load(block("yaml"))
    for part in ("worker", "scheduler"):
        (container,) = manifest["spec"][part]["spec"]["containers"]
        # "args" would go to the image's own program, which is ours
        assert container["command"][:2] == ["dask", part] and "args" not in container
    worker = manifest["spec"]["worker"]["spec"]
    mounted = {entry["name"] for entry in worker["containers"][0]["volumeMounts"]}
    assert mounted == {volume["name"] for volume in worker["volumes"]}


def test_dask_takes_the_options_of_the_recipes() -> None:
    pytest.importorskip("distributed")
    from distributed.cli import dask_scheduler, dask_worker

    manifest = yaml.safe_load(block("yaml"))
    for name, command in (("worker", dask_worker.main), ("scheduler", dask_scheduler.main)):
        (container,) = manifest["spec"][name]["spec"]["containers"]
        command.make_context(name, [*container["command"][2:]])
        lines = re.findall(rf"^dask {name} (.*)$", PAGE.read_text(), re.MULTILINE)
        for line in lines:
            command.make_context(name, line.split())
