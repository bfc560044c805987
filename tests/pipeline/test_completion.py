"""What the shell is offered."""

from __future__ import annotations

import os
import subprocess
import sys

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
    [(name, meaning)] = completion.setting("fit.iterations")
    assert name == "fit.iterations=" and meaning
    assert [name for name, _ in completion.setting("export.frame=m")] == ["export.frame=mouth"]
    assert [name for name, _ in completion.setting("export.mesh=")] == [
        "export.mesh=true", "export.mesh=false",
    ]  # fmt: skip
    assert completion.setting("nosuch.x") == []


def test_the_shell_is_answered() -> None:
    """As bash asks: the program itself, with the line in its environment."""
    asked = {
        "_PIPELINE_COMPLETE": "complete_bash",
        "COMP_WORDS": "pipeline run --from ex", "COMP_CWORD": "3",
    }  # fmt: skip
    code = "import sys; sys.argv[0] = 'pipeline'; from pipeline.cli import main; main()"
    told = subprocess.run(
        [sys.executable, "-c", code], env={**os.environ, **asked}, capture_output=True, text=True,
        check=False,
    )  # fmt: skip
    assert told.stdout.split() == ["export"], told.stderr
