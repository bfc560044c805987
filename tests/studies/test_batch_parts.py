"""Names of cases, folders and lists of them, and the summary: also of names that mean harm."""

from __future__ import annotations

import csv
import io
import json
import os
import re
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from pipeline import run
from pipeline.artifacts.space.frames import Frame
from pipeline.artifacts.space.scale import Scale
from pipeline.errors import RequestError
from pipeline.files import sha256_file, write_json
from pipeline.front.progress import LiveReporter
from pipeline.studies.batch.find import MOST_FOREIGN, Names, find_cases
from pipeline.studies.batch.keep import keep_results, write_thumbnail
from pipeline.studies.batch.listing import read_cases
from pipeline.studies.batch.plan import check_folder, make_plan
from pipeline.studies.batch.progress import Bar
from pipeline.studies.batch.records import Case, new_record, write_case
from pipeline.studies.batch.sources import contents_of, settings_of
from pipeline.studies.batch.summary import MEASURED, csv_text, write_summary
from stages.export.measuring.measures import RULES
from stages.export.texts import scene_description
from tests.browser import needs_chromium, run_in

DATA = Path(__file__).resolve().parents[2] / "data_samples"
HOSTILE = (
    "../../etc", "a/b", "a__b", "A__B", "con", "<script>alert(1)</script>", "ü", ".",
    "x" * 300, "a b", "a_b", "%2e%2e", "'\"&#", "\N{TOOTH}", "-rf", "NUL.txt", "",
)  # fmt: skip


def pictures(folder: Path, count: int = 2) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    for number in range(count):
        (folder / f"{number}.jpg").write_bytes(bytes([number]))
    return folder


def states(found: list[Case]) -> dict[str, str]:
    return {case.name: case.settled for case in found}


def test_names_are_safe_and_unique_and_stay() -> None:
    names = Names({})
    given = {called: names.of(called) for called in HOSTILE}
    assert len({name.casefold() for name in given.values()}) == len(HOSTILE)
    for name in given.values():
        assert re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9._-]*", name) and len(name) < 80, name
        assert not re.match(r"(?i)(con|nul)(\.|$)", name)
    # A case that comes to it later takes no name away, whatever the order.
    later = Names(given)
    assert {called: later.of(called) for called in reversed(HOSTILE)} == given
    assert later.of("A B").casefold() not in {name.casefold() for name in given.values()}


def test_what_lies_in_a_folder_of_cases(tmp_path: Path) -> None:
    pictures(tmp_path / "a")
    pictures(tmp_path / "clinic" / "2024" / "b")
    pictures(tmp_path / "c" / "images")
    pictures(tmp_path / "both" / "more")
    pictures(tmp_path / "both")
    pictures(tmp_path / "masked" / "masks")
    pictures(tmp_path / "masked")
    pictures(tmp_path / ".hidden")
    pictures(tmp_path / "$RECYCLE.BIN" / "S-1-5-21")
    pictures(tmp_path / "a" / "#recycle")
    (tmp_path / "film").mkdir()
    (tmp_path / "film" / "x.mp4").write_bytes(b"x")
    (tmp_path / "films").mkdir()
    for name in "xy":
        (tmp_path / "films" / f"{name}.mp4").write_bytes(b"x")
    (tmp_path / "empty").mkdir()
    (tmp_path / "one").mkdir()
    (tmp_path / "one" / "1.jpg").write_bytes(b"x")
    (tmp_path / "text.pdf").write_text("")
    (tmp_path / "1.jpg").write_text("")
    (tmp_path / "a link").symlink_to("a")
    (tmp_path / "clinic" / "up").symlink_to("..")
    (tmp_path / "self").symlink_to("self")
    (tmp_path / "dead").symlink_to("nowhere")
    os.mkfifo(tmp_path / "pipe")
    os.mkdir(os.fsencode(tmp_path) + b"/\xff")  # noqa: PTH102
    found = find_cases(tmp_path, Names({}))
    run = {"a", "clinic/2024/b", "c", "masked", "film", "one"}
    wrong = {"both", "films", "empty", r"\xff"}
    skipped = {".hidden", "text.pdf", "1.jpg", "a link", "clinic/up", "self", "dead", "pipe"}
    skipped.add("$RECYCLE.BIN")
    assert states(found) == {
        **dict.fromkeys(run, ""), **dict.fromkeys(wrong, "wrong"),
        **dict.fromkeys(skipped, "skipped"),
    }  # fmt: skip
    assert all(case.reason for case in found if case.settled)
    assert len({case.id for case in found}) == len(found)
    reasons = {case.name: case.reason for case in found}
    assert "which is a case already" in reasons["a link"]
    assert "2 films" in reasons["films"]


