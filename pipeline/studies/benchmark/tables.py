"""The cells of a suite as tables in the paper's form, with the paper's figures beside them."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from pipeline.studies.benchmark.paper import DATA, PaperFigures, paper_figures
from pipeline.studies.benchmark.statistics import Summary, compare, figures_of, summarise
from pipeline.studies.benchmark.suite import Method, Suite, TableSpec

Record = Mapping[str, Any]
Grid = dict[str, Any]

SCORINGS = {
    "registered": "unseen views, test poses registered by a similarity from the true cameras",
    "refined": "unseen views, test poses registered and then refined with the scene frozen",
    "input": "training views: the figures say nothing about unseen ones",
}
HEADINGS = {"psnr": "PSNR", "ssim": "SSIM", "lpips": "LPIPS"}
NO_WEIGHTS = "LPIPS is '-' where its weights were not there (evaluate.lpips_weights)."
SECONDS = (
    "Seconds: wall time of the stages from the photographs to the scene, each as it was measured "
    "when it was computed, also where this run took it from the store; loading and scoring are not "
    "in it."
)


@dataclass
class Rows:
    """The cells of one table: method -> number of views -> cells over scenes and seeds."""

    spec: TableSpec
    methods: list[Method]
    views: list[int]
    cells: dict[str, dict[int, list[Record]]]
    records: Sequence[Record] = field(default_factory=list)

    def at(self, method: Method, views: int) -> list[Record]:
        return self.cells[method.name].get(views, [])

    def ours(self) -> Method:
        name = self.spec.ours or self.methods[0].name
        return next(method for method in self.methods if method.name == name)

    def scorings(self) -> list[str]:
        """What was measured, the two protocols of test poses apart."""
        found = [
            name
            for name in SCORINGS
            if any(name in r["figures"] for r in self.records if r["status"] == "done")
        ]
        return found or ["input"]


def paper_note(suite: Suite) -> str:
    """The plain sentence about the data; of figures of the paper where a method has some."""
    scenes = ", ".join(scene.name for scene in suite.scenes)
    if not any(method.paper for method in suite.methods):
        return f"Measured on {scenes}."
    sources = dict.fromkeys(DATA[table.form] for table in suite.tables)
    return (
        f"Ours are measured on {scenes}; the paper's figures beside them come from "
        f"{' and '.join(sources)}, which are not public, and an RTX 4090. The data differ, so "
        "that only the order and the distances of methods can be compared with the paper's, not "
        "the figures themselves."
    )


def build_table(suite: Suite, spec: TableSpec, records: Sequence[Record]) -> dict[str, Any]:
    """One table of the suite, as `results` documents it.

    Args:
        records: the cells of this table.
    """
    methods = [suite.method(name) for name in spec.methods or [m.name for m in suite.methods]]
    views = sorted({record["views"] for record in records})
    cells: dict[str, dict[int, list[Record]]] = {method.name: {} for method in methods}
    for record in records:
        cells[record["method"]].setdefault(record["views"], []).append(record)
    rows = Rows(spec, methods, views, cells, records)
    unseen = [scoring for scoring in rows.scorings() if scoring != "input"]
    judged = unseen or ["input"]
    grids = [grid for scoring in rows.scorings() for grid in _quality_grids(rows, scoring)]
    grids += [grid for grid in (_cost_grid(rows), _truth_grid(rows)) if grid is not None]
    told = [f"{title_of(m)}: {m.note.rstrip('.')}." for m in methods if m.note]
    grids[0]["footnotes"] = [*told, *grids[0]["footnotes"]]
    return {
        "name": spec.name,
        "title": spec.title or spec.name,
        "note": spec.note,
        "form": spec.form,
        "protocol": spec.split,
        "known_cameras": spec.known_cameras,
        "grids": grids,
        "conclusions": [s for scoring in judged for s in _conclusions(rows, scoring)],
        "figures": _long_form(rows),
    }


def title_of(method: Method) -> str:
    return method.title or method.name


# -- grids -----------------------------------------------------------------------------------------


def _quality_grids(rows: Rows, scoring: str) -> list[Grid]:
    if rows.spec.form == "views":
        grids = [_views_grid(rows, scoring, "", HEADINGS)]
    else:
        grids = [_list_grid(rows, scoring, views) for views in rows.views]
    if "psnr_mask" in figures_of(rows.records, scoring):
        masked = {"psnr_mask": "PSNR", "ssim_mask": "SSIM"}
        grids.append(_views_grid(rows, scoring, "inside the masks (teeth); ", masked))
    return grids


def _views_grid(rows: Rows, scoring: str, what: str, headings: Mapping[str, str]) -> Grid:
    """Table 1: a row per method, the figures of each number of views side by side."""
    with_paper = headings is HEADINGS and _comparable(rows, scoring)
    columns = ["Method"]
    for views in rows.views:
        columns += [f"{heading}, {views} views" for heading in headings.values()]
    body = []
    for method in rows.methods:
        line = [title_of(method)]
        for views in rows.views:
            cells = rows.at(method, views)
            line += [_shown(summarise(cells, scoring, name), name, cells) for name in headings]
        body.append(line)
        said = [paper_figures(rows.spec.form, method.paper, views) for views in rows.views]
        if with_paper and any(entry != "absent" for entry in said):
            quoted = [_quoted(entry, name) for entry in said for name in headings]
            body.append(["— in the paper", *quoted])
    return _grid(rows, f"{what}{SCORINGS[scoring]}", columns, body, scoring)


def _list_grid(rows: Rows, scoring: str, views: int) -> Grid:
    """Tables 2 and 3: a row per method, its figures, seconds, and the paper's beside them."""
    columns = ["Method", *HEADINGS.values(), "Seconds"]
    said = {m.name: paper_figures(rows.spec.form, m.paper, views) for m in rows.methods}
    with_paper = _comparable(rows, scoring) and any(e != "absent" for e in said.values())
    if with_paper:
        columns += [f"paper: {heading}" for heading in (*HEADINGS.values(), "Seconds")]
    body = []
    for method in rows.methods:
        cells = rows.at(method, views)
        line = [title_of(method)]
        line += [_shown(summarise(cells, scoring, name), name, cells) for name in HEADINGS]
        line.append(_shown(summarise(cells, "cost", "seconds"), "seconds", cells))
        if with_paper:
            line += [_quoted(said[method.name], name) for name in (*HEADINGS, "seconds")]
        body.append(line)
    grid = _grid(rows, f"{views} views; {SCORINGS[scoring]}", columns, body, scoring)
    grid["footnotes"].append(SECONDS)
    return grid


