"""The tables of a benchmark, from records with known figures."""

from __future__ import annotations

from typing import Any

import pytest

from pipeline.studies.benchmark.paper import ABLATIONS, PHOTOS, VIEWS, paper_figures
from pipeline.studies.benchmark.statistics import compare, figure_of, summarise
from pipeline.studies.benchmark.suite import Method, Suite
from pipeline.studies.benchmark.tables import build_table, paper_note
from pipeline.studies.benchmark.writing import csv_text, grid_markdown, markdown


def record(method: str, views: int = 3, scene: str = "a", **more: Any) -> dict[str, Any]:
    """A finished cell whose PSNR on unseen views is `psnr`."""
    psnr = more.pop("psnr", 25.0)
    figures = {
        "input": {"psnr": psnr + 10, "ssim": 0.9, "lpips": None, "psnr_mask": psnr + 12},
        "registered": {"psnr": psnr, "ssim": psnr / 100, "lpips": None},
        "refined": {"psnr": psnr + 1, "ssim": psnr / 100, "lpips": None},
    }
    stage = {"name": "fit", "threads": 2, "wall_seconds": 5.0}
    return {
        "id": f"{scene}-{method}-{views}", "scene": scene, "method": method, "views": views,
        "seed": 0, "status": "done", "figures": figures, "seconds": 7.4, "cpu_seconds": 12.0,
        "scoring_seconds": 1.0, "peak_memory_mb": 800.0, "gaussians": 12345, "stages": [stage],
        "registered": views, "total": views,
        "poses": {"rotation_deg": {"median": 0.25, "max": 1.0}, "alignment": "a similarity"},
        **more,
    }  # fmt: skip


def failed(method: str, views: int = 3, scene: str = "a", status: str = "failed") -> dict[str, Any]:
    return {
        "id": f"{scene}-{method}-{views}", "scene": scene, "method": method, "views": views,
        "seed": 0, "status": status, "reason": "Too few matches.", "stages": [], "keys": {},
    }  # fmt: skip


def suite(form: str = "views", **table: Any) -> Suite:
    return Suite.model_validate(
        {
            "title": "Test",
            "scenes": [{"name": "a", "images": "a"}, {"name": "b", "images": "b"}],
            "methods": [
                {"name": "ours", "paper": "ours", "title": "Ours"},
                {"name": "rival", "paper": "instantsplat", "note": "has our points"},
            ],
            "tables": [{"name": "t", "form": form, "title": "The table", **table}],
        }
    )


def built(records: list[dict[str, Any]], form: str = "views", **table: Any) -> dict[str, Any]:
    read = suite(form, **table)
    return build_table(read, read.tables[0], records)


def grid(table: dict[str, Any], text: str) -> dict[str, Any]:
    return next(g for g in table["grids"] if text in g["caption"])


def test_mean_and_spread() -> None:
    records = [record("ours", psnr=20.0), record("ours", psnr=23.0, scene="b"), failed("ours")]
    found = summarise(records, "registered", "psnr")
    assert (found.mean, found.n, found.failed) == (21.5, 2, 1)
    assert found.std == pytest.approx(1.5 * 2**0.5)
    assert summarise(records[:1], "registered", "psnr").std is None
    assert summarise(records, "registered", "lpips").mean is None
    assert figure_of(records[0], "poses", "rotation_deg/median") == 0.25
    assert figure_of(records[0], "cost", "seconds") == 7.4
    assert figure_of(records[2], "cost", "seconds") is None


def test_only_what_both_could_do_is_compared() -> None:
    ours = [record("ours", psnr=20.0), record("ours", psnr=30.0, scene="b")]
    rival = [record("rival", psnr=25.0), failed("rival", scene="b")]
    found = {c.figure: c for c in compare(ours, {"rival": rival}, "registered")}
    assert (found["psnr"].ours, found["psnr"].theirs, found["psnr"].won) == (20, 25, False)
    assert "lpips" not in found  # nobody measured it


def test_table_1_has_the_papers_figures_beside_ours() -> None:
    table = built([record("ours"), record("ours", 6), record("rival"), failed("rival", 6)])
    registered = grid(table, "registered by a similarity")
    assert registered["columns"][:5] == [
        "Method", "PSNR, 3 views", "SSIM, 3 views", "LPIPS, 3 views", "PSNR, 6 views"
    ]  # fmt: skip
    assert registered["rows"] == [
        ["Ours", "25.00", "0.250", "-", "25.00", "0.250", "-"],
        ["— in the paper", "23.96", "0.822", "0.301", "28.41", "0.872", "0.247"],
        ["rival", "25.00", "0.250", "-", "failed", "failed", "failed"],
        ["— in the paper", "23.81", "0.826", "0.304", "27.01", "0.863", "0.268"],
    ]
    assert any("LPIPS is '-'" in note for note in registered["footnotes"])
    assert "rival: has our points." in registered["footnotes"]
    refined = grid(table, "then refined")
    assert refined["rows"][0][1] == "26.00"
    training = grid(table, "training views")
    assert [line[0] for line in training["rows"]] == ["Ours", "rival"]
    masked = grid(table, "inside the masks")
    assert masked["rows"][0][1] == "37.00"
    assert not any("LPIPS" in note for note in masked["footnotes"])
    cost = grid(table, "cost")
    assert cost["rows"][0] == ["Ours", "3", "3 of 3", "7", "12", "800", "12,345"]
    truth = grid(table, "against the truth")
    assert truth["columns"] == ["Method", "Views", "rotation error, degrees"]
    assert "Alignment: a similarity." in truth["footnotes"]


