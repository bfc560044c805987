"""The house: what may import what, read from the sources without running any of them."""

from __future__ import annotations

import ast
import configparser
import re
from collections.abc import Iterator, Mapping
from functools import cache
from pathlib import Path

import pytest

from pipeline.artifacts import KINDS

ROOT = Path(__file__).resolve().parents[2]
#: The folders of `stages/` that are no stages but what stages are made of.
LIBRARIES = {"dentition", "photographs", "pointmaps", "splatting", "stereo"}
#: The engine's parts that may know stages: the command line, and what is done with whole runs.
ABOVE = ("pipeline.cli", "pipeline.front", "pipeline.studies")
#: Modules on the floor of a folder at most.
MOST_MODULES = 12


@cache
def modules() -> dict[str, Path]:
    """Dotted name -> file, of all modules of both packages."""
    found = {}
    for path in (p for home in ("pipeline", "stages") for p in (ROOT / home).rglob("*.py")):
        name = ".".join(path.relative_to(ROOT).with_suffix("").parts)
        found[name.removesuffix(".__init__")] = path
    return found


@cache
def tree_of(name: str) -> ast.Module:
    return ast.parse(modules()[name].read_text())


@cache
def imports_of(name: str) -> set[str]:
    """The modules that a module imports, at its top and in functions; not what only names types."""
    known = modules()
    found: set[str] = set()
    for node in _loaded(tree_of(name)):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{name}: relative imports hide where they lead"
            for alias in node.names:
                inner = f"{node.module}.{alias.name}"
                found.add(inner if inner in known else str(node.module))
    return {module for module in found if module in known and module != name}


def _loaded(tree: ast.AST) -> Iterator[ast.AST]:
    """All nodes but those that only a type checker reads."""
    for node in ast.iter_child_nodes(tree):
        if not (isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING"):
            yield node
            yield from _loaded(node)


@cache
def top_imports_of(name: str) -> set[str]:
    """The modules of stages that a module imports as soon as it is imported itself."""
    found: set[str] = set()
    for node in tree_of(name).body:
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            found.add(str(node.module))
    return {module for module in found if module.split(".")[0] == "stages"}


def circles(arrows: Mapping[str, set[str]]) -> Iterator[set[str]]:
    """The strongly connected parts of more than one module (Tarjan 1972)."""
    number: dict[str, int] = {}
    low: dict[str, int] = {}
    stack: list[str] = []

    def visit(name: str) -> Iterator[set[str]]:
        number[name] = low[name] = len(number)
        stack.append(name)
        for other in sorted(arrows[name]):
            if other not in number:
                yield from visit(other)
                low[name] = min(low[name], low[other])
            elif other in stack:
                low[name] = min(low[name], number[other])
        if low[name] == number[name]:
            part = set(stack[stack.index(name) :])
            del stack[stack.index(name) :]
            if len(part) > 1:
                yield part

    for name in sorted(arrows):
        if name not in number:
            yield from visit(name)


def is_above(name: str) -> bool:
    return any(name == home or name.startswith(f"{home}.") for home in ABOVE)


def engine() -> list[str]:
    return [n for n in modules() if n.split(".")[0] == "pipeline" and not is_above(n)]


def stage_names() -> set[str]:
    config = configparser.ConfigParser()
    config.read(ROOT / "setup.cfg")
    lines = config["options.entry_points"]["dentalsplat.stages"].strip().splitlines()
    return {line.partition("=")[0].strip() for line in lines}


def test_circles_are_found() -> None:
    arrows = {"a": {"b"}, "b": {"c"}, "c": {"a", "d"}, "d": {"e"}, "e": set(), "f": {"g"}}
    arrows["g"] = {"f", "a"}
    assert sorted(map(sorted, circles(arrows))) == [["a", "b", "c"], ["f", "g"]]


def test_there_are_no_circles() -> None:
    found = circles({name: imports_of(name) for name in modules()})
    assert [sorted(circle) for circle in found] == []


def test_the_engine_imports_no_stage() -> None:
    found = {
        name: sorted(other for other in imports_of(name) if other.split(".")[0] == "stages")
        for name in engine()
    }
    assert {name: others for name, others in found.items() if others} == {}


def test_the_engine_knows_nothing_of_what_stands_above_it() -> None:
    found = {name: sorted(filter(is_above, imports_of(name))) for name in engine()}
    assert {name: others for name, others in found.items() if others} == {}


def test_what_knows_stages_imports_them_only_when_asked() -> None:
    found = {name: top_imports_of(name) for name in modules() if is_above(name)}
    assert {name: others for name, others in found.items() if others} == {}


def test_no_stage_imports_another() -> None:
    found = []
    for name in modules():
        _, _, own = name.partition("stages.")
        for other in imports_of(name) if own else ():
            home = other.split(".")[1] if other.startswith("stages.") else own.split(".")[0]
            if home not in {own.split(".")[0], *LIBRARIES}:
                found.append(f"{name} -> {other}")
    assert found == []


def test_libraries_know_no_stage() -> None:
    found = [
        f"{name} -> {other}"
        for name in modules()
        for other in imports_of(name)
        if name.split(".")[1:2] and name.split(".")[0] == "stages"
        if name.split(".")[1] in LIBRARIES
        if other.startswith("stages.") and other.split(".")[1] not in LIBRARIES
    ]
    assert found == []


def test_stages_know_only_the_ground_they_stand_on() -> None:
    ground = {
        "artifacts",
        "errors",
        "files",
        "geometry",
        "installed",
        "kernels",
        "pages",
        "stage",
        "untrusted",
    }
    found = [
        f"{name} -> {other}"
        for name in modules()
        if name.startswith("stages.")
        for other in imports_of(name)
        if other.startswith("pipeline.") and other.split(".")[1] not in ground
    ]
    assert found == []


def test_the_engine_names_no_stage() -> None:
    names = stage_names()
    setting = re.compile(rf"\b(?:{'|'.join(sorted(names))})\.[a-z_]+")
    files = (".json", ".yaml", ".html")
    found = []
    for name in engine():
        # Some stages are called like the kind that they make, and kinds are known to these.
        knows_kinds = name.startswith(("pipeline.artifacts", "pipeline.geometry", "pipeline.pages"))
        wrong = names - set(KINDS) if knows_kinds else names
        for text in _texts(tree_of(name)):
            settings = [said for said in setting.findall(text) if not said.endswith(files)]
            found += [f"{name}: {text!r}"] if text in wrong or settings else []
    assert found == []


def _texts(tree: ast.Module) -> Iterator[str]:
    """The texts in a module's code, without its docstrings."""
    said = {id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Expr)}
    for node in ast.walk(tree):
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in said:
            yield node.value


