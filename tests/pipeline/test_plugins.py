"""Stages and kinds of artifact from outside: one that works, and what is refused in words."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import textwrap
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

import pipeline
from pipeline.artifacts import GROUP as KINDS_GROUP
from pipeline.artifacts import KINDS
from pipeline.config import RunConfig
from pipeline.errors import RequestError
from pipeline.plugins import registered
from pipeline.stage import GROUP, TAKEN, get_stage

ROOT = Path(__file__).resolve().parents[2]
PHOTOS = ROOT / "data_samples" / "three_photos"

#: The whole of a plug-in: a kind of its own, a stage that makes it, its part of the report.
PLUGIN = """
import json
import os
from dataclasses import dataclass
from pipeline.artifacts import Artifact
from pipeline.stage import Stage, StageConfig

@dataclass(frozen=True)
class Sharpness(Artifact):
    kind = "sharpness"
    of_views: dict

    def save(self, folder):
        (folder / "sharpness.json").write_text(json.dumps(self.of_views))

    @classmethod
    def load(cls, folder):
        return cls(json.loads((folder / "sharpness.json").read_text()))

class SharpnessStage(Stage):
    name, version, summary = "sharp", 1, "how sharp each photograph is"
    requires, provides = ("views",), ("sharpness",)

    class Config(StageConfig):
        step: int = 1
        which: frozenset[str] = frozenset("abcdefgh")  # in another order in every process

    def run(self, context):
        print("said by Python")
        os.write(1, b"said by C")
        step = context.config.step
        views = context.load("views").views
        found = {v.name: float(abs(v.image[step:] - v.image[:-step]).mean()) for v in views}
        context.save(Sharpness(found))
        context.summarize(sharpest=max(found, key=found.get), most=float("inf"))

    def report(self):
        return {"sharpness": told}

def told(case):
    from pipeline.pages.parts import Card, Section, Text
    found = case.latest("sharpness").of_views
    yield Card(f"{max(found.values()):.3f}", "sharpness of the <sharpest> photograph")
    yield Section("Sharpness", [Text(f"{name}: {value:.3f}") for name, value in found.items()])
