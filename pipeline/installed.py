"""What is installed here, and where it lies: our own files, and libraries that may be missing."""

from __future__ import annotations

import importlib.util
import os
import sys
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from pipeline.errors import RequestError

#: The folder that holds the packages `pipeline` and `stages`.
ROOT = Path(__file__).resolve().parents[1]

#: Wheels of the same modules under another name, which do as well.
SUBSTITUTES = {"open3d": "open3d-cpu", "opencv-contrib-python-headless": "opencv-contrib-python"}


def shipped_configs() -> Path:
    """The folder of the presets and suites: in the package, or in the repository beside it."""
    packaged = Path(__file__).resolve().parent / "presets"
    return packaged if packaged.is_dir() else ROOT / "configs"


def module_command(module: str) -> tuple[str, ...]:
    """The command that runs a module of ours, whatever lies in the folder it is called from.

    ``python -m`` would take a ``pipeline.py`` of the user's there for our package. The process is a
    child of this one, and ends with it (`pipeline.process.signals`).
    """
    script = (
        f"import runpy, sys; sys.path[0] = {str(ROOT)!r}; "
        f"from pipeline.process.signals import child; child({os.getpid()}); "
        f"runpy.run_module({module!r}, run_name='__main__', alter_sys=True)"
    )
    return (sys.executable, "-c", script)


def library_version(name: str) -> str:
    """Version of an installed distribution or its substitute, ``"missing"`` where there is none."""
    for found in (name, SUBSTITUTES.get(name)):
        try:
            if found is not None:
                return version(found)
        except PackageNotFoundError:
            continue
    return "missing"


def is_installed(*modules: str) -> bool:
    """Whether Python finds these top-level modules; nothing is imported."""
    return all(importlib.util.find_spec(name) is not None for name in modules)


def require(purpose: str, extra: str, *modules: str) -> None:
    """Make sure that optional libraries are there.

    Args:
        purpose: the setting or the work that needs them, as the beginning of a sentence.
        extra: the extra of dentalsplat that brings them.
        modules: the top-level modules to import.

    Raises:
        RequestError: one is missing; how to install it.
    """
    missing = [name for name in modules if not is_installed(name)]
    if missing:
        raise RequestError(
            f"{purpose} needs {' and '.join(missing)}, which is not part of the smallest "
            f"installation. Install it with: pip install 'dentalsplat[{extra}]'."
        )
