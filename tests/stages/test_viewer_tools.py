"""The tools of the viewer page in a real browser: measuring, overlays, links, keys, names."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest

from stages.export.viewer import page as viewer_page
from stages.splatting.rendering import render
from tests.browser import ENGINE, NARROWEST, needs_chromium, run_in
from tests.stages import export_scene as scene
from tests.stages.viewer_case import HEAD, ball_page, solid_ball

PIXELS = ((70.5, 50.5), (100.5, 66.5), (82.5, 90.5))
UNTRUE = "<img src=x onerror=document.documentElement.dataset.errors='run'>"


def expected_place(pixel: tuple[float, float]) -> np.ndarray:
    """The place under a pixel as our rasterizer's depth has it."""
    camera = scene.ball_cameras()[1]
    view = render(solid_ball(), camera)
    return camera.unproject(view.depth)[int(pixel[1]), int(pixel[0])]


MEASURE = """(async () => {
  await page.ready;
  const result = {};
  page.setCamera(CAMERA);
  page.render();
  result.places = PIXELS.map(([x, y]) => page.pick(x, y)?.point);
  result.nothing = page.pick(2, 2);
  const box = canvas.getBoundingClientRect();
  const scale = box.width / canvas.width;
  const at = (k) => [PIXELS[k][0] * scale, PIXELS[k][1] * scale];
  press("m");
  result.pressed = $("distance").getAttribute("aria-pressed");
  click(...at(0));
  result.first = said();
  click(...at(1));
  result.distance = said();
  press("g");
  [0, 1, 2].forEach((k) => click(...at(k)));
  result.angle = said();
  click(1, 1);
  result.beside = said();
  result.told = !$("told").hidden && $("told").textContent;
  press("Escape");
  result.tool = page.state.tool;
  result.marks = [...document.querySelectorAll("#marks li > span")].map((s) => s.textContent);
  result.table = [...document.querySelectorAll("#measured tr")].map((r) => r.textContent);
  press("m");
  canvas.focus();
  press("Enter", canvas);
  result.crosshair = page.state.pending.length;
  press("Escape");
  document.querySelector("#marks button").click();
  result.left = page.state.marks.length;
  const estimate = document.querySelector("#measured [data-measure=overbite]");
  estimate.click();
  page.render();
  result.estimate = [...document.querySelectorAll("#drawing .said")].at(-1).textContent;
  estimate.click();
  const overjet = document.querySelector("#measured [data-measure=overjet]");
  overjet.click();
  page.render();
  result.behind = [...document.querySelectorAll("#drawing .said")].at(-1).textContent;
  overjet.click();

  const whole = colours();
  press("u");
  page.render();
  result.numbers = numbers();
  press("u");
  page.render();
  result.universal = numbers();
  press("j");
  page.render();
  result.upper = numbers();
  const upper = colours();
  result.jaw = page.state.jaw;
  result.upperIsLess = upper[0] + upper[1] + upper[2] < 0.75 * (whole[0] + whole[1] + whole[2]);
  press("j"); press("j");
  press("x");
  for (let k = 0; k < 8; k++) press("[");
  page.render();
  result.cutIsLess = colours()[1] < 0.8 * whole[1];
  result.at = page.state.at;
  press("x"); press("x"); press("x");
  page.render();
  result.wholeAgain = colours().every((v, k) => v === whole[k]);
  press("v");
  result.legend = !$("legend").hidden;
  result.frontTint = colours().map((v, k) => v / whole[k]);
  const behind = CAMERA_BEHIND;
  page.setCamera(...behind);
  press("v");
  const back = colours();
  press("v");
  result.backTint = colours().map((v, k) => v / back[k]);
  press("v");
  page.setCamera(CAMERA);
  press("o");
  page.render();
  result.meshGrey = Array.from(page.pixels().slice(4 * (60 * 160 + 80), 4 * (60 * 160 + 80) + 3));
  press("o");
  tell({ ...result, errors: document.documentElement.dataset.errors ?? "" });
})();"""