def test_surfaces_have_their_unit() -> None:
    median = {"median": 0.5}
    shares = record("ours", geometry={"accuracy": median, "completeness": median})
    assert grid(built([shares]), "against the truth")["columns"][-2:] == [
        "accuracy, % of the mesh's diagonal", "completeness, % of the mesh's diagonal",
    ]  # fmt: skip
    lengths = record("ours", geometry={"accuracy_mm": median})
    assert grid(built([lengths]), "against the truth")["columns"][-1] == "accuracy, mm"


def test_tables_2_and_3_have_seconds() -> None:
    (quality, *_) = built([record("ours"), record("rival")], "photos")["grids"]
    assert "unseen views" in quality["caption"]  # nothing of the paper's beside these
    assert quality["columns"] == ["Method", "PSNR", "SSIM", "LPIPS", "Seconds"]
    training = grid(built([record("ours"), record("rival")], "photos"), "training views")
    assert training["rows"][1][:5] == ["rival", "35.00", "0.900", "-", "7"]
    assert training["rows"][1][5:] == ["32.78", "0.945", "0.160", "57"]
    ablations = built([record("ours", 6), record("rival", 6)], "ablations")["grids"][0]
    assert ablations["rows"][0][5:] == ["28.41", "0.872", "0.247", "72"]
    assert ablations["rows"][1][5:] == ["", "", "", ""]


def test_spread_and_failures_are_shown() -> None:
    table = built(
        [
            record("ours", psnr=20.0),
            record("ours", psnr=23.0, scene="b"),
            record("rival"),
            failed("rival", scene="b"),
        ]
    )
    rows = grid(table, "registered by a similarity")["rows"]
    assert rows[0][1] == "21.50 ± 2.12 (n=2)"
    assert rows[2][1] == "25.00 (1 of 2 failed)"
    broken = built([record("ours"), failed("rival", status="fault")])
    assert grid(broken, "registered by")["rows"][2][1] == "fault"


def test_where_we_do_not_win_is_said() -> None:
    table = built([record("ours", psnr=20), record("rival", psnr=24)])
    registered, refined = table["conclusions"]
    assert registered.startswith("Unseen views, test poses registered")
    assert "better in 0 of 2 comparisons" in registered
    assert "PSNR at 3 views against rival (20.00 : 24.00)" in registered
    assert "PSNR at 3 views against rival (21.00 : 25.00)" in refined
    won = built([record("ours", psnr=24.5), record("rival", psnr=24)])["conclusions"]
    assert "better in each of the 2 comparisons" in won[0]
    lost = built([failed("ours"), record("rival")])["conclusions"]
    assert lost[0].endswith("Ours has no result at 3 views.")
    alone = built([record("ours"), failed("rival")])["conclusions"]
    assert "no other method gave a result at 3 views" in alone[0]
    other = built([record("ours", psnr=20), record("rival", psnr=24)], ours="rival")
    assert "rival is better in each" in other["conclusions"][0]


def test_a_tie_is_no_win() -> None:
    (said, _) = built([record("ours"), record("rival")])["conclusions"]
    assert "better in 0 of 2" in said


def test_views_that_were_not_placed_are_said() -> None:
    table = built([record("ours", registered=2), record("rival")])
    notes = grid(table, "registered by a similarity")["footnotes"]
    assert "Input views that got no camera are not used: Ours at 3 views placed 2 of 3." in notes
    assert grid(table, "cost")["rows"][0][2] == "2 of 3"


def test_different_threads_are_said() -> None:
    other = record("rival")
    other["stages"] = [{**other["stages"][0], "threads": 1}]
    notes = grid(built([record("ours"), other]), "cost")["footnotes"]
    assert any("different numbers of threads (1, 2)" in note for note in notes)


def test_the_papers_figures() -> None:
    """As its tables have them; a row that it doesn't have is not a failure."""
    ours = VIEWS["ours"][12]
    assert ours is not None and ours.psnr == 30.174
    assert paper_figures("views", "3dgs", 9) is None
    assert paper_figures("views", "3dgs", 5) == "absent"
    assert paper_figures("photos", "cf3dgs", 3) == PHOTOS["cf3dgs"]
    assert paper_figures("photos", "ours", 11) == "absent"
    assert paper_figures("ablations", "no_sap", 6) == ABLATIONS["no_sap"]
    assert paper_figures("ablations", None, 6) == "absent"
    assert "195 clinical videos" in paper_note(suite())
    assert "The data differ" in paper_note(suite())
    own = suite().model_copy(update={"methods": (Method(name="mine"),)})
    assert paper_note(own) == "Measured on a, b.", "none of the paper's stand beside them"


def test_markdown_and_csv() -> None:
    records = [record("ours"), failed("rival")]
    results = {
        "title": "Test", "note": "A note.", "tables": [built(records)], "cells": records,
        "machine": {"processor": "x", "cores": 2, "jobs": 1, "threads": 2},
        "versions": {"dentalsplat": "1", "python": "3"},
    }  # fmt: skip
    text = markdown(results)
    assert text.startswith("# Test\n\nA note.\n\n## The table\n")
    assert "- a, 3 views, rival (failed): Too few matches." in text
    table = [line for line in text.splitlines() if line.startswith("|")]
    assert table[1].startswith("| :-") and table[1].endswith("-: |")
    assert len({line.count("|") for line in table[:4]}) == 1
    lines = csv_text(results).splitlines()
    assert lines[0].startswith("table,protocol,known_cameras,method,views,scoring,figure,mean")
    assert "t,video24,False,ours,3,refined,psnr,26.0,,1,0" in lines
    assert "t,video24,False,rival,3,refined,psnr,,,0,1" in lines
    escaped = {"title": "t", "caption": "c", "columns": ["a", "b"], "rows": [["x|y", ""]]}
    assert "| x\\|y |" in grid_markdown({**escaped, "footnotes": []})
