"""The viewer page in hand: the focus, how finely it moves, keys, small windows, paper."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from tests.browser import needs_chromium, run_in
from tests.stages.viewer_case import HEAD, ball_page

STEADY = """(async () => {
  await page.ready;
  const at = () => document.activeElement.id || document.activeElement.tagName;
  const result = {};
  const closed = (open, close) => {
    open();
    const inside = at();
    close();
    return [inside, at()];
  };
  const escape = () => press("Escape", document.activeElement);
  const key = (name) => () => press(name, document.activeElement);
  canvas.focus();
  result.help = closed(key("h"), escape);
  result.tools = closed(key("t"), escape);
  result.done = closed(key("t"), () => $("done").click());
  result.onScene = closed(() => { press("t", canvas); press("m"); press("Escape"); }, escape);
  $("more").focus();
  result.button = closed(() => $("more").click(), escape);
  press("t", canvas);
  $("jaw").focus();
  result.within = closed(() => $("ask").click(), () => $("close").click());
  escape();
  result.end = at();
  press("n");
  $("more").focus();
  const box = canvas.getBoundingClientRect();
  click(box.width / 2, box.height / 2);
  const lifted = new Event("touchend", { cancelable: true });
  canvas.dispatchEvent(lifted);
  result.tapped = [document.activeElement.ariaLabel, lifted.defaultPrevented];
  click(5, 5);
  result.touched = at();
  tell({ ...result, errors: document.documentElement.dataset.errors ?? "" });
})();"""


@needs_chromium
def test_the_focus_goes_back_where_it_was(tmp_path: Path) -> None:
    found, log = run_in(ball_page(), HEAD + STEADY, tmp_path, (640, 480), address="#still")
    assert (found["errors"], log) == ("", [])
    assert found["help"] == ["close", "canvas"]
    assert found["tools"] == found["done"] == ["done", "canvas"]
    assert found["onScene"] == ["canvas", "canvas"]
    assert found["button"] == ["done", "more"]
    assert found["within"] == ["close", "jaw"]
    assert found["end"] == "more"
    assert found["tapped"] == ["Note 1", True], "a browser's mouse would press the scene after it"
    assert found["touched"] == "canvas"


TREMBLE = """(async () => {
  await page.ready;
  press("m");
  const { width, height } = canvas.getBoundingClientRect();
  const tapped = (pointerType, by) => {
    page.state.pending.length = 0;
    const at = [width / 2, height * .4];
    for (const [type, x] of [["pointerdown", at[0]], ["pointermove", at[0] + by],
      ["pointerup", at[0] + by]]) {
      canvas.dispatchEvent(new PointerEvent(type,
        { pointerId: 5, pointerType, clientX: x, clientY: at[1], button: 0, buttons: 1 }));
    }
    return page.state.pending.length;
  };
  tell({ mouse: [3, 8].map((by) => tapped("mouse", by)),
    finger: [3, 8, 14].map((by) => tapped("touch", by)),
    errors: document.documentElement.dataset.errors ?? "" });
})();"""


@needs_chromium
def test_a_finger_may_tremble_more_than_a_mouse(tmp_path: Path) -> None:
    found, log = run_in(ball_page(), HEAD + TREMBLE, tmp_path, (640, 480), address="#still")
    assert (found["errors"], log) == ("", [])
    assert found["mouse"] == [1, 0]
    assert found["finger"] == [1, 1, 0]


SMALL = """(async () => {
  await page.ready;
  const inside = (element) => {
    const { left, right, top, bottom } = element.getBoundingClientRect();
    return Math.min(left, top, innerWidth - right, innerHeight - bottom) > -1;
  };
  const buttons = [...$("bar").querySelectorAll("button, input")];
  const reached = buttons.filter((button) => {
    button.focus();
    // without a window in front, Firefox tells nobody of the focus, and WebKit gives a frame none
    if (!document.hasFocus()) button.scrollIntoView({ block: "nearest", inline: "nearest" });
    return inside(button);
  });
  const bar = $("bar").getBoundingClientRect();
  press("h");
  const help = [$("help").scrollTop, inside(document.activeElement), inside($("help-title"))];
  tell({ missed: buttons.length - reached.length, help, share: bar.height / innerHeight,
    count: buttons.length, errors: document.documentElement.dataset.errors ?? "" });
})();"""


@needs_chromium
@pytest.mark.parametrize("size", [(320, 640), (320, 200), (844, 390)])
def test_small_windows_have_room_for_everything(tmp_path: Path, size: tuple[int, int]) -> None:
    """Phones; and a window of 1280 by 800 that is enlarged four times."""
    found, log = run_in(
        ball_page(), HEAD + SMALL, tmp_path, size, address="#still", framed=True, coarse=True
    )
    assert (found["errors"], log) == ("", [])
    assert found["count"] > 8 and found["missed"] == 0
    assert found["share"] < 0.5, "the scene is seen as well"
    assert found["help"] == [0, True, True], "help begins at its beginning"


CHOSEN = """(async () => {
  await page.ready;
  const pictures = [...document.querySelectorAll("#views img")];
  await Promise.all(pictures.map((picture) => picture.decode()));
  const [row, button] = [$("views"), document.querySelector("#views [aria-pressed=true]")]
    .map((element) => element.getBoundingClientRect());
  tell({ place: [row.left, button.left, button.right, row.right], count: pictures.length,
    narrow: row.width < $("views").scrollWidth });
})();"""


@needs_chromium
def test_the_view_that_a_phone_begins_with_is_in_sight_among_many(tmp_path: Path) -> None:
    found, log = run_in(ball_page(4), HEAD + CHOSEN, tmp_path, (320, 640), "#view=9", True)
    assert log == []
    assert (found["count"], found["narrow"]) == (12, True)
    assert found["place"] == sorted(found["place"])


PAPER = """(async () => {
  const frames = [];
  requestAnimationFrame = (frame) => frames.push(frame);  // on a busy machine none may come
  await page.ready;
  press("u");
  press("t");
  press("p");
  frames.forEach((frame) => frame(performance.now()));  // no more on its way to the printer
  const box = (element) => element.getBoundingClientRect();
  const places = () => [...document.querySelectorAll("#drawing .number, #photo")].map((element) => {
    const [{ x, y, width, height }, whole] = [box(element), box(canvas)];
    return [(x + width / 2 - whole.x) / whole.width, (y + height / 2 - whole.y) / whole.height];
  });
  const shape = () => box(canvas).width / box(canvas).height;
  const result = { screen: [places(), shape()] };
  const rules = [...document.styleSheets].flatMap((sheet) => [...sheet.cssRules]);
  rules.find(({ media }) => media?.mediaText === "print").media.mediaText = "all";
  const under = () => box($("tools")).top - box(canvas).bottom;
  result.sheets = [];
  for (const [width, height] of [[740, 980], [980, 740]]) {
    await resized(width, height);
    result.sheets.push([places(), shape(), under() >= 0, box(canvas).bottom <= height]);
  }
  result.shown = ["bar", "distance", "copy", "measured"]
    .filter((id) => $(id).getClientRects().length);
  result.ink = getComputedStyle($("measured")).color;
  tell({ ...result, errors: document.documentElement.dataset.errors ?? "" });
})();"""


@needs_chromium
@pytest.mark.parametrize("size", [(640, 480), (390, 780)])
def test_on_paper_numbers_stand_on_their_teeth(tmp_path: Path, size: tuple[int, int]) -> None:
    found, log = run_in(ball_page(), HEAD + PAPER, tmp_path, size, address="#still", framed=True)
    assert (found["errors"], log) == ("", [])
    places, shape = found["screen"]
    assert len(places) == 3
    for sheet, its_shape, under, whole in found["sheets"]:
        assert np.allclose(sheet, places, atol=0.01)
        assert its_shape == pytest.approx(shape, rel=0.01), "the teeth keep their proportions"
        assert under and whole
    assert found["shown"] == ["measured"]
    assert found["ink"] == "rgb(0, 0, 0)"


PACE = """(async () => {
  await page.ready;
  let now = performance.now();
  const frame = (gap) => {
    now += gap;
    const callbacks = waiting;
    waiting = [];
    callbacks.forEach((callback) => callback(now));
    return canvas.width;
  };
  const pointer = (type, x) => canvas.dispatchEvent(
    new PointerEvent(type, { pointerId: 5, clientX: x, clientY: 100, button: 0, buttons: 1 }));
  const drag = (gaps) => {
    pointer("pointerdown", 100);
    const widths = gaps.map((gap, k) => {
      pointer("pointermove", 120 + 20 * k);
      return frame(gap);
    });
    pointer("pointerup", 0);
    frame(16);
    return widths;
  };
  frame(16);
  const result = { whole: canvas.width };
  result.rests = [drag([5000, 16, 16]), drag([3000, 16, 16]), drag([16, 2000, 16, 2000, 16])];
  result.slow = drag([3000, 1500, 1500, 1500, 1500, 1500, 1500, 1500]);
  result.end = canvas.width;
  tell({ ...result, errors: document.documentElement.dataset.errors ?? "" });
})();"""


@needs_chromium
def test_the_slowest_devices_move_at_a_lower_resolution(tmp_path: Path) -> None:
    frames = "let waiting = []; requestAnimationFrame = (callback) => waiting.push(callback);"
    page = ball_page().replace("<head>", f"<head><script>{frames}</script>", 1)
    found, log = run_in(page, HEAD + PACE, tmp_path, (640, 480), address="#still")
    assert (found["errors"], log) == ("", [])
    whole = found["whole"]
    assert all(width == whole for widths in found["rests"] for width in widths), "these are rests"
    assert found["slow"][0] == whole
    assert found["slow"] == sorted(found["slow"], reverse=True)
    assert found["slow"][-1] < 0.45 * whole
    assert found["end"] == whole, "at rest it is whole again"


LOST = """(async () => {
  await page.ready;
  const wait = (ms) => new Promise((done) => setTimeout(done, ms));
  const before = colours();
  const card = canvas.getContext("webgl2").getExtension("WEBGL_lose_context");
  const lose = async (away) => {
    card.loseContext();
    await wait(away);
    const said = [$("message").hidden, $("reason").textContent];
    card.restoreContext();
    await wait(500);
    return [...said, $("message").hidden, colours().join() === before.join()];
  };
  const result = { soon: await lose(500), late: await lose(5000) };
  await wait(5000);
  result.end = $("message").hidden;
  tell({ ...result, errors: document.documentElement.dataset.errors ?? "" });
})();"""


@needs_chromium
def test_a_graphics_context_that_stays_away_is_said(tmp_path: Path) -> None:
    found, log = run_in(ball_page(), HEAD + LOST, tmp_path, (640, 480), address="#still")
    assert found["errors"] == ""
    assert all(re.search("context.(was.)?lost", line, re.IGNORECASE) for line in log)
    assert found["soon"] == [True, "", True, True], "what comes back at once is nobody's concern"
    hidden, reason, *after = found["late"]
    assert hidden is False and "load the page again" in reason
    assert after == [True, True] and found["end"] is True, "it came back after all"


BRACKETS = """(async () => {
  await page.ready;
  press("x");
  const moved = (key, more) => {
    const before = page.state.at;
    press(key, document.body, more);
    return Math.round(100 * (page.state.at - before));
  };
  tell({
    plain: [moved("["), moved("]")],
    mac: [moved("[", { altKey: true, code: "Digit5" }), moved("]", { altKey: true })],
    windows: [moved("]", { altKey: true, ctrlKey: true, code: "Digit9" })],
    places: [moved("ü", { code: "BracketLeft" }), moved("ъ", { code: "BracketRight" })],
    zooms: moved("+", { code: "BracketRight" }),
    browser: [moved("[", { metaKey: true, code: "BracketLeft" }),
      moved("[", { ctrlKey: true, code: "BracketLeft" }),
      moved("ü", { altKey: true, code: "BracketLeft" })],
    errors: document.documentElement.dataset.errors ?? "",
  });
})();"""


@needs_chromium
def test_the_section_moves_on_all_keyboards(tmp_path: Path) -> None:
    found, log = run_in(ball_page(), HEAD + BRACKETS, tmp_path, (640, 480), address="#still")
    assert (found["errors"], log) == ("", [])
    assert found["plain"] == found["mac"] == found["places"] == [-5, 5]
    assert found["windows"] == [5]
    assert found["zooms"] == 0, "what a layout has there goes first"
    assert found["browser"] == [0, 0, 0], "shortcuts of the browser stay"


FIELDS = """(async () => {
  await page.ready;
  press("t");
  const box = $("support"), slider = $("opacity");
  const shown = (on) => { press("u", on); return page.state.numbers; };
  box.click();
  box.focus();
  const result = { ticked: shown(box), slid: shown(slider) };
  press("1", slider);
  await page.ready;
  result.view = $("label").textContent;
  press("ArrowLeft", slider);
  result.stays = $("label").textContent;
  press("n");
  press("Enter", canvas);
  result.note = shown(document.querySelector("#marks input"));
  press("]");
  result.cut = [page.state.axis, page.state.at, $("told").textContent];
  tell(result);
})();"""


@needs_chromium
def test_keys_work_beside_boxes_and_sliders_and_not_in_text(tmp_path: Path) -> None:
    """A box that was ticked, or the slider, keeps the focus: keys did nothing until a click."""
    result, log = run_in(ball_page(), HEAD + FIELDS, tmp_path, (640, 480), coarse=True)
    assert log == []
    assert result == {
        "ticked": "fdi", "slid": "universal", "view": "View 1", "stays": "View 1",
        "note": "universal", "cut": ["off", 0, "Choose a section first (X)."],
    }  # fmt: skip
