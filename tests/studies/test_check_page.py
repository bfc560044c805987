"""The page to put the teeth right: when it is written, what it says, how a browser takes it."""

from __future__ import annotations

import html
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pipeline.artifacts.dental.corrections import Corrections, read_corrections
from pipeline.artifacts.teeth import UNREAD, Dentition, Teeth
from pipeline.store import Store
from pipeline.studies.report import run_report
from stages.dentition.corrections import apply_corrections
from stages.dentition.crowns import mirrored_dentition
from tests import teeth_case as case
from tests.browser import needs_chromium
from tests.studies.check_case import SAVE, data_of, doubtful_case, probed
from tests.studies.report_case import write_result
from tests.studies.report_page import assert_alone, text_of


def test_a_doubtful_case_gets_the_page_and_the_report_leads_to_it(tmp_path: Path) -> None:
    workspace = doubtful_case(tmp_path / "Anna", failure="Two <i>numberings</i> are as good.")
    report = run_report(workspace).read_text()
    assert 'href="check.html"' in report
    assert "Put the teeth right" in text_of(report)
    assert "it is <b>blurred</b>" in html.unescape(report)
    page = (workspace / "check.html").read_text()
    assert_alone(page)
    assert "Two &lt;i&gt;numberings&lt;/i&gt; are as good." in page
    assert "<left>" not in page
    photographs = data_of(page)["photographs"]
    assert [photo["name"] for photo in photographs] == list(case.NAMES)
    assert photographs[0]["scale"] == [case.SCALE, case.SCALE]
    assert photographs[2]["aside"] == "it is <b>blurred</b>"
    first = photographs[0]["crowns"][0]
    assert first["number"] == 13 and first["jaw"] == "upper"
    assert first["offered"] == [[13, 0.7], [53, 0.2]]
    run_report(workspace)
    assert (workspace / "check.html").read_text() == page, "the same case gives the same page"


def test_numbered_teeth_of_a_run_that_succeeded_can_be_checked_too(tmp_path: Path) -> None:
    workspace = doubtful_case(tmp_path / "case")
    store = Store(workspace)
    picture = np.full((20, 30, 3), 90, np.uint8)
    numbered = replace(case.teeth("it is blurred"), pictures={"000": picture})
    write_result(workspace, "init", [numbered])
    assert store.failures.of("init") is None
    report = run_report(workspace).read_text()
    assert (workspace / "check.html").is_file()
    assert "Check the teeth" in report
    assert "right, 12 of 12 teeth numbered" in text_of(report)
    assert "takes no part: it is blurred" in text_of(report)


def test_without_numbers_there_is_no_page_and_an_old_one_goes(tmp_path: Path) -> None:
    workspace = doubtful_case(tmp_path / "case")
    run_report(workspace)
    titles = [
        re.search("<title>(.*)</title>", (workspace / name).read_text())[1]
        for name in ("check.html", "report.html")
    ]
    assert titles == [
        "case: teeth to check · dentalsplat", "case: report of the run · dentalsplat",
    ], "tabs of a browser can be told apart"  # fmt: skip
    bare = Teeth(tuple(case.dentition(f"{k:03d}", "front", [0] * 6, [0] * 6) for k in range(3)))
    write_result(workspace, "init", [bare])
    report = run_report(workspace).read_text()
    assert not (workspace / "check.html").exists()
    assert "check.html" not in report


@pytest.mark.parametrize("text", ["photographs: [", "photographs: {x: {used: 1}}"])
def test_a_wrong_file_is_said_on_the_page(tmp_path: Path, text: str) -> None:
    workspace = doubtful_case(tmp_path / "case")
    case.write(workspace / "teeth.yaml", text)
    run_report(workspace)
    page = (workspace / "check.html").read_text()
    assert "Saving here writes it anew." in text_of(page)
    assert "could not be drawn" not in (workspace / "report.html").read_text()