def _comparable(rows: Rows, scoring: str) -> bool:
    """Did the paper score so? Its tables 1 and 3 are on unseen views, table 2 on training views."""
    return (scoring == "input") == (rows.spec.form == "photos")


COSTS = {
    "seconds": "seconds",
    "cpu_seconds": "CPU seconds",
    "peak_memory_mb": "MB",
    "gaussians": "Gaussians",
}


def _cost_grid(rows: Rows) -> Grid:
    """Seconds, memory and placed views, per method and number of views."""
    columns = ["Method", "Views", "placed", *COSTS.values()]
    body = []
    for method in rows.methods:
        for views in rows.views:
            cells = rows.at(method, views)
            line = [title_of(method), str(views), _placed(cells)]
            line += [_shown(summarise(cells, "cost", name), name, cells) for name in COSTS]
            body.append(line)
    grid = _grid(rows, "cost, and input views that got a camera", columns, body, "cost")
    grid["footnotes"] += [SECONDS, "MB: the stage that needed most.", *_thread_notes(rows.records)]
    return grid


TRUTH = {
    ("poses", "rotation_deg/median"): "rotation error, degrees",
    ("poses", "translation_percent/median"): "position error, % of the largest distance",
    ("poses", "auc_5"): "AUC at 5°",
    ("poses", "focal_error_percent"): "focal length error, %",
    ("geometry", "accuracy_mm/median"): "accuracy, mm",
    ("geometry", "accuracy/median"): "accuracy, % of the mesh's diagonal",
    ("geometry", "completeness_mm/median"): "completeness, mm",
    ("geometry", "completeness/median"): "completeness, % of the mesh's diagonal",
    ("geometry", "fscore/0.5"): "F-score at 0.5",
    ("geometry", "fscore/1.0"): "F-score at 1.0",
}


