"""`pipeline doctor`: is everything here that a run needs, and if not, how to mend it."""

from __future__ import annotations

import ctypes.util
import importlib.util
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from importlib.metadata import distributions
from pathlib import Path

from pipeline.config import DEFAULT_PRESET, presets, read_yaml
from pipeline.errors import PipelineError
from pipeline.installed import is_installed, library_version
from pipeline.measure import usable_cores
from pipeline.stage import Finding, get_stage, stage_names

#: distribution -> module to import, for all that a run without a GPU needs.
LIBRARIES = {
    "numpy": "numpy",
    "scipy": "scipy",
    "opencv-contrib-python-headless": "cv2",
    "numba": "numba",
    "pycolmap": "pycolmap",
    "open3d": "open3d",
    "pymeshlab": "pymeshlab",
    "av": "av",
    "pillow": "PIL",
    "pillow-heif": "pillow_heif",
    "plyfile": "plyfile",
    "safetensors": "safetensors",
}

#: distribution -> module and what is missing without it: the extras.
OPTIONAL = {
    "torch": ("torch", "LPIPS, pointmap models and the GPU"),
    "torchmetrics": ("torchmetrics", "LPIPS"),
    "distributed": ("distributed", "many cases with one command (pipeline batch)"),
    "pydicom": ("pydicom", "DICOM files"),
    "pyinstrument": ("pyinstrument", "pipeline run --profile"),
}

#: soname -> Debian package that brings it.
SYSTEM_LIBRARIES = {
    "usb-1.0": "libusb-1.0-0",
    "GL": "libgl1",
    "OpenGL": "libopengl0",
    "EGL": "libegl1",
    "X11": "libx11-6",
    "gomp": "libgomp1",
}


def doctor() -> list[Finding]:
    """Check libraries, processor, kernels, GPU, disk and installation.

    Nothing is changed, but that a missing folder for compiled kernels is made.
    """
    findings: list[Finding] = []
    checks: tuple[Callable[[], Iterator[Finding]], ...] = (
        _python,
        _system_libraries,
        _libraries,
        _cv2_wheels,
        _processor,
        _numba_cache,
        _gpu,
        _stages,
        _disk,
    )
    for check in checks:
        findings.extend(check())
    return findings


def _python() -> Iterator[Finding]:
    version = ".".join(map(str, sys.version_info[:3]))
    enough = sys.version_info >= (3, 11)
    yield Finding(
        "python",
        "ok" if enough else "problem",
        version,
        "" if enough else "Use Python 3.11 or newer.",
    )


def _system_libraries() -> Iterator[Finding]:
    if not sys.platform.startswith("linux"):
        return
    for soname, package in SYSTEM_LIBRARIES.items():
        found = ctypes.util.find_library(soname)
        yield Finding(
            package,
            "ok" if found else "problem",
            found or "not found",
            "" if found else f"sudo apt-get install {package}",
        )


def _libraries() -> Iterator[Finding]:
    """Import each in a process of its own: a broken native library may crash instead of raising."""
    script = "import importlib, sys\nimportlib.import_module(sys.argv[1])"
    for name, module in LIBRARIES.items():
        done = subprocess.run(
            [sys.executable, "-P", "-c", script, module],
            capture_output=True,
            text=True,
            timeout=120,
        )
        if done.returncode == 0:
            yield Finding(name, "ok", library_version(name))
        else:
            last = (done.stderr.strip().splitlines() or ["crashed"])[-1]
            yield Finding(name, "problem", last, f"pip install {name}")
    for name, (module, purpose) in OPTIONAL.items():
        there = is_installed(module)
        detail = library_version(name) if there else f"not installed; only for {purpose}"
        yield Finding(name, "ok", detail)


def _cv2_wheels() -> Iterator[Finding]:
    wheels = sorted(
        {
            d.metadata["Name"]
            for d in distributions()
            if (d.metadata["Name"] or "").lower().startswith("opencv-")
        }
    )
    if len(wheels) > 1:
        yield Finding(
            "cv2", "problem", f"{len(wheels)} wheels overwrite each other: {', '.join(wheels)}",
            f"pip uninstall -y {' '.join(wheels)} && pip install opencv-contrib-python-headless",
        )  # fmt: skip


def _processor() -> Iterator[Finding]:
    threads = usable_cores()
    yield Finding("threads", "ok" if threads > 1 else "note", f"{threads} usable")
    try:
        text = Path("/proc/cpuinfo").read_text()
    except OSError:
        return
    flags = next((line for line in text.splitlines() if line.startswith("flags")), "").split()
    known = [name for name in ("avx2", "fma", "avx512f") if name in flags]
    yield Finding(
        "vector units", "ok" if "avx2" in known else "note", ", ".join(known) or "none known",
        "" if "avx2" in known else "The fit will be several times slower on this processor.",
    )  # fmt: skip


def _numba_cache() -> Iterator[Finding]:
    from pipeline.kernels.folder import SUFFIX, folders, readable, writable

    folder = writable()
    if folder is None:
        yield Finding(
            "kernel cache", "note", "every run compiles its kernels anew: "
            f"{' and '.join(map(str, folders()))} can't be written",
            "NUMBA_CACHE_DIR=FOLDER names another place for compiled kernels.",
        )  # fmt: skip
        return
    number = len({path.name for place in readable() for path in place.glob(f"*{SUFFIX}")})
    yield Finding("kernel cache", "ok", f"{number} compiled kernels in {folder}")


def _gpu() -> Iterator[Finding]:
    if shutil.which("nvidia-smi") is None:
        yield Finding("gpu", "ok", "none; not needed")
        return
    has_gsplat = importlib.util.find_spec("gsplat") is not None
    yield Finding(
        "gpu", "ok" if has_gsplat else "note",
        f"NVIDIA driver found; gsplat {'installed' if has_gsplat else 'not installed'}",
    )  # fmt: skip


def _stages() -> Iterator[Finding]:
    names = stage_names()
    if not names:
        yield Finding("stages", "problem", "none registered", "Install dentalsplat with pip.")
    for name in read_yaml(presets()[DEFAULT_PRESET], "preset")["stages"]:
        if names and name not in names:
            yield Finding(
                f"stage {name}", "problem", "not registered, and every run has it",
                "Install dentalsplat again with pip: another version is registered here.",
            )  # fmt: skip
    for name in names:
        try:
            stage = get_stage(name)
        except PipelineError as error:
            yield Finding(f"stage {name}", "problem", str(error))
            continue
        try:
            yield from list(stage.findings())
        except Exception as error:
            yield Finding(f"stage {name}", "problem", f"{type(error).__name__}: {error}")
    yield Finding("stages", "ok", ", ".join(names))


def _disk() -> Iterator[Finding]:
    for label, folder in (("disk here", Path.cwd()), ("disk for temporary files", None)):
        place = folder or Path(tempfile.gettempdir())
        free = shutil.disk_usage(place).free / 2**30
        yield Finding(
            label, "ok" if free > 2 else "note", f"{free:.1f} GB free",
            "" if free > 2 else "A run needs up to 1 GB; 'pipeline clean' deletes unused results.",
        )  # fmt: skip
