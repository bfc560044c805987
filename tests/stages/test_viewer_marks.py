"""Marks on the viewer page: a point chosen twice, their order in a link, what is drawn when."""

from __future__ import annotations

from pathlib import Path

from tests.browser import needs_chromium, run_in
from tests.stages.viewer_case import HEAD, ball_page

TWICE = """(async () => {
  await page.ready;
  const texts = () => [...document.querySelectorAll("#marks li > span")].map((s) => s.textContent);
  const box = canvas.getBoundingClientRect();
  const at = (x, y) => click(box.width * x, box.height * y);
  const result = {};
  press("g");
  at(.5, .4); at(.5, .4);
  result.told = [$("told").textContent, page.state.pending.length];
  at(.55, .4); at(.5, .4); at(.55, .45);
  result.angle = texts();
  press("Escape");
  const place = "0,0,-1,0,0,1,.01,.01,3";
  location.hash = `a=${place};${place};.2,0,-1,0,0,1,.01,.01,3`;
  await new Promise((done) => setTimeout(done, 300));
  result.link = texts();
  tell({ ...result, errors: document.documentElement.dataset.errors ?? "" });
})();"""


@needs_chromium
def test_the_same_point_twice_is_no_measurement(tmp_path: Path) -> None:
    found, log = run_in(
        ball_page(), HEAD + TWICE, tmp_path, (640, 480), address="#still", coarse=True
    )
    assert (found["errors"], log) == ("", [])
    assert found["told"] == ["This point is chosen already; choose another one.", 1]
    assert len(found["angle"]) == 1 and "± 180°" not in found["angle"][0]
    assert found["link"] == ["Angle 90° ± 180°"], "there is no angle at a corner without a side"


ORDER = """(async () => {
  await page.ready;
  const wait = () => new Promise((done) => setTimeout(done, 300));
  const place = (x) => `${x},0,-1,0,0,1,.01,.01,3`;
  const given = [["n", place(0)], ["text", "first"], ["d", `${place(0)};${place(.1)}`],
    ["n", "spoilt"], ["text", "nowhere"], ["constructor", place(0)], ["n", place(.2)],
    ["text", "last"], ["a", `${place(0)};${place(.1)};${place(.2)}`]];
  location.hash = new URLSearchParams(given).toString();
  await wait();
  const kinds = () => page.state.marks.map(({ kind, text }) => text ?? kind).join();
  const result = { read: kinds() };
  press("l");
  await wait();
  const link = location.hash;
  location.hash = "camera=none";
  location.hash = link;
  await wait();
  result.again = kinds();
  tell({ ...result, errors: document.documentElement.dataset.errors ?? "" });
})();"""


@needs_chromium
def test_marks_keep_their_numbers_in_a_link(tmp_path: Path) -> None:
    found, log = run_in(
        ball_page(), HEAD + ORDER, tmp_path, (640, 480), address="#still", coarse=True
    )
    assert (found["errors"], log) == ("", [])
    assert found["read"] == found["again"] == "first,distance,last,angle"


DRAWN = """(async () => {
  await page.ready;
  const crosshair = () => {
    waiting.splice(0).forEach((callback) => callback(performance.now()));
    return document.querySelectorAll("#drawing path").length > 0;
  };
  const result = { numbers: [] };
  press("u");
  for (const key of ["", "x", "x", "x", "x"]) {
    if (key) press(key);
    page.render();
    result.numbers.push(`${page.state.axis}: ${numbers().join(" ")}`);
  }
  press("m");
  result.crosshair = [crosshair()];
  for (const element of [$("more"), canvas]) {
    element.focus();
    result.crosshair.push(crosshair());
  }
  tell({ ...result, errors: document.documentElement.dataset.errors ?? "" });
})();"""


@needs_chromium
def test_what_is_drawn_is_of_what_is_there(tmp_path: Path) -> None:
    frames = "const waiting = []; requestAnimationFrame = (callback) => waiting.push(callback);"
    page = ball_page().replace("<head>", f"<head><script>{frames}</script>", 1)
    found, log = run_in(page, HEAD + DRAWN, tmp_path, (640, 480), address="#still", coarse=True)
    assert (found["errors"], log) == ("", [])
    assert found["numbers"] == [
        "off: 11 41", "height: 41", "depth: ", "across: 11 41", "off: 11 41",
    ], "no numbers of teeth that are cut away"  # fmt: skip
    assert found["crosshair"] == [True, False, True], "it is there while the keys are the scene's"
