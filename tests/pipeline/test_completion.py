"""What the shell is offered."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

from pipeline.config import presets
from pipeline.front import completion
from pipeline.stage import stage_names


def test_stages() -> None:
    assert completion.stage("ev") == ["evaluate"]
    assert set(completion.stage("")) == set(stage_names())
    assert completion.stages("init,sap,f") == ["init,sap,fit", "init,sap,flow"]
    assert completion.stages("fit,fi") == []


def test_presets() -> None:
    assert completion.preset("no_s") == ["no_sap"]
    assert completion.preset("") == sorted(presets())


def test_settings() -> None:
    (name, meaning), (default, _) = completion.setting("fit.iterations")
    assert name == "fit.iterations=" and meaning
    assert default == "fit.iterations=auto", "a space would follow what is alone"
    assert completion.setting("views.masks")[1][0] == "views.masks=null"
    assert [name for name, _ in completion.setting("export.frame=m")] == ["export.frame=mouth"]
    assert [name for name, _ in completion.setting("export.mesh=")] == [
        "export.mesh=true", "export.mesh=false",
    ]  # fmt: skip
    assert completion.setting("init.dental.order=") == [], "a list is more than one of its words"
    assert completion.setting("fit.parts=") == [("fit.parts=auto", "")]
    assert len(completion.setting("fit.densify=")) == 3, "auto, true and false"
    assert completion.setting("nosuch.x") == []


@pytest.mark.parametrize(
    ("words", "answer"),
    [
        ("pipeline run --from ex", ["export"]),
        ("pipeline run --set export.mesh =", ["true", "false"]),
        ("pipeline run --set export.frame = m", ["mouth"]),
        ("pipeline run --set = export.frame = m", ["mouth"]),
        ("pipeline run --set fit.iterations = 5 --set = flow.min_te", ["flow.min_texture="]),
        ("pipeline run --set fit.iterations = 5 --from ev", ["evaluate"]),
    ],
)
def test_bash_is_answered(words: str, answer: list[str]) -> None:
    """Its line is apart at each ``=``."""
    given = words.split()
    asked = {"COMP_WORDS": "\n".join(given), "COMP_CWORD": str(len(given) - 1)}
    assert told("bash", **asked).split()[: len(answer)] == answer


def test_fish_and_zsh_are_answered() -> None:
    asked = {
        "_TYPER_COMPLETE_ARGS": "pipeline run --set fit.light", "COLUMNS": "40",
        "_TYPER_COMPLETE_FISH_ACTION": "get-args",
    }  # fmt: skip
    lines = told("fish", **asked).splitlines()
    assert lines[0].startswith("fit.light=\ta light beside the lens") and len(lines) > 5
    assert all("\t" in line for line in lines), "each line is an answer"
    assert '("fit.light=":"a light beside the lens' in told("zsh", **asked)


def told(shell: str, **asked: str) -> str:
    """What the program answers a shell that asks by its environment."""
    code = "import sys; sys.argv[0] = 'pipeline'; from pipeline.cli import main; main()"
    environment = {**os.environ, **asked, "_PIPELINE_COMPLETE": f"complete_{shell}"}
    done = subprocess.run(
        [sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=False
    )
    return done.stdout
