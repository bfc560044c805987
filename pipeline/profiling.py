"""Where the time of a stage goes, as a page for a browser."""

from __future__ import annotations

import contextlib
import re
from collections.abc import Iterator
from pathlib import Path

from pipeline.installed import require

#: Folder of the pages in a workspace.
FOLDER = "profile"
#: Seconds from one look at what runs to the next.
INTERVAL = 0.002
#: The only thing that the page would load from the network.
_FONTS = re.compile(r"https://fonts\.googleapis\.com/[^\"']*")


def require_profiler() -> None:
    """Make sure that the profiler is installed.

    Raises:
        RequestError: it is not; how to install it.
    """
    require("--profile", "profile", "pyinstrument")


@contextlib.contextmanager
def profiled(page: Path) -> Iterator[None]:
    """Write what this thread did meanwhile, by wall time, to a self-contained HTML page.

    What compiled code does counts for the line that called it; so does waiting for other threads
    and for child processes. The page is written also if an error ends it.

    Args:
        page: the `.html` file; its folder is made.
    """
    from pyinstrument import Profiler
    from pyinstrument.renderers import HTMLRenderer

    page.parent.mkdir(exist_ok=True)  # what is in the way is found before the work is done
    profiler = Profiler(interval=INTERVAL, async_mode="disabled")
    profiler.start()
    try:
        yield
    finally:
        session = profiler.stop()
        text = HTMLRenderer(show_all=True).render(session)
        page.write_text(_FONTS.sub("data:text/css,", text), encoding="utf-8")
