"""The pages of the site that are made from the code: stages, settings, artifacts.

mkdocs calls `on_files` (``hooks`` in mkdocs.yml) whenever it builds the site, so that these pages
are never out of date.
"""

from __future__ import annotations

import inspect
import json
import sys
from pathlib import Path
from typing import Any

ROOT = str(Path(__file__).resolve().parents[1])
sys.path.insert(0, ROOT)

import pipeline  # noqa: E402
from pipeline.artifacts import KINDS, artifact_class  # noqa: E402
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


def artifacts_page() -> str:
    """Every kind of artifact, with what its class says of itself."""
    lines = [
        "# Artifacts", "",
        "An artifact is what stages hand to each other: arrays in memory, files in a common format",
        "on disk. They lie in `WORKSPACE/<stage>/<key>/<kind>/`. This page is made from the code.",
        "",
    ]  # fmt: skip
    made = {kind: [] for kind in KINDS}
    for stage in pipeline.stages():
        for kind in (*stage.get("provides", ()), *stage.get("may_provide", ())):
            made.setdefault(kind, []).append(stage["name"])
    for kind, stages in made.items():
        found = artifact_class(kind)
        by = ", ".join(f"[{name}](stages.md#{name})" for name in stages)
        module = inspect.getdoc(sys.modules[found.__module__]) or ""
        about = _sentence(module.split(": ", 1)[-1].split("\n\n")[0].replace("\n", " "))
        lines += [f"## {kind}", "", about, "", f"Made by: {by or 'no stage of ours'}.", ""]
        lines += [f"In Python: `{found.__module__}.{found.__name__}`.", ""]
        lines += ["```text", inspect.getdoc(found) or "", "```", ""]
    return "\n".join(lines)


def _sentence(text: str) -> str:
    return text[:1].upper() + text[1:] + ("" if text.endswith(".") else ".")


def _short(value: Any) -> str:
    text = json.dumps(value, ensure_ascii=False)
    return text if len(text) <= 40 else text[:37] + "…"


def _cell(text: str) -> str:
    return text.replace("|", "\\|").replace("<", "&lt;").replace("*", "\\*").replace("\n", " ")


PAGES = {"stages.md": stages_page, "settings.md": settings_page, "artifacts.md": artifacts_page}