def test_many_foreign_files_are_counted(tmp_path: Path) -> None:
    pictures(tmp_path / "a")
    for number in range(MOST_FOREIGN + 7):
        (tmp_path / f"{number}.txt").write_text("")
    found = find_cases(tmp_path, Names({}))
    assert len(found) == MOST_FOREIGN + 2
    assert any("7 more files" in case.reason for case in found)


def test_a_list_of_cases(tmp_path: Path) -> None:
    pictures(tmp_path / "p")
    text = (
        "\ufeffname;photographs;settings\r\n"
        '"Müller; Anna";p;\r\nb;"p/0.jpg;p/1.jpg";"fit.iterations=5; fit.light=none"\r\n'
        "b;p;\r\n;p;\r\nc;nowhere;\r\nd;;\r\ne;p;;;x\r\n"
    )
    (tmp_path / "list.csv").write_text(text, encoding="utf-8", newline="")
    found = read_cases(tmp_path / "list.csv", Names({}))
    assert states(found) == {
        "Müller; Anna": "", "b": "", "b (line 4)": "wrong", "line 5": "wrong", "c": "wrong",
        "d": "wrong", "e": "wrong",
    }  # fmt: skip
    assert found[1].overrides == ("fit.iterations=5", "fit.light=none")
    assert [Path(path).name for path, _, _ in found[1].files] == ["0.jpg", "1.jpg"]


def test_paths_of_a_list_begin_at_its_folder(tmp_path: Path) -> None:
    pictures(tmp_path / "p")
    text = "name,photographs,settings\na,p,views.masks=m; views.held_out=[0.jpg]\n"
    (tmp_path / "list.csv").write_text(text)
    (case,) = read_cases(tmp_path / "list.csv", Names({}))
    assert case.overrides == (f"views.masks={tmp_path / 'm'}", "views.held_out=[0.jpg]")


def test_a_list_may_begin_at_home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pictures(tmp_path / "home" / "p")
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    (tmp_path / "list.csv").write_text("name,photographs\na,~/p\nb,~nobody-is-called-so/p\n")
    first, second = read_cases(tmp_path / "list.csv", Names({}))
    assert [Path(path).parent for path, _, _ in first.files] == [tmp_path / "home" / "p"] * 2
    assert second.settled == "wrong" and "home of a user that there isn't" in second.reason


def test_a_list_with_what_a_spreadsheet_leaves(tmp_path: Path) -> None:
    pictures(tmp_path / "p")
    text = "name;photographs;settings;;\n;;;;\na;p;;;\n\na;p;;;\nb;p;;;x\n"
    for before in ("\n", "sep=;\r\n"):
        (tmp_path / "list.csv").write_text(before + text, newline="")
        found = read_cases(tmp_path / "list.csv", Names({}))
        assert states(found) == {"a": "", "a (line 6)": "wrong", "b": "wrong"}
        assert "Line 7 has 2 entries too many" in found[2].reason


@pytest.mark.parametrize(
    ("text", "what"),
    [
        ("", "must name its columns"),
        ("name,photos\na,b\n", "a column 'photos'; .*Did you mean 'photographs'"),
        ("name,photographs\n", "has no cases"),
        ("name,name,photographs\na,b,c\n", "each once"),
        ('name,photographs\n"a,b\n', r"can't be read as CSV \(line 2: "),
    ],
)
def test_a_wrong_list_is_refused(tmp_path: Path, text: str, what: str) -> None:
    (tmp_path / "list.csv").write_text(text)
    with pytest.raises(RequestError, match=what):
        read_cases(tmp_path / "list.csv", Names({}))
    (tmp_path / "list.csv").write_bytes(b"name,photographs\n\xff\xfe,b\n")
    with pytest.raises(RequestError, match="not text in UTF-8"):
        read_cases(tmp_path / "list.csv", Names({}))


