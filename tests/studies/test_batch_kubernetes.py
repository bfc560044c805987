"""The recipe for Kubernetes of docs/batch.md, without Kubernetes.

The operator's own schema judges the manifest, its own functions make pods of it, and these pods'
containers are run as processes of this machine, which a batch is then sent to.
"""

from __future__ import annotations

import os
import re
import socket
import subprocess
import sys
import urllib.request
from collections.abc import Iterator
from copy import deepcopy
from pathlib import Path
from typing import Any

import pytest
import yaml

from tests.studies.small_batch import ROOT, SETTINGS, block, summary, wait_for, write_cases

pytest.importorskip("distributed")
kubernetes = pytest.importorskip("dask_kubernetes", reason="needs dask-kubernetes (make clusters)")
#: Where Kubernetes would find the scheduler of the page.
SERVICE = "dentalsplat-scheduler.default.svc.cluster.local"


@pytest.fixture(scope="module")
def manifest() -> dict[str, Any]:
    return dict(yaml.safe_load(block("yaml")))


def test_the_operators_schema_takes_the_manifest(manifest: dict[str, Any]) -> None:
    jsonschema = pytest.importorskip("jsonschema")
    (file,) = Path(kubernetes.__file__).parent.glob("operator/**/crds/daskcluster.yaml")
    (version,) = yaml.safe_load(file.read_text())["spec"]["versions"]
    schema = version["schema"]["openAPIV3Schema"]
    jsonschema.validate(manifest, schema)
    wrong = deepcopy(manifest)
    wrong["spec"]["worker"]["spec"]["containers"][0]["command"] = "dask worker"
    with pytest.raises(jsonschema.ValidationError):
        jsonschema.validate(wrong, schema)


def test_the_service_is_the_one_that_the_operator_would_make(manifest: dict[str, Any]) -> None:
    from dask_kubernetes.operator import make_cluster_spec

    made = make_cluster_spec(name=manifest["metadata"]["name"], image="x", n_workers=20)
    assert manifest["spec"]["scheduler"]["service"] == made["spec"]["scheduler"]["service"]


def pods(manifest: dict[str, Any], workers: int) -> list[dict[str, Any]]:
    """The containers that the operator makes: the scheduler's, and some workers'."""
    from dask_kubernetes.operator.controller import controller

    name, spec = manifest["metadata"]["name"], manifest["spec"]
    made = [controller.build_scheduler_deployment_spec(name, spec["scheduler"]["spec"], {}, {})]
    made += [
        controller.build_worker_deployment_spec(
            f"{name}-default", "default", name, str(number), spec["worker"]["spec"], {}, {}
        )
        for number in range(workers)
    ]
    return [deployment["spec"]["template"]["spec"]["containers"][0] for deployment in made]


def expanded(word: str, given: dict[str, str]) -> str:
    """A word of a command as Kubernetes hands it on: $(NAME) is what the environment has."""
    return re.sub(r"\$\((\w+)\)", lambda match: given[match[1]], word)


@pytest.fixture
def running(manifest: dict[str, Any], tmp_path: Path) -> Iterator[list[subprocess.Popen[bytes]]]:
    """The containers as processes here: scheduler, two workers."""
    for port in (8786, 8787):
        with socket.socket() as tried:
            tried.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            try:
                tried.bind(("127.0.0.1", port))
            except OSError:
                pytest.skip(f"port {port} of this machine is taken")
    processes = []
    with (tmp_path / "pods.log").open("w") as log:
        for container in pods(manifest, workers=2):
            given = {entry["name"]: entry["value"] for entry in container.get("env", ())}
            given = {name: value.replace(SERVICE, "127.0.0.1") for name, value in given.items()}
            program, *words = (expanded(word, given) for word in container["command"])
            processes.append(
                subprocess.Popen(
                    [str(Path(sys.executable).parent / program), *words], cwd=tmp_path,
                    env={**os.environ, "PYTHONPATH": str(ROOT), **given}, stdout=log, stderr=log,
                )
            )  # fmt: skip
    yield processes
    for process in reversed(processes):
        process.kill()
        process.wait()


def test_the_pods_of_the_manifest_take_cases(
    manifest: dict[str, Any], running: list[subprocess.Popen[bytes]], tmp_path: Path
) -> None:
    (scheduler,) = manifest["spec"]["scheduler"]["spec"]["containers"]
    ports = {entry["name"]: entry["containerPort"] for entry in scheduler["ports"]}
    probe = scheduler["readinessProbe"]["httpGet"]
    address = f"http://127.0.0.1:{ports[probe['port']]}{probe['path']}"

    def ready() -> bool:
        try:
            return bool(urllib.request.urlopen(address, timeout=5).status == 200)
        except OSError:
            return False

    wait_for(ready)
    write_cases(tmp_path / "cases")
    batch = subprocess.Popen(
        [sys.executable, "-m", "dentalsplat", "batch", "cases", "-o", "out", *SETTINGS,
         "--scheduler", f"tcp://127.0.0.1:{ports['tcp-comm']}"],
        cwd=tmp_path, env={**os.environ, "PYTHONPATH": str(ROOT)}, text=True,
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
    )  # fmt: skip
    wait_for(lambda: list((tmp_path / "out" / "cases").glob("*")), 120)
    running[1].kill()  # a pod is evicted
    said, _ = batch.communicate(timeout=300)
    assert [row["state"] for row in summary(tmp_path / "out")] == ["done"] * 4, said
    assert batch.returncode == 0
