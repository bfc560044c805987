"""The report of a benchmark, from results with known figures."""

from __future__ import annotations

import html
import json
import re
from pathlib import Path
from typing import Any

import pytest

from pipeline.artifacts.views import write_png
from pipeline.studies.benchmark.report import benchmark_report, charts, grid_table, groups
from pipeline.studies.benchmark.suite import Suite
from pipeline.studies.benchmark.tables import build_table, paper_note
from stages.evaluate.images.pictures import comparison
from tests.browser import needs_chromium, run_in
from tests.studies import report_case as case
from tests.studies.report_page import assert_alone, look, text_of

SUITE = {
    "title": "Ours <b>&",
    "scenes": [{"name": "a", "images": "a"}],
    "methods": [
        {"name": "ours", "paper": "ours", "title": "Ours"},
        {"name": "rival", "paper": "instantsplat", "title": "<i>Rival</i>"},
    ],
    "tables": [{"name": "t", "form": "views", "title": "The table"}],
}


def cell(method: str, views: int, psnr: float | None) -> dict[str, Any]:
    about = {
        "id": f"a-{method}-{views}", "scene": "a", "method": method, "preset": method,
        "protocol": "video24", "views": views, "seed": 0, "known_cameras": False,
        "workspace": f"a/{views}_views", "keys": {"fit": "f" * 64}, "stages": [],
    }  # fmt: skip
    if psnr is None:
        return {**about, "status": "failed", "reason": "Photos <x> and y share too little."}
    scores = {"psnr": psnr, "ssim": psnr / 100, "lpips": None}
    return {
        **about, "status": "done", "seconds": 10.0 * views, "cpu_seconds": 20.0,
        "scoring_seconds": 1.0, "peak_memory_mb": 500.0, "gaussians": 1000, "registered": views,
        "total": views, "metrics": f"a/{views}_views/{method}/metrics.json",
        "figures": {
            "input": {**scores, "psnr": psnr + 5}, "registered": scores,
            "refined": {**scores, "psnr": psnr + 1},
        },
        "stages": [{"name": "fit", "threads": 2, "wall_seconds": 5.0}],
    }  # fmt: skip


def results(cells: list[dict[str, Any]], form: str = "views") -> dict[str, Any]:
    suite = Suite.model_validate({**SUITE, "tables": [{**SUITE["tables"][0], "form": form}]})  # type: ignore[index,dict-item]
    return {
        "format": 1, "title": suite.title, "note": paper_note(suite),
        "suite": json.loads(suite.model_dump_json()), "versions": {"python": "3.11"},
        "machine": {"processor": "P", "cores": 2, "jobs": 1, "threads": 2}, "cells": cells,
        "tables": [build_table(suite, suite.tables[0], cells)], "problems": [],
    }  # fmt: skip


def write_pictures(out: Path, record: dict[str, Any]) -> None:
    folder = (out / record["metrics"]).parent
    folder.mkdir(parents=True)
    block = case.scored(["h000", "h001"], record["figures"]["registered"]["psnr"])
    metrics = {"held_out": {"registered": block, "pictures": "registered"}}
    (folder / "metrics.json").write_text(json.dumps(metrics))
    for name in ("comparison_000", "heldout_comparison_h000", "heldout_comparison_h001"):
        write_png(folder / f"{name}.png", comparison(case.picture(1), case.picture(2), 0.25))


def cells_of_two_methods() -> list[dict[str, Any]]:
    return [
        cell("ours", 3, 25.0), cell("rival", 3, 24.0), cell("ours", 6, 28.0), cell("rival", 6, None)
    ]  # fmt: skip


def test_tables_failures_pictures(tmp_path: Path) -> None:
    found = results(cells_of_two_methods())
    for record in found["cells"]:
        if record["status"] == "done":
            write_pictures(tmp_path, record)
    file = benchmark_report(found, tmp_path)
    assert file == tmp_path / "report.html"
    page = file.read_text()
    assert_alone(page)
    assert "<i>Rival" not in page and "Ours <b>&" not in page and "<x>" not in page
    text = text_of(page)
    for said in (
        "3 of 4 cells done", "The data differ", "Photos <x> and y share too little.", "25.00",
        "23.96", "a, 6 views, <i>Rival</i>", "a, 3 views a photograph held out", "26.00 dB",
    ):  # fmt: skip
        assert said in text, said
    assert "could not be" not in text.replace("could not be placed", "")
    rows = [
        re.sub(r"<.*?>", "", row) for row in re.findall(r"<figcaption>(.*?)</figcaption>", page)
    ]
    shown = [html.unescape(row) for row in rows if "dB" in row and ":" not in row]
    assert shown == ["Ours · 29.00 dB", "Ours · 26.00 dB", "<i>Rival</i> · 25.00 dB"]
    assert len(re.findall(r"<img src=\"data:image/jpeg", page)) == 5


def test_the_best_of_a_column_is_marked_and_the_papers_figures_are_not() -> None:
    grid = {
        "title": "T", "caption": "unseen views", "footnotes": ["one", "one"],
        "columns": ["Method", "PSNR, 3 views", "LPIPS, 3 views", "placed"],
        "rows": [
            ["Ours", "25.00 ± 0.10 (n=2)", "0.300", "3 of 3"],
            ["— in the paper", "30.00", "0.1", ""],
            ["Rival", "24.00", "0.200", "3 of 3"], ["Other", "failed", "-", "failed"],
        ],
    }  # fmt: skip
    made = grid_table(grid)
    best = [[entry.best for entry in row] for row in made["table"].rows]
    assert best == [
        [False, True, False, False], [False] * 4, [False, False, True, False], [False] * 4
    ]  # fmt: skip
    assert made["footnotes"] == ["one"]
    costs = {**grid, "columns": ["Method", "Views", "seconds", "MB"]}
    assert not any(entry.best for row in grid_table(costs)["table"].rows for entry in row)


