"""The pages of the site that are made from the code: stages, settings, artifacts.

mkdocs calls `on_files` (``hooks`` in mkdocs.yml) whenever it builds the site, so that these pages
are never out of date.
"""

from __future__ import annotations

import dataclasses
import inspect
import json
import re
import sys
from pathlib import Path
from typing import Any

ROOT = str(Path(__file__).resolve().parents[1])
sys.path.insert(0, ROOT)

import pipeline  # noqa: E402
from pipeline.artifacts import KINDS, Artifact, artifact_class  # noqa: E402
from pipeline.front import settings  # noqa: E402


def on_files(files: Any, config: Any) -> Any:
    """Add the generated pages to those of the folder."""
    from mkdocs.structure.files import File

    if ROOT not in sys.path:  # mkdocs puts the path back after it has read this file
        sys.path.insert(0, ROOT)
    for name, make in PAGES.items():
        files.append(File.generated(config, name, content=make()))
    return files


def stages_page() -> str:
    """What ``pipeline stages`` lists."""
    lines = [
        "# Stages", "",
        "A stage takes artifacts and makes artifacts. This page is made from the code;",
        "`pipeline stages` prints the same.", "",
    ]  # fmt: skip
    for stage in pipeline.stages():
        if "error" in stage:
            raise RuntimeError(stage["error"])
        name = stage["name"]
        lines += [f"## {name}", "", f"{_sentence(stage['summary'])}", ""]
        for label, key in (
            ("Needs", "requires"), ("Uses, where it is there", "optional"), ("Makes", "provides"),
            ("Sometimes makes", "may_provide"),
        ):  # fmt: skip
            if stage[key]:
                kinds = ", ".join(f"[{kind}](artifacts.md#{kind})" for kind in stage[key])
                lines.append(f"- {label}: {kinds}")
        lines += [f"- Its settings: [{name}](settings.md#{name})", ""]
        if stage["methods"]:
            lines += [f"`--set {name}.method=…`", "", "| method | |", "|---|---|"]
            lines += [f"| `{key}` | {_cell(text)} |" for key, text in stage["methods"].items()]
            lines.append("")
    return "\n".join(lines)


def settings_page() -> str:
    """What ``pipeline settings`` lists."""
    lines = [
        "# Settings", "",
        "Change a setting with `--set`, or in a preset (a YAML file with a section per stage):", "",
        "```", "pipeline run photos/ --set fit.iterations=800 --set views.long_side=768", "```", "",
        "This page is made from the code; `pipeline settings` and `pipeline settings STAGE` print",
        "the same, and `--json` makes it readable for programs. `auto` follows the case; the",
        "summary of a run tells what it came to.", "",
    ]  # fmt: skip
    for name, model in settings.config_models().items():
        lines += [f"## {name}", "", "| setting | may be | default | meaning |", "|---|---|---|---|"]
        for setting in settings.model_settings(model, name):
            default = "" if setting.required else f"`{_short(setting.default)}`"
            lines.append(
                f"| `{setting.name}` | {_cell(setting.allowed)} | {_cell(default)} | "
                f"{_cell(setting.meaning)} |"
            )
        lines.append("")
    return "\n".join(lines)


#: How an artifact of a finished run is read.
READ = """\
from pathlib import Path

import dentalsplat
from pipeline.artifacts import artifact_class

stages = dentalsplat.status(workspace="runs/demo")
folders = {stage.name: Path(stage.folder) for stage in stages}
cloud = artifact_class("points").load(folders["sap"] / "points")
print(cloud.positions.shape, cloud.colors.dtype)
"""


def artifacts_page() -> str:
    """Every kind of artifact, with what its class and the parts of it say of themselves."""
    lines = [
        "# Artifacts", "",
        "An artifact is what stages hand to each other: arrays in memory, files in a common format",
        "on disk. They lie in `WORKSPACE/<stage>/<key>/<kind>/`. This page is made from the code.",
        "", "To read one of a finished run:", "", "```python", f"{READ}```", "",
    ]  # fmt: skip
    made = {kind: [] for kind in KINDS}
    for stage in pipeline.stages():
        for kind in (*stage.get("provides", ()), *stage.get("may_provide", ())):
            made.setdefault(kind, []).append(stage["name"])
    told: set[str] = set()  # modules; one may have two kinds
    for kind, stages in made.items():
        found = artifact_class(kind)
        again = found.__module__ in told
        told.add(found.__module__)
        by = ", ".join(f"[{name}](stages.md#{name})" for name in stages)
        module = inspect.getdoc(sys.modules[found.__module__]) or ""
        about = _sentence(re.sub(r"^`\w+`: ", "", module).split("\n\n")[0].replace("\n", " "))
        lines += [f"## {kind}", ""] + ([] if again else [about, ""])
        lines += [f"Made by: {by or 'no stage of ours'}.", ""]
        lines += [f"In Python: `{found.__module__}.{found.__name__}`.", ""]
        lines += _told(found)
        for part in [] if again else _parts(found):
            lines += [f"### {part.__name__}", "", *_told(part)]
    return "\n".join(lines)


def _parts(found: type) -> list[type]:
    """The classes that an artifact's arrays are in: those of its module that are no artifacts."""
    return [
        part
        for name, part in vars(sys.modules[found.__module__]).items()
        if dataclasses.is_dataclass(part)
        and isinstance(part, type)
        and part.__module__ == found.__module__
        and not issubclass(part, Artifact)
        and not name.startswith("_")
    ]


def _told(part: type) -> list[str]:
    """What a class says of itself, its attributes as a list."""
    about, _, attributes = (inspect.getdoc(part) or "").partition("\n\nAttributes:\n")
    entries = re.split(r"\n    (?! )", attributes.removeprefix("    ")) if attributes else []
    lines = [about, ""]
    for entry in entries:
        names, _, meaning = " ".join(entry.split()).partition(": ")
        lines.append(f"- `{names}`: {meaning.replace('<', '&lt;')}")
    return [*lines, ""]


def _sentence(text: str) -> str:
    return text[:1].upper() + text[1:] + ("" if text.endswith(".") else ".")


def _short(value: Any) -> str:
    text = json.dumps(value, ensure_ascii=False)
    return text if len(text) <= 40 else text[:37] + "…"


def _cell(text: str) -> str:
    return text.replace("|", "\\|").replace("<", "&lt;").replace("*", "\\*").replace("\n", " ")


PAGES = {"stages.md": stages_page, "settings.md": settings_page, "artifacts.md": artifacts_page}