def _truth_grid(rows: Rows) -> Grid | None:
    """Cameras and surface against the truth, where there is one."""
    there = {(s, name) for s in ("poses", "geometry") for name in figures_of(rows.records, s)}
    shown = {key: heading for key, heading in TRUTH.items() if key in there}
    if not shown:
        return None
    body = []
    for method in rows.methods:
        for views in rows.views:
            cells = rows.at(method, views)
            line = [title_of(method), str(views)]
            line += [_shown(summarise(cells, *key), key[1], cells) for key in shown]
            body.append(line)
    columns = ["Method", "Views", *shown.values()]
    grid = _grid(rows, "against the truth; medians over views or points", columns, body, "truth")
    told = [r[s].get("alignment") for r in rows.records for s in ("poses", "geometry") if s in r]
    grid["footnotes"] += [f"Alignment: {text}." for text in dict.fromkeys(filter(None, told))]
    return grid


def _grid(
    rows: Rows, caption: str, columns: list[str], body: list[list[str]], scoring: str
) -> Grid:
    spec = rows.spec
    notes = []
    counts = {len(rows.at(method, views)) for method in rows.methods for views in rows.views}
    if max(counts, default=0) > 1:
        notes.append(
            "Mean ± sample standard deviation over scenes and seeds (n: how many); each counts the "
            "same."
        )
    if any(entry == "failed" or "failed)" in entry for line in body for entry in line):
        notes.append("failed: the method could not reconstruct these photographs.")
    if scoring in SCORINGS:
        notes += _partly_placed(rows)
    if any("LPIPS" in name for name in columns) and _nowhere(rows, scoring, "lpips"):
        notes.append(NO_WEIGHTS)
    cameras = "; all methods have the true cameras of the input" if spec.known_cameras else ""
    return {
        "title": spec.title or spec.name,
        "caption": f"{caption}{cameras}",
        "columns": columns,
        "rows": body,
        "footnotes": notes,
    }


def _nowhere(rows: Rows, scoring: str, figure: str) -> bool:
    return summarise(rows.records, scoring, figure).n == 0


def _partly_placed(rows: Rows) -> list[str]:
    """Name the methods that left input views out: their scenes rest on fewer views."""
    found = []
    for method in rows.methods:
        for views in rows.views:
            done = [cell for cell in rows.at(method, views) if cell["status"] == "done"]
            if any(cell["registered"] < cell["total"] for cell in done):
                found.append(f"{title_of(method)} at {views} views placed {_placed(done)}")
    return [f"Input views that got no camera are not used: {'; '.join(found)}."] if found else []


def _thread_notes(records: Sequence[Record]) -> list[str]:
    threads = {stage["threads"] for record in records for stage in record["stages"]}
    if len(threads) < 2:
        return [f"{n} thread{'s' if n > 1 else ''}." for n in threads]
    said = ", ".join(str(number) for number in sorted(threads))
    return [f"Stages ran with different numbers of threads ({said}): seconds are not comparable."]


# -- entries ---------------------------------------------------------------------------------------

FORMATS: dict[str, Callable[[float], str]] = {
    "psnr": "{:.2f}".format,
    "psnr_mask": "{:.2f}".format,
    "seconds": "{:.0f}".format,
    "cpu_seconds": "{:.0f}".format,
    "peak_memory_mb": "{:.0f}".format,
    "gaussians": "{:,.0f}".format,
    "rotation_deg/median": "{:.2f}".format,
    "translation_percent/median": "{:.2f}".format,
    "focal_error_percent": "{:.1f}".format,
}


