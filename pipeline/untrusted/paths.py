"""Paths that a setting names."""

from __future__ import annotations

import os
from pathlib import Path

from pipeline.errors import RequestError


def user_path(text: str | Path, setting: str) -> Path:
    """The path that a setting names, with `~` and `~name` replaced.

    Args:
        text: as given; it need not be there.
        setting: its name, for the message.

    Raises:
        RequestError: there is no such user, or no file system has such a name.
    """
    try:
        path = Path(text).expanduser()
        os.lstat(path)
    except FileNotFoundError:
        pass
    except RuntimeError as error:  # expanduser: ~nobody
        raise RequestError(
            f"{setting}: {_shown(text)} begins with the home of a user that there isn't. Give the "
            "whole path."
        ) from error
    except (OSError, ValueError) as error:  # too long, or a zero byte
        reason = getattr(error, "strerror", None) or str(error)
        raise RequestError(
            f"{setting}: {_shown(text)} can't be looked for ({reason.lower()}). Check the path."
        ) from error
    return path


def _shown(text: str | Path) -> str:
    name = str(text)
    return ascii(name if len(name) <= 80 else f"{name[:40]}...{name[-30:]}")
