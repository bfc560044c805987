"""The viewer page: its packed splats, and what a real browser makes of it."""

import base64
import json
import re
from importlib.resources import files
from pathlib import Path

import cv2
import numpy as np
import pytest

from pipeline.artifacts.gaussians import Gaussians
from pipeline.artifacts.views import to_uint8
from stages.export.pictures.orbits import find_orbit
from stages.export.splats import visible
from stages.export.viewer.lighter import with_degree
from stages.export.viewer.page import build_page, rasterizer_constants
from stages.splatting.rendering import render
from tests.browser import browse, console, needs_chromium
from tests.stages import export_scene as scene


def psnr(a: np.ndarray, b: np.ndarray) -> float:
    error = ((a.astype(float) - b.astype(float)) ** 2).mean()
    return float(10 * np.log10(255**2 / max(error, 1e-12)))


def page(
    degree: int = 1, photos: bool = True, gaussians: Gaussians | None = None, carried: int = 3
) -> str:
    gaussians = gaussians or scene.ball_gaussians(degree=degree)
    cameras = scene.ball_cameras()
    pictures = {camera.name: to_uint8(render(gaussians, camera).image) for camera in cameras}
    return build_page(
        gaussians, cameras, find_orbit(cameras, [3.0] * 3), pictures if photos else {},
        rasterizer_constants(gaussians, cameras), carried,
    )  # fmt: skip


def test_what_cannot_be_seen_is_not_carried() -> None:
    ball = scene.ball_gaussians(count=8)
    logits, means = ball.logit_opacities.copy(), ball.means.copy()
    logits[2], means[5, 1] = -9, np.nan
    kept = visible(
        Gaussians(means, ball.quats_wxyz, ball.log_scales, logits, ball.sh), alpha_min=1 / 255
    )
    assert kept.tolist() == [True, True, False, True, True, False, True, True]


def test_the_page_is_whole_and_needs_no_network() -> None:
    text = page()
    assert not re.search(r"{{(styles|scene|splats|scripts)}}", text)
    assert not re.search(r"https?://(?!www\.w3\.org)", text)
    assert not re.search(r"<(?:script|link|img)[^>]*(?:src|href)=[\"'](?!data:)", text)
    assert "<title>dentalsplat</title>" in text
    assert text == page(), "the same scene gives the same page"
    described = json.loads(re.search(r'id="scene">(.*?)</script>', text, re.S)[1])
    assert described["format"]["count"] == 1500
    splats = base64.b64decode(re.search(r'id="splats">(.*?)</script>', text, re.S)[1])
    assert len(splats) < 1500 * 36
    for view in described["views"]:
        jpeg = base64.b64decode(view["photo"].partition(",")[2])
        assert b"Exif" not in jpeg
        assert cv2.imdecode(np.frombuffer(jpeg, np.uint8), 1).shape == (120, 160, 3)


def test_a_page_of_fewer_harmonics_has_the_colours_of_the_photographs() -> None:
    ball = scene.ball_gaussians(degree=2)
    fewer = with_degree(ball, scene.ball_cameras(), 1)
    assert page(gaussians=ball, photos=False, carried=1) == page(gaussians=fewer, photos=False)


@needs_chromium
@pytest.mark.parametrize("lit", [False, True])
def test_a_browser_draws_what_our_rasterizer_draws(tmp_path: Path, lit: bool) -> None:
    gaussians = scene.lit_ball() if lit else scene.ball_gaussians(degree=3)
    file = tmp_path / "viewer.html"
    file.write_text(page(gaussians=gaussians))
    shot = tmp_path / "shot.png"
    camera = scene.ball_cameras()[2].resized(640, 480)  # Chromium has no smaller windows than 500
    _, log = browse(
        file, tmp_path, (640, 480), f"--screenshot={shot}", address="#view=3&bare&still"
    )
    assert console(log) == []
    picture = cv2.imread(str(shot))[..., ::-1]
    expected = to_uint8(render(gaussians, camera).image)
    assert picture.shape == expected.shape
    # Ours stops at 1e-4 transmittance and stores 32 bits, the page 16: 55 dB and more when written.
    assert psnr(picture, expected) > 40
    assert psnr(picture[:, ::-1], expected) < 25, "mirrored"
    assert psnr(picture[::-1], expected) < 25, "upside down"