@needs_chromium
def test_what_is_seldom_right_is_not_said_to_be_impossible(tmp_path: Path) -> None:
    """A canine may have changed places with its neighbour; no number stands at both ends."""
    script = """
      const said = (place, number) => {
        all(".chip:not(.gone)", card(0))[place].click();
        [...String(number)].forEach((digit) => press(digit));
      };
      const sure = () => all(".head button", card(0))
        .find((entry) => /All numbers/.test(entry.textContent)).disabled;
      const before = row(0);
      said(0, 12); said(1, 13);
      result.changed = [row(0).slice(0, 2), notes(0), sure()];
      press("z", { ctrlKey: true }); press("z", { ctrlKey: true });
      result.back = row(0).join() === before.join();
      said(0, before[5]);
      result.far = [notes(0), sure()];
    """
    found = probed(doubtful_case(tmp_path / "case"), tmp_path / "browser", script)
    numbers, notes, disabled = found["changed"]
    assert numbers == ["12", "13"] and found["back"]
    assert "12 and 13 are out of order: right only for teeth that have changed places" in notes
    assert "Can't be" not in notes and not disabled
    assert re.search(r"Can't be: \d\d stands twice\.", found["far"][0]) and found["far"][1]


@needs_chromium
def test_a_case_of_a_batch_is_run_again_by_the_batch(tmp_path: Path) -> None:
    """`pipeline run` would leave its summary as it is, and be refused where results are kept."""
    (tmp_path / "out" / "cases").mkdir(parents=True)
    (tmp_path / "out" / "batch.json").write_text("{}")
    workspace = doubtful_case(tmp_path / "out" / "cases" / "anna")
    change = "chip(0, '11').click(); press('1'); press('2');"
    told = 'result.next = document.getElementById("next").textContent;'
    result = probed(workspace, tmp_path / "browser", change, SAVE, told)
    assert "Run the same pipeline batch again" in result["next"]
    assert "pipeline run -w" not in result["next"]


def test_what_was_said_of_another_picture_of_that_name_is_not_shown(tmp_path: Path) -> None:
    workspace = doubtful_case(tmp_path / "case")
    other, same = "{use: false, sha256: aaaa}", "{use: false, sha256: '1111'}"
    text = f"photographs: {{0_right.jpg: {other}, 1_front.jpg: {same}}}"
    case.write(workspace / "teeth.yaml", text)
    run_report(workspace)
    shown = data_of((workspace / "check.html").read_text())["photographs"]
    assert [photo["earlier"]["use"] for photo in shown] == [None, False, None]


def test_photographs_that_were_not_read_are_not_shown_but_for_what_was_said(tmp_path: Path) -> None:
    read = case.teeth().views
    unread = [Dentition(view.name, view.size, UNREAD) for view in read[1:]]
    workspace = doubtful_case(tmp_path / "case", Teeth((read[0], *unread)))
    case.write(workspace / "teeth.yaml", "photographs: {1_front.jpg: {use: false}}")
    run_report(workspace)
    shown = data_of((workspace / "check.html").read_text())["photographs"]
    assert [photo["aside"] for photo in shown] == ["", "its teeth have not been read"]


PROBE = """
  result.cards = all("article").length;
  result.left = all("#aside figure").map((entry) => entry.textContent);
  result.rest = document.getElementById("panel").textContent;

  all(".crown polygon", card(0))[0].dispatchEvent(new MouseEvent("click", { bubbles: true }));
  result.chosen = document.activeElement.textContent;
  result.says = document.querySelector("#panel .now div").textContent;
  press("1"); press("2");
  result.twice = notes(0);
  press("z", { ctrlKey: true });
  result.undone = row(0)[0];
  press("1"); press("9");
  result.refused = document.getElementById("said").textContent;
  press("5"); press("3");
  press("ArrowRight"); press("ArrowDown"); press("ArrowRight");
  result.walked = document.activeElement.textContent;
  press("Delete");
  result.afterRemoval = row(0);

  chip(1, "21").click();
  deed("Split").click();
  const svg = card(1).querySelector("svg");
  const box = svg.querySelector(".chosen polygon").getBoundingClientRect();
  svg.setPointerCapture = () => {};
  const drag = (type, y) => svg.dispatchEvent(new PointerEvent(type, { bubbles: true,
    cancelable: true, pointerId: 3, clientX: box.x + box.width / 2, clientY: y }));
  drag("pointerdown", box.y - 5); drag("pointermove", box.y + 9); drag("pointerup", box.bottom + 5);
  svg.dispatchEvent(new MouseEvent("click", { bubbles: true }));
  result.split = row(1);
  press("2"); press("1");
  deed("Number the row").click();
  result.renumbered = row(1);
  chip(1, "13").click();
  press("2"); press("8");
  deed("Number the row").click();
  result.beyond = row(1);
  press("z", { ctrlKey: true }); press("z", { ctrlKey: true });
  chip(1, "42").click();
  press("s"); press("ArrowRight"); press("Enter");
  result.splitByKeys = row(1).slice(7);
  press("z", { ctrlKey: true });
  card(1).querySelector("select").value = "left";
  card(1).querySelector("select").dispatchEvent(new Event("change"));
  all("#aside button")[0].click();
  all(".head button", card(2)).find((entry) => /All numbers/.test(entry.textContent)).click();
  result.cards += all("article").length;
"""
SAVED = """
  result.next = document.getElementById("next").textContent;
  result.overflow = document.documentElement.scrollWidth - innerWidth;
  result.requests = performance.getEntriesByType("resource").map((entry) => entry.name)
    .filter((name) => !name.startsWith("data:"));
"""
READ = "result.yaml = check.yaml();"