def test_the_mean_of_the_scenes_that_did_not_fail_is_not_the_best() -> None:
    """It was marked, though of the scene that both could do the other's is better."""
    rows = [["Ours", "27.00 ± 4.24 (n=2)"], ["Rival", "29.00 (1 of 2 failed)"], ["Other", "26.00"]]
    grid = {"title": "T", "caption": "c", "columns": ["Method", "PSNR, 3 views"], "rows": rows}
    assert [row[1].best for row in grid_table(grid)["table"].rows] == [True, False, False]
    harder = [{**cell(m, 3, psnr), "scene": "b"} for m, psnr in (("ours", 20.0), ("rival", None))]
    found = results([cell("ours", 3, 25.0), cell("rival", 3, 24.0), *harder])
    for chart in charts(found, found["tables"][0], {"ours": "Ours", "rival": "Rival"}):
        assert "Without the scenes that failed: Rival at 3 views." in chart.caption


def test_charts_have_the_papers_figures_where_it_scored_so() -> None:
    titles = {"ours": "Ours", "rival": "Rival"}
    found = results(cells_of_two_methods())
    drawn = list(charts(found, found["tables"][0], titles))
    assert [chart.caption.partition(".")[0] for chart in drawn] == [
        "PSNR of unseen views, registered cameras", "PSNR of unseen views, refined cameras",
        "PSNR of training views", "Seconds from the photographs to the scene",
    ]  # fmt: skip
    assert ["paper" in chart.caption for chart in drawn] == [True, True, False, False]
    assert "Ours: 25.00 at 3 views, 28.00 at 6 views; Rival: 24.00 at 3 views" in drawn[0].alt
    found = results([cell("ours", 3, 25.0), cell("rival", 3, 24.0)], "photos")
    drawn = list(charts(found, found["tables"][0], titles))
    quoted = {chart.caption.partition(".")[0]: "paper" in chart.caption for chart in drawn}
    assert quoted["PSNR of training views"] is True
    assert quoted["Seconds from the photographs to the scene"] is True
    assert quoted["PSNR of unseen views, registered cameras"] is False


def test_pictures_come_by_scene_most_views_first_and_of_one_seed() -> None:
    other = {**cell("ours", 3, 20.0), "seed": 1}
    found = groups(results([*cells_of_two_methods(), other]))
    assert [[(r["method"], r["views"], r["seed"]) for r in group] for group in found] == [
        [("ours", 6, 0)], [("ours", 3, 0), ("rival", 3, 0)],
    ]  # fmt: skip


def test_without_workspaces_and_without_anything_done(tmp_path: Path) -> None:
    page = benchmark_report(results([cell("ours", 3, None)]), tmp_path).read_text()
    text = text_of(page)
    assert "0 of 1 cells done" in text
    assert "What failed, and why" in text
    assert "could not be drawn" not in text


@needs_chromium
def test_a_browser_draws_it(tmp_path: Path) -> None:
    found = results(cells_of_two_methods())
    for record in found["cells"]:
        if record["status"] == "done":
            write_pictures(tmp_path, record)
    seen = look(benchmark_report(found, tmp_path), tmp_path)
    assert seen["wide"]["images"] == 5
    assert len(seen["phone"]["charts"]) == 4


LONG_NAMES = """
  const table = document.querySelector(".scroll");
  const [name, figure] = table.querySelector("tbody tr").cells;
  const box = name.getBoundingClientRect();
  const outside = [...document.querySelectorAll("svg.chart")].flatMap((chart) => {
    const { left, right, top, bottom } = chart.getBoundingClientRect();
    return [...chart.querySelectorAll("text")].filter((text) => {
      const at = text.getBoundingClientRect();
      return at.left < left - 1 || at.right > right + 1 || at.top < top || at.bottom > bottom + 1;
    }).map((text) => text.textContent);
  });
  table.scrollLeft = figure.offsetLeft - box.width;
  tell({ share: box.width / innerWidth, shown: name.scrollWidth <= name.clientWidth,
    figure: figure.getBoundingClientRect().left >= name.getBoundingClientRect().right - 1,
    width: innerWidth, charts: document.querySelectorAll("svg.chart text").length, outside });
"""


@needs_chromium
@pytest.mark.parametrize("width", [1280, 390])
@pytest.mark.parametrize("name", ["20240513_frontal_retracted_view_of_may_IMG_1234", "n" * 160])
def test_long_names_leave_the_figures_in_sight(tmp_path: Path, name: str, width: int) -> None:
    found = results(cells_of_two_methods())
    for method in found["suite"]["methods"]:
        method["title"] = f"{method['title']} {name}"
    suite = Suite.model_validate(found["suite"])
    found["tables"] = [build_table(suite, suite.tables[0], found["cells"])]
    page = benchmark_report(found, tmp_path).read_text()
    told, log = run_in(page, LONG_NAMES, tmp_path, (width, 900))
    assert (log, told["width"]) == ([], width)
    assert told["share"] <= 0.51 and told["shown"] and told["figure"]
    assert told["charts"] > 20 and told["outside"] == []
