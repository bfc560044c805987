"""Pages in Firefox (WebDriver BiDi) and in WebKitGTK, Safari's engine (WebDriver).

`make browsers` installs them and runs the tests of pages there; both want a screen, be it Xvfb's,
and take Mesa's software renderer for WebGL.
"""

from __future__ import annotations

import json
import os
import shutil
import socket
import subprocess
import time
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

FIREFOX = shutil.which("firefox-esr") or shutil.which("firefox")
WEBKIT_DRIVER = shutil.which("WebKitWebDriver")
MINI_BROWSERS = sorted(Path("/usr/lib").glob("*/webkit2gtk-4.*/MiniBrowser"))
#: Seconds in which a browser must start, and a page must have told something.
START, PATIENCE = 30, 120
#: WebGL2 by Mesa in a process that has a screen but no card.
PREFERENCES = {
    "webgl.force-enabled": True, "webgl.enable-software-rendering": True,
    "browser.shell.checkDefaultBrowser": False, "datareporting.policy.dataSubmissionEnabled": False,
    "browser.aboutwelcome.enabled": False,
}  # fmt: skip
_PLACE = "document.getElementById('what-the-script-told')"
#: What the page has told, once it has.
TOLD = f"{_PLACE} && {_PLACE}.textContent"


def told_in(
    engine: str, url: str, folder: Path, size: tuple[int, int], scale: float = 1.0
) -> tuple[str | None, list[str]]:
    """Open a page; what it told, None: nothing in time; and what the console had to say.

    Args:
        engine: firefox or webkit; the console of the latter is not heard.
        url: of the page.
        folder: for a profile.
        size: of the window: width, height.
        scale: pixels of the screen for one of the page; WebKit has one.
    """
    if engine == "firefox":
        return _told_in_firefox(url, folder, size, scale)
    if engine == "webkit":
        return _told_in_webkit(url, size), []
    raise ValueError(f"no such browser: {engine}")


def _told_in_firefox(
    url: str, folder: Path, size: tuple[int, int], scale: float
) -> tuple[str | None, list[str]]:
    from websockets.sync.client import connect

    assert FIREFOX, "there is no Firefox"
    profile = folder / f"firefox{len(list(folder.iterdir()))}"
    profile.mkdir()
    settings = [f"user_pref({json.dumps(k)}, {json.dumps(v)});" for k, v in PREFERENCES.items()]
    (profile / "user.js").write_text("\n".join(settings))
    port = _free_port()
    command = [
        FIREFOX, "--no-remote", "--profile", str(profile), "--remote-debugging-port", str(port),
        "about:blank",
    ]  # fmt: skip
    messages: list[str] = []
    with _running(command, port), connect(
        f"ws://127.0.0.1:{port}/session", max_size=None, open_timeout=START
    ) as socket_:  # fmt: skip
        number = 0

        def call(method: str, **parameters: Any) -> Any:
            nonlocal number
            number += 1
            socket_.send(json.dumps({"id": number, "method": method, "params": parameters}))
            while True:
                answer = json.loads(socket_.recv(timeout=PATIENCE))
                if answer.get("method") == "log.entryAdded":
                    messages.append(f"{answer['params']['level']}: {answer['params']['text']}")
                if answer.get("id") == number:
                    assert answer["type"] == "success", answer
                    return answer["result"]

        call("session.new", capabilities={})
        call("session.subscribe", events=["log.entryAdded"])
        page = call("browsingContext.getTree")["contexts"][0]["context"]
        call(
            "browsingContext.setViewport", context=page, devicePixelRatio=scale,
            viewport={"width": size[0], "height": size[1]},
        )  # fmt: skip
        call("browsingContext.navigate", context=page, url=url, wait="complete")

        def told() -> str | None:
            found = call(
                "script.evaluate", expression=TOLD, target={"context": page}, awaitPromise=False
            )
            text: str | None = found["result"].get("value")
            return text

        return _patiently(told), messages


def _told_in_webkit(url: str, size: tuple[int, int]) -> str | None:
    assert WEBKIT_DRIVER and MINI_BROWSERS, "there is no WebKitGTK with its driver"
    port = _free_port()
    options = {"binary": str(MINI_BROWSERS[-1]), "args": ["--automation"]}
    wanted = {"capabilities": {"alwaysMatch": {"webkitgtk:browserOptions": options}}}

    def call(path: str, body: dict[str, Any]) -> Any:
        request = urllib.request.Request(
            f"http://127.0.0.1:{port}{path}", json.dumps(body).encode(),
            {"Content-Type": "application/json"},
        )  # fmt: skip
        with urllib.request.urlopen(request, timeout=PATIENCE) as answer:
            return json.loads(answer.read())["value"]

    with _running([WEBKIT_DRIVER, f"--port={port}"], port):
        session = f"/session/{call('/session', wanted)['sessionId']}"
        inner = call(f"{session}/window/rect", {"width": size[0], "height": size[1]})
        # the window has a frame and a bar for addresses: what is inside is to have that size
        seen = call(
            f"{session}/execute/sync", {"script": "return [innerWidth, innerHeight]", "args": []}
        )
        grown = {
            "width": inner["width"] + size[0] - seen[0],
            "height": inner["height"] + size[1] - seen[1],
        }
        call(f"{session}/window/rect", grown)
        call(f"{session}/url", {"url": url})
        script = {"script": f"return {TOLD}", "args": []}
        return _patiently(lambda: call(f"{session}/execute/sync", script))


def _patiently(told: Any) -> str | None:
    end = time.monotonic() + PATIENCE
    while time.monotonic() < end:
        text: str | None = told()
        if text:
            return text
        time.sleep(0.2)
    return None


@contextmanager
def _running(command: list[str], port: int) -> Iterator[None]:
    """A program that listens on a port."""
    environment = {**os.environ, "LIBGL_ALWAYS_SOFTWARE": "1"}
    process = subprocess.Popen(
        command, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        start_new_session=True,
    )  # fmt: skip
    try:
        end = time.monotonic() + START
        while True:
            try:
                socket.create_connection(("127.0.0.1", port), timeout=1).close()
                break
            except OSError:
                assert process.poll() is None and time.monotonic() < end, "it did not start"
                time.sleep(0.2)
        yield
    finally:
        os.killpg(process.pid, 15)
        process.wait(START)


def _free_port() -> int:
    with socket.socket() as listening:
        listening.bind(("127.0.0.1", 0))
        port: int = listening.getsockname()[1]
        return port
