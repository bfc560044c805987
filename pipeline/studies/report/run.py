"""The report of a run: what its stages say of it, and what is common to all."""

from __future__ import annotations

import platform
import shlex
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import TypeVar

from pipeline.errors import PICTURES, PipelineError
from pipeline.installed import library_version
from pipeline.pages.anonymous import anonymous as without_names
from pipeline.pages.case import Case, title_of
from pipeline.pages.page import ANONYMOUS, CHECK, REPORT, as_yaml, seconds, write_page
from pipeline.pages.parts import Card, Fact, Hero, Link, Part, Section
from pipeline.pages.pictures import Picture, from_file
from pipeline.pages.tables import costs
from pipeline.stage import get_stage
from pipeline.studies.report.check import write_check_page
from pipeline.studies.report.compared import comparison
from pipeline.studies.report.kinds import KINDS
from pipeline.studies.report.reading import read_case

Some = TypeVar("Some")

TEMPLATE = "run.html"
#: Names of photographs in the command line that the page shows, and pictures of a failure.
MOST_NAMED, MOST_PICTURES = 4, 12


def write_run_report(workspace: Path, anonymous: bool = False) -> Path:
    """Write the report of a workspace's last request; see `pipeline.studies.report.run_report`."""
    case = read_case(workspace)
    if anonymous:
        case, check = without_names(case), None
    else:
        check = _drawn(case, "page to put the teeth right", write_check_page, None)
    # The last stage says most of what came out; the sections stand in the order of the run.
    told = [part_of_stage(case, record.name) for record in case.stages]
    first_last = [
        *_parts(case, "key figures", placed),
        *(part for parts in told[::-1] for part in parts),
        *_parts(case, "findings", closing),
    ]
    told, first_last = case.hide(told), case.hide(first_last)
    sections = [part for parts in told for part in parts if isinstance(part, Section)]
    sections = [section for section in sections if section.blocks]
    manifests = {record.name: record.manifest for record in case.stages}
    views = _drawn(case, "photographs", lambda case: case.latest("views"), None)
    return write_page(
        "pipeline.studies.report", TEMPLATE, workspace / (ANONYMOUS if anonymous else REPORT),
        title="A case" if anonymous else workspace.resolve().name, case=case,
        failed=case.failed, notes=case.hide(case.notes),
        stale=[r for r in case.stages if r.state in ("stale", "pending") and r.result],
        total=len(views) if views else 0, warnings=list(case.warnings()), costs=costs(manifests),
        cards=_only(Card, first_last), facts=_only(Fact, first_last),
        hero=next(iter(_only(Hero, first_last)), None),
        links=[] if anonymous else links(case, first_last),
        to_check=[section for section in sections if section.place == "check"],
        chapters=[section for section in sections if section.place == "chapter"],
        folded=[section for section in sections if section.place in ("folded", "open")],
        comparison_with_colmap=_drawn(case, "comparison", comparison, None),
        failure_pictures=case.hide(_drawn(case, "failure", failure_pictures, list[Picture]())),
        settings=settings(case), versions=versions(case), command=command(case),
        date="" if anonymous else time.strftime("%Y-%m-%d %H:%M"), diagnosis=diagnosis(case),
        check=CHECK if check else "",
    )  # fmt: skip


def _drawn(case: Case, title: str, build: Callable[[Case], Some], otherwise: Some) -> Some:
    """What `build` makes of a case: one damaged or foreign file must not cost the reader the rest.

    Args:
        title: what the reader is told that it was to be.
        otherwise: what stands for it where it can't be made.
    """
    try:
        return build(case)
    except Exception as error:
        case.notes.append(f"The part '{title}' could not be drawn: {type(error).__name__}: {error}")
        return otherwise


def _parts(case: Case, title: str, build: Callable[[Case], Iterable[Part]]) -> list[Part]:
    return _drawn(case, title, lambda case: list(build(case)), [])


def part_of_stage(case: Case, name: str) -> list[Part]:
    """What a stage says of itself, and what is said of the kinds that it is the first to make."""
    found: list[Part] = []
    try:
        builders = get_stage(name).report()
    except Exception as error:
        why = str(error) if isinstance(error, PipelineError) else f"{type(error).__name__}: {error}"
        case.notes.append(f"What the stage '{name}' has to say is missing: {why}")
        builders = {}
    for title, build in builders.items():
        found += _parts(case, title, build)
    for kind, draw in KINDS.items():
        if case.providers(kind)[:1] == [name]:
            found += _parts(case, kind, draw)
    return found


def _only(kind: type[Some], parts: Iterable[Part]) -> list[Some]:
    return [part for part in parts if isinstance(part, kind)]


