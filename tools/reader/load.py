"""Read a reader's weights: those of a training (`.pt`), or the file that ships (`.onnx`)."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import onnx
import torch
from export import HALF, Graph, to_onnx
from network import Reader
from onnx import numpy_helper
from torch import Tensor, nn


class _Filling(Graph):
    """Passes the network as `export.py` does, and puts the weights of a file into its layers."""

    def __init__(self, weights: Iterator[Tensor]) -> None:
        super().__init__()
        self._weights = weights

    def convolution(self, x: str, layer: nn.Conv2d, norm: nn.BatchNorm2d | None = None) -> str:
        with torch.no_grad():
            layer.weight.copy_(next(self._weights))
            bias = next(self._weights)
            if norm is None:
                layer.bias.copy_(bias)
            else:  # folded in: what is left of it adds the bias
                norm.weight.fill_(1)
                norm.bias.copy_(bias)
                norm.running_mean.zero_()
                norm.running_var.fill_(1 - norm.eps)
        return super().convolution(x, layer, norm)


def load(path: Path) -> Reader:
    """The reader with the weights of a file, in evaluation mode."""
    net = Reader().eval()
    if path.suffix != ".onnx":
        net.load_state_dict(torch.load(path, map_location="cpu", weights_only=True))
        return net
    halves = (w for w in onnx.load(path).graph.initializer if w.name.startswith(HALF))
    weights = (torch.from_numpy(numpy_helper.to_array(w).astype(np.float32)) for w in halves)
    to_onnx(net, _Filling(weights))
    return net
