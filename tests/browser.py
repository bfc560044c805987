"""Pages in headless Chromium."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import pytest

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
        f"file://{file}{address}",
    ]  # fmt: skip
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)
    return done.stdout, done.stderr


def console(log: str) -> list[str]:
    """Console messages of the page, without the graphics driver's remarks on speed."""
    return [
        line for line in log.splitlines()
        if "CONSOLE" in line and "GL Driver Message" not in line
    ]  # fmt: skip
