"""Pages in headless Chromium; those that tell what they found also in what PAGES_IN names."""

from __future__ import annotations

import html
import json
import os
import re
import shutil
import subprocess
from pathlib import Path
from typing import Any

import pytest

from tests.other_browsers import told_in

#: Where `run_in` runs its scripts: chromium, firefox or webkit.
ENGINE = os.environ.get("PAGES_IN", "chromium")
CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("chrome")
needs_chromium = pytest.mark.skipif(CHROMIUM is None, reason="no chromium is installed")


def browse(
    file: Path, folder: Path, size: tuple[int, int], *extra: str, address: str = ""
) -> tuple[str, str]:
    """Open a page from disk; returns what Chromium printed, and its log.

    Args:
        file: the page.
        folder: where Chromium may keep a profile, a new one for each call.
        size: of the window: width, height.
        extra: options of Chromium, such as ``--dump-dom``.
        address: what follows the file in the address: ``#view=1``.
    """
    assert CHROMIUM
    profile = folder / f"profile{len(list(folder.iterdir()))}"
    command = [
        CHROMIUM, "--headless", "--no-sandbox", "--disable-gpu", "--use-angle=swiftshader",
        "--enable-unsafe-swiftshader", "--disable-quic", "--no-first-run",
        "--disable-background-networking", "--disable-component-update", "--disable-sync",
        "--hide-scrollbars", f"--window-size={size[0]},{size[1]}", "--virtual-time-budget=4000",
        f"--user-data-dir={profile}", "--enable-logging=stderr", "--v=0", *extra,
        f"{file.absolute().as_uri()}{address}",
    ]  # fmt: skip
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)
    return done.stdout, done.stderr


def console(log: str) -> list[str]:
    """Console messages of the page, without the graphics driver's remarks on speed."""
    return [
        line for line in log.splitlines()
        if "CONSOLE" in line and "GL Driver Message" not in line
    ]  # fmt: skip


def run_in(
    text: str, script: str, folder: Path, size: tuple[int, int], address: str = "",
    coarse: bool = False, framed: bool = False,
) -> tuple[dict[str, Any], list[str]]:  # fmt: skip
    """Run a script in a page; returns what it told, and the messages on the console.

    Args:
        text: of the page.
        script: JavaScript, may await; calls `tell(object)` once, when it is done.
        folder: for the page and the profile.
        size: of the window; narrower than `NARROWEST` it is a frame.
        address: see `browse`.
        coarse: two pixels of a page are one of the screen: scenes are drawn in a quarter of the
            time.
        framed: in a frame in any case, to which the script may give another size: `await
            resized(width, height)`.
    """
    page = folder / f"page{len(list(folder.iterdir()))}.html"
    page.write_text(text.replace("</body>", _TELL + f"<script>{script}</script></body>"))
    file = page
    if framed or size[0] < NARROWEST:
        file = page.with_name(f"frame_of_{page.name}")
        file.write_text(_FRAME.format(page.name, html.escape(address), *size))
        address = ""
    window = max(size[0], NARROWEST), size[1]
    if ENGINE != "chromium":
        url, scale = f"file://{file}{address}", 0.5 if coarse else 1.0
        told, messages = told_in(ENGINE, url, folder, window, scale)
        assert told, f"the script told nothing: {messages}"
        return json.loads(told), messages
    dom, log = browse(
        file, folder, window, "--dump-dom",
        "--virtual-time-budget=30000", *["--force-device-scale-factor=0.5"] * coarse,
        address=address,
    )  # fmt: skip
    found = re.search(r'<pre id="what-the-script-told">(.*?)</pre>', dom, re.S)
    assert found, f"the script told nothing: {console(log)}"
    return json.loads(html.unescape(found[1])), console(log)


#: Browsers have no narrower windows.
NARROWEST = 500
_TELL = """<script>
function tell(result) {
  const text = JSON.stringify(result);
  if (parent !== window) return parent.postMessage(text, "*");
  const shown = document.createElement("pre");
  shown.id = "what-the-script-told";
  shown.textContent = text;
  document.body.append(shown);
}
function resized(width, height) {
  parent.postMessage({ width: `${width}px`, height: `${height}px` }, "*");
  return new Promise((done) => addEventListener("message", done, { once: true }));
}
</script>"""
_FRAME = """<!doctype html><title>frame</title><body style="margin:0">
<iframe src="{0}{1}" style="border:0;width:{2}px;height:{3}px"></iframe>
<script>
addEventListener("message", (event) => {{
  const frame = document.querySelector("iframe");
  if (event.data.width) {{
    Object.assign(frame.style, event.data);
    frame.getBoundingClientRect();  // now, without waiting for a picture that may not be drawn
    return event.source.postMessage("resized", "*");
  }}
  const shown = document.createElement("pre");
  shown.id = "what-the-script-told";
  shown.textContent = event.data;
  document.body.append(shown);
}});
</script></body>"""
