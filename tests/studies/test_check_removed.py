"""Crowns that a run was told are no teeth: `check.html` shows them, and brings them back."""

from __future__ import annotations

from pathlib import Path

from pipeline.artifacts.dental.corrections import (
    CrownCorrection,
    PhotoCorrection,
    read_corrections,
)
from pipeline.artifacts.teeth import Dentition, Teeth
from pipeline.studies.report import run_report
from stages.dentition.corrections import apply_corrections
from tests import teeth_case as case
from tests.browser import needs_chromium
from tests.studies.check_case import NOWHERE, SAVE, corrected_case, data_of, probed

#: Of the first photograph, a mirror image, two crowns are removed, of which the first was numbered
#: before, and what isn't there; of the last one all.
SAID = {
    "0_right.jpg": PhotoCorrection(
        mirrored=True, crowns=(
            CrownCorrection(case.original(0, "upper"), tooth=24),
            CrownCorrection(case.original(0, "upper"), remove=True),
            CrownCorrection(NOWHERE, remove=True),
            CrownCorrection(case.original(2, "lower"), remove=True),
        ),
    ),
    "2_<left>.jpg": PhotoCorrection(
        crowns=tuple(CrownCorrection(case.original(k, "upper"), remove=True) for k in (0, 1))
    ),
}  # fmt: skip


def _row(view: Dentition) -> list[int]:
    return [crown.number for crown in view.all_crowns]


def as_read() -> Teeth:
    few = case.dentition("002", "left", (21, 22), ())
    return Teeth((*case.teeth().views[:2], few))


def test_what_was_removed_is_listed_where_it_was(tmp_path: Path) -> None:
    workspace = corrected_case(tmp_path / "case", as_read(), SAID)
    run_report(workspace)
    first, second, third = data_of((workspace / "check.html").read_text())["photographs"]
    assert [crown["at"] for crown in first["removed"]] == [
        list(case.original(0, "upper")), list(NOWHERE), list(case.original(2, "lower")),
    ]  # fmt: skip
    upper, nothing, lower = first["removed"]
    assert (upper["number"], upper["doubt"], upper["jaw"]) == (24, 0, "upper")
    assert nothing["outline"] == []
    assert (lower["number"], lower["jaw"]) == (31, "lower"), "of the picture turned over"
    left, right = (f(x for x, _ in upper["outline"]) for f in (min, max))
    assert left < case.WIDTH - case.middle(0, "upper")[0] < right
    assert second["removed"] == []
    assert [len(third[kind]) for kind in ("crowns", "removed")] == [0, 2]
    assert third["aside"] == "no teeth were found in it"


def test_what_a_run_has_not_removed_yet_is_shown_once(tmp_path: Path) -> None:
    workspace = corrected_case(tmp_path / "case", as_read(), SAID)
    at = list(case.original(3, "upper"))
    text = f"photographs: {{1_front.jpg: {{crowns: [{{at: {at}, remove: true}}]}}}}"
    case.write(workspace / "teeth.yaml", text)
    run_report(workspace)
    shown = data_of((workspace / "check.html").read_text())["photographs"][1]
    assert [crown["number"] for crown in shown["removed"]] == [21]
    numbers = [crown["number"] for crown in shown["crowns"]]
    assert numbers == [13, 12, 11, 22, 23, *case.LOWER]


BACK = """
  const gone = (inside) => all(".chip.gone", inside);
  const said = () => document.getElementById("said").textContent;
  const struck = () => all("g.gone", card(0)).map((entry) =>
    [entry.textContent, getComputedStyle(entry.querySelector("text")).textDecorationLine].join());
  result.start = [row(0).join(" "), struck(), gone(card(1)).length];
  result.names = gone(card(0)).map((button) => button.getAttribute("aria-label"));
  gone(card(0))[0].focus();
  result.pointed = all("g.pointed", card(0)).map((entry) => entry.textContent);
  gone(card(0))[0].click();
  result.upper = [document.activeElement.getAttribute("aria-label"), said()];
  gone(card(0))[0].click();
  result.nothing = [gone(card(0)).length, struck().length];
  press("z", { ctrlKey: true });
  result.undone = gone(card(0)).length;
  gone(card(0))[0].click();
  document.activeElement.blur();
  gone(card(0))[0].click();
  press("3"); press("2");
  result.end = row(0).join(" ");
  press("Delete");
  result.again = [row(0).length, gone(card(0)).map((entry) => entry.textContent).join()];
  gone(card(0))[0].click();
  const left = () => document.getElementById("aside");
  result.left = [left().querySelector("figcaption").textContent, gone(left()).length];
  gone(left())[1].click();
  result.leftAfter = [gone(left()).length, all("button", left()).at(-1).textContent];
  all("button", left()).at(-1).click();
  result.used = [all("article").length, row(2), gone(card(2)).length];
  result.near = card(2).querySelector("svg").getAttribute("viewBox").split(" ").every(isFinite);
"""


@needs_chromium
def test_what_was_removed_is_brought_back_in_a_browser(tmp_path: Path) -> None:
    workspace = corrected_case(tmp_path / "case", as_read(), SAID)
    result = probed(workspace, tmp_path / "browser", BACK, SAVE)
    line = ",line-through"
    assert result["start"] == ["13 12 11 21 22 43 42 41 32 33", ["24" + line, "31" + line], 0]
    assert result["names"] == [
        "24 bring back: removed, upper left first premolar",
        "? bring back: removed, nothing is read there any more",
        "31 bring back: removed, lower left central incisor",
    ]
    assert result["pointed"] == ["24"], "the picture shows which one the button is about"
    assert result["upper"] == ["upper row, 6 of 6: 24, upper left first premolar", "Brought back."]
    assert result["nothing"] == [1, 1] and result["undone"] == 2
    assert result["end"] == "13 12 11 21 22 24 43 42 41 32 32 33", "brought back and numbered"
    assert result["again"] == [11, "32 bring back"], "removed again"
    assert result["left"] == ["2_<left>.jpgno teeth were found in it", 2]
    assert result["leftAfter"] == [0, "Use it"]
    assert result["used"] == [3, ["22"], 1] and result["near"] is True

    said = read_corrections(case.write(workspace / "teeth.yaml", result["yaml"]))
    first, last = said.photographs.values()
    assert [change.tooth for change in first.crowns] == [24, 32]
    assert [change.at for change in last.crowns] == [case.original(0, "upper")]
    after = apply_corrections(as_read(), case.views(), said).views
    assert _row(after[0]) == [13, 12, 11, 21, 22, 24, 43, 42, 41, 32, 32, 33]
    assert [_row(after[2]), after[2].set_aside] == [[22], ""]
