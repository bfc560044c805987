"""The templates, and how numbers are written."""

from __future__ import annotations

import math
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pipeline.errors import RequestError
from pipeline.files import write_atomic

if TYPE_CHECKING:
    from jinja2 import Environment


#: Pages in a workspace: what the last run did, the same without names, and the teeth to put right
#: where there are any.
REPORT, ANONYMOUS, CHECK = "report.html", "report_anonymous.html", "check.html"


@cache
def environment(package: str) -> Environment:
    """The templates of a package and those that all pages share; what goes in is escaped."""
    from jinja2 import Environment, FunctionLoader, StrictUndefined

    def source(name: str) -> str | None:
        for home in (package, "pipeline.pages"):
            file = files(home) / name
            if file.is_file():
                return file.read_text(encoding="utf-8")
        return None

    made = Environment(
        loader=FunctionLoader(source), autoescape=True, undefined=StrictUndefined,
        trim_blocks=True, lstrip_blocks=True,
    )  # fmt: skip
    made.filters["number"] = number
    made.filters["seconds"] = seconds
    return made


def compile_template(package: str, template: str) -> None:
    """Compile a template, and all that it includes, before it is to be filled."""
    from jinja2.meta import find_referenced_templates

    templates = environment(package)
    assert templates.loader is not None
    templates.get_template(template)
    source, _, _ = templates.loader.get_source(templates, template)
    for name in find_referenced_templates(templates.parse(source)):
        if name is not None:
            compile_template(package, name)


def number(value: Any, digits: int = 2) -> str:
    """A figure for people: ``1,234``, ``0.83``; a dash for what is not known."""
    if value is None:
        return "–"
    if isinstance(value, bool) or not isinstance(value, int | float):
        return str(value)
    if not math.isfinite(value):
        return "–"
    if isinstance(value, int) or (value == int(value) and abs(value) >= 1000):
        return f"{int(value):,}"
    return f"{value:z,.{digits}f}"


def seconds(value: float | None) -> str:
    """A time for people: ``0.4 s``, ``12 s``, ``3 min 20 s``."""
    if value is None:
        return "–"
    if round(value, 1) < 10:
        return f"{value:.1f} s"
    whole = round(value)
    return f"{whole} s" if whole < 120 else f"{whole // 60} min {whole % 60} s"


def as_yaml(values: Any) -> str:
    """Settings as one writes them."""
    import yaml

    return yaml.safe_dump(values, sort_keys=False, allow_unicode=True, default_flow_style=None)


def write_page(package: str, template: str, out: Path, **content: Any) -> Path:
    """Fill a template and replace the file in one step.

    Args:
        package: where the template lies.

    Raises:
        RequestError: the folder can't be written to.
    """
    text = environment(package).get_template(template).render(**content)
    try:
        write_atomic(out, text)
    except OSError as error:
        raise RequestError(f"The report {out} can't be written ({error.strerror}).") from error
    return out
