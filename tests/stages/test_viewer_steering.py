"""The viewer page in hand: where the focus goes, how finely it moves, keys, a lost context."""

from __future__ import annotations

from pathlib import Path

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
