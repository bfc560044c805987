"""One byte of a workspace changes: it is noticed before anything is handed over."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

import pipeline
from pipeline.artifacts.metrics import Metrics
from pipeline.store import Store, checks, read_own, records, write_sealed

RAN = {"read": "ran", "scale": "ran", "count": "ran", "publish": "ran"}
CACHED = dict.fromkeys(RAN, "cached")
QUIET = "report=false"


def manifest_of(workspace: Path, stage: str) -> Path:
    (found,) = (p for p in workspace.glob(f"{stage}/*/manifest.json") if "." not in p.parent.name)
    return found


def flip(path: Path, at: int | None = None) -> None:
    data = bytearray(path.read_bytes())
    data[len(data) // 2 if at is None else at] ^= 1
    path.write_bytes(data)


def contents(workspace: Path) -> dict[str, bytes]:
    """Artifacts of the results that are no damaged ones set aside."""
    return {
        str(path.relative_to(workspace)): path.read_bytes()
        for path in sorted(workspace.glob("*/*/*/*"))
        if path.is_file() and "." not in path.parts[-3]
    }


@pytest.fixture
def settled(monkeypatch: pytest.MonkeyPatch) -> None:
    """As if the files had been written long ago."""
    monkeypatch.setattr(checks, "SETTLED_NS", 0)


@pytest.fixture
def read(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Names of the files of results whose bytes are read from now on to be checked."""
    found: list[str] = []
    digest = checks.sha256_file

    def listened(path: Path) -> str:
        found.append(path.name)
        return digest(path)

    monkeypatch.setattr(checks, "sha256_file", listened)
    return found


def test_a_flipped_byte_in_any_artifact(run: Any, toys: Path, settled: None) -> None:
    run(QUIET)
    assert run(QUIET) == CACHED
    whole = contents(toys / "w")
    assert len(whole) == 9
    for name in whole:
        flip(toys / "w" / name)
        stage = name.partition("/")[0]
        assert run(QUIET) == {**CACHED, stage: "ran"}
        assert contents(toys / "w") == whole