def test_files_that_settings_name_are_files_of_a_case(tmp_path: Path) -> None:
    """By what each stage that is run reads, also of stages that run unnamed."""
    pictures(tmp_path / "cases" / "a")
    pictures(tmp_path / "masks")
    (tmp_path / "transforms.json").write_text("{}")
    (tmp_path / "splats.ply").write_text("ply")
    given = (
        f"views.masks={tmp_path / 'masks'}", f"init.cameras={tmp_path}",
        f"swap.cameras={tmp_path}", f"splats.file={tmp_path / 'splats.ply'}",
        f"evaluate.ground_truth={tmp_path}", f"evaluate.masks={tmp_path / 'masks'}",
    )  # fmt: skip
    stages = ("init", "swap", "splats", "evaluate")

    def made(*overrides: str) -> Case:
        plan = make_plan(tmp_path / "cases", tmp_path / "out", None, overrides, stages, ())
        assert [case.id for case in plan.waiting] == ["a"]
        return plan.cases[0]

    case = made(*given)
    assert {label for label, _, _, _ in case.named} == {
        "views: masks/0.jpg", "views: masks/1.jpg", "init: cameras/transforms.json",
        "swap: cameras/transforms.json", "splats: splats.ply", "evaluate: masks/0.jpg",
        "evaluate: masks/1.jpg", "evaluate: ground_truth/transforms.json",
    }  # fmt: skip
    assert len(case.stamps) == len(case.files) + len(case.named)
    assert Case.from_dict(json.loads(json.dumps(case.to_dict()))) == case
    before = contents_of(case.named)
    (tmp_path / "splats.ply").write_text("PLY")
    (changed,) = {*contents_of(made(*given).named)} - {*before}
    assert changed.startswith("splats: splats.ply ")
    wrong = made(*given[:3], f"splats.file={tmp_path / 'none.ply'}")
    assert any("there is no file" in label for label, _, _, _ in wrong.named)
    small = settings_of(None, ("views.long_side=256",), stages)
    assert small.key != settings_of(None, (), stages).key


def test_a_folder_of_another_batch_is_not_taken(tmp_path: Path) -> None:
    north, south, out = tmp_path / "north", tmp_path / "south", tmp_path / "out"
    (out / "records").mkdir(parents=True)
    pictures(north / "anna", 2)
    pictures(south / "anna", 3)
    (south / "anna" / "0.jpg").write_bytes(b"ab")
    for k in (1, 2):
        (south / "anna" / f"{k}.jpg").write_bytes(b"abc")
    pictures(south / "berta", 2)
    cases = {place: find_cases(place, Names({})) for place in (north, south)}
    check_folder(out, north, cases[north], chosen=False)
    write_json(out / "batch.json", {"cases": str(north)})
    for case in cases[north]:
        write_case(out, new_record(case, "done"))
    for chosen in (True, False):
        check_folder(out, north, cases[north], chosen=chosen)
        with pytest.raises(RequestError, match=r"of other cases, those of .*north"):
            check_folder(out, south, cases[south], chosen=chosen)
    check_folder(out, south, cases[south][1:], chosen=True)  # others join them
    copy = tmp_path / "copy"
    shutil.copytree(north, copy)
    check_folder(out, copy, find_cases(copy, Names({})), chosen=True)
    north.rename(tmp_path / "moved")
    check_folder(out, south, cases[south], chosen=False)
    (out / "batch.json").write_text("[")
    check_folder(out, copy, cases[south], chosen=False)


