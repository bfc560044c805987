"""Are `pipeline` and `stages` ours? A user's own ``pipeline.py`` may come first."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path

HERE = Path(__file__).resolve().parent
PACKAGES = ("pipeline", "stages")


class NameTakenError(ImportError):
    """Python finds something else under the name of one of our packages."""


def check_names() -> None:
    """Make sure that our packages are the ones that Python finds.

    Raises:
        NameTakenError: it names the file that is in the way, and what to do.
    """
    for name in PACKAGES:
        found = _where(name)
        if found == HERE.parent / name:
            continue
        if found is None:
            raise NameTakenError(
                f"dentalsplat is not installed whole: its package '{name}' is missing. Install it "
                "again.",
                name=name,
            )
        raise NameTakenError(
            f"{found} is in the way: dentalsplat has a package of the name '{name}', and Python "
            f"finds yours first. Rename it, or start the program from another folder and without "
            f"{found.parent} in PYTHONPATH.",
            name=name,
        )


def _where(name: str) -> Path | None:
    """The folder of a package, or the file of a module, that Python finds under a name."""
    module = sys.modules.get(name)
    try:
        spec = module.__spec__ if module is not None else importlib.util.find_spec(name)
    except ValueError:  # a module that somebody made by hand
        spec = None
    if spec is None:
        return None
    if spec.submodule_search_locations is not None:
        folders = list(spec.submodule_search_locations)
        return Path(folders[0]).resolve() if folders else None
    return Path(spec.origin).resolve() if spec.origin else None