def test_what_is_handed_over_is_checked_through_its_link(
    run: Any, toys: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run(QUIET)
    page = toys / "w" / "results" / "viewer.html"
    good = page.read_text()
    flip(page)
    assert run(QUIET)["publish"] == "ran"
    assert page.read_text() == good
    assert "publish" in (told := capsys.readouterr().err) and "exports/viewer.html" in told


def test_setting_the_time_back_hides_nothing(run: Any, toys: Path, settled: None) -> None:
    run(QUIET)
    run(QUIET)
    victim = toys / "w" / next(name for name in contents(toys / "w") if name.startswith("scale"))
    found = victim.stat()
    flip(victim)
    os.utime(victim, ns=(found.st_atime_ns, found.st_mtime_ns))
    assert run(QUIET)["scale"] == "ran"


def test_a_disk_that_changes_bytes_silently_is_found_by_verify(
    run: Any, toys: Path, settled: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(checks, "mark_of", lambda path: (path.stat().st_size, 1, 1, 1))
    run(QUIET)
    run(QUIET)
    victim = toys / "w" / next(name for name in contents(toys / "w") if name.startswith("count"))
    flip(victim)
    assert run(QUIET) == CACHED
    states = {s.name: s.state for s in pipeline.status(workspace=toys / "w")}
    assert states["count"] == "cached"
    states = {s.name: s.state for s in pipeline.status(workspace=toys / "w", verify=True)}
    assert states == {"read": "cached", "scale": "cached", "count": "missing", "publish": "pending"}
    assert run(QUIET)["count"] == "ran"
    flip(victim)
    assert run(QUIET, verify=True)["count"] == "ran"


def test_a_cached_run_reads_no_byte_of_the_artifacts(
    run: Any, toys: Path, settled: None, read: list[str]
) -> None:
    run(QUIET)
    run(QUIET)
    assert len(read) == 9
    assert run(QUIET) == CACHED
    assert len(read) == 9


def test_a_file_that_has_just_changed_is_not_trusted_to_show_the_next_change(
    run: Any, read: list[str]
) -> None:
    run(QUIET)
    run(QUIET)
    run(QUIET)
    assert len(read) == 18  # by the second run and by the third, not by the one that wrote them


def test_the_memory_of_what_was_read_may_be_damaged(
    run: Any, toys: Path, settled: None, read: list[str]
) -> None:
    run(QUIET)
    run(QUIET)
    memory = next((toys / "w" / "scale").glob(f"*/{checks.MEMORY}"))
    whole = memory.read_bytes()
    for at in range(0, len(whole), 17):
        flip(memory, at)
        read.clear()
        assert run(QUIET) == CACHED
        assert read == ["numbers.json"]
    for text in ("5", "[]", "{}", '{"contents": {}, "files": {"a": 5}}', "", "\0" * 200):
        memory.write_text(text)
        read.clear()
        assert run(QUIET) == CACHED
        assert read == ["numbers.json"]


def test_a_copy_is_read_once(run: Any, toys: Path, settled: None, read: list[str]) -> None:
    run(QUIET)
    run(QUIET)
    (toys / "w").rename(toys / "first")
    shutil.copytree(toys / "first", toys / "w", symlinks=True)
    read.clear()
    assert run(QUIET) == CACHED
    assert len(read) == 9
    assert run(QUIET) == CACHED
    assert len(read) == 9


def test_any_flipped_byte_of_a_record_is_noticed(tmp_path: Path) -> None:
    path = tmp_path / "manifest.json"
    write_sealed(path, {"format": 2, "stage": "fit", "text": 'é "quoted" \udcff', "numbers": [1]})
    assert records.read_manifest(path) == {
        "format": 2, "stage": "fit", "text": 'é "quoted" \udcff', "numbers": [1]
    }  # fmt: skip
    whole = path.read_bytes()
    for at in range(len(whole)):
        for bit in range(8):
            data = bytearray(whole)
            data[at] ^= 1 << bit
            path.write_bytes(data)
            assert read_own(path) is None
            with pytest.raises(records.DamagedError):
                records.read_manifest(path)


def test_a_flipped_byte_in_a_manifest(run: Any, toys: Path) -> None:
    run(QUIET)
    for _ in range(3):
        manifest = manifest_of(toys / "w", "count")
        text = manifest.read_text()
        flip(manifest, text.index("wall_seconds") + 16)
        assert run(QUIET) == {**CACHED, "count": "ran"}


@pytest.mark.parametrize("stage", ["read", "scale", "count", "publish"])
def test_a_flipped_byte_in_a_pointer(run: Any, toys: Path, stage: str) -> None:
    run(QUIET)
    pointer = toys / "w" / stage / "current.json"
    whole = pointer.read_bytes()
    for at in (2, len(whole) // 2, len(whole) - 3):
        flip(pointer, at)
        assert run(QUIET) == CACHED
        assert pointer.read_bytes() == whole
    flip(pointer)
    assert {s.state for s in pipeline.status(workspace=toys / "w")} == {"cached"}


def test_a_damaged_pointer_among_several_results(run: Any, toys: Path) -> None:
    run(QUIET)
    run(QUIET, "scale.factor=3")
    flip(toys / "w" / "scale" / "current.json")
    with pytest.raises(pipeline.RequestError, match="Which result of 'scale' is in use"):
        run(QUIET, stages=["count"], images=())
    assert run(QUIET, "scale.factor=3") == CACHED
    assert run(QUIET, stages=["count"], images=()) == {"count": "cached"}


def test_clean_leaves_alone_what_may_be_in_use(run: Any, toys: Path) -> None:
    run(QUIET)
    run(QUIET, "scale.factor=3")
    flip(toys / "w" / "scale" / "current.json")
    removed, _ = pipeline.clean(toys / "w")
    assert {name.partition("/")[0] for name in removed} == {"count", "publish"}
    assert run(QUIET, "scale.factor=3") == CACHED


def test_a_flipped_byte_in_the_request(run: Any, toys: Path) -> None:
    run(QUIET)
    request = toys / "w" / "request.json"
    whole = request.read_bytes()
    for at in range(0, len(whole), 23):
        flip(request, at)
        for ask in (pipeline.status, pipeline.run_report, pipeline.run):
            with pytest.raises(pipeline.RequestError, match=r"request.json is damaged.*pipeline r"):
                ask(workspace=toys / "w")
        pipeline.clean(toys / "w")
        assert run(QUIET) == CACHED
        assert request.read_bytes() == whole


def test_a_flipped_byte_in_a_failure(run: Any, toys: Path) -> None:
    with pytest.raises(pipeline.ReconstructionError):
        run(QUIET, "count.fail=data")
    failure = toys / "w" / "count" / "failure.json"
    assert [s.state for s in pipeline.status(workspace=toys / "w")][2] == "failed"
    for at in range(0, failure.stat().st_size, 31):
        whole = failure.read_bytes()
        flip(failure, at)
        assert [s.state for s in pipeline.status(workspace=toys / "w")][2] == "missing"
        failure.write_bytes(whole)
    flip(failure)
    assert run(QUIET)["count"] == "ran"
    assert not failure.exists()


def test_a_damaged_checkpoint_is_no_obstacle(tmp_path: Path) -> None:
    import numpy as np

    from stages.fit.records import load_checkpoint, save_checkpoint

    path = tmp_path / "fit.npz"
    save_checkpoint(path, {"a": np.arange(50.0), "b": np.eye(3)}, {"iteration": 7})
    whole = path.read_bytes()
    assert load_checkpoint(path) is not None
    wrong = 0
    for at in range(len(whole)):
        flip(path, at)
        found = load_checkpoint(path)
        wrong += found is not None and not (
            np.array_equal(found[0].get("a", 0), np.arange(50.0)) and found[1] == {"iteration": 7}
        )
        path.write_bytes(whole)
    assert wrong == 0


def test_teeth_yaml_damaged_is_a_wrong_request(tmp_path: Path) -> None:
    from pipeline.artifacts.dental.corrections import read_corrections

    path = tmp_path / "teeth.yaml"
    for content in (b"\xff\xfe\0photographs", b"5", b"[1, 2]", b"photographs: 5", b"{" * 5000):
        path.write_bytes(content)
        with pytest.raises(pipeline.RequestError, match=r"teeth\.yaml"):
            read_corrections(path)


def test_load_notices_what_changed_after_it_was_found(tmp_path: Path) -> None:
    store = Store(tmp_path)
    folder = store.begin("fit", "a" * 64)
    (folder / "metrics").mkdir()
    Metrics({"value": 1}).save(folder / "metrics")
    store.commit("fit", "a" * 64, {"key_material": {}}, ["metrics"])
    result = store.find("fit", "a" * 64)
    assert result is not None
    flip(result.folder / "metrics" / "metrics.json")
    with pytest.raises(Exception, match="has changed"):
        store.load(result, "metrics")
    assert store.find("fit", "a" * 64) is None


def test_results_of_earlier_versions_are_still_good(run: Any, toys: Path) -> None:
    """Their records have no checksums."""
    run(QUIET)
    unseal: Callable[[dict[str, Any]], dict[str, Any]] = lambda value: {  # noqa: E731
        name: entry for name, entry in value.items() if name != "checksum"
    }
    for path in (toys / "w").rglob("*.json"):
        value = json.loads(path.read_text())
        if "checksum" in value:
            changed = unseal(value) | ({"format": 1} if path.name == "manifest.json" else {})
            path.write_text(json.dumps(changed, indent=1))
    assert run(QUIET) == CACHED
    manifest = manifest_of(toys / "w", "count")
    value = json.loads(manifest.read_text())
    for name in ("outputs", "key_material", "summary", "inputs"):
        manifest.write_text(json.dumps({k: v for k, v in value.items() if k != name}))
        assert run(QUIET) == {**CACHED, "count": "ran"}
        manifest = manifest_of(toys / "w", "count")
