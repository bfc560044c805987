"""Numbers and splits that were said, now or before a run: `check.html` takes them back."""

from __future__ import annotations

from pathlib import Path

import pytest

from pipeline.artifacts.dental.corrections import (
    Corrections,
    CrownCorrection,
    PhotoCorrection,
    read_corrections,
)
from pipeline.artifacts.teeth import Teeth
from pipeline.studies.report import run_report
from stages.dentition.corrections import apply_corrections
from tests import teeth_case as case
from tests.browser import needs_chromium
from tests.studies.check_case import NOWHERE, SAVE, corrected_case, data_of, probed


def _across(place: int) -> tuple[tuple[float, float], tuple[float, float]]:
    """A line from above through the middle of an upper crown."""
    x, y = case.original(place, "upper")
    return (x, y - 200), (x, y + 200)


def _part(place: int) -> tuple[float, float]:
    x, y = case.original(place, "upper")
    return x + 20, y


#: Of the first photograph, a mirror image or none, a number is said, a crown is split and one of
#: its parts numbered; and two things are said of what isn't there.
def said(mirrored: bool) -> dict[str, PhotoCorrection]:
    crowns = (
        CrownCorrection(case.original(0, "upper"), tooth=18),
        CrownCorrection(case.original(3, "upper"), split=_across(3)),
        CrownCorrection(_part(3), tooth=16),
        CrownCorrection(NOWHERE, tooth=48),
        CrownCorrection(NOWHERE, split=((1, 2), (3, 4))),
    )
    return {"0_right.jpg": PhotoCorrection(mirrored=mirrored or None, crowns=crowns)}


TAKE = """
  const at = () => document.activeElement.getAttribute("aria-label");
  const told = () => document.getElementById("said").textContent;
  const deeds = () => all("#panel .deeds button").map((entry) => entry.textContent)
    .filter((text) => text.startsWith("Take"));
  const lost = () => all(".chip.gone", card(0));
  const hit = (button) => { button.focus(); button.click(); };
  result.start = row(0).join(" ");
  result.lost = lost().map((button) => button.getAttribute("aria-label"));
  hit(lost()[0]);
  hit(lost()[0]);
  result.found = [lost().length, told()];
  hit(chip(0, "18"));
  result.offered = [deeds()];
  press("t");
  result.number = [row(0).join(" "), at(), told(), deeds()];
  press("z", { ctrlKey: true });
  result.undone = row(0).join(" ");
  hit(deed("Take back 18"));
  result.byMouse = [row(0).join(" "), at()];
  press("t");
  result.nothing = told();
  hit(chip(0, "16"));
  result.offered.push(deeds());
  hit(deed("Take back the split"));
  result.split = [row(0).join(" "), at(), told(), deeds()];
  const chosen = document.activeElement.textContent;
  result.file = check.yaml().split("\\n").filter((line) => line.includes("at:")).length;

  press("3"); press("8");
  result.offered.push(deeds());
  press("2"); press("8");
  press("s"); press("Enter");
  result.parts = row(0).join(" ");
  press("1"); press("5");
  result.offered.push(deeds());
  press("t");
  result.unnumbered = row(0).join(" ");
  press("t");
  result.whole = row(0).join(" ");
  press("t");
  result.end = [row(0).join(" "), document.activeElement.textContent === chosen];
"""


@needs_chromium
@pytest.mark.parametrize("mirrored", [False, True])
def test_what_was_said_is_taken_back_in_a_browser(tmp_path: Path, mirrored: bool) -> None:
    read = case.teeth()
    workspace = corrected_case(tmp_path / "case", read, said(mirrored))
    result = probed(workspace, tmp_path / "browser", TAKE, SAVE)
    lower = "43 42 41 31 32 33"

    def upper(first: str, fourth: str) -> str:
        """The row, of the picture turned over where it is a mirror image."""
        if mirrored:
            return f"13 12 {fourth} 21 22 {first} {lower}"
        return f"{first} 12 11 {fourth} 22 23 {lower}"

    bare = ("23", "11") if mirrored else ("13", "21")
    parts = "16 ?" if mirrored else "? 16"
    assert result["start"] == upper("18", parts)
    assert result["lost"] == [
        "48 take back: said before, nothing is read there any more",
        "split take back: said before, nothing is read there any more",
    ]
    assert result["found"] == [0, "Taken back."]
    taken = upper(bare[0], parts)
    number, label, told, offered = result["number"]
    assert (number, offered) == (taken, [])
    assert label.startswith("upper row, ") and f": {bare[0]}, " in label
    assert told == f"Taken back: it is {bare[0]} again."
    assert result["undone"] == result["start"]
    assert result["byMouse"] == [taken, label]
    assert result["nothing"] == "Nothing was said of this crown."
    whole, label, told, offered = result["split"]
    assert (whole, told, offered) == (upper(*bare), "Taken back: it is not split.", [])
    assert f": {bare[1]}, " in label
    assert result["file"] == 0
    assert result["offered"] == [
        ["Take back 18"], ["Take back 16", "Take back the split"], ["Take back 38"],
        ["Take back 15", "Take back the split"],
    ]  # fmt: skip
    assert result["whole"].count("28") == 1 and "?" not in result["whole"]
    assert result["parts"] == result["unnumbered"]
    assert result["end"] == [upper(*bare), True]

    now = read_corrections(case.write(workspace / "teeth.yaml", result["yaml"]))
    assert not any(photo.crowns for photo in now.photographs.values())