@needs_chromium
@pytest.mark.parametrize("corner", [(0, 0), (30, 20)])
def test_everything_can_be_put_right_in_a_browser(tmp_path: Path, corner: tuple[int, int]) -> None:
    """Also where photographs are cut out of a sheet: places are those in the sheet."""
    workspace = doubtful_case(tmp_path / "a case", corner=corner)
    result = probed(workspace, tmp_path / "browser", PROBE, SAVE, SAVED)
    assert result["cards"] == 2 + 3
    assert result["left"] == ["2_<left>.jpgit is <b>blurred</b>Use it"]
    assert "Nothing looks wrong" in result["rest"]
    assert result["chosen"] == "13"
    assert "upper right canine" in result["says"]
    assert "12 stands twice: right only" in result["twice"]
    assert "Can't be" not in result["twice"], "it may be two parts of one crown"
    assert result["undone"] == "13"
    assert "19 is no FDI number" in result["refused"]
    assert result["walked"] == "41"
    assert " ".join(result["afterRemoval"]) == "53 12 11 21 22 23 43 42 31 32 33"
    assert result["split"][:7] == ["13", "12", "11", "?", "?", "22", "23"]
    assert result["renumbered"][:7] == ["13", "12", "11", "21", "22", "23", "24"]
    assert result["beyond"] == ["28", *result["renumbered"][1:]], "no teeth of other quadrants"
    assert result["splitByKeys"] == ["43", "?", "?", "41", "31", "32", "33"]
    assert result["overflow"] == 0 and result["requests"] == []
    assert result["download"] == "teeth.yaml"
    assert f"folder, beside this page: {workspace}." in result["next"]
    assert (
        f"pipeline run -w '{workspace}' --stages views,init --set fit.iterations=20"
        in result["next"]
    )

    corrections = read_corrections(case.write(workspace / "teeth.yaml", result["yaml"]))
    after = apply_corrections(case.teeth("x"), case.views(corner=corner), corrections).views
    rows = [[crown.number for crown in view.all_crowns] for view in after]
    assert rows[0] == [53, 12, 11, 21, 22, 23, 43, 42, 31, 32, 33]
    assert rows[1] == [13, 12, 11, 21, 22, 23, 24, *case.LOWER]
    assert rows[2] == [*case.UPPER, *case.LOWER]
    assert after[1].kind == "left" and after[2].set_aside == ""
    assert {crown.doubt for crown in after[2].all_crowns} == {0.0}

    # A second look: what was put right before stays in the file that the page writes.
    store = Store(workspace)
    store.failures.keep("init", {}, {"teeth": Teeth(after)})
    run_report(workspace)
    again = data_of((workspace / "check.html").read_text())["photographs"]
    assert [len(photo["earlier"]["crowns"]) for photo in again] == [2, 8, 12]
    assert again[2]["earlier"]["use"] is True
    assert probed(workspace, tmp_path / "browser", READ) == {"yaml": result["yaml"]}


#: The first photograph shows four teeth of a jaw in its left half; of the second, init has found
#: that it is a mirror image.
TAKEN = ((14, 13, 12, 11), (44, 43, 42, 41))


def mirrored_case(folder: Path) -> tuple[Path, Teeth]:
    """A workspace with what init found, and the teeth as they were read from the photographs."""
    side = case.dentition("000", "right", *TAKEN)
    sure, said = side.upper[1:3]
    upper = (
        side.upper[0], replace(sure, doubt=1e-4), replace(said, number=62, doubt=0.0), side.upper[3]
    )  # fmt: skip
    read = Teeth((replace(side, upper=upper), case.dentition("001", "front", (12, 11), (42, 41))))
    found = Teeth((read.views[0], mirrored_dentition(read.views[1])))
    return doubtful_case(folder, found), read


