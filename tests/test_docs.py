"""What the pages show works: commands parse, settings and files exist, examples run."""

from __future__ import annotations

import json
import os
import re
import shlex
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import typer

from pipeline.artifacts.dental.corrections import read_corrections
from pipeline.cli import app
from pipeline.config import load_config, presets
from pipeline.front.settings import settings
from pipeline.running.outcomes import RunSummary, StageOutcome
from pipeline.stage import stage_names

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").glob("*.md"))]
#: Pages that the site does not hold.
BESIDE = [
    *(ROOT / f"{name}.md" for name in ("README", "CONTRIBUTING", "SECURITY", "CHANGELOG")),
    ROOT / "benchmarks" / "peers.md", ROOT / "data_samples" / "README.md",
]  # fmt: skip
#: Suffixes of files that are called as stages are.
FILES = {".ply", ".sog", ".spz", ".json", ".csv", ".yaml"}
FENCE = re.compile(r"^```(\w*)\n(.*?)^```", re.MULTILINE | re.DOTALL)


def blocks(page: Path, *languages: str) -> list[str]:
    return [text for language, text in FENCE.findall(page.read_text()) if language in languages]


def commands(page: Path) -> list[list[str]]:
    """The arguments of every ``pipeline ...`` in a page's blocks."""
    found = []
    for block in blocks(page, "", "bash"):
        for line in block.replace("\\\n", " ").splitlines():
            words = shlex.split(line, comments=True)
            ours = words and Path(words[0]).name in ("pipeline", "dentalsplat")
            if ours and not words[1].startswith("-"):
                found.append(words[1:])
    return found


SHOWN = [(page.name, words) for page in PAGES for words in commands(page)]


@pytest.mark.parametrize(("page", "words"), SHOWN, ids=lambda value: str(value)[:60])
def test_commands_parse(page: str, words: list[str]) -> None:
    name, *arguments = words
    group: Any = typer.main.get_command(app)
    command = group.commands[name]
    context = command.make_context(name, arguments)
    load_config(None, context.params.get("overrides") or [])
    preset = context.params.get("config")
    assert preset is None or preset in presets() or preset.endswith(".yaml")
    # "thin" is the stage that docs/extending.md shows how to write
    stages = (context.params.get("stages") or context.params.get("from_stage") or "").split(",")
    assert set(filter(None, stages)) <= {*stage_names(), "thin"}


def test_enough_is_shown() -> None:
    assert len(SHOWN) > 30


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_targets_of_make_exist(page: Path) -> None:
    makefile = (ROOT / "Makefile").read_text()
    for target in re.findall(r"`?make ([a-z-]+)", "\n".join(blocks(page, ""))):
        assert f"\n{target}:" in makefile


def test_the_package_that_extending_shows_installs_and_runs(tmp_path: Path) -> None:
    """Each block goes into the file that its first line names, without one into the project's."""
    texts: dict[str, str] = {}
    for block in blocks(ROOT / "docs" / "extending.md", "python", "toml"):
        named = re.match(r"# (\S+)\n", block)
        name = named.group(1) if named else "pyproject.toml"
        texts[name] = texts.get(name, "") + block
    assert set(texts) == {
        "thinning/stage.py", "thinning/heights.py", "pyproject.toml", "try_it.py",
    }  # fmt: skip
    source, there = tmp_path / "source", tmp_path / "there"
    for name, text in texts.items():
        (source / name).parent.mkdir(parents=True, exist_ok=True)
        (source / name).write_text(text)
    install = ["-m", "pip", "install", "--no-deps", "--no-index", "--no-build-isolation", "--quiet"]
    subprocess.run([sys.executable, *install, "--target", there, source], check=True)
    check = """
import runpy, sys
from pathlib import Path
runpy.run_path(sys.argv[1])
from pipeline.artifacts import artifact_class
from pipeline.stage import get_stage
assert get_stage("thin").Config(keep=3).keep == 3
Heights = artifact_class("heights")
Heights({"11": 9.5}).save(Path(sys.argv[2]))
assert Heights.load(Path(sys.argv[2])).by_tooth == {"11": 9.5}
"""
    path = os.pathsep.join([str(there), str(ROOT)])
    call = [sys.executable, "-c", check, source / "try_it.py", tmp_path]
    subprocess.run(call, check=True, cwd=tmp_path, env={**os.environ, "PYTHONPATH": path})


