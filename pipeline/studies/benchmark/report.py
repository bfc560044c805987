"""The report of a benchmark: its tables, curves beside the paper's, what failed, and pictures."""

from __future__ import annotations

import re
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from pipeline.artifacts.metrics import Metrics, Scores
from pipeline.artifacts.views import read_png
from pipeline.pages.charts import Bar, Chart, bar_chart, series_chart
from pipeline.pages.page import REPORT, as_yaml, number, write_page
from pipeline.pages.pictures import Picture, picture, thirds
from pipeline.pages.tables import Cell, Table, cell
from pipeline.studies.benchmark.paper import paper_figures

Results = Mapping[str, Any]
Record = Mapping[str, Any]

#: Rows of pictures on the page at most, and the long side of each picture.
MOST_ROWS, THUMBNAIL = 12, 300
#: What was scored, by the names that `results.json` uses.
SCORINGS = {
    "registered": "unseen views, registered cameras",
    "refined": "unseen views, refined cameras",
    "input": "training views",
}
STATUS = {"done": "good", "failed": "warn", "fault": "bad", "refused": "bad"}


def benchmark_report(results: Results, out: str | Path) -> Path:
    """Write the report of a benchmark.

    Args:
        results: what `results.json` of the benchmark says.
        out: the benchmark's folder (the report is ``report.html`` in it).

    Returns:
        The file.
    """
    out = Path(out)
    notes: list[str] = []
    titles = {m["name"]: m["title"] or m["name"] for m in results["suite"]["methods"]}
    tables = []
    for table in results["tables"]:
        content = {"table": table, "grids": [grid_table(grid) for grid in table["grids"]]}
        try:
            content["charts"] = list(charts(results, table, titles))
        except Exception as error:  # the tables matter more than a curve
            content["charts"] = []
            notes.append(f"The curves of '{table['title']}' could not be drawn: {error}")
        tables.append(content)
    rows = []
    for group in groups(results):
        try:
            found = picture_row(group, out, titles)
        except Exception as error:  # a damaged picture must not cost the rest
            notes.append(f"Pictures of {group[0]['workspace']} could not be shown: {error}")
            continue
        if found is not None:
            rows.append(found)
    cells = results["cells"]
    done = sum(record["status"] == "done" for record in cells)
    scenes = len({record["scene"] for record in cells})
    cards = [
        {"value": f"{done} of {len(cells)}", "label": "cells done", "poor": done < len(cells)},
        {"value": str(scenes), "label": "scenes" if scenes != 1 else "scene", "poor": False},
        {"value": str(len(titles)), "label": "methods", "poor": False},
        {"value": f"{sum(r.get('seconds', 0) for r in cells) / 60:,.0f} min",
         "label": "computing time of all cells, shared stages counted in each", "poor": False},
    ]  # fmt: skip
    return write_page(
        "pipeline.studies.benchmark", "benchmark.html", out / REPORT,
        title=results["title"], note=results["note"], tables=tables, cards=cards,
        problems=list(results.get("problems", [])), notes=notes, rows=rows[:MOST_ROWS],
        more_rows=max(0, len(rows) - MOST_ROWS), failures=failures(results, titles),
        cells=cells_table(cells, titles), suite=as_yaml(results["suite"]),
        machine=results["machine"], versions=sorted(results["versions"].items()),
        date=time.strftime("%Y-%m-%d %H:%M"),
        quoted=any(method.get("paper") for method in results["suite"]["methods"]),
    )  # fmt: skip


# -- tables ----------------------------------------------------------------------------------------


def grid_table(grid: Mapping[str, Any]) -> dict[str, Any]:
    """A grid that is ready to print as a table, the best entry of each column marked.

    Entries of the paper compete only with the paper's own, so they are not marked. Nor are those of
    a method that failed on some scenes: they are the mean of the others, mostly the easier ones.
    """
    rows = [[_entry(text) for text in row] for row in grid["rows"]]
    best: dict[int, float] = {}
    # Rows of different numbers of views do not compete.
    columns = [] if "Views" in grid["columns"] else list(grid["columns"])
    for k, name in enumerate(columns):
        up = _larger_is_better(name)
        if up is None:
            continue
        values = [row[k].value for row in rows if _competes(row, k)]
        if len(values) > 1:
            best[k] = (max if up else min)(v for v in values if v is not None)
    marked = [
        [
            Cell(c.text, c.value, _competes(row, k) and best.get(k) == c.value)
            for k, c in enumerate(row)
        ]
        for row in rows
    ]
    footnotes = list(dict.fromkeys(grid.get("footnotes", [])))
    caption = str(grid["caption"])
    return {
        "caption": caption[:1].upper() + caption[1:],
        "table": Table(grid["columns"], marked),
        "footnotes": footnotes,
        "quoted": [_quoted(row) for row in rows],
    }


