"""`status` names the field or the input that made a stage stale; `clean` spares what is in use."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import toy

import pipeline
from pipeline.front.progress import LineReporter
from pipeline.planning import key_material
from pipeline.running.reporter import Reporter
from pipeline.stage import get_stage
from pipeline.studies.report import run_report


def states(toys: Path, *overrides: str) -> dict[str, tuple[str, list[str]]]:
    found = pipeline.status(workspace=toys / "w", overrides=overrides)
    return {stage.name: (stage.state, stage.reasons) for stage in found}


def test_names_the_field(run: Any, toys: Path) -> None:
    run()
    asked = states(toys, "scale.factor=3")
    assert asked["scale"] == ("stale", ["scale.factor 2.0 → 3.0"])
    assert asked["count"] == ("pending", ["depends on scale"])
    asked = states(toys, "scale.round=true", "count.fail=null and void")
    assert asked["scale"] == ("stale", ["scale.round false → true"])
    assert states(toys, "count.fail=no way")["count"][1] == ["count.fail '' → no way"]
    run("scale.factor=3")
    assert states(toys)["scale"] == ("cached", ["scale.factor 2.0 → 3.0"])
    assert states(toys)["count"] == ("cached", ["input numbers (from scale) changed"])


def test_names_the_input_file(run: Any, toys: Path) -> None:
    run()
    (toys / "images" / "1.txt").write_text("7")
    assert states(toys)["read"] == ("stale", ["input file changed: 1.txt"])
    (toys / "images" / "9.txt").write_text("7")
    assert states(toys)["read"][1] == ["input file added: 9.txt", "input file changed: 1.txt"]


def test_a_run_says_that_what_it_takes_as_it_is_has_changed(run: Any, toys: Path) -> None:
    """As status does: without the photographs named a run does not read them again."""
    heard: list[str] = []
    ears = Reporter()
    ears.message = heard.append  # type: ignore[method-assign]
    run()
    run(images=(), reporter=ears)
    assert not any("Since" in text for text in heard)
    (toys / "images" / "1.txt").write_text("7")
    (toys / "images" / "2.txt").unlink()
    assert set(run(images=(), reporter=ears).values()) == {"cached"}
    (said,) = (text for text in heard if text.startswith("Since 'read' read"))
    assert "input file removed: 2.txt; input file changed: 1.txt." in said
    assert run(images=(), from_stage="read", reporter=ears)["read"] == "ran"
    (toys / "images").rename(toys / "away")
    heard.clear()
    assert set(run(images=(), reporter=ears).values()) == {"cached"}
    assert not any("Since" in text for text in heard)


def test_names_library_seed_and_version(
    run: Any, toys: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run()
    assert states(toys, "seed=5")["read"] == ("stale", ["read seed 0 → 5"])
    monkeypatch.setattr("pipeline.planning.keys.library_version", lambda name: "0.0.1")
    (reason,) = states(toys)["scale"][1]
    assert reason.startswith("library numpy") and reason.endswith("→ 0.0.1")
    monkeypatch.undo()


def test_names_what_auto_comes_to(run: Any, toys: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run()
    monkeypatch.setattr(type(get_stage("scale")), "backend", lambda self, config: "card")
    assert states(toys)["scale"] == ("stale", ["scale backend (unknown) → card"])


def test_llvmlite_counts_where_numba_does(toys: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    stage = get_stage("read")
    monkeypatch.setattr(type(stage), "libraries", ("numba",))
    config = SimpleNamespace(sections={"read": stage.Config()}, run=SimpleNamespace(seed=0))
    assert key_material(stage, config, {}, {})["libraries"].keys() == {"numba", "llvmlite"}


def test_stages_never_run_are_missing(run: Any, toys: Path) -> None:
    run(stages=["read", "scale"])
    found = pipeline.status(workspace=toys / "w", stages=["read", "scale", "count"])
    assert [stage.state for stage in found] == ["cached", "cached", "missing"]


def test_a_stage_that_is_not_installed_any_more(
    run: Any, toys: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    run("scale.factor=3", stages=["read", "scale"])
    others = {name: entry for name, entry in toy.STAGES.items() if name != "scale"}
    monkeypatch.setattr("pipeline.stage._entry_points", lambda: others)
    get_stage.cache_clear()
    (toys / "toy.yaml").write_text("stages: [read, count]\nthreads: 1\n")
    with pytest.raises(pipeline.RequestError, match="run with the stage 'scale' last") as refused:
        pipeline.status(workspace=toys / "w")
    assert "package" in str(refused.value) and "Did you mean" not in str(refused.value)
    [read] = pipeline.status(workspace=toys / "w", stages=["read"])
    assert read.state == "cached"
    pipeline.run(workspace=toys / "w", stages=["read"], reporter=LineReporter())
    assert "not installed here: scale.factor=3" in capsys.readouterr().err


def test_what_a_workspace_remembers_may_be_of_no_use_any_more(run: Any, toys: Path) -> None:
    run("scale.factor=3")
    (toys / "toy.yaml").unlink()
    for call in (pipeline.status, pipeline.run):
        with pytest.raises(pipeline.RequestError, match=r"was run with -c .*toy\.yaml --set scale"):
            call(workspace=toys / "w")
    (toys / "toy.yaml").write_text(f"stages: {toy.ORDER}\nthreads: 1\n")
    with pytest.raises(pipeline.RequestError, match=r"^'scale\.nope' is not a setting"):
        pipeline.run(workspace=toys / "w", overrides=["scale.nope=3"])


@pytest.mark.parametrize("call", [pipeline.status, pipeline.clean, run_report])
def test_of_the_folder_of_a_batch_its_cases_are_named(call: Any, tmp_path: Path) -> None:
    (tmp_path / "batch.json").write_text("{}")
    with pytest.raises(pipeline.RequestError, match=r"of a batch.* -w .*cases/NAME"):
        call(workspace=tmp_path)


def test_unknown_workspace_is_refused(toys: Path) -> None:
    with pytest.raises(pipeline.RequestError, match="is not a workspace"):
        pipeline.status(workspace=toys / "nowhere")
    with pytest.raises(pipeline.RequestError, match="nothing in it was deleted"):
        pipeline.clean(toys / "images")
    assert (toys / "images" / "0.txt").exists()


def test_clean_spares_what_is_in_use(run: Any, toys: Path) -> None:
    for factor in (3, 4, 5):
        run(f"scale.factor={factor}")
    files = [file for file in (toys / "w").rglob("*") if file.is_file()]
    sizes = {file: file.stat().st_size for file in files}
    removed, freed = pipeline.clean(toys / "w", keep=1)
    assert len([name for name in removed if name.startswith("scale/")]) == 1
    assert freed == sum(size for file, size in sizes.items() if not file.exists()) > 0
    assert set(run("scale.factor=5").values()) == {"cached"}
    assert set(run("scale.factor=4").values()) == {"cached"}
    assert run("scale.factor=3")["scale"] == "ran"
    pipeline.clean(toys / "w")
    assert set(run("scale.factor=3").values()) == {"cached"}
    assert run("scale.factor=4")["scale"] == "ran"