def test_no_floor_is_crowded() -> None:
    floors: dict[str, int] = {}
    for path in modules().values():
        if path.name != "__init__.py":
            folder = str(path.parent.relative_to(ROOT))
            floors[folder] = floors.get(folder, 0) + 1
    assert {folder: count for folder, count in floors.items() if count > MOST_MODULES} == {}


@pytest.mark.parametrize("home", ["pipeline", "stages"])
def test_every_folder_is_packaged(home: str) -> None:
    config = configparser.ConfigParser()
    config.read(ROOT / "setup.cfg")
    packaged = set(config["options"]["packages"].split())
    folders = {path.parent for path in (ROOT / home).rglob("*.py")}
    assert {".".join(f.relative_to(ROOT).parts) for f in folders} <= packaged
    data = config["options.package_data"]
    for path in (ROOT / home).rglob("*"):
        if path.suffix in (".html", ".css", ".js", ".glsl", ".onnx"):
            package = ".".join(path.parent.relative_to(ROOT).parts)
            assert f"*{path.suffix}" in data.get(package, ""), path


def test_no_test_module_imports_another() -> None:
    """What tests share is in modules beside them."""
    found = []
    for path in (ROOT / "tests").rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            names: list[str] = []
            if isinstance(node, ast.Import):
                names = [alias.name for alias in node.names]
            elif isinstance(node, ast.ImportFrom):
                names = [f"{node.module}.{alias.name}" for alias in node.names]
            found += [
                f"{path.relative_to(ROOT)}: {name}"
                for name in names
                if any(part.startswith("test_") for part in name.split("."))
            ]
    assert found == []
