"""Marks on the viewer page: a point chosen twice, their order in a link, what is drawn when."""

from __future__ import annotations

from pathlib import Path

import numpy as np

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
  press("n");
  at(.5, .42);
  const note = document.activeElement;
  result.note = [true, false].map((isComposing) => {
    press("Enter", note, { isComposing });
    return document.activeElement === note;
  });
  const place = "0,0,-1,0,0,1,.01,.01,3";
  press("Delete");
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
    assert found["note"] == [True, False], "Enter ends a note, but not while its signs are chosen"
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
  const slider = () => [$("opacity").disabled, $("opacity").value];
  press("d"); press("p");
  result.slider = [slider()];
  press("d"); press("p");
  result.slider.push(slider());
  press("m");
  result.crosshair = [crosshair()];
  for (const element of [$("more"), canvas]) {
    element.focus();
    if (!document.hasFocus()) {  // a window that nobody looks at is told of no focus
      canvas.dispatchEvent(new Event(element === canvas ? "focus" : "blur"));
    }
    result.crosshair.push(crosshair());
  }
  press("d"); press("t");
  page.setBackground([1, .5, 0]);
  result.corner = [...page.pixels().subarray(4 * canvas.width - 4, 4 * canvas.width)];
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
    assert found["slider"] == [[True, "0"], [False, "100"]], "two panes have no photograph"
    assert found["crosshair"] == [True, False, True], "it is there while the keys are the scene's"
    assert np.allclose(found["corner"], [255, 127.5, 0, 255], atol=1), "no black strip at the tools"


ELSEWHERE = """(async () => {
  await page.ready;
  const wait = () => new Promise((done) => setTimeout(done, 300));
  const go = async (hash) => { location.hash = hash; await wait(); };
  const warned = () => [!$("elsewhere").hidden, !$("told").hidden, page.state.marks.length];
  const result = { opened: warned(), said: said() };
  press("l");
  await wait();
  const theirs = location.hash;
  await go("view=1");
  result.stays = warned().filter((_, k) => k !== 1);
  await go("n=0,0,-1,0,0,1,.01,.01,3&text=ours");
  result.unsaid = warned()[0];
  press("l");
  await wait();
  const ours = location.hash;
  await go(theirs);
  result.theirs = warned()[0];
  await go(ours);
  result.ours = warned()[0];
  await go("scene=fewer&camera=1,0,0,0,1,0,0,0,1,0,0,0,4,99");
  result.camera = warned()[0];
  await go(`n=0,0,-1,0,0,1,.01,.01,3&text=${"x".repeat(30000)}`);
  result.long = $("told").textContent;
  tell({ ...result, errors: document.documentElement.dataset.errors ?? "" });
})();"""


@needs_chromium
def test_a_link_of_another_scene_is_followed_and_said(tmp_path: Path) -> None:
    camera = "camera=1,0,0,0,1,0,0,0,1,0,0,0,4,0"
    note = "n=0,0,-1,0,0,1,.01,.01,3&text=theirs"
    found, log = run_in(
        ball_page(), HEAD + ELSEWHERE, tmp_path, (640, 480),
        address=f"#still&scene=<b>another&{camera}&{note}", coarse=True,
    )  # fmt: skip
    assert (found["errors"], log) == ("", [])
    assert found["opened"] == [True, True, 1]
    assert found["said"].strip().startswith("This link was made in another scene")
    assert found["stays"] == [True, 1], "the marks are still the other scene's"
    assert (found["unsaid"], found["theirs"], found["ours"]) == (False, True, False)
    assert found["camera"], "so it is where its camera has no photograph here"
    assert found["long"].startswith("The link is too long to be read")


UNSURE = """(async () => {
  await page.ready;
  const { rotation, translation, fx, fy, cx, cy, width, height } = page.views[0];
  const matrix = [0, 1, 2].flatMap((k) => [...rotation.slice(3 * k, 3 * k + 3), translation[k]]);
  const picked = (zoom, fine, [x, y]) => {
    page.setCamera(matrix, zoom * fx, zoom * fy, fine * width / 2 - zoom * (width / 2 - cx),
      fine * height / 2 - zoom * (height / 2 - cy), fine * width, fine * height);
    page.render();
    return page.pick(fine * width / 2 + zoom * (x - width / 2),
      fine * height / 2 + zoom * (y - height / 2));
  };
  let alone = null;
  for (let x = 0; x < width && !alone; x += 2) {
    if (picked(1, 1, [x + .5, 60.5])?.seen === 1) alone = [x + 3.5, 60.5];
  }
  const told = (place) => [place.across, place.along, place.seen];
  tell({ once: told(picked(1, 1, alone)), finer: told(picked(2, 2, alone)),
    nearer: told(picked(1.5, 1, alone)), page: canvas.clientWidth / width,
    errors: document.documentElement.dataset.errors ?? "" });
})();"""