def _shown(summary: Summary, figure: str, cells: Sequence[Record]) -> str:
    """One entry: ``27.31``, ``27.31 ± 0.42 (n=4)``, ``27.31 (1 of 2 failed)``, ``failed`` or ``-``.

    Args:
        cells: what the figure is the mean of.
    """
    if cells and summary.failed == len(cells):
        return _worst_status(cells)
    if summary.mean is None:
        return "-"
    text = (FORMATS.get(figure) or "{:.3f}".format)(summary.mean)
    if summary.std is not None:
        text += f" ± {(FORMATS.get(figure) or '{:.3f}'.format)(summary.std)} (n={summary.n})"
    if summary.failed:
        text += f" ({summary.failed} of {len(cells)} {_worst_status(cells)})"
    return text


def _worst_status(cells: Sequence[Record]) -> str:
    """``failed`` is a result; ``fault`` is ours, ``refused`` the suite's."""
    found = {cell["status"] for cell in cells}
    return next(status for status in ("fault", "refused", "failed") if status in found)


def _quoted(entry: PaperFigures | str | None, figure: str) -> str:
    if isinstance(entry, str):
        return ""
    if entry is None:
        return "failed"
    value = getattr(entry, figure)
    return "" if value is None else (FORMATS.get(figure) or "{:.3f}".format)(value)


def _placed(cells: Sequence[Record]) -> str:
    """Registered and total views; summed over scenes and seeds."""
    done = [cell for cell in cells if cell["status"] == "done"]
    if not done:
        return _worst_status(cells) if cells else "-"
    return f"{sum(c['registered'] for c in done)} of {sum(c['total'] for c in done)}"


# -- conclusions -----------------------------------------------------------------------------------


def _conclusions(rows: Rows, scoring: str) -> list[str]:
    """Say where the method under test wins, and name each entry where it does not."""
    ours = rows.ours()
    rivals = [method for method in rows.methods if method is not ours]
    where = SCORINGS[scoring].partition(":")[0]
    lost, compared, alone, failed = [], 0, [], []
    for views in rows.views:
        cells = rows.at(ours, views)
        if all(cell["status"] != "done" for cell in cells):
            failed.append(f"{views} views")
            continue
        found = compare(cells, {title_of(m): rows.at(m, views) for m in rivals}, scoring)
        compared += len(found)
        if rivals and not found:
            alone.append(f"{views} views")
        for entry in (entry for entry in found if not entry.won):
            show = FORMATS.get(entry.figure) or "{:.3f}".format
            lost.append(
                f"{HEADINGS[entry.figure]} at {views} views against {entry.rival} "
                f"({show(entry.ours)} : {show(entry.theirs)})"
            )
    name = title_of(ours)
    said = [f"{where}: {name} has no result at {', '.join(failed)}."] if failed else []
    if alone:
        said.append(f"{where}: no other method gave a result at {', '.join(alone)}.")
    if compared and not lost:
        said.append(f"{where}: {name} is better in each of the {compared} comparisons.")
    elif compared:
        won = compared - len(lost)
        said.append(
            f"{where}: {name} is better in {won} of {compared} comparisons; it does not win on "
            f"{'; '.join(lost)}."
        )
    return [text[0].upper() + text[1:] for text in said]


# -- the numbers -----------------------------------------------------------------------------------


def _long_form(rows: Rows) -> list[dict[str, Any]]:
    """Every figure of the table, one entry each, for CSV and for whoever draws curves."""
    wanted = [(s, name) for s in SCORINGS for name in figures_of(rows.records, s)]
    wanted += [("cost", name) for name in (*COSTS, "scoring_seconds", "registered", "total")]
    wanted += [(s, name) for s in ("poses", "geometry") for name in figures_of(rows.records, s)]
    found = []
    for method in rows.methods:
        for views in rows.views:
            for scoring, figure in wanted:
                summary = summarise(rows.at(method, views), scoring, figure)
                entry = {"method": method.name, "views": views, "scoring": scoring}
                found.append({**entry, "figure": figure, **vars(summary)})
    return found
