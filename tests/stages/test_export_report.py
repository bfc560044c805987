"""What the page about a run says of the exports: what was measured on the teeth."""

import json
from pathlib import Path

from pipeline.pages.parts import Text
from pipeline.pages.tables import Table
from stages.export.report import PARTS


class Exports:
    """A case whose last exports lie in a folder."""

    def __init__(self, folder: Path | None) -> None:
        self._folder = folder

    def providers(self, kind: str) -> list[str]:
        return ["export"] if kind == "exports" and self._folder else []

    def folder(self, stage: str, kind: str) -> Path | None:
        return self._folder


def entry(name: str, value: float | None, **more: object) -> dict:
    return {
        "name": name, "title": name.capitalize(), "value": value, "uncertainty": 0.94,
        "unit": "mm", "sure": "fair", "direction": "", "estimated": None, "not_visible": "", **more,
    }  # fmt: skip


def test_measurements_stand_on_the_page_with_how_sure_they_are(tmp_path: Path) -> None:
    found = {
        "scale": {"text": "Lengths are in millimetres."},
        "measurements": [
            entry("overjet", -1.26, direction="reversed"),
            entry("midline_shift", -1.26, direction="to the right"),
            entry("overbite", 3.0, estimated={"covered_percent": 40.0}),
            entry("width", None, not_visible="no photograph shows 16"),
            entry("overjet", -0.04),
            entry("length", 0.1234, unit="none"),
            entry("length", 0.001234, unit="none", uncertainty=0.000321),
        ],
    }
    (tmp_path / "teeth.json").write_text(json.dumps(found))
    (section,) = PARTS["measurements"](Exports(tmp_path))
    table, *texts = section.blocks
    assert isinstance(table, Table)
    assert [[cell.text for cell in row] for row in table.rows] == [
        ["Overjet", "-1.3 ± 0.9 mm", "reversed; fair"],
        ["Midline_shift", "1.3 ± 0.9 mm", "to the right; fair"],
        ["Overbite", "3.0 ± 0.9 mm", "estimated; fair"],
        ["Width", "not visible", "no photograph shows 16"],
        ["Overjet", "0.0 ± 0.9 mm", "fair"],
        ["Length", "0.12 ± 0.94 (no scale)", "fair"],
        ["Length", "0.00123 ± 0.00032 (no scale)", "fair"],
    ]
    assert all(isinstance(text, Text) for text in texts)
    assert texts[-1].text == "Lengths are in millimetres."


def test_without_teeth_or_exports_there_is_no_such_section(tmp_path: Path) -> None:
    assert list(PARTS["measurements"](Exports(None))) == []
    assert list(PARTS["measurements"](Exports(tmp_path))) == []
    (tmp_path / "teeth.json").write_text(json.dumps({"teeth": []}))
    assert list(PARTS["measurements"](Exports(tmp_path))) == []
