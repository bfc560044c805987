"""What is installed: every package, the front door for Python, and names that are taken."""

from __future__ import annotations

import configparser
import inspect
import os
import re
import subprocess
import sys
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path

import pytest

import dentalsplat
import pipeline
from dentalsplat import names
from pipeline.errors import RequestError
from pipeline.installed import library_version, module_command, require, shipped_configs

ROOT = Path(__file__).parents[1]
PACKAGES = ("dentalsplat", "pipeline", "stages")


@pytest.fixture(scope="module")
def setup_cfg() -> configparser.ConfigParser:
    parser = configparser.ConfigParser()
    parser.read(ROOT / "setup.cfg")
    return parser


def test_every_package_is_named_in_setup_cfg(setup_cfg: configparser.ConfigParser) -> None:
    named = set(setup_cfg["options"]["packages"].split())
    folders = {path.parent for top in PACKAGES for path in (ROOT / top).rglob("*.py")}
    there = {".".join(folder.relative_to(ROOT).parts) for folder in folders}
    assert named == there | {"pipeline.presets"}
    assert not [folder for folder in folders if not (folder / "__init__.py").is_file()]
    assert all((ROOT / top / "py.typed").is_file() for top in PACKAGES)


def test_every_bound_is_met_by_what_is_tested_with(setup_cfg: configparser.ConfigParser) -> None:
    from packaging.requirements import Requirement

    def plain(name: str) -> str:
        return re.sub(r"[-_.]+", "-", name).lower()

    lines = (ROOT / "constraints.txt").read_text().splitlines()
    pinned = {
        plain(name): version
        for name, _, version in (line.partition("==") for line in lines if not line.startswith("#"))
    }
    texts = [
        setup_cfg["options"]["install_requires"],
        *setup_cfg["options.extras_require"].values(),
    ]
    for line in "\n".join(texts).splitlines():
        if line and not line.startswith("%"):
            wanted = Requirement(line)
            assert plain(wanted.name) in pinned, f"{wanted.name} is not in constraints.txt"
            assert pinned[plain(wanted.name)] in wanted.specifier, line


def test_what_is_imported_is_required(setup_cfg: configparser.ConfigParser) -> None:
    """And what is required is imported."""
    modules = {
        "cv2": "opencv-contrib-python-headless", "PIL": "pillow", "pillow_heif": "pillow-heif",
        "yaml": "pyyaml", "pydantic_core": "pydantic",
    }  # fmt: skip
    optional = {
        "torch", "torchmetrics", "gsplat", "pyinstrument", "dask", "distributed",
        "psutil", "pydicom",
    }  # fmt: skip
    imported = set()
    for package in PACKAGES:
        for path in (ROOT / package).rglob("*.py"):
            text = path.read_text(encoding="utf-8")
            for line in re.findall(r"^ *(?:from|import) +(\w+)(?=[ .\n])", text, re.MULTILINE):
                imported.add(line)
    foreign = imported - set(sys.stdlib_module_names) - set(PACKAGES) - {"__future__"}
    required = re.findall(r"^[\w.-]+", setup_cfg["options"]["install_requires"], re.MULTILINE)
    known = {modules.get(name, name) for name in foreign} & (set(required) | optional)
    missing = {modules.get(name, name) for name in foreign} - set(required) - optional
    # words that stand at the beginning of a line of a docstring
    assert not {name for name in missing if library_version(name) != "missing"}
    assert known - optional == set(required)


def test_help_shows_the_front_door() -> None:
    for name in sorted(set(dentalsplat.__all__) - {"report"}):
        function = getattr(dentalsplat, name)
        assert inspect.getdoc(function)
        assert function is getattr(pipeline, name)
    with pytest.raises(AttributeError):
        dentalsplat.nothing  # noqa: B018


def test_front_door_answers() -> None:
    assert "fit" in [stage["name"] for stage in dentalsplat.stages()]
    assert dentalsplat.settings("sap")[0].name == "sap.mode"
    with pytest.raises(dentalsplat.RequestError, match="is not a workspace"):
        dentalsplat.clean("/nowhere")


def test_import_is_quick_and_loads_nothing_heavy() -> None:
    script = (
        "import sys, dentalsplat; heavy = {'numpy', 'pydantic', 'cv2', 'torch', 'typer', 'yaml'}; "
        "print(sorted(heavy & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", script], cwd=ROOT, capture_output=True, text=True)
    assert done.stdout.strip() == "[]", done.stderr


def test_both_commands_are_the_same(setup_cfg: configparser.ConfigParser) -> None:
    scripts = setup_cfg["options.entry_points"]["console_scripts"]
    assert {line.split(" = ")[1] for line in scripts.split("\n") if line} == {
        "dentalsplat.command:main"
    }


