"""How one works on `check.html`: where the focus is, and what is there when it is opened again."""

from __future__ import annotations

import os
from pathlib import Path

from pipeline.studies.report import run_report
from tests import teeth_case as case
from tests.browser import needs_chromium, run_in
from tests.studies.check_case import BEGIN, SAVE, data_of, doubtful_case, probed

FOCUS = """
  const at = () => {
    const active = document.activeElement;
    const where = active.closest("article")?.getAttribute("aria-label") ?? active.parentElement.id;
    const what = active === document.body ? "nothing" : active.ariaLabel ?? active.textContent;
    return `${what} in ${where}`;
  };
  const hit = (button) => { button.focus(); button.click(); };
  const head = (k, text) => all(".head button", card(k))
    .find((entry) => entry.textContent === text);
  hit(chip(0, "12")); press("Escape");
  result.escape = at();
  hit(chip(0, "12")); hit(document.querySelector("#panel .close"));
  result.close = at();
  hit(chip(0, "12"));
  document.querySelector("#panel input").focus(); press("Escape");
  result.field = at();
  hit(chip(1, "21"));
  head(0, "Mirror image").focus(); head(0, "Mirror image").click();
  result.mirror = at();
  const kind = card(0).querySelector("select");
  kind.focus(); kind.value = "left"; kind.dispatchEvent(new Event("change"));
  result.kind = at().split(" in ")[1];
  hit(document.getElementById("undo")); hit(document.getElementById("undo"));
  result.undo = at();
  head(1, "All numbers are right").focus(); hit(head(1, "All numbers are right"));
  result.sure = at();
  hit(head(0, "Leave out"));
  result.left = [at(), all("article").length];
  document.activeElement.click();
  result.back = [at(), all("article").length];
  hit(all("#aside button")[0]);
  result.used = [at(), all("article").length];
  hit(chip(0, "12")); press("z", { ctrlKey: true });
  result.keys = at();
  document.getElementById("undo").focus();
  for (let k = 0; k < 9; k++) document.activeElement.click();
  result.all = [at(), all("article").length];
"""


@needs_chromium
def test_the_focus_stays_where_one_works(tmp_path: Path) -> None:
    result = probed(doubtful_case(tmp_path / "case"), tmp_path / "browser", FOCUS)
    chip = "upper row, 2 of 6: 12, upper right lateral incisor in 0_right.jpg"
    assert [result[how] for how in ("escape", "close", "field")] == [chip] * 3
    assert result["mirror"] == "Mirror image in 0_right.jpg"
    assert result["kind"] == "0_right.jpg"
    assert result["undo"] == result["sure"] == "Undo in "
    assert result["left"] == ["Undo in ", 1], "what was pressed is gone: what brings it back"
    assert result["back"] == ["Undo in ", 2]
    assert result["used"] == ["Undo in ", 3]
    assert result["keys"].startswith("upper row, 4 of 6: 21"), "where what was undone stands"
    assert result["all"] == ["Undo in ", 2]


PHONE = """
  const box = (query) => document.querySelector(query).getBoundingClientRect();
  const tops = [];
  const tap = (k, number) => {
    const before = card(k).getBoundingClientRect().top;
    const mark = all(".crown", card(k)).find((entry) => entry.textContent.startsWith(number));
    mark.dispatchEvent(new MouseEvent("click", { bubbles: true }));
    tops.push(card(k).getBoundingClientRect().top - before);
  };
  const settled = () => new Promise((done) => setTimeout(done, 200));
  result.first = box("#panel").height > 100;
  card(1).scrollIntoView({ block: "start" });
  tap(1, "21");
  tap(1, "11");
  document.querySelector("#panel .close").click();
  card(1).scrollIntoView({ block: "end" });
  tap(1, "41");
  result.low = box("#panel").top - box(".crown.chosen polygon").bottom;
  press("1"); press("9");
  await settled();
  result.said = document.getElementById("said").textContent;
  result.dock = box("footer.dock").top - box("#panel").bottom;
  result.lines = box("#said").width > 300;
  result.tops = tops.map(Math.round);
"""
LONG = """
  await resized(320, 560);
  document.querySelector("#next summary").click();
  await settled();
  const close = box("#next > button");
  result.next = [box("#next").top >= 0, box("#panel").top >= -1, close.top >= 0];
  result.beside = [...document.querySelector("#next > b").getClientRects()]
    .every((line) => line.right <= close.left || line.top >= close.bottom);
  tell(result);
})();
"""


