"""Which rasterizer a fit uses: the processor's, or gsplat's on a card that first proves itself."""

from __future__ import annotations

import importlib.util
import shutil
from functools import cache
from importlib.metadata import version
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from pipeline.errors import RequestError

if TYPE_CHECKING:
    from stages.fit.trainer import Trainer
    from stages.splatting.rasterizer import Viewpoint

#: the card's image may differ by this much from the processor's (mean over the pixels), and its
#: gradients by this share: sums in another order do, a wrong convention does by far more
IMAGE_TOLERANCE, GRADIENT_TOLERANCE = 1e-3, 0.02


def has_card() -> bool:
    """Whether gsplat is installed and there is a card that torch can use."""
    if shutil.which("nvidia-smi") is None or importlib.util.find_spec("gsplat") is None:
        return False
    from stages.splatting.torch_api import choose_backend

    return choose_backend() == "gsplat"


def expected_backend(config: Any) -> str:
    """What a fit with this `FitConfig` will run on here: ``"cpu"``, or gsplat on which card.

    A card that is out of order doesn't count, so that what the processor makes in its place is
    never taken for the card's.
    """
    if config.backend == "cpu" or _obstacle(config) is not None:
        return "cpu"
    if config.backend == "auto" and card_trouble() is not None:
        return "cpu"
    import torch

    versions = ", ".join(f"{name} {version(name)}" for name in ("gsplat", "torch"))
    return f"{torch.cuda.get_device_name()}, {versions}"


def use_backend(trainer: Trainer) -> str | None:
    """Give a fit that is about to start its rasterizer.

    Returns:
        Why there is a card that is not used; None if all is as it was asked for.

    Raises:
        RequestError: gsplat was asked for and can't be used.
    """
    s = trainer.settings
    if s.backend == "cpu" or (s.backend == "auto" and not has_card()):
        return None
    why = _obstacle(s) or card_trouble()
    if why is None:
        trainer.rasterize = _card()
        return None
    if s.backend == "gsplat":
        raise RequestError(
            f"fit.backend=gsplat can't be used: {why}. Take fit.backend=cpu, or auto, which uses a "
            "card only where it works."
        )
    return f"The fit ran on the processor although there is a card: {why}."


def _obstacle(s: Any) -> str | None:
    """Why settings, or a config, can't be had on a card."""
    if s.optimize_focal:
        return "it gives no gradient by the focal length (fit.optimize_focal)"
    if s.progressive is True:
        return "views that are placed one by one are placed by the processor (fit.progressive)"
    if not has_card():
        return "there is no gsplat (install dentalsplat[gpu]) or no card that torch can use"
    return None


def _card() -> Any:
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
        theirs = _card()(packed, here, **options)
        off = float(np.abs(ours.planes[:4] - theirs.planes[:4]).mean())
        if not off < IMAGE_TOLERANCE:
            return f"its images differ from the processor's by {off:.2g} on average"
        pattern = np.random.default_rng(0).normal(size=ours.planes.shape).astype(np.float32)
        pattern[4:] = 0  # in px, of another size
        nothing = np.zeros_like(ours.transmittance)
        wanted, found = ours.backward(pattern, nothing), theirs.backward(pattern, nothing)
    except Exception as error:  # a driver or compiler that is out of order is no reason to stop
        return f"it failed ({type(error).__name__}: {error})"
    for name in ("packed", "pose", "centres", "absolute"):
        expected, got = getattr(wanted, name), getattr(found, name)
        size = max(float(np.linalg.norm(expected)), 1e-30)
        share = float(np.linalg.norm(got - expected)) / size
        if not share < GRADIENT_TOLERANCE:
            return f"its gradients ({name}) differ from the processor's by {share:.1%}"
    return None


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