def placed(case: Case) -> Iterator[Card | Fact]:
    """How many photographs have a camera."""
    from stages.dentition.corrections import LEFT_OUT

    views, cameras, teeth = (case.latest(kind) for kind in ("views", "cameras", "teeth"))
    if views is None or cameras is None:
        return
    known = cameras.by_name()
    without = {view.name: view.source_name or view.name for view in views.views
               if view.name not in known}  # fmt: skip
    read = teeth.views if teeth else ()
    out = [without.pop(t.name) for t in read if t.set_aside == LEFT_OUT and t.name in without]
    total, unplaced = len(views.views) - len(out), list(without.values())
    count = total - len(unplaced)
    yield Card(f"{count} of {total}", "photographs placed in space", poor=count < total)
    if not unplaced:
        yield Fact(f"All {total} photographs were placed in space.")
    else:
        yield Fact(
            f"{len(unplaced)} of {total} photographs could not be placed and are not part of the "
            f"scene: {', '.join(unplaced)}."
        )
    if out:
        yield Fact(f"Left out by hand: {', '.join(out)}.")


def closing(case: Case) -> Iterator[Card | Fact]:
    """What holds for the whole scene: its unit, how well its cameras fit, what it took."""
    computed = [record.manifest["wall_seconds"] for record in case.stages if record.result]
    if computed:
        yield Card(seconds(sum(computed)), "computing time, all stages")
    cameras = case.latest("cameras")
    if cameras is not None:
        advice = " Give a known length (init.length) for that."
        yield Fact(cameras.scale.text + ("" if cameras.scale.unit == "mm" else advice))
    error = case.figures().get("reprojection_error_px")
    if error is not None:
        yield Fact(
            f"Matched spots are met by the cameras within {error:.2f} pixels (root mean square)."
        )


def failure_pictures(case: Case) -> list[Picture]:
    """What a failed stage drew of the trouble."""
    failed = case.failed
    if failed is None:
        return []
    paths = sorted((case.workspace / failed.name / "failure").glob("*.png"))
    return [
        from_file(path, title, title, 900)
        for path in paths[:MOST_PICTURES]
        for title in [title_of(path.stem, case.labels)]
    ]


def diagnosis(case: Case) -> str:
    """Why the run failed, without the place of the pictures that the page shows itself."""
    return (case.failed.failure or "").partition(PICTURES)[0] if case.failed else ""


def links(case: Case, parts: Iterable[Part]) -> list[Link]:
    """The files that came out and are there."""
    named = [
        *_only(Link, parts),
        Link(CHECK, "Check the teeth"),
        Link("compare/report.html", "Comparison with COLMAP"),
    ]
    return [link for link in named if (case.workspace / link.path).is_file()]


def settings(case: Case) -> list[tuple[str, str]]:
    """(stage, its resolved settings as YAML): of its result, or of the next run."""
    found = []
    if case.run_settings is not None:
        found.append(("run", case.run_settings.model_dump(mode="json")))
    for record in case.stages:
        values = record.manifest.get("config")
        if values is None and record.name in case.settings:
            values = case.settings[record.name].model_dump(mode="json")
        if values is not None:
            found.append((record.name, values))
    # Hidden before YAML folds long lines.
    return [(name, as_yaml(case.hide(values))) for name, values in found]


def versions(case: Case) -> list[tuple[str, str]]:
    """(what, version) of what computed the results and of what wrote this page."""
    found: dict[str, str] = {}
    for record in case.stages:
        found |= record.manifest.get("key_material", {}).get("libraries", {})
    own = [("dentalsplat", library_version("dentalsplat")), ("Python", sys.version.split()[0]),
           ("system", f"{platform.system()} {platform.machine()}")]  # fmt: skip
    return own + sorted(found.items())


def command(case: Case) -> str:
    """The request as a command line, with names of files instead of their folders."""
    request = case.request
    images = [Path(path).name for path in request.get("images", [])]
    images = [f"./{name}" if name.startswith("-") else name for name in images]
    if len(images) > MOST_NAMED:
        images = [images[0], "...", images[-1]]
    parts = ["pipeline", "run", *images]
    if request.get("preset"):
        parts += ["-c", Path(request["preset"]).name]
    if request.get("stages"):
        parts += ["--stages", ",".join(request["stages"])]
    if request.get("from"):
        parts += ["--from", request["from"]]
    for text in request.get("overrides", []):
        parts += ["--set", text]
    # without names it can't be run, and quotes could keep a name from being known
    return str(case.hide(" ".join(parts))) if case.nameless else shlex.join(parts)