@needs_chromium
def test_measuring_and_overlays(tmp_path: Path) -> None:
    camera = scene.ball_cameras()[1]
    behind = camera.cam_from_world @ np.diag([-1.0, 1, -1, 1])

    def call(pose: np.ndarray) -> str:
        lens = f"{camera.fx},{camera.fy},{camera.cx},{camera.cy},{camera.width},{camera.height}"
        return f"{json.dumps(pose.ravel().tolist())},{lens}"

    script = HEAD + MEASURE.replace("CAMERA_BEHIND", f"[{call(behind)}]").replace(
        "CAMERA", call(camera.cam_from_world)
    ).replace("PIXELS", json.dumps(PIXELS))
    found, log = run_in(ball_page(), script, tmp_path, (640, 480))
    assert (found["errors"], log) == ("", [])
    places = [expected_place(pixel) for pixel in PIXELS]
    np.testing.assert_allclose(found["places"], places, atol=0.01)
    assert found["nothing"] is None
    assert found["pressed"] == "true"
    assert found["first"].startswith("Point 1 near tooth 11")

    value, off = map(float, re.match(r"([\d.]+) ± ([\d.]+) mm", found["distance"]).groups())
    assert value == pytest.approx(np.linalg.norm(places[1] - places[0]), abs=0.03)
    assert 0.01 <= off < 0.5, "2 % of the scale, pointing, and depth"
    a, b = places[0] - places[1], places[2] - places[1]
    angle = np.degrees(np.arccos(a @ b / np.linalg.norm(a) / np.linalg.norm(b)))
    assert float(found["angle"].split("°")[0]) == pytest.approx(angle, abs=2)
    assert found["beside"] == found["told"] == "There is no surface at this point."
    assert found["tool"] == "turn"
    assert [text.split()[0] for text in found["marks"]] == ["Distance", "Angle"]
    assert found["table"][0] == "Overjet-2.5 ± 0.4 mmsure"
    assert found["table"][-1] == "Edge to edge0.0 ± 0.4 mmsure", "no minus before nothing"
    assert found["behind"] == "Overjet -2.5 ± 0.4 mm", "lower teeth in front"
    assert found["table"][1] == "Overbitenot visible: the upper teeth cover the edges"
    assert found["table"][2] == (
        "Overbite3.1 ± 2.2 mmestimated, 38 ± 17 % of the crowns covered; unsure"
    )
    assert found["estimate"] == "Overbite, estimated: 3.1 ± 2.2 mm"
    assert (found["crosshair"], found["left"]) == (1, 1)

    assert found["numbers"] == ["11", "41"]
    assert found["universal"] == ["8", "25"]
    assert (found["jaw"], found["upper"]) == ("upper", ["8"])
    assert found["upperIsLess"] and found["cutIsLess"] and found["wholeAgain"]
    assert found["at"] == pytest.approx(-0.4)
    assert found["legend"]
    assert np.abs(np.array(found["frontTint"]) - 1).max() < 0.1, "the front was photographed"
    red, green, blue = found["backTint"]
    assert green < 0.6 and min(red, blue) > 1.1 * green, "the back was not: it is magenta"
    assert np.ptp(found["meshGrey"]) < 60 and min(found["meshGrey"]) > 60