def test_a_picture_is_of_the_photographs_that_were_read(tmp_path: Path) -> None:
    frames = sorted((DATA / "twelve_frames").glob("*.jpg"))[:2]
    workspace, picture = tmp_path / "w", tmp_path / "a.jpg"
    run(
        frames, workspace=workspace, stages=["views"],
        overrides={"views.long_side": 128, "report": False},
    )  # fmt: skip
    contents = [f"views: {frame.name} {sha256_file(frame)}" for frame in frames]
    write_thumbnail(workspace, picture, contents[:1], scene=False)
    assert not picture.exists()
    write_thumbnail(workspace, picture, contents, scene=False)
    photograph = picture.read_bytes()
    (workspace / "results").mkdir()
    Image.new("RGB", (8, 6), "red").save(workspace / "results" / "preview.png")
    write_thumbnail(workspace, picture, contents, scene=False)
    assert picture.read_bytes() == photograph
    write_thumbnail(workspace, picture, contents, scene=True)
    assert picture.read_bytes() != photograph


def test_the_summary_sorts_by_how_many_are_placed(tmp_path: Path) -> None:
    records = [
        new_record(Case(str(placed), "x"), "done", placed=placed, photographs=14)
        for placed in (9, 12, None)
    ]
    write_summary(tmp_path, records, "Batch", "")
    page = (tmp_path / "summary.html").read_text()
    for cell in ('data-v="9">9 of 14<', 'data-v="12">12 of 14<', 'data-v="-1">–<'):
        assert cell in page


def test_the_summary_takes_any_name_and_stays_small(tmp_path: Path) -> None:
    bad = "<img src=x onerror=alert(1)>"
    records: list[dict[str, Any]] = [
        new_record(Case("x-1", bad), "wrong", f"=cmd {bad}\nsecond line"),
        new_record(Case("+x", "=1+1"), "done", psnr=31.25, links={"viewer": "results/a b#.html"}),
        *(new_record(Case(f"c{n}", f"case {n}"), "waiting") for n in range(948)),
    ]
    write_summary(tmp_path, records, f"Batch: {bad}", "950 cases")
    page = (tmp_path / "summary.html").read_text()
    assert "<img src=x" not in page and "&lt;img src=x" in page
    assert 'href="cases/%2Bx/results/a%20b%23.html"' in page
    assert len(page) < 1_000_000
    rows = list(csv.DictReader(io.StringIO(csv_text(records))))
    assert len(rows) == 950
    assert rows[0]["reason"] == f"'=cmd {bad} second line"
    assert (rows[1]["name"], rows[1]["psnr"]) == ("'=1+1", "31.25")


@needs_chromium
def test_the_summary_says_how_many_are_found(tmp_path: Path) -> None:
    records = [new_record(Case(f"c{n}", f"case {n}"), "waiting") for n in range(3)]
    records.append(new_record(Case("x", "Jose\u0301 x"), "done"))  # as macOS writes it
    write_summary(tmp_path, records, "Batch", "")
    script = """
      delete Element.prototype.ariaPressed;  // as in Firefox 115
      const field = document.querySelector(".filters input");
      const found = (text) => {
        field.value = text;
        field.dispatchEvent(new Event("input"));
        return [document.getElementById("found").textContent,
          document.querySelectorAll("tbody tr:not([hidden])").length];
      };
      const told = [found("case"), found(""), found("no such case")];
      document.querySelector("[data-state=done]").click();
      tell({ told: [...told, found(" X "), found("jos\\u00c9"), found("case 1")] });"""
    page = (tmp_path / "summary.html").read_text()
    told, log = run_in(page, script, tmp_path, (1280, 800))
    assert log == []
    nothing, *_ = told["told"][2]
    assert nothing.startswith("No case found.")
    assert told["told"] == [
        ["3 of 4 cases", 3], ["", 4], [nothing, 0], *[["1 of 4 cases", 1]] * 2, [nothing, 0],
    ]  # fmt: skip