def _entry(text: str) -> Cell:
    found = re.match(r"-?[\d,]*\.?\d+", text)
    return Cell(text, float(found[0].replace(",", "")) if found else None)


def _quoted(row: Sequence[Cell]) -> bool:
    return row[0].text.startswith("—")


def _competes(row: Sequence[Cell], column: int) -> bool:
    """Is this entry a figure of ours, and of all scenes: no ``31.20 (1 of 2 failed)``?"""
    entry = row[column]
    partial = re.search(r"\(\d+ of \d+ ", entry.text)
    return entry.value is not None and not _quoted(row) and partial is None


def _larger_is_better(column: str) -> bool | None:
    """None where a column has no best, or holds the paper's figures."""
    if column.startswith("paper"):
        return None
    if column.startswith(("PSNR", "SSIM", "AUC", "F-score")):
        return True
    if column.startswith(("LPIPS", "FLIP", "Seconds", "seconds", "CPU")) or "error" in column:
        return False
    return None


def cells_table(cells: Sequence[Record], titles: Mapping[str, str]) -> Table:
    """Every cell with its outcome."""
    rows = []
    for record in cells:
        figures = record.get("figures", {})
        psnr = next((figures[s].get("psnr") for s in SCORINGS if s in figures), None)
        rows.append(
            [Cell(record["scene"]), Cell(titles.get(record["method"], record["method"])),
             cell(record["views"]), cell(record["seed"]), Cell(record["protocol"]),
             Cell(record["status"]), cell(psnr), cell(record.get("seconds"), 1),
             cell(record.get("peak_memory_mb"), 0), cell(record.get("gaussians")),
             Cell((record.get("keys") or {}).get("fit", "–")[:12])]
        )  # fmt: skip
    head = ("scene", "method", "views", "seed", "protocol", "outcome", "PSNR dB", "seconds", "MB",
            "Gaussians", "key of fit")  # fmt: skip
    return Table(head, rows, sortable=True)


def failures(results: Results, titles: Mapping[str, str]) -> list[dict[str, Any]]:
    """What did not come out, and why."""
    return [
        {
            "what": f"{record['scene']}, {record['views']} views, "
            f"{titles.get(record['method'], record['method'])}",
            "status": record["status"],
            "tone": STATUS.get(record["status"], ""),
            "reason": record.get("reason", ""),
        }
        for record in results["cells"]
        if record["status"] != "done"
    ]


# -- charts ----------------------------------------------------------------------------------------


def charts(
    results: Results, table: Mapping[str, Any], titles: Mapping[str, str]
) -> Iterator[Chart]:
    """PSNR and seconds over the number of views, or as bars where there is one number only."""
    papers = {m["name"]: m.get("paper") for m in results["suite"]["methods"]}
    views = sorted({entry["views"] for entry in table["figures"]})
    scorings = [s for s in SCORINGS if any(_values(table, s, "psnr").values())]
    for scoring in scorings:
        quoted = _paper_values(table, papers, scoring, views, "psnr")
        yield _chart(
            _titled(_values(table, scoring, "psnr"), titles), _titled(quoted, titles), views,
            "PSNR, dB", f"PSNR of {SCORINGS[scoring]}", _partial(table, scoring, "psnr", titles),
        )  # fmt: skip
    seconds = _values(table, "cost", "seconds")
    if any(seconds.values()):
        scoring = "input" if table["form"] == "photos" else "registered"
        quoted = _paper_values(table, papers, scoring, views, "seconds")
        yield _chart(
            _titled(seconds, titles), _titled(quoted, titles), views, "seconds",
            "Seconds from the photographs to the scene",
            _partial(table, "cost", "seconds", titles), log=True,
        )  # fmt: skip


def _chart(
    ours: Mapping[str, Mapping[float, float]], paper: Mapping[str, Mapping[float, float]],
    views: Sequence[int], label: str, title: str, partial: str, *, log: bool = False,
) -> Chart:  # fmt: skip
    said = "; ".join(
        f"{name}: " + ", ".join(f"{value:.2f} at {k:g} views" for k, value in sorted(v.items()))
        for name, v in ours.items() if v
    )  # fmt: skip
    told = "Dashed" if len(views) > 1 else "Orange mark"
    caption = f"{title}. {told}: the paper's, on other data." if paper else f"{title}."
    caption += partial
    if len(views) > 1:
        return series_chart(
            ours, ("input views", label), f"{title}. {said}.", caption, paper, log=log
        )
    bars = [
        Bar(name, next(iter(ours.get(name, {}).values()), None),
            next(iter(paper.get(name, {}).values()), None))
        for name in dict.fromkeys([*ours, *paper])
    ]  # fmt: skip
    return bar_chart(bars, label, f"{title}. {said}.", caption)


