"""pycolmap, without its chatter on the user's screen."""

from __future__ import annotations

from typing import Any


def quiet_pycolmap() -> Any:  # pycolmap has no types
    """Import pycolmap and let it log nothing: failures show in what it returns."""
    import pycolmap

    pycolmap.logging.minloglevel = pycolmap.logging.FATAL.value
    return pycolmap