@needs_chromium
@pytest.mark.parametrize("width", [390, 718])
def test_a_phone_and_a_sheet_of_paper_show_what_came_of_a_case(tmp_path: Path, width: int) -> None:
    records = [
        new_record(Case("x", "anna"), "wrong", "It holds two films; a case is one."),
        new_record(Case("y", "ben"), "done"),
    ]
    write_summary(tmp_path, records, "Batch", "")
    script = """
      document.querySelector("[data-state=wrong]").click();
      const cell = document.querySelector("td.why").getBoundingClientRect();
      const colour = (each) => getComputedStyle(document.querySelector(each)).color;
      tell({ right: cell.right, width: cell.width,
        named: document.querySelector("td.n").dataset.name,
        hidden: getComputedStyle(document.querySelectorAll("tbody tr")[1]).display,
        alike: colour(".state.bad") === colour("td.name") });"""
    told, log = run_in((tmp_path / "summary.html").read_text(), script, tmp_path, (width, 800))
    assert log == []
    assert told["right"] <= width and told["width"] > width / 2
    assert (told["named"], told["hidden"], told["alike"]) == ("teeth", "none", False)


def test_a_terminal_shows_names_as_they_are(capsys: pytest.CaptureFixture[str]) -> None:
    for bar in (Bar(), LiveReporter()):
        bar.message("ward:on:3 [b]")
    assert capsys.readouterr().err == 2 * "ward:on:3 [b]\n"


def test_the_table_has_all_that_is_measured() -> None:
    assert tuple(rule.name for rule in RULES) == MEASURED
    estimated = {"overbite": {"value": 3.5, "uncertainty": 2.25, "estimated": True}}
    (row,) = csv.DictReader(
        io.StringIO(csv_text([new_record(Case("a", "a"), "done", measured=estimated)]))
    )
    assert (row["overbite_mm"], row["overbite_uncertainty_mm"]) == ("3.5", "2.25")
    assert row["overbite_is_estimated"] == "yes"


def test_what_a_case_is_kept_for_may_take_more_room_than_the_rest(tmp_path: Path) -> None:
    """A large viewer page stays with its mesh and report; what else there is has no room then."""
    results = tmp_path / "results"
    (tmp_path / "export").mkdir()
    results.symlink_to("export")  # as a run leaves it
    sizes = {"viewer.html": 8_500_000, "mesh.ply": 1_000_000, "mesh.glb": 500_000, "scene.json": 10}
    for name, size in sizes.items():
        (results / name).write_bytes(bytes(size))
    (tmp_path / "report.html").write_bytes(bytes(1_000_000))
    (tmp_path / "check.html").write_bytes(bytes(100_000))
    assert sorted(keep_results(tmp_path)) == ["check.html", "mesh.glb"]
    assert {path.name for path in results.iterdir()} == {"viewer.html", "mesh.ply", "scene.json"}
    assert (tmp_path / "report.html").is_file() and not (tmp_path / "check.html").exists()


def test_scene_json_says_what_was_left_out_and_no_jaw_is_kept_alone(tmp_path: Path) -> None:
    results = tmp_path / "results"
    (tmp_path / "export").mkdir()
    results.symlink_to("export")
    jaws = [f"mesh_{jaw}.glb" for jaw in ("lower", "upper")]
    sizes = {"mesh.ply": 4_000_000, jaws[0]: 3_000_000, jaws[1]: 3_500_000, "preview.png": 900_000}
    for name, size in sizes.items():
        (results / name).write_bytes(bytes(size))
    frame, scale = Frame("mouth", np.eye(4)), Scale("mm", "length", 2.0)
    before = scene_description([*sizes], frame, scale, (0, 1, 0), {}, {"model": "open"}, {})
    assert set(jaws) <= before["files"].keys() & before["frame"]["file_from_frame"].keys()
    write_json(results / "scene.json", before)
    assert sorted(keep_results(tmp_path)) == jaws
    assert {path.name for path in results.iterdir()} == {"mesh.ply", "preview.png", "scene.json"}
    told = json.loads((results / "scene.json").read_text())
    assert set(told["files"]) == {"mesh.ply", "preview.png"}
    assert set(told["skipped"]) == {"model", *jaws}
    assert not set(jaws) & told["frame"]["file_from_frame"].keys()