"""


def install(folder: Path, code: str = PLUGIN, package: str = "outside", **entries: str) -> Path:
    """A package with its entry points, as pip would lay it down, without installing anything."""
    (folder / f"{package}.py").write_text(textwrap.dedent(code))
    info = folder / f"{package}-1.2.dist-info"
    info.mkdir()
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {package}\nVersion: 1.2\n")
    named = entries or {"sharp": "SharpnessStage", "sharpness": "Sharpness"}
    groups = {GROUP: "", KINDS_GROUP: ""}
    for name, found in named.items():
        group = KINDS_GROUP if name in ("sharpness", "points") else GROUP
        groups[group] += f"{name} = {package}:{found}\n"
    text = "".join(f"[{group}]\n{lines}" for group, lines in groups.items())
    (info / "entry_points.txt").write_text(text)
    return folder


def call(folder: Path, *words: str) -> subprocess.CompletedProcess[str]:
    """The command line with a folder of packages beside those installed."""
    path = os.pathsep.join([str(ROOT), str(folder), os.environ.get("PYTHONPATH", "")])
    return subprocess.run(
        [sys.executable, "-m", "pipeline.cli", *words], capture_output=True, text=True,
        cwd=folder, env={**os.environ, "PYTHONPATH": path}, timeout=250,
    )  # fmt: skip


def run(folder: Path, *more: str, stages: str = "views,sharp") -> subprocess.CompletedProcess[str]:
    return call(
        folder, "run", str(PHOTOS), "-w", "w", "--stages", stages,
        "--set", "views.long_side=128", "--json", *more,
    )  # fmt: skip


def test_a_stage_with_a_kind_of_its_own_runs_and_is_reported(tmp_path: Path) -> None:
    done = run(install(tmp_path), "--set", "sharp.step=2")
    assert done.returncode == 0, done.stderr
    assert "said by Python" in done.stderr and "said by C" in done.stderr
    answer = json.loads(done.stdout, parse_constant=lambda name: pytest.fail(f"{name} is no JSON"))
    stages = {stage["name"]: stage for stage in answer["stages"]}
    assert stages["sharp"]["action"] == "ran"
    assert stages["sharp"]["figures"]["summary"]["most"] == "inf"
    file = tmp_path / stages["sharp"]["folder"] / "sharpness" / "sharpness.json"
    written = json.loads(file.read_text())
    assert sorted(written) == ["000", "001", "002"]
    page = (tmp_path / "w" / "report.html").read_text()
    assert "could not be drawn" not in page
    assert "sharpness of the &lt;sharpest&gt; photograph" in page
    assert "<summary>Sharpness" in page
    name, value = next(iter(written.items()))
    assert f"{name}: {value:.3f}" in page
    again = json.loads(run(tmp_path, "--set", "sharp.step=2").stdout)
    assert [stage["action"] for stage in again["stages"]] == ["cached", "cached"]
    listed = json.loads(call(tmp_path, "stages", "--json").stdout)
    assert next(entry for entry in listed if entry["name"] == "sharp")["provides"] == ["sharpness"]


Outside = Callable[..., str]


@pytest.fixture
def outside(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Outside]:
    """Install a package in this process; how the run of one of its stages is refused."""

    def call(code: str, stage: str, **entries: str) -> str:
        monkeypatch.syspath_prepend(install(tmp_path, code, **entries))
        forget()
        with pytest.raises(RequestError) as refused:
            pipeline.run(PHOTOS, workspace=tmp_path / "w", stages=["views", stage])
        assert not (tmp_path / "w").exists()
        return str(refused.value)

    def forget() -> None:
        sys.modules.pop("outside", None)
        registered.cache_clear()
        get_stage.cache_clear()

    yield call
    monkeypatch.undo()
    forget()


@pytest.mark.parametrize(
    ("change", "entries", "told"),
    [
        (("", ""), {"sharp": "SharpnessStage"}, "names 'sharpness' in provides, a kind of"),
        (("import json", "import jsonn"), {}, "ModuleNotFoundError: No module named 'jsonn'"),
        (("import json", "import json,"), {}, "can't be imported: SyntaxError"),
        (("", ""), {"sharp": "Nothing"}, "can't be imported: AttributeError"),
        (("", ""), {"sharp": "told"}, "is not a class derived from pipeline.stage.Stage"),
        (('name, version, summary = "sharp", 1,', 'name, summary = "sharp",'), {}, "no version"),
        (('name, version, summary = "sharp", 1, "how', 'version, _ = 1, "how'), {}, "name = None"),
        (("    class Config(StageConfig)", "    class Config"), {}, "has no Config"),
        (("step: int = 1", "step: int"), {}, "has the setting 'step' without a default"),
        (
            ("    def run(self", "    def __init__(self): 1 / 0\n    def run(self"),
            {},
            "can't be made",
        ),
        (("def run(self, context)", "def ran(self, context)"), {}, "lacks run"),
        (('("sharpness",)', '"sharpness"'), {}, "has provides = 'sharpness'"),
        (('kind = "sharpness"', 'kind = "blur"'), {}, "has kind = 'blur'"),
        (("def save(self", "def write(self"), {}, "lacks save"),
        (("", ""), {"sharp": "SharpnessStage", "sharpness": "told"}, "pipeline.artifacts.base.A"),
    ],
)
def test_a_bad_one_is_refused_in_words(
    outside: Outside, change: tuple[str, str], entries: dict[str, str], told: str
) -> None:
    said = outside(PLUGIN.replace(*change, 1), "sharp", **entries)
    assert told in said
    assert "(outside:" in said and "of outside 1.2)" in said
    assert get_stage("views").name == "views", "it harms only who asks for it"


def test_the_command_refuses_a_bad_one_too(tmp_path: Path) -> None:
    done = run(install(tmp_path, PLUGIN.replace("import json", "import jsonn")))
    assert done.returncode == 2
    assert "The stage 'sharp' (outside:SharpnessStage, of outside 1.2) can't" in done.stderr
    assert "uninstall" in done.stderr
    assert "Traceback" not in done.stderr
    assert not (tmp_path / "w").exists()
    listed = call(tmp_path, "stages", "--json")
    assert "can't be imported" in listed.stdout, "the others are listed beside it"


@pytest.mark.parametrize(
    ("entries", "told"),
    [
        ({"views": "SharpnessStage"}, "The stage 'views' is registered twice"),
        ({"points": "Sharpness", "sharp": "SharpnessStage"}, "'points' is registered twice"),
        ({"report": "SharpnessStage"}, "can't have this name"),
    ],
)
def test_a_name_that_is_taken_is_refused(
    outside: Outside, entries: dict[str, str], told: str
) -> None:
    name = next(iter(entries))
    code = PLUGIN.replace('"sharpness"' if name == "points" else '"sharp"', f'"{name}"')
    said = outside(code, [*entries][-1], **entries)
    assert told in said
    assert "outside:Sharpness" in said


def test_writing_what_was_not_declared_is_a_fault_in_words(tmp_path: Path) -> None:
    code = PLUGIN.replace('("views",), ("sharpness",)', '("views",), ()')
    done = run(install(tmp_path, code))
    assert done.returncode == 1
    assert "The stage 'sharp' writes sharpness without saying so" in done.stderr


def test_files_that_are_named_wrongly_are_a_fault_of_the_stage(tmp_path: Path) -> None:
    code = f"{PLUGIN}\nSharpnessStage.sources = lambda *given: None\n"
    done = run(install(tmp_path, code))
    assert done.returncode == 1
    assert "The stage 'sharp' failed where it names the files that it reads" in done.stderr


def test_settings_of_a_run_are_no_names_for_stages() -> None:
    assert set(RunConfig.model_fields) < set(TAKEN)


def test_the_kinds_of_the_project_are_registered_as_others_are() -> None:
    text = (ROOT / "setup.cfg").read_text()
    section = text.partition(f"{KINDS_GROUP} =\n")[2].partition("\n\n")[0]
    lines = (line.split(" = ") for line in section.splitlines() if line.startswith("    "))
    assert {name.strip(): where for name, where in lines} == KINDS