def test_a_split_of_what_was_read_as_two_is_of_both(tmp_path: Path) -> None:
    (x, y), (end, _) = case.original(1, "upper"), case.original(2, "upper")
    line = (((x + end) / 2, y - 200), ((x + end) / 2, y + 200))
    change = CrownCorrection((x, y), split=line)
    first, _, last = case.teeth().views
    twice = case.dentition("001", upper=(13, 12, 12, 21, 22, 23))
    read = Teeth((first, twice, last))
    told = {"1_front.jpg": PhotoCorrection(crowns=(change,))}
    after = apply_corrections(read, case.views(), Corrections(told)).views[1]
    assert [crown.number for crown in after.upper] == [13, 0, 0, 21, 22, 23]
    workspace = corrected_case(tmp_path / "case", read, told)
    run_report(workspace)
    shown = data_of((workspace / "check.html").read_text())["photographs"][1]
    assert [crown["number"] for crown in shown["earlier"]["crowns"][0]["was"]] == [12, 12]


JOINED = """
  const file = () => check.yaml().split("\\n").filter((line) => line.includes("tooth:"))
    .map((line) => line.match(/tooth: (\\d+)/)[1]).join(" ");
  result.start = [row(0).join(" "), file()];
  chip(0, "28").click();
  press("2"); press("7");
  result.anew = [row(0).join(" "), file()];
  press("t");
  result.back = [row(0).join(" "), file()];
"""


@needs_chromium
def test_the_number_of_joined_parts_is_of_all_of_them(tmp_path: Path) -> None:
    x, y = case.original(5, "upper")
    parts = [CrownCorrection((x + side, y), tooth=28) for side in (-20, 20)]
    crowns = (CrownCorrection((x, y), split=_across(5)), *parts)
    told = {"0_right.jpg": PhotoCorrection(crowns=crowns)}
    workspace = corrected_case(tmp_path / "case", case.teeth(), told)
    result = probed(workspace, tmp_path / "browser", JOINED)
    row = "13 12 11 21 22 {} 43 42 41 31 32 33"
    assert result["start"] == [row.format(28), "28 28"]
    assert result["anew"] == [row.format(27), "27 27"]
    assert result["back"] == [row.format("?"), ""]


@needs_chromium
def test_numbers_that_a_refused_run_has_not_given_are_shown_and_taken_back(tmp_path: Path) -> None:
    crowns = (CrownCorrection(case.original(2, "upper"), tooth=18),)
    told = {"0_right.jpg": PhotoCorrection(crowns=crowns)}
    workspace = corrected_case(tmp_path / "case", case.teeth(), told, applied=False)
    script = """
      result.start = row(0).join(" ");
      chip(0, "18").click();
      press("t");
      result.end = [row(0).join(" "), check.yaml().includes("tooth")];
    """
    result = probed(workspace, tmp_path / "browser", script)
    row = "13 12 {} 21 22 23 43 42 41 31 32 33"
    assert result == {"start": row.format(18), "end": [row.format(11), False]}


@needs_chromium
def test_a_photograph_that_was_left_out_is_used_as_if_nothing_had_been_said(tmp_path: Path) -> None:
    told = {"0_right.jpg": PhotoCorrection(use=False)}
    workspace = corrected_case(tmp_path / "case", case.teeth(), told)
    script = """
      const uses = () => check.yaml().split("\\n").filter((line) => line.includes("use:")).join();
      const shown = () => all("article h2").map((title) => title.textContent).join();
      result.start = [shown(), uses(), all("#aside figcaption")[0].textContent];
      all("#aside button")[0].click();
      result.end = [shown(), uses()];
    """
    result = probed(workspace, tmp_path / "browser", script)
    assert result["start"] == [
        "1_front.jpg,2_<left>.jpg", "    use: false", "0_right.jpgleft out by you",
    ]  # fmt: skip
    assert result["end"] == ["0_right.jpg,1_front.jpg,2_<left>.jpg", ""]