def _values(table: Mapping[str, Any], scoring: str, figure: str) -> dict[str, dict[float, float]]:
    """Method -> {views: mean}."""
    found: dict[str, dict[float, float]] = {}
    for entry in table["figures"]:
        if (entry["scoring"], entry["figure"]) == (scoring, figure):
            values = found.setdefault(entry["method"], {})
            if entry["mean"] is not None:
                values[entry["views"]] = float(entry["mean"])
    return found


def _partial(
    table: Mapping[str, Any], scoring: str, figure: str, titles: Mapping[str, str]
) -> str:  # fmt: skip
    """Which entries of a chart are means without the scenes that failed; mostly none."""
    found = [
        f"{titles.get(entry['method'], entry['method'])} at {entry['views']} views"
        for entry in table["figures"]
        if (entry["scoring"], entry["figure"]) == (scoring, figure)
        and entry["failed"] and entry["mean"] is not None
    ]  # fmt: skip
    return f" Without the scenes that failed: {', '.join(found)}." if found else ""


def _paper_values(
    table: Mapping[str, Any], papers: Mapping[str, str | None], scoring: str,
    views: Sequence[int], figure: str,
) -> dict[str, dict[float, float]]:  # fmt: skip
    """The same of the paper, where it scored so: training views for photos, else unseen views."""
    if (scoring == "input") != (table["form"] == "photos"):
        return {}
    found: dict[str, dict[float, float]] = {}
    shown: set[str | None] = set()
    for method in dict.fromkeys(entry["method"] for entry in table["figures"]):
        if papers.get(method) in shown and len(views) > 1:
            continue  # variants of one method share its curve
        shown.add(papers.get(method))
        for count in views:
            quoted = paper_figures(table["form"], papers.get(method), count)
            value = None if isinstance(quoted, str | None) else getattr(quoted, figure)
            if value is not None:
                found.setdefault(method, {})[count] = float(value)
    return found


def _titled(
    values: Mapping[str, Mapping[float, float]], titles: Mapping[str, str]
) -> dict[str, Mapping[float, float]]:
    return {titles.get(name, name): those for name, those in values.items() if those}


# -- pictures --------------------------------------------------------------------------------------


def groups(results: Results) -> list[list[Record]]:
    """The cells on the same photographs (of the first seed), most views first."""
    found: dict[tuple[Any, ...], list[Record]] = {}
    for record in results["cells"]:
        if record["status"] == "done":
            key = (record["scene"], record["protocol"], record["known_cameras"], -record["views"])
            group = found.setdefault(key, [])
            if not group or group[0]["seed"] == record["seed"]:
                group.append(record)
    return [found[key] for key in sorted(found)]


def picture_row(
    group: Sequence[Record], out: Path, titles: Mapping[str, str]
) -> dict[str, Any] | None:
    """One view, as photographed and as each method renders it.

    Held-out views come before training views; of the views that all methods have, the middle one.
    """
    for kind in ("heldout_comparison", "comparison"):
        found = {
            record["method"]: {path.stem: path for path in folder.glob(f"{kind}_*.png")}
            for record in group
            if record.get("metrics")
            for folder in [(out / record["metrics"]).parent]
        }
        found = {method: paths for method, paths in found.items() if paths}
        if not found:
            continue
        shared = sorted(set.intersection(*(set(paths) for paths in found.values())))
        if not shared:
            continue
        stem = shared[len(shared) // 2]
        return _row(group, {method: paths[stem] for method, paths in found.items()}, kind, titles)
    return None


def _row(
    group: Sequence[Record], paths: Mapping[str, Path], kind: str, titles: Mapping[str, str]
) -> dict[str, Any]:
    first = group[0]
    view = next(iter(paths.values())).stem.removeprefix(f"{kind}_")
    tiles: list[Picture] = []
    for method, path in paths.items():
        image = read_png(path)
        parts = thirds(image)
        title = titles.get(method, method)
        psnr = _psnr(path.parent, view, kind)
        caption = f"{title}{f' · {number(psnr)} dB' if psnr is not None else ''}"
        if parts is None:
            tiles.append(picture(image, f"{view} by {title}.", caption, 3 * THUMBNAIL))
            continue
        if not tiles:
            alt = f"Photograph {view} of {first['scene']}."
            tiles.append(picture(parts[0], alt, "photograph", THUMBNAIL))
        tiles.append(picture(parts[1], f"{view}, rendered by {title}.", caption, THUMBNAIL))
    cameras = ", true cameras" if first["known_cameras"] else ""
    what = "a training view" if kind == "comparison" else "a photograph held out"
    return {
        "title": f"{first['scene']}, {first['views']} views{cameras}", "what": what,
        "tiles": tiles,
    }  # fmt: skip


def _psnr(folder: Path, view: str, kind: str) -> float | None:
    metrics = Metrics.load(folder)
    scores = metrics.input
    if kind != "comparison":  # the pictures are of one of the protocols of test poses
        scores = metrics.held_out.get(metrics.pictured or "", Scores())
    psnr = scores.views.get(view, {}).get("psnr")
    return float(psnr) if psnr is not None else None