LINKS = """(async () => {
  await page.ready;
  const result = {};
  const wait = (ms) => new Promise((done) => setTimeout(done, ms));
  const go = async (hash) => { location.hash = hash; await wait(60); page.render(); };
  result.opened = [page.state.jaw, page.state.numbers, page.state.marks.length];
  press("m");
  const [x, y] = [canvas.clientWidth / 2, 0.4 * canvas.clientHeight];
  click(x - 20, y);
  click(x + 30, y + 10);
  press("n");
  click(x, y + 20);
  const field = document.querySelector("#marks input");
  result.focus = document.activeElement === field;
  field.value = UNTRUE;
  field.dispatchEvent(new Event("change"));
  result.stays = [field.isConnected, document.activeElement === field, field.value === UNTRUE];
  press("u"); press("v"); press("x"); press("]");
  for (let k = 0; k < 5; k++) press("ArrowLeft");
  page.render();
  const before = Array.from(page.pixels());
  const state = JSON.stringify(page.state.marks.map(({ kind, text }) => [kind, text]));
  press("l");
  await wait(50);
  result.link = location.hash;
  result.note = [...document.querySelectorAll("#drawing .said")].at(-1).textContent;
  result.images = document.querySelectorAll("#drawing img, #tools img").length;
  press("Delete"); press("Delete"); press("v"); press("r");
  await wait(900);
  const link = result.link;
  await go("");
  await go(link);
  const after = page.pixels();
  press("j"); press("o");
  await go(`${link}&`);
  result.asTheLink = [page.state.jaw, page.state.mesh, page.state.marks.length];
  press("m"); press("h"); press("Escape");
  result.helpFirst = [$("help").hidden, page.state.tool];
  press("Escape");
  result.same = state === JSON.stringify(page.state.marks.map(({ kind, text }) => [kind, text]));
  result.shown = [page.state.support, page.state.axis, page.state.at, page.state.numbers];
  result.picture = before.reduce((sum, v, k) => sum + Math.abs(v - after[k]), 0) / before.length;

  const good = JSON.stringify({ ...page.state, marks: page.state.marks.length });
  for (const bad of HOSTILE) await go(bad);
  result.unchanged = good === JSON.stringify({ ...page.state, marks: page.state.marks.length });
  const text = encodeURIComponent("a\\u202eb\\n" + "x".repeat(999));
  await go(`n=0,0,-1,0,0,1,1e-9,-5,99&text=${text}`);
  const [mark] = page.state.marks;
  result.tamed = [mark.text.length, mark.text.slice(0, 3), mark.places[0].seen];
  result.positive = mark.places[0].across > 0 && mark.places[0].along > 0;

  press("d");
  await wait(50);
  page.render();
  result.sides = page.state.sides;
  const half = canvas.width / 2;
  const row = page.pixels();
  const lit = (from, to) => {
    let sum = 0;
    for (let y = 0; y < canvas.height; y++) {
      for (let x = from; x < to; x++) sum += row[4 * (y * canvas.width + x)];
    }
    return sum;
  };
  result.halves = [lit(0, half), lit(half, canvas.width)];
  tell({ ...result, errors: document.documentElement.dataset.errors ?? "" });
})();"""

HOSTILE = [
    "camera=1,2,3", "camera=" + ",".join(["NaN"] * 14), "camera=" + ",".join(["1e99"] * 14),
    "camera=" + ",".join(["1"] * 14), "cut=height,NaN", "cut=__proto__,1", "jaw=constructor",
    "numbers=<b>", "d=1,2,3;4,5,6", "d=" + "1," * 5000, "n=" + "9e9," * 9, "%E0%A4%A", "view=-1",
    "view=1e9", "=&=&=", "x" * 40_000, "n=0,0,0,0,0,0,1,1,1&text=a",
]  # fmt: skip


@needs_chromium
def test_links_bring_back_what_was_seen_and_nothing_else(tmp_path: Path) -> None:
    script = HEAD + LINKS.replace("UNTRUE", json.dumps(UNTRUE)).replace(
        "HOSTILE", json.dumps(HOSTILE)
    )
    found, log = run_in(
        ball_page(), script, tmp_path, (640, 480), address="#still&jaw=both&numbers=universal&d=1,2"
    )
    assert (found["errors"], log) == ("", [])
    assert found["opened"] == ["both", "universal", 0]
    assert found["focus"], "the note can be written at once"
    assert found["asTheLink"] == ["both", False, 2], "nothing stays of what was shown before"
    assert found["helpFirst"] == [True, "distance"]
    assert found["stays"] == [True, True, True], "a note that is written keeps what has the focus"
    assert found["note"].startswith("2: <img src=x"), "text stays text"
    assert found["images"] == 0
    assert len(found["link"]) < 1500
    assert found["same"]
    assert found["shown"] == [True, "height", pytest.approx(0.05), "off"]
    assert found["picture"] < 0.5, "of 255, on average"
    assert found["unchanged"]
    assert found["tamed"] == [300, "a b", 63]
    assert found["positive"]
    assert found["sides"] is True
    left, right = found["halves"]
    assert min(left, right) > 0.3 * max(left, right)


