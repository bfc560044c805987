"""Whether a graphics card draws and derives as the processor does, tried on a made scene."""

from __future__ import annotations

import contextlib
import hashlib
import importlib.util
import os
import shutil
import subprocess
from functools import cache
from importlib.metadata import version
from pathlib import Path
from textwrap import shorten
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from pipeline.kernels import folder

if TYPE_CHECKING:
    from stages.splatting.rasterizer import Viewpoint

#: the card's image may differ by this much from the processor's (mean over the pixels), and its
#: gradients by this share: sums in another order do, a wrong convention does by far more
IMAGE_TOLERANCE, GRADIENT_TOLERANCE = 1e-3, 0.02


def has_card() -> bool:
    """Whether gsplat is installed and there is a card that torch can use."""
    if not looks_like_a_card():
        return False
    from stages.splatting.torch_api import choose_backend

    return choose_backend() == "gsplat"


def looks_like_a_card() -> bool:
    """Whether a driver and gsplat are installed; as much as is known without loading torch."""
    return shutil.which("nvidia-smi") is not None and bool(importlib.util.find_spec("gsplat"))


def rasterizer_of_card() -> Any:
    """What draws on the card; gsplat compiles its kernels here if it came without.

    Raises:
        RuntimeError: it can't.
    """
    from gsplat.cuda import _backend

    if _backend._C is None:
        raise RuntimeError(
            "gsplat came without kernels and finds no CUDA compiler, nvcc, to make them with"
        )
    from stages.splatting.card import rasterize_on_card

    return rasterize_on_card


@cache
def card_trouble() -> str | None:
    """What the card draws or derives otherwise than the processor, of a trial scene; or None."""
    from stages.splatting.rasterizer import rasterize

    packed, here, there = _trial_scene()
    options: dict[str, Any] = {"degree": 3, "near": 0.2, "depth": True, "flow_to": there}
    try:
        ours = rasterize(packed, here, **options)
        theirs = rasterizer_of_card()(packed, here, **options)
        off = float(np.abs(ours.planes[:4] - theirs.planes[:4]).mean())
        if not off < IMAGE_TOLERANCE:
            return f"its images differ from the processor's by {off:.2g} on average"
        pattern = np.random.default_rng(0).normal(size=ours.planes.shape).astype(np.float32)
        pattern[4:] = 0  # in px, of another size
        nothing = np.zeros_like(ours.transmittance)
        wanted, found = ours.backward(pattern, nothing), theirs.backward(pattern, nothing)
    except Exception as error:  # a driver or compiler that is out of order is no reason to stop
        said = shorten(str(error), 300, placeholder=" …")  # a compiler says pages
        return f"it failed ({type(error).__name__}: {said})"
    for name in ("packed", "pose", "centres", "absolute"):
        expected, got = getattr(wanted, name), getattr(found, name)
        size = max(float(np.linalg.norm(expected)), 1e-30)
        share = float(np.linalg.norm(got - expected)) / size
        if not share < GRADIENT_TOLERANCE:
            return f"its gradients ({name}) differ from the processor's by {share:.1%}"
    return None


def card_in_order() -> str | None:
    """The name of a card that passed the trial, with all that it passed with; None: there is none.

    What passed is noted beside the compiled kernels, for this driver, these libraries and this
    code: to know that a result is there already nobody need start a card, which takes seconds.
    """
    if not looks_like_a_card():
        return None
    name = _noted()
    if name is None and has_card() and card_trouble() is None:
        name = name_of_card()
        note_card(name)
    return name


def name_of_card() -> str:
    """Of the card that torch would use, and of the libraries that would."""
    import torch

    return f"{torch.cuda.get_device_name()}, {_libraries()}"


def note_card(name: str) -> None:
    """Note that a card passed the trial."""
    place = folder.writable()
    if place is not None:
        with contextlib.suppress(OSError):
            (place / _file()).write_text(name + "\n", encoding="utf-8")


def forget_card() -> bool:
    """Delete the note about a card that no longer passes; whether there was one."""
    noted = False
    for place in folder.readable():
        with contextlib.suppress(OSError):
            (place / _file()).unlink()
            noted = True
    return noted


def _noted() -> str | None:
    file = _file()
    for place in folder.readable():
        with contextlib.suppress(OSError, UnicodeDecodeError):
            return (place / file).read_text(encoding="utf-8").strip() or None
    return None


@cache
def _file() -> str:
    """Name of the note about what is here: cards, driver, libraries, and the code they ran."""
    try:
        cards = subprocess.run(
            ["nvidia-smi", "--query-gpu=name,driver_version,uuid", "--format=csv,noheader"],
            capture_output=True, text=True, timeout=60, check=False,
        ).stdout  # fmt: skip
    except (OSError, subprocess.TimeoutExpired):
        cards = ""
    said = [cards, os.environ.get("CUDA_VISIBLE_DEVICES", ""), _libraries()]
    content = hashlib.sha256(repr(said).encode())
    splatting = Path(__file__).resolve().parents[1] / "splatting"
    for path in (Path(__file__), splatting / "card.py", splatting / "torch_api.py"):
        content.update(path.read_bytes())
    return f"card-{content.hexdigest()[:16]}.txt"


def _libraries() -> str:
    return ", ".join(f"{name} {version(name)}" for name in ("gsplat", "torch"))


def _trial_scene() -> tuple[npt.NDArray[np.float32], Viewpoint, Viewpoint]:
    """Gaussians of all sizes, before and behind each other, and two cameras."""
    from stages.splatting.rasterizer import Viewpoint

    random, count = np.random.default_rng(0), 2000
    packed = np.concatenate(
        [
            random.uniform(-1, 1, (count, 2)), random.uniform(1, 3, (count, 1)),
            random.normal(size=(count, 4)), np.log(random.uniform(0.02, 0.2, (count, 3))),
            random.normal(size=(count, 1)), random.normal(0, 0.3, (count, 48)),
        ], 1,
    ).astype(np.float32)  # fmt: skip
    poses = np.tile(np.eye(4, dtype=np.float32)[:3], (2, 1, 1))
    poses[1, 0, 3] = 0.05
    lens = np.array([180, 170, 95, 62], np.float32)
    here, there = (Viewpoint(pose.copy(), lens, 192, 128) for pose in poses)
    return packed, here, there