@needs_chromium
def test_on_a_phone_the_chosen_crown_stays_in_sight(tmp_path: Path) -> None:
    workspace = doubtful_case(tmp_path / "case")
    run_report(workspace)
    script = BEGIN.removeprefix("<script>") + PHONE + SAVE + LONG
    folder = tmp_path / "browser"
    folder.mkdir()
    page = (workspace / "check.html").read_text()
    result, log = run_in(page, script, folder, (390, 780), framed=True)
    assert log == []
    assert result["first"], "the list of what to look at stands above the photographs until then"
    assert result["tops"][:2] == [0, 0], "what is touched stays under the finger"
    assert result["low"] > 0, "the panel covers no crown that is chosen"
    assert "is no FDI number" in result["said"]
    assert abs(result["dock"]) <= 1 and result["lines"], "the panel ends where the buttons begin"
    assert result["next"] == [True] * 3, "what is to be done now can be read, and closed"
    assert result["beside"], "its first line is not under the button"


KEYS = """
  const free = () => document.querySelector("footer.dock").getBoundingClientRect().top
    - document.activeElement.getBoundingClientRect().bottom;
  await wait(200);
  result.free = all(".chips", document).flatMap((row) => {
    row.querySelector("button").scrollIntoView({ block: "end" });
    row.querySelector("button").focus();
    return free();
  });
  all(".chip", card(1))[0].click();
  scrollTo(0, 0);
  press("ArrowDown");
  result.walked = [document.activeElement.getAttribute("aria-label"), free()];
  const rules = [...document.styleSheets].flatMap((sheet) => [...sheet.cssRules]);
  rules.filter(({ media }) => media?.mediaText === "print")
    .forEach(({ media }) => { media.mediaText = "all"; });
  result.paper = [getComputedStyle(card(0)).breakInside,
    all("button", card(0)).filter((button) => button.getClientRects().length).length];
  tell(result);
})();
"""


@needs_chromium
def test_the_focus_is_not_behind_the_buttons(tmp_path: Path) -> None:
    workspace = doubtful_case(tmp_path / "case")
    run_report(workspace)
    folder = tmp_path / "browser"
    folder.mkdir()
    page = (workspace / "check.html").read_text()
    script = BEGIN.removeprefix("<script>") + KEYS
    result, log = run_in(page, script, folder, (1280, 520), framed=True)
    assert log == []
    assert len(result["free"]) == 4 and min(result["free"]) >= 0
    assert result["paper"] == ["avoid", 12], "a photograph, its name and its numbers on one sheet"
    assert result["walked"][0].startswith("lower row, 1 of 6") and result["walked"][1] >= 0


#: The page is opened five times; what it told before is kept beside what it remembers itself.
REOPENED = """
  Object.assign(result, JSON.parse(localStorage.told ?? '{"opened": []}'));
  BeforeUnloadEvent.prototype.preventDefault = () => {};
  const back = document.getElementById("back");
  result.opened.push([back.hidden ? "" : back.textContent.replace(/of .* are/, "of TODAY are"),
    check.yaml(), document.getElementById("save").textContent]);
  const k = result.opened.length;
  if (k === 1) {
    chip(0, "12").click();
    deed("Split").click();
    press("Enter");
    press("1"); press("2");
    all(".head button", card(1)).find((entry) => entry.textContent === "Mirror image").click();
    all("#aside button")[0].click();
  }
  if (k === 2) {
    chip(0, "?").click();
    deed("Split").click();
    press("Enter");
    const ids = check.photos.flatMap(({ crowns }) => crowns.map(({ id }) => id));
    result.own = ids.length === new Set(ids).size;
    press("z", { ctrlKey: true });
SAVING
    result.saved = back.textContent.replace(/of .* are/, "of TODAY are");
  }
  if (k === 3) {
    back.querySelector("button").click();
    result.discarded = [check.yaml(), back.hidden, document.activeElement.id];
    document.getElementById("undo").click();
    result.undiscarded = check.yaml();
  }
  if (k === 4) {
    const key = Object.keys(localStorage).find((name) => name.startsWith("dentalsplat check"));
    const kept = JSON.parse(localStorage[key]);
    localStorage["dentalsplat check 1 elsewhere"] = JSON.stringify({ on: 1 });
    localStorage[key] = JSON.stringify({ ...kept, of: "another run's data" });
  }
  if (k === 5) result.elsewhere = "dentalsplat check 1 elsewhere" in localStorage;
  localStorage.told = JSON.stringify(result);
  if (k < 5) location.reload();
"""