def test_architecture_names_every_folder() -> None:
    text = (ROOT / "docs" / "architecture.md").read_text()
    folders = {path.parent.name for path in (ROOT / "pipeline").glob("*/__init__.py")}
    assert [name for name in sorted(folders) if f"`pipeline/{name}/`" not in text] == []
    beside = {path.parent.name for path in (ROOT / "stages").glob("*/__init__.py")}
    beside -= set(stage_names())
    assert [name for name in sorted(beside) if f"`stages/{name}/`" not in text] == []


def test_what_formats_says_of_teeth_yaml_is_read(tmp_path: Path) -> None:
    (text,) = blocks(ROOT / "docs" / "formats.md", "yaml")
    path = tmp_path / "teeth.yaml"
    path.write_text(text)
    (photo,) = read_corrections(path).photographs.values()
    assert [crown.tooth for crown in photo.crowns] == [16, None, None]
    assert photo.crowns[1].remove and photo.crowns[2].split


def test_the_answer_in_programs_is_what_a_run_gives() -> None:
    page = ROOT / "docs" / "programs.md"
    (shown,) = (json.loads(text) for text in blocks(page, "") if text.startswith("{"))
    outcome = StageOutcome("teeth", "ran", folder=Path("folder"))
    answer = RunSummary(Path("cases/anna"), [outcome]).to_dict()
    assert shown.keys() == answer.keys()
    assert shown["stages"][0].keys() == answer["stages"][0].keys()
    names = {"wall_seconds", "cpu_seconds", "peak_memory_mb", "summary"}
    assert shown["stages"][0]["figures"].keys() == names


@pytest.mark.parametrize("page", sorted({*PAGES, *BESIDE}), ids=lambda page: page.name)
def test_named_files_exist_and_scripts_have_the_options(page: Path) -> None:
    folders = "benchmarks|configs|data_samples|docs|pipeline|stages|tests|tools"
    named = rf"`(?:python )?((?:{folders})/[\w/.-]+\.\w+)([^`]*)`"
    for name, rest in re.findall(named, page.read_text()):
        assert (ROOT / name).exists(), f"{page.name}: {name}"
        for option in re.findall(r"--[a-z-]+", rest):
            assert f'"{option}"' in (ROOT / name).read_text(), f"{page.name}: {name} {option}"


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_settings_in_sentences_exist(page: Path) -> None:
    known = {setting.name for setting in settings()}
    known |= {name.rpartition(".")[0] for name in known}  # sections, too
    stages = "|".join(stage_names())
    for name in re.findall(rf"`(?:--set )?'?((?:{stages})\.[\w.]+)[^`]*`", page.read_text()):
        assert name in known or Path(name).suffix in FILES, f"{page.name}: {name}"


@pytest.mark.parametrize("page", BESIDE, ids=lambda page: page.name)
def test_links_that_the_site_does_not_check_lead_somewhere(page: Path) -> None:
    for link in re.findall(r"\]\(([^)\s]+)\)", page.read_text()):
        if not link.startswith("http"):
            name, _, anchor = link.partition("#")
            target = page.parent / name if name else page
            assert target.exists(), f"{page.name}: {link}"
            assert not anchor or anchor in anchors(target), f"{page.name}: {link}"


def anchors(page: Path) -> set[str]:
    """Those that GitHub gives the headings of a page."""
    found = re.findall(r"^#+ (.*)$", FENCE.sub("", page.read_text()), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in found}


def test_pages_made_from_the_code_are_whole(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(ROOT / "tools"))
    import docs_pages

    pages = {name: make() for name, make in docs_pages.PAGES.items()}
    for setting in settings():
        assert f"| `{setting.name}` |" in pages["settings.md"]
    for stage in stage_names():
        assert f"\n## {stage}\n" in pages["stages.md"]
    assert "\n## gaussians\n" in pages["artifacts.md"]
    for part in ("View", "PointmapPair", "Camera", "FlowPair", "Light", "Crown"):
        assert f"\n### {part}\n" in pages["artifacts.md"], part
    assert "\n- `positions`: [N, 3] float32.\n" in pages["artifacts.md"]
    compile(docs_pages.READ, "artifacts.md", "exec")


def test_code_cites_pages_that_exist() -> None:
    for package in ("dentalsplat", "pipeline", "stages", "tools"):
        for path in (ROOT / package).rglob("*.py"):
            text = path.read_text(encoding="utf-8")
            assert "DESIGN" not in text, path
            for name in re.findall(r"docs/\w+\.md", text):
                assert (ROOT / name).is_file(), f"{path}: {name}"