@pytest.mark.parametrize("trap", ["pipeline.py", "pipeline/__init__.py", "stages/__init__.py"])
def test_a_file_in_the_way_is_named(trap: str, tmp_path: Path) -> None:
    (tmp_path / trap).parent.mkdir(exist_ok=True)
    (tmp_path / trap).write_text("raise SystemExit('the wrong one')\n")
    done = subprocess.run(
        [sys.executable, "-c", "from dentalsplat.command import main; main()", "stages"],
        cwd=tmp_path, capture_output=True, text=True,
        env={**os.environ, "PYTHONPATH": os.pathsep.join([str(tmp_path), str(ROOT)])},
    )  # fmt: skip
    first = str(tmp_path / trap).removesuffix("/__init__.py")
    assert done.returncode == 2
    assert f"{first} is in the way" in done.stderr and "\n" not in done.stderr.strip()


def test_a_missing_package_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    names.check_names()
    monkeypatch.setattr(names, "PACKAGES", ("no_such_package",))
    with pytest.raises(names.NameTakenError, match="not installed whole"):
        names.check_names()


def test_processes_of_ours_pass_by_the_folder_they_start_in(tmp_path: Path) -> None:
    (tmp_path / "pipeline.py").write_text("raise SystemExit('the wrong one')\n")
    done = subprocess.run(
        [*module_command("pipeline.cli"), "--help"], cwd=tmp_path, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    assert "A 3D scene from photographs of teeth" in done.stdout


def test_make_clean_leaves_cases_where_runs_keep_them() -> None:
    recipe = (ROOT / "Makefile").read_text().partition("\nclean:\n")[2].splitlines()[0]
    deleted = [word.rstrip("/*") for word in recipe.split()]
    assert "dist" in deleted and "runs" not in deleted


def test_presets_are_ours_whatever_else_is_called_configs() -> None:
    assert (shipped_configs() / "dentalsplat.yaml").is_file()
    assert (shipped_configs() / "suites").is_dir()


def test_a_missing_library_says_which_extra_brings_it() -> None:
    require("Something", "torch", "numpy")
    with pytest.raises(RequestError, match=r"LPIPS needs no_such_thing.*'dentalsplat\[torch\]'"):
        require("LPIPS", "torch", "numpy", "no_such_thing")


def test_lpips_is_left_out_without_torch(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    from stages.evaluate.images import perceptual

    cached = tmp_path / "hub" / "checkpoints" / perceptual.VGG_FILE
    cached.parent.mkdir(parents=True)
    cached.write_bytes(b"weights")
    monkeypatch.setenv("TORCH_HOME", str(tmp_path))
    monkeypatch.setitem(sys.modules, "torch", None)
    monkeypatch.setattr("importlib.util.find_spec", lambda name, package=None: None)
    assert perceptual.find_vgg_weights(None) is None
    with pytest.raises(RequestError, match=r"evaluate.lpips_weights needs torch"):
        perceptual.find_vgg_weights(str(cached))


def test_open3d_comes_without_cuda_where_there_is_such_a_wheel(
    setup_cfg: configparser.ConfigParser,
) -> None:
    spec = spec_from_file_location("requirements", ROOT / "tools" / "requirements.py")
    assert spec is not None and spec.loader is not None
    tool = module_from_spec(spec)
    spec.loader.exec_module(tool)
    asked = setup_cfg["options"]["install_requires"].split()
    assert list(tool.requirements([], "Darwin", "arm64")) == asked
    without = list(tool.requirements(["torch", "dicom"], "Linux", "x86_64"))
    assert {line.replace("open3d-cpu", "open3d") for line in without} > set(asked)
    assert not any(line.startswith("open3d>") for line in without)
    assert any(line.startswith("torch>") for line in without)
    assert any(line.startswith("pydicom>") for line in without)
    pinned = dict(
        line.split("==") for line in (ROOT / "constraints.txt").read_text().splitlines()
        if "==" in line
    )  # fmt: skip
    assert pinned["open3d-cpu"] == pinned["open3d"]


def test_the_wheel_of_another_name_will_do(monkeypatch: pytest.MonkeyPatch) -> None:
    from importlib.metadata import PackageNotFoundError

    def version(name: str) -> str:
        if name != "open3d-cpu":
            raise PackageNotFoundError(name)
        return "0.20.0"

    monkeypatch.setattr("pipeline.installed.version", version)
    assert library_version("open3d") == "0.20.0"
    assert library_version("numpy") == "missing"
