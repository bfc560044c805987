"""LPIPS, where VGG-16's weights are at hand."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from pipeline.errors import RequestError
from pipeline.installed import is_installed, require
from pipeline.untrusted.paths import user_path

if TYPE_CHECKING:
    import torch

Image = npt.NDArray[np.uint8]
Mask = npt.NDArray[np.bool_]

#: torchvision's file name of VGG-16 trained on ImageNet, in torch's cache.
VGG_FILE = "vgg16-397923af.pth"
#: Index of VGG-16's convolutions in torchvision's `features`, by the block that LPIPS looks at; a
#: block ends with the ReLU whose output is compared, and all but the first begin with pooling.
VGG_BLOCKS = ((0, 2), (5, 7), (10, 12, 14), (17, 19, 21), (24, 26, 28))
#: LPIPS's normalisation of an image in -1..1.
_SHIFT = (-0.030, -0.088, -0.188)
_SCALE = (0.458, 0.448, 0.450)


def find_vgg_weights(given: str | None) -> Path | None:
    """The file with VGG-16's weights: the given one, else torch's cached one, else None.

    None also where there is a cached one but no torch to read it.

    Raises:
        RequestError: the given file does not exist, or what reads it is not installed.
    """
    if given is not None:
        path = user_path(given, "evaluate.lpips_weights")
        if not path.is_file():
            raise RequestError(
                f"evaluate.lpips_weights: there is no file {path}. Give torchvision's weights of "
                f"VGG-16 ({VGG_FILE}), or leave the setting out: lpips is then not computed."
            )
        require("evaluate.lpips_weights", "torch", "torch", "torchmetrics")
        return path
    if not is_installed("torch", "torchmetrics"):
        return None
    import os

    cache = os.environ.get("TORCH_HOME") or (
        Path(os.environ.get("XDG_CACHE_HOME") or "~/.cache") / "torch"
    )
    path = user_path(cache, "TORCH_HOME or XDG_CACHE_HOME") / "hub" / "checkpoints" / VGG_FILE
    return path if path.is_file() else None


class Lpips:
    """LPIPS with VGG-16 (Zhang et al., CVPR 2018), version 0.1: lower is more alike.

    The features are VGG-16's, from torchvision's weights; the linear layers on top of them come
    with torchmetrics. Nothing is ever downloaded.
    """

    def __init__(
        self, features: Mapping[str, torch.Tensor], heads: Mapping[str, torch.Tensor]
    ) -> None:
        """
        Args:
            features: torchvision's state of VGG-16 (``features.0.weight``, ...).
            heads: linear layers (``lin0.model.1.weight``, ...).

        Raises:
            KeyError: a weight is missing.
        """
        self.convolutions = [
            [
                tuple(features[f"features.{index}.{part}"].float() for part in ("weight", "bias"))
                for index in block
            ]
            for block in VGG_BLOCKS
        ]
        self.heads = [
            heads[f"lin{level}.model.1.weight"].float() for level in range(len(VGG_BLOCKS))
        ]

    @classmethod
    def from_file(cls, path: Path) -> Lpips:
        """Read torchvision's weights of VGG-16.

        Raises:
            RequestError: the file is something else.
        """
        import torch

        try:
            if path.suffix == ".safetensors":
                from safetensors.torch import load_file

                state: Mapping[str, Any] = load_file(path)
            else:
                state = torch.load(path, map_location="cpu", weights_only=True)
            return cls(state, _heads())
        except Exception as error:
            raise RequestError(
                f"evaluate.lpips_weights: {path} does not hold torchvision's weights of VGG-16 "
                f"({type(error).__name__}: {error}). Their file is {VGG_FILE}."
            ) from error

    def __call__(self, image: Image, truth: Image, mask: Mask | None = None) -> float:
        """LPIPS of two [H, W, 3] uint8 images of at least 16 x 16 pixels.

        Args:
            image, truth: the images.
            mask: [H, W] pixels that the mean is of, some at least; None: all. At each level a
                feature counts by their share of what it is the place of.
        """
        import torch

        counted = torch.from_numpy(np.ones(image.shape[:2]) if mask is None else mask * 1.0)
        before = torch.get_num_threads()
        torch.set_num_threads(1)  # sums in another order would give other bytes
        try:
            with torch.inference_mode():
                distance = 0.0
                levels = zip(self._features(image), self._features(truth), self.heads, strict=True)
                for a, b, head in levels:
                    weighted = torch.nn.functional.conv2d((_unit(a) - _unit(b)) ** 2, head)
                    share = torch.nn.functional.adaptive_avg_pool2d(
                        counted[None], (weighted.shape[2], weighted.shape[3])
                    )
                    distance += float((weighted.double() * share).sum() / share.sum())
        finally:
            torch.set_num_threads(before)
        return distance

    def _features(self, image: Image) -> list[torch.Tensor]:
        import torch

        picture = torch.from_numpy(np.array(image)).permute(2, 0, 1)[None].float()
        picture = picture / 127.5 - 1
        shift, scale = (torch.tensor(values)[None, :, None, None] for values in (_SHIFT, _SCALE))
        picture = (picture - shift) / scale
        found = []
        for number, block in enumerate(self.convolutions):
            if number:
                picture = torch.nn.functional.max_pool2d(picture, 2)
            for weight, bias in block:
                picture = torch.nn.functional.conv2d(picture, weight, bias, padding=1).relu()
            found.append(picture)
        return found


def _unit(features: torch.Tensor) -> torch.Tensor:
    """Each pixel's features at length 1."""
    norm: torch.Tensor = (features**2).sum(1, keepdim=True).sqrt()
    return features / (norm + 1e-8)


def _heads() -> Mapping[str, torch.Tensor]:
    """The linear layers, from the installed torchmetrics."""
    from importlib.resources import files

    import torch

    name = files("torchmetrics") / "functional" / "image" / "lpips_models" / "vgg.pth"
    with name.open("rb") as file:
        state: Mapping[str, torch.Tensor] = torch.load(file, map_location="cpu", weights_only=True)
    return state