PROBE = """
<script>
(async () => {
  const result = {};
  const page = window.dentalsplat;
  await page.ready;
  const sum = () => page.pixels().reduce((total, value) => total + value, 0);
  const wait = async (ms) => {
    await new Promise((done) => setTimeout(done, ms));
    page.render();  // virtual time may run ahead of the frames
  };
  page.setCamera(CAMERA);
  result.pixels = Array.from(page.pixels());
  page.setBackground([1, 1, 1]);
  result.corner = Array.from(page.pixels().slice(0, 4));
  page.setBackground([0, 0, 0]);

  const canvas = document.getElementById("canvas");
  const photo = document.getElementById("photo");
  const slider = document.getElementById("opacity");
  const press = (key) => dispatchEvent(new KeyboardEvent("keydown", { key, bubbles: true }));
  document.querySelectorAll("#views button")[0].click();
  await wait(900);
  result.label = document.getElementById("label").textContent;
  const first = sum();
  slider.value = 60;
  slider.dispatchEvent(new Event("input"));
  await wait(100);
  result.photo = photo.style.opacity;
  const move = (type, x, y, id = 7) => canvas.dispatchEvent(new PointerEvent(type,
    { pointerId: id, clientX: x, clientY: y, buttons: 1, bubbles: true }));
  canvas.setPointerCapture = () => {};
  move("pointerdown", 50, 50);
  for (let x = 50; x < 90; x += 4) move("pointermove", x, 50);
  move("pointerup", 90, 50);
  await wait(100);
  result.photoAfterDrag = photo.style.opacity;
  result.changedByDrag = sum() !== first;
  result.labelAfterDrag = document.getElementById("label").textContent;
  for (let k = 0; k < 200; k++) canvas.dispatchEvent(new WheelEvent("wheel", { deltaY: 100 }));
  result.farAway = sum() > 0;
  for (let k = 0; k < 400; k++) canvas.dispatchEvent(new WheelEvent("wheel", { deltaY: -100 }));
  result.close = sum() > 0;
  for (let k = 0; k < 100; k++) press("ArrowUp");
  result.above = sum() > 0;
  press("h");
  result.help = !document.getElementById("help").hidden;
  press("1");
  await wait(900);
  result.sameAgain = sum() === first;
  press("a");
  await wait(300);
  result.turning = document.getElementById("turn").getAttribute("aria-pressed");
  press("r");
  await wait(900);
  result.labelAfterReset = document.getElementById("label").textContent;
  const camera = new OrbitCamera({ up: [0, -1, 0], front: [0, 0, -1], centre: [0, 0, 0], radius: 1,
    limits: { azimuth: null, elevation: [-1, 1], distance: [0.1, 9], pan: 1 } });
  camera.rotation = turned([0, 0, 1], 0.3);
  result.tilts = [];
  for (let k = 0; k < 12; k++) {
    result.tilts.push(Math.asin(camera.rotation[1]));
    camera.orbit(0.05, 0);
  }
  const { azimuth, elevation } = camera.angles();
  result.turned = [azimuth, elevation];
  const text = document.createElement("pre");
  text.id = "result";
  text.textContent = JSON.stringify({ ...result, state: document.documentElement.dataset.state,
    errors: document.documentElement.dataset.errors ?? "" });
  document.body.append(text);
})();
</script>
</body>"""


@needs_chromium
def test_the_page_can_be_steered(tmp_path: Path) -> None:
    camera = scene.ball_cameras()[0].resized(96, 72)
    numbers = json.dumps(camera.cam_from_world.ravel().tolist())
    call = f"{numbers}, {camera.fx}, {camera.fy}, {camera.cx}, {camera.cy}, 96, 72"
    file = tmp_path / "probe.html"
    camera_script = files("stages.export.viewer").joinpath("camera.js").read_text()
    probe = f"<script>{camera_script}</script>" + PROBE.replace("CAMERA", call)
    file.write_text(page().replace("</body>", probe))
    dom, log = browse(file, tmp_path, (480, 360), "--dump-dom", "--virtual-time-budget=20000")
    assert console(log) == []
    result = json.loads(re.search(r"<pre id=\"result\">(.*?)</pre>", dom, re.S)[1])
    assert result["errors"] == ""
    assert result["state"] == "ready"
    picture = np.array(result["pixels"], np.uint8).reshape(72, 96, 4)[..., :3]
    expected = to_uint8(render(scene.ball_gaussians(), camera).image)
    assert psnr(picture, expected) > 40
    assert result["corner"] == [255, 255, 255, 255]
    assert result["label"] == "View 1"
    assert float(result["photo"]) == pytest.approx(0.6)
    assert float(result["photoAfterDrag"]) == 0
    assert result["labelAfterDrag"] == ""
    assert result["labelAfterReset"] == "View 2"
    assert result["turning"] == "true"
    tilts = np.abs(result["tilts"])
    assert tilts[0] == pytest.approx(0.3), "a photograph is shown as it was taken"
    assert (np.diff(tilts) < 0).all() and tilts[-1] < 0.01, "turned, it comes to stand level"
    np.testing.assert_allclose(np.abs(result["turned"]), [0.6, 0], atol=1e-6)
    for what in ("changedByDrag", "farAway", "close", "above", "help", "sameAgain"):
        assert result[what] is True, what


@needs_chromium
def test_without_webgl_the_page_says_so(tmp_path: Path) -> None:
    file = tmp_path / "viewer.html"
    blind = page(photos=False).replace('getContext("webgl2"', 'getContext("nothing"')
    file.write_text(blind)
    dom, _ = browse(file, tmp_path, (480, 360), "--dump-dom")
    assert 'data-state="failed"' in dom
    assert "offers no WebGL2" in dom
