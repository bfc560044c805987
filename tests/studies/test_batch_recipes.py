"""The recipes of docs/batch.md: rendered as far as that goes without SLURM and Kubernetes."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest
import yaml

PAGE = Path(__file__).resolve().parents[2] / "docs" / "batch.md"


def block(language: str) -> str:
    """The block of a language on the page."""
    (found,) = re.findall(rf"```{language}\n(.*?)```", PAGE.read_text(), re.DOTALL)
    return str(found)


def keys(tree: Any, depth: int = 3) -> set[str]:
    """Dotted names of the first levels of a tree."""
    if not isinstance(tree, dict) or not depth:
        return set()
    inner = {f"{name}.{key}" for name, entry in tree.items() for key in keys(entry, depth - 1)}
    return {*tree, *inner}


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


def test_the_kubernetes_manifest_says_what_the_operator_wants() -> None:
    manifest = yaml.safe_load(block("yaml"))
    for part in ("worker", "scheduler"):
        (container,) = manifest["spec"][part]["spec"]["containers"]
        assert container["name"] == part and container["args"][0] == f"dask-{part}"
    worker = manifest["spec"]["worker"]["spec"]
    mounted = {entry["name"] for entry in worker["containers"][0]["volumeMounts"]}
    assert mounted == {volume["name"] for volume in worker["volumes"]}
    operator = pytest.importorskip("dask_kubernetes.operator")
    made = operator.make_cluster_spec(name="dentalsplat", image="x", n_workers=20)
    assert keys(manifest) >= keys(made) - {"spec.idleTimeout"}
    assert manifest["apiVersion"] == made["apiVersion"] and manifest["kind"] == made["kind"]
    service = manifest["spec"]["scheduler"]["service"]
    assert service == made["spec"]["scheduler"]["service"]


def test_dask_takes_the_options_of_the_recipes() -> None:
    pytest.importorskip("distributed")
    from distributed.cli import dask_scheduler, dask_worker

    manifest = yaml.safe_load(block("yaml"))
    for name, command in (("worker", dask_worker.main), ("scheduler", dask_scheduler.main)):
        (container,) = manifest["spec"][name]["spec"]["containers"]
        command.make_context(name, [*container["args"][1:]])
        lines = re.findall(rf"^dask {name} (.*)$", PAGE.read_text(), re.MULTILINE)
        for line in lines:
            command.make_context(name, line.split())
