"""Which cases a batch finds beside what runs have made, and that it looks for them once."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import pytest

from pipeline.errors import RequestError
from pipeline.studies.batch import plan
from pipeline.studies.batch.find import Names, find_cases
from pipeline.studies.batch.records import Case, new_record, write_case
from pipeline.studies.batch.sources import settings_of


def pictures(folder: Path) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    for number in range(2):
        (folder / f"{number}.jpg").write_bytes(bytes([number]))
    return folder


def test_what_runs_have_made_is_no_case(tmp_path: Path) -> None:
    for name in ("workspace", "workspace with photographs", "workspace around photographs"):
        (tmp_path / name / "fit").mkdir(parents=True)
        for file in ("request.json", "report.html", "fit/current.json"):
            (tmp_path / name / file).write_text("{}")
        pictures(tmp_path / name / "fit" / "0123456789ab" / "renders")
        pictures(tmp_path / name / "results")
    pictures(tmp_path / "workspace with photographs")
    pictures(tmp_path / "workspace around photographs" / "photos")
    pictures(tmp_path / "passed on" / "results")
    (tmp_path / "passed on" / "results" / "scene.json").write_text("{}")
    pictures(tmp_path / "batch" / "thumbnails")
    pictures(tmp_path / "batch" / "cases" / "a" / "results")
    for file in ("batch.json", "cases/a/request.json"):
        (tmp_path / "batch" / file).write_text("{}")
    found = {case.name: case for case in find_cases(tmp_path, Names({}))}
    assert {name: case.settled for name, case in found.items()} == {
        "workspace with photographs": "", "workspace around photographs": "",
        "workspace": "skipped", "passed on": "skipped", "batch/cases/a": "skipped",
    }  # fmt: skip
    assert "what they made" in found["workspace"].reason


def test_what_goes_with_photographs_is_no_case(tmp_path: Path) -> None:
    """Also where these lie where folders of cases were to lie."""
    pictures(tmp_path)
    pictures(tmp_path / "Masks")
    pictures(tmp_path / "depth")
    pictures(tmp_path / "@eaDir")
    with pytest.raises(RequestError, match="holds photographs itself, so it is one case"):
        find_cases(tmp_path, Names({}))
    pictures(tmp_path / "anna")
    found = {case.name: case.settled for case in find_cases(tmp_path, Names({}))}
    assert found == {
        "anna": "", "Masks": "skipped", "depth": "skipped", "0.jpg": "skipped", "1.jpg": "skipped",
        "@eaDir": "skipped",
    }  # fmt: skip
    (tmp_path / "0.jpg").unlink()
    (tmp_path / "1.jpg").unlink()
    found = {case.name: case.settled for case in find_cases(tmp_path, Names({}))}
    found.pop("@eaDir")
    assert found == {"anna": "", "Masks": "", "depth": ""}, "beside no photographs: names of cases"


def test_folders_whose_names_are_written_alike_are_no_one_case(tmp_path: Path) -> None:
    """The name of a file is bytes: one may hold what is no text, another say so in letters."""
    for name in (b"\xffanna", rb"\xffanna"):
        pictures(Path(os.fsdecode(os.fsencode(tmp_path) + b"/" + name)))
    first, second = find_cases(tmp_path, Names({}))
    assert (first.name, first.settled) == (r"\xffanna", "")
    assert (second.name, second.settled) == (r"\xffanna (2)", "wrong")
    assert "written like that of this one" in second.reason and first.id != second.id


def test_a_list_is_looked_at_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[Any] = []
    known = settings_of

    def counted(*given: Any) -> Any:
        asked.append(given)
        return known(*given)

    monkeypatch.setattr(plan, "settings_of", counted)
    monkeypatch.setattr(plan, "PATIENCE", -1.0)
    lines = ["name,photographs,settings"]
    for number in range(6):
        (pictures(tmp_path / "cases" / f"{number}") / "0.jpg").write_text(f"case {number}")
        lines.append(f"{number},cases/{number},fit.iterations={20 + number % 3}")
    (tmp_path / "list.csv").write_text("\n".join(lines))
    out = tmp_path / "out"
    told: list[str] = []
    (out / "records").mkdir(parents=True)
    given = (tmp_path / "list.csv", out, None, (), None, ())
    first = plan.make_plan(*given, "workspace", told.append)
    assert len(told) == 1 and "6 cases" in told[0]
    assert len(asked) == 4 and len(first.waiting) == 6
    second = first.again()
    assert len(asked) == 4 and second.records == first.records and second.cases == first.cases
    case = first.cases[0]
    write_case(out, new_record(case, "done", settings=first.settings[case.id]))
    third = first.again()  # another batch has done it meanwhile
    assert [entry.id for entry in third.waiting] == [entry.id for entry in first.cases[1:]]
    assert third.records[case.id]["state"] == "done"
    assert plan.make_plan(*given).again().waiting == third.waiting


def test_a_case_is_known_again_only_where_its_photographs_have_gone(tmp_path: Path) -> None:
    """Two lists may have the same ones under names of their own, with other settings."""
    (tmp_path / "records").mkdir()
    photo = pictures(tmp_path / "anna") / "0.jpg"
    old = Case("anna", "anna", files=((str(photo), 1, 7),))
    write_case(tmp_path, new_record(old, "done"))
    for place, files, known in (
        (photo, ((str(photo), 1, 7),), "new"),
        (photo.with_name("moved"), ((str(tmp_path / "elsewhere" / "0.jpg"), 1, 7),), "anna"),
        (photo.with_name("moved"), ((str(tmp_path / "elsewhere" / "0.jpg"), 1, 8),), "new"),
    ):
        if photo != place and photo.exists():
            photo.rename(place)
        case = Case("new", "new", files=files)
        (found,) = plan._known_again([case], {"anna": "anna"}, tmp_path)
        assert found.id == known