@needs_chromium
def test_how_sure_a_place_is_does_not_hang_on_the_pixels_of_the_canvas(tmp_path: Path) -> None:
    found, log = run_in(ball_page(), HEAD + UNSURE, tmp_path, (640, 480), address="#still")
    assert (found["errors"], log) == ("", [])
    (across, along, seen), finer, nearer = found["once"], found["finer"], found["nearer"]
    assert seen == finer[2] == nearer[2] == 1
    assert np.allclose(across, 1.5 / found["page"] * 3.5 / 200, rtol=0.2), "1.5 of the page"
    assert np.allclose(finer[0], across, rtol=0.02), "a screen with more pixels points no better"
    assert np.allclose(nearer[0], across / 1.5, rtol=0.02), "enlarged, one points better"
    assert np.allclose(along, 20 * 3.5 / 200, rtol=0.2), "20 pixels of the one photograph"
    assert np.allclose([finer[1], nearer[1]], along, rtol=0.02), "its depth stays as unsure"


SAVED = """(async () => {
  await page.ready;
  let blob = null;
  URL.createObjectURL = (given) => { blob = given; return "blob:x"; };
  HTMLAnchorElement.prototype.click = () => {};
  const until = async (there) => {
    while (!there()) {  // drawing takes true time: virtual time alone would be over before
      await new Promise((done) => setTimeout(done, 10));
      page.render();
    }
  };
  const saved = async () => {
    blob = null;
    press("s");
    await until(() => blob);
    let bitmap = null;
    createImageBitmap(blob).then((made) => { bitmap = made; });
    await until(() => bitmap);
    const { width, height } = canvas;
    const brush = Object.assign(document.createElement("canvas"), { width, height })
      .getContext("2d");
    brush.drawImage(bitmap, 0, 0);
    const picture = brush.getImageData(0, 0, width, height).data;
    const scene = page.pixels();
    let [off, left, right, top, bottom] = [0, width, 0, height, 0];
    for (let k = 0; k < scene.length; k += 4) {
      if ([0, 1, 2].every((c) => Math.abs(scene[k + c] - picture[k + c]) < 60)) continue;
      const [x, y] = [k / 4 % width, Math.floor(k / 4 / width)];
      [off, left, right] = [off + 1, Math.min(left, x), Math.max(right, x)];
      [top, bottom] = [Math.min(top, y), Math.max(bottom, y)];
    }
    const scale = canvas.clientWidth / width;
    return [off, [left, top, right + 1, bottom + 1].map((edge) => edge * scale)];
  };
  const result = {};
  press("m");
  canvas.focus();
  result.bare = await saved();
  const place = "0,0,-1,0,0,1,.01,.01,3";
  const texts = [`${"x".repeat(38)}\\u{1f9b7}\\u{1f9b7} and more`, "no letter: \\uffff"];
  const notes = texts.flatMap((text) => [["n", place], ["text", text]]);
  location.hash = new URLSearchParams(notes).toString();
  await until(() => page.state.marks.length === 2);
  result.notes = await saved();
  press("Delete"); press("Delete");
  press("u");
  result.numbers = await saved();
  page.render();
  const boxes = [...document.querySelectorAll("#drawing .number")]
    .map((number) => number.getBoundingClientRect());
  result.where = [Math.min(...boxes.map(({ left }) => left)), Math.min(...boxes.map((b) => b.top)),
    Math.max(...boxes.map((b) => b.right)), Math.max(...boxes.map((b) => b.bottom))];
  press("u"); press("u");
  press("2");
  page.setBackground([1, 1, 1]);
  press("p");
  await new Promise((done) => setTimeout(done, 300));
  page.render();
  const { left, top, right, bottom } = $("photo").getBoundingClientRect();
  result.photo = [await saved(), [left, top, right, bottom]];
  tell({ ...result, errors: document.documentElement.dataset.errors ?? "" });
})();"""


@needs_chromium
def test_what_is_saved_is_what_is_seen(tmp_path: Path) -> None:
    found, log = run_in(ball_page(), HEAD + SAVED, tmp_path, (640, 480), address="#still")
    assert (found["errors"], log) == ("", [])
    assert found["bare"][0] == 0, "the crosshair is no part of the picture"
    assert found["notes"][0] > 100, "whatever letters they have"
    count, box = found["numbers"]
    assert count > 100
    assert np.allclose(box, found["where"], atol=6), "numbers are in it where they are on screen"
    (count, box), where = found["photo"]
    assert count > 20_000, "the photograph lies over the scene"
    assert np.allclose(box, where, atol=2)