@needs_chromium
def test_changes_are_there_when_the_page_is_opened_again(tmp_path: Path) -> None:
    workspace = doubtful_case(tmp_path / "case")
    result = probed(workspace, tmp_path / "browser", REOPENED.replace("SAVING", SAVE))
    opened = result["opened"]
    changed = result["yaml"]
    bare, button = "# Written", "Save teeth.yaml"
    assert opened[0][0] == "" and opened[0][1].startswith(bare) and opened[0][2] == button
    assert all(word in changed for word in ("split: ", "tooth: 12", "mirrored: true", "use: true"))
    unsaved = "Your changes of TODAY are back, not saved in teeth.yaml yet. Discard"
    assert opened[1] == [unsaved, changed, button]
    assert result["own"], "each crown has an id of its own"
    assert result["saved"] == "Your changes of TODAY are back. Discard"
    assert opened[2] == [result["saved"], changed, f"{button} again"]
    assert result["discarded"] == [opened[0][1], True, "undo"]
    assert result["undiscarded"] == changed
    assert opened[3][1] == changed
    assert opened[4] == ["", opened[0][1], button], "another run's page begins clean"
    assert result["elsewhere"] is False, "nothing is kept for ever"


@needs_chromium
def test_a_browser_that_lets_nothing_be_copied_is_believed(tmp_path: Path) -> None:
    copying = """
  const copy = (clipboard) => {
    Object.defineProperty(navigator, "clipboard", { value: clipboard, configurable: true });
    const button = all("#next li button")[0];
    button.click();
    return wait().then(() => [button.textContent, `${getSelection()}`.slice(0, 12)]);
  };
  result.copies = [
    await copy({ writeText: () => Promise.reject(new DOMException("no", "NotAllowedError")) }),
    await copy(undefined),
    await copy({ writeText: async (text) => { result.copied = text; } }),
  ];
"""
    result = probed(doubtful_case(tmp_path / "case"), tmp_path / "browser", SAVE, copying)
    refused = ["Not allowed: copy what is marked", "pipeline run"]
    assert result["copies"][:2] == [refused, refused]
    assert result["copies"][2][0] == "Copied"
    assert result["copied"].startswith("pipeline run -w ")


@needs_chromium
def test_a_browser_that_keeps_nothing_is_no_error(tmp_path: Path) -> None:
    refused = """
  Object.defineProperty(window, "localStorage",
    { get() { throw new DOMException("no", "SecurityError"); } });
  chip(0, "12").click();
  press("2"); press("2");
  result.yaml = check.yaml();
"""
    result = probed(doubtful_case(tmp_path / "case"), tmp_path / "browser", refused)
    assert "tooth: 22" in result["yaml"]


@needs_chromium
def test_what_to_do_next_is_said_in_a_folder_whose_name_is_no_text(tmp_path: Path) -> None:
    steps = """
  result.steps = all("#next li").map((entry) => entry.textContent);
"""
    workspace = doubtful_case(tmp_path / os.fsdecode(b"caf\xe9"))
    result = probed(workspace, tmp_path / "browser", SAVE, steps)
    assert result["steps"][0].startswith("Put it into the workspace folder, beside this page.")
    assert "pipeline run -w WORKSPACE" in result["steps"][1]


def test_what_is_remembered_counts_for_the_pages_own_data(tmp_path: Path) -> None:
    workspace = doubtful_case(tmp_path / "case")

    def digest() -> str:
        run_report(workspace)
        return str(data_of((workspace / "check.html").read_text())["digest"])

    first = digest()
    assert digest() == first
    case.write(workspace / "teeth.yaml", "photographs: {0_right.jpg: {kind: right}}")
    assert digest() != first, "what a run knows is not changed again"