def test_the_page_knows_mirror_images(tmp_path: Path) -> None:
    workspace, _ = mirrored_case(tmp_path / "case")
    case.write(workspace / "teeth.yaml", "photographs: {0_right.jpg: {mirrored: false}}")
    run_report(workspace)
    first, second, third = data_of((workspace / "check.html").read_text())["photographs"]
    assert [photo["mirrored"] for photo in (first, second, third)] == [False, True, False]
    said = [photo["earlier"]["mirrored"] for photo in (first, second, third)]
    assert said == [False, None, None]
    assert [crown["doubt"] for crown in first["crowns"][:4]] == [0.05, 0.001, 0, 0.05]
    assert [crown["number"] for crown in second["crowns"]] == [21, 22, 31, 32]


TURN = """
  const over = (k) => all(".head button", card(k))
    .find((entry) => entry.textContent === "Mirror image");
  const seen = (k) => [row(k).join(" "), over(k).getAttribute("aria-pressed"),
    card(k).querySelector("image").getAttribute("transform"), card(k).querySelector("select").value,
    notes(k).includes("shown turned over")];
  const inside = (k) => {
    const { x, width } = card(k).querySelector("svg").viewBox.baseVal;
    return all("polygon", card(k)).every((polygon) => [...polygon.points]
      .every((point) => point.x > x && point.x < x + width)) && width < 299;
  };
  result.start = [seen(0), seen(1)];
  over(0).click();
  result.turned = seen(0);
  const file = () => check.yaml().split("\\n").slice(1).join("|");
  result.files = [file()];
  result.near = inside(0);
  over(0).click();
  result.back = seen(0);
  result.files.push(file());
  result.near &&= inside(0);
  press("z", { ctrlKey: true });
  result.undone = seen(0);
  result.near &&= inside(0);
  all(".chip", card(0))[3].click();
  press("2"); press("5");
  press("2"); press("4");
  chip(0, "31").click();
  deed("Split").click();
  press("Enter");
  press("3"); press("1");
  all(".chip", card(1))[0].click();
  press("6"); press("1");
  result.end = [row(0).join(" "), row(1).join(" ")];
"""


@needs_chromium
def test_a_mirror_image_is_turned_over_in_a_browser(tmp_path: Path) -> None:
    workspace, read = mirrored_case(tmp_path / "case")
    result = probed(workspace, tmp_path / "browser", TURN, SAVE)
    as_taken = ["14 13 62 11 44 43 42 41", "false", "", "right", False]
    over = f"translate({case.WIDTH} 0) scale(-1 1)"
    as_turned = ["21 62 23 24 31 32 33 34", "true", over, "left", True]
    assert result["start"] == [as_taken, ["21 22 31 32", "true", over, "front", True]]
    assert result["turned"] == result["undone"] == as_turned
    assert result["back"] == as_taken
    assert result["near"] is True
    assert result["files"] == [
        f'photographs:|  "0_right.jpg":|    mirrored: {said}|    sha256: "{"0" * 16}"|'
        for said in ("true", "false")
    ]
    assert result["end"] == ["21 62 23 24 31 ? 32 33 34", "61 22 31 32"]

    said = read_corrections(case.write(workspace / "teeth.yaml", result["yaml"])).photographs
    first, second = said["0_right.jpg"], said["1_front.jpg"]
    assert (first.mirrored, first.kind, first.use) == (True, None, None)
    assert second.mirrored is True, "its number is that of the picture turned over"
    number, split, part = first.crowns
    assert (number.tooth, part.tooth, second.crowns[0].tooth) == (24, 31, 61)
    # Places are those of the photograph as it was taken: what is on the right there is on the left.
    assert number.at == pytest.approx(case.original(0, "upper"), abs=1)
    assert split.at == pytest.approx(case.original(3, "lower"), abs=1)
    assert part.at[0] > split.at[0]
    assert second.crowns[0].at == pytest.approx(case.original(1, "upper"), abs=1)

    after = apply_corrections(read, case.views(), Corrections(said)).views
    rows = [" ".join(str(crown.number or "?") for crown in view.all_crowns) for view in after]
    assert rows == result["end"]
    assert [(view.mirrored, view.kind) for view in after] == [(True, "left"), (True, "front")]

    # A second look: all stays as it was said.
    Store(workspace).failures.keep("init", {}, {"teeth": Teeth(after)})
    again = probed(workspace, tmp_path / "browser", READ, "result.row = row(0).join(' ');")
    assert again == {"yaml": result["yaml"], "row": result["end"][0]}
