"""The tables that the command line prints."""

from __future__ import annotations

import contextlib
import json
from typing import Any

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from pipeline.front.progress import cost, describe, in_words
from pipeline.front.settings import Setting
from pipeline.running.outcomes import RunSummary, StageOutcome
from pipeline.stage import Finding
from pipeline.workspace import StageStatus

STATE_STYLE = {"cached": "green", "stale": "yellow", "failed": "red", "problem": "red"}


def _console() -> Console:
    """Wrap to the terminal, but never fold lines that go to a file or a pipe."""
    console = Console(highlight=False)
    return console if console.is_terminal else Console(highlight=False, width=200)


def _table(*columns: str) -> Table:
    table = Table(box=None, pad_edge=False, header_style="bold")
    for name in columns:
        number = name in ("seconds", "MB")
        table.add_column(name, justify="right" if number else "left", no_wrap=name == "stage")
    return table


def print_summary(summary: RunSummary) -> None:
    """What came of each stage, what it cost, and where the outputs lie."""
    console = _console()
    table = _table("stage", "", "seconds", "MB", "result")
    for stage in summary.stages:
        table.add_row(
            stage.name,
            stage.action,
            f"{stage.figures['wall_seconds']:.1f}",
            f"{stage.figures['peak_memory_mb']:.0f}",
            escape(describe(stage.figures["summary"])),
        )
    console.print(table)
    for stage in summary.stages:
        _print_notes(console, stage)
        pictures = stage.folder / "pictures" if stage.folder else None
        if pictures and pictures.is_dir():
            console.print(f"Pictures ({stage.name}): {pictures}/", soft_wrap=True, markup=False)
    if text := headline(summary):
        console.print(f"\n{text}")
    if summary.results:
        console.print(f"\nResults: {summary.results}/", soft_wrap=True, markup=False)
        viewer = summary.results / "viewer.html"
        if viewer.exists():
            console.print(f"Look at it: open {viewer} in a browser.", soft_wrap=True, markup=False)
    else:
        console.print(f"\nResults: {summary.stages[-1].folder}/", soft_wrap=True, markup=False)
    if summary.check:
        console.print(
            f"The teeth, to check and put right: {summary.check}", soft_wrap=True, markup=False
        )
    if summary.report:
        console.print(f"How it went, with pictures: {summary.report}", soft_wrap=True, markup=False)


#: Figures that everybody asks for, by the names under which stages report them.
HEADLINE = (
    "{views_registered} of {views_total} views registered",
    "{points_before:,} points, {points_after_pruning:,} after SAP",
    "{gaussians:,} Gaussians",
    "PSNR {psnr:.2f} dB on the input views",
)


def headline(summary: RunSummary) -> str:
    """One sentence with those figures that the stages of this run gave."""
    figures: dict[str, Any] = {}
    for stage in summary.stages:
        figures |= stage.figures["summary"]
    parts = []
    for text in HEADLINE:
        with contextlib.suppress(KeyError):
            parts.append(text.format_map(figures))
    return "; ".join(parts)


def _print_notes(console: Console, stage: StageOutcome) -> None:
    for warning in stage.warnings:
        console.print(f"[yellow]Note[/] ({stage.name}): ", end="")
        console.print(warning, markup=False)


def print_dry_run(summary: RunSummary) -> None:
    """What a run would do."""
    table = _table("stage", "", "last time", "why")
    for stage in summary.stages:
        last = in_words(stage.figures["wall_seconds"]) if stage.figures else ""
        table.add_row(stage.name, stage.action, last, escape("; ".join(stage.reasons)))
    console = _console()
    console.print(table)
    for stage in summary.stages:
        _print_notes(console, stage)
    if told := cost(summary.stages):
        console.print(told, markup=False)


def print_status(stages: list[StageStatus]) -> None:
    """State and reasons of each stage."""
    table = _table("stage", "state", "why", "result")
    for stage in stages:
        why = stage.failure or "; ".join(stage.reasons)
        if stage.state == "cached" and why:
            why = f"last ran because: {why}"
        if stage.resumable:
            why = "; ".join(filter(None, (why, "goes on from its checkpoint")))
        style = STATE_STYLE.get(stage.state, "")
        state = f"[{style}]{stage.state}[/]" if style else stage.state
        table.add_row(stage.name, state, escape(why), escape(describe(stage.summary)))
    _console().print(table)


def print_stages(stages: list[dict[str, Any]]) -> None:
    """The registered stages."""
    table = _table("stage", "what it does", "requires", "can use", "provides")
    for stage in stages:
        if "error" in stage:
            table.add_row(stage["name"], f"[red]{escape(stage['error'])}[/]")
            continue
        kinds = [", ".join(stage[key]) for key in ("requires", "optional", "provides")]
        if stage["may_provide"]:
            kinds[-1] += f"; sometimes {', '.join(stage['may_provide'])}"
        table.add_row(stage["name"], stage["summary"], *kinds)
        for method, text in stage["methods"].items():
            table.add_row("", f"  method {method}: {text}")
    _console().print(table)


def print_settings(settings: list[Setting]) -> None:
    """Name, type and range, default and meaning of each setting."""
    table = _table("setting", "may be", "default", "meaning")
    for setting in settings:
        default = "-" if setting.required else json.dumps(setting.default, ensure_ascii=False)
        cells = (setting.name, setting.allowed, default, setting.meaning)
        table.add_row(*map(escape, cells))
    _console().print(table)


def print_findings(findings: list[Finding]) -> None:
    """What the doctor found."""
    table = _table("", "check", "found", "what to do")
    for finding in findings:
        style = STATE_STYLE.get(finding.level, "green" if finding.level == "ok" else "yellow")
        cells = map(escape, (finding.name, finding.detail, finding.mend))
        table.add_row(f"[{style}]{finding.level}[/]", *cells)
    _console().print(table)