LOOKS = """(async () => {
  await page.ready;
  press("t");
  const shown = (element) => element.getClientRects().length > 0;
  const controls = [...document.querySelectorAll("button, input, select, canvas")].filter(shown);
  const name = (element) => element.getAttribute("aria-label")
    || element.closest("label")?.textContent.trim() || element.textContent.trim();
  const small = controls.filter((element) => {
    const box = element.getBoundingClientRect();
    return box.width < 24 || box.height < 16;
  });
  const sheet = $("tools").getBoundingClientRect();
  const covered = [...$("bar").children].map((group) => group.getBoundingClientRect())
    .filter((box) => box.width && box.right > sheet.left && box.bottom > sheet.top
      && box.top < sheet.bottom);
  const focus = document.activeElement.id;
  press("Escape");
  tell({
    nameless: controls.filter((element) => !name(element)).map((element) => element.outerHTML),
    tabindex: [...document.querySelectorAll("[tabindex]")].map((element) => element.tabIndex),
    order: controls.map(({ id }) => id).filter(Boolean),
    small: small.map((element) => element.id),
    wide: document.documentElement.scrollWidth - innerWidth,
    outside: controls.filter((element) => element !== canvas && !element.closest("#views, #tools"))
      .filter((element) => element.getBoundingClientRect().right > innerWidth + 1).length,
    sheet: [sheet.left, sheet.right, innerWidth],
    covered: covered.length, focus, back: document.activeElement.id, closed: $("tools").hidden,
    live: document.querySelectorAll("[role=status], [role=alert]").length,
    width: innerWidth,
    errors: document.documentElement.dataset.errors ?? "",
  });
})();"""


@needs_chromium
@pytest.mark.parametrize("width", [1280, 844, 390])
def test_everything_has_a_name_and_a_place(tmp_path: Path, width: int) -> None:
    found, log = run_in(
        ball_page(), HEAD + LOOKS, tmp_path, (width, 780 if width != 844 else 390), address="#still"
    )
    assert (found["errors"], log) == ("", [])
    assert found["width"] == width
    assert found["nameless"] == []
    assert found["tabindex"] == [0], "the order is that of the page"
    assert found["order"][0] == "canvas"
    assert found["order"][-1] == "copy"
    assert {"distance", "angle", "note", "numbers", "jaw", "axis", "support"} <= set(found["order"])
    assert found["small"] == []
    assert found["wide"] <= 0 and found["outside"] == 0
    assert found["covered"] == 0, "the tools leave the bar free"
    assert found["sheet"][0] >= 0 and found["sheet"][1] <= width
    assert found["closed"]
    if ENGINE != "webkit" or width >= NARROWEST:  # it gives a frame no focus unless it is touched
        assert (found["focus"], found["back"]) == ("done", "more")
    assert found["live"] >= 2


SIDES = """(async () => {
  await page.ready;
  press("d"); press("t");
  page.render();
  const tools = $("tools").getBoundingClientRect();
  const divide = document.querySelector("#drawing .divide").getBoundingClientRect();
  const bar = [...$("bar").children].map((group) => group.getBoundingClientRect());
  tell({
    end: 2 * divide.left, tools: [tools.left, tools.top, tools.width],
    bar: bar.filter((box) => box.width && box.bottom > tools.top && box.top < tools.bottom
      && box.right > tools.left).length,
    width: innerWidth, height: innerHeight,
    errors: document.documentElement.dataset.errors ?? "",
  });
})();"""


@needs_chromium
@pytest.mark.parametrize("width", [1280, 820, 700, 390])
def test_the_tools_cover_no_part_of_two_panes(tmp_path: Path, width: int) -> None:
    found, log = run_in(ball_page(), HEAD + SIDES, tmp_path, (width, 780), address="#still")
    assert (found["errors"], log, found["width"]) == ("", [], width)
    left, top, wide = found["tools"]
    if width < 820:
        assert (left, wide) == (0, width) and top > 0.5 * found["height"], "they lie below"
    else:
        assert width / 2 < found["end"] <= left, "they stand beside"
    assert found["bar"] == 0


def test_colours_can_be_told_apart() -> None:
    """Text on the panels has a contrast of 4.5 and more (WCAG 2.1), even over white teeth."""
    style = (viewer_page.HERE / "viewer.css").read_text()

    def luminance(rgb: np.ndarray) -> float:
        linear = np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4)
        return float(linear @ [0.2126, 0.7152, 0.0722])

    def colour(name: str) -> np.ndarray:
        text = re.search(rf"--{name}: #(\w{{6}})", style)[1]
        return np.array([int(text[k : k + 2], 16) for k in (0, 2, 4)]) / 255

    red, green, blue, alpha = map(
        float, re.search(r"--panel: rgba\(([^)]*)\)", style)[1].split(",")
    )
    panel = np.array([red, green, blue]) / 255 * alpha + (1 - alpha)
    for name in ("ink", "dim", "accent"):
        lighter, darker = sorted([luminance(colour(name)), luminance(panel)], reverse=True)
        assert (lighter + 0.05) / (darker + 0.05) > 4.5, name
