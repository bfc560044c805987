"""Write a trained reader as the file that ships: ONNX, normalisation folded in, float16 weights.

python tools/reader/export.py reader.pt stages/teeth/reader.onnx
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import onnx
import torch
from network import CHANNELS, HEIGHT, VIEWS, WIDTH, Reader, Residual, Wide
from onnx import TensorProto, helper, numpy_helper
from torch import Tensor, nn

#: Names of weights in half precision begin so.
HALF = "half"


class Graph:
    """Collects nodes and weights."""

    def __init__(self) -> None:
        self.nodes: list[onnx.NodeProto] = []
        self.weights: list[onnx.TensorProto] = []
        self._count = 0

    def add(self, kind: str, inputs: list[str], **attributes: object) -> str:
        """Append a node; returns its output's name."""
        self._count += 1
        name = f"{kind.lower()}{self._count}"
        self.nodes.append(helper.make_node(kind, inputs, [name], name, **attributes))
        return name

    def weight(self, values: Tensor) -> str:
        """Append a weight, in half precision; returns its name in single precision."""
        self._count += 1
        array = values.detach().numpy().astype(np.float16)
        self.weights.append(numpy_helper.from_array(array, f"{HALF}{self._count}"))
        return self.add("Cast", [f"{HALF}{self._count}"], to=TensorProto.FLOAT)

    def constant(self, values: list[float], kind: type = np.float32) -> str:
        """Append a small constant; returns its name."""
        self._count += 1
        name = f"constant{self._count}"
        self.weights.append(numpy_helper.from_array(np.array(values, kind), name))
        return name

    def convolution(self, x: str, layer: nn.Conv2d, norm: nn.BatchNorm2d | None = None) -> str:
        """A convolution with the normalisation after it folded in."""
        weight = layer.weight
        bias = layer.bias if layer.bias is not None else torch.zeros(len(weight))
        if norm is not None:
            factor = norm.weight / torch.sqrt(norm.running_var + norm.eps)
            weight = weight * factor[:, None, None, None]
            bias = (bias - norm.running_mean) * factor + norm.bias
        pad, stride = layer.kernel_size[0] // 2, layer.stride[0]
        return self.add(
            "Conv", [x, self.weight(weight), self.weight(bias)], pads=[pad] * 4,
            strides=[stride] * 2, kernel_shape=list(layer.kernel_size), group=layer.groups,
        )  # fmt: skip

    def doubled(self, x: str) -> str:
        """Twice as large, bilinear."""
        return self.add(
            "Resize", [x, "", self.constant([1, 1, 2, 2])],
            mode="linear", coordinate_transformation_mode="half_pixel",
        )  # fmt: skip

    def block(self, x: str, block: nn.Module) -> str:
        """Whatever the network's blocks are made of."""
        if isinstance(block, Residual):
            y = self.block(x, block.first)
            y = self.convolution(y, block.second[0], block.second[1])
            return self.add("Relu", [self.add("Add", [x, y])])
        if isinstance(block, Wide):
            y = self.block(self.convolution(x, block.spread[0], block.spread[1]), block.mix)
            y = self.convolution(y, block.join[0], block.join[1])
            return self.add("Relu", [self.add("Add", [x, y])])
        if isinstance(block, nn.Sequential):
            parts = list(block)
            if len(parts) == 3 and isinstance(parts[1], nn.BatchNorm2d):
                return self.add("Relu", [self.convolution(x, parts[0], parts[1])])
            for part in parts:
                x = self.block(x, part)
            return x
        if isinstance(block, nn.Conv2d):
            return self.convolution(x, block)
        assert isinstance(block, nn.Dropout2d), type(block)
        return x


def to_onnx(net: Reader, graph: Graph | None = None) -> onnx.ModelProto:
    """The network as an ONNX graph of plain operations."""
    graph = graph or Graph()
    levels = [graph.block("image", net.stem)]
    for down in net.down:
        levels.append(graph.block(levels[-1], down))
    y = levels.pop()
    whole = graph.add("GlobalAveragePool", [y])
    kind = graph.convolution(whole, net.kind)
    # As large as the level, for a graph without broadcasting: every place adds the same.
    y = graph.add("Add", [y, graph.add("Relu", [graph.convolution(whole, net.context)])])
    grown = []
    for narrow, up in zip(net.narrow, net.up, strict=True):
        large = graph.doubled(graph.convolution(y, narrow))
        y = graph.block(graph.add("Add", [large, levels.pop()]), up)
        grown.append(y)
    far, near = graph.doubled(graph.block(grown[1], net.far)), graph.block(grown[2], net.near)
    meaning = graph.block(graph.add("Add", [far, near]), net.meaning)
    shape = graph.block(y, net.shape)
    far, near = (
        graph.doubled(graph.block(grown[1], net.tissue.far)),
        graph.block(grown[2], net.tissue.near),
    )
    join = graph.block(graph.add("Add", [far, near]), net.tissue.join)
    here = graph.block(y, net.tissue.here)
    tissue = graph.block(graph.add("Add", [graph.doubled(join), here]), net.tissue.last)
    y = graph.add("Concat", [shape, graph.doubled(meaning), tissue], axis=1)
    graph.nodes.append(helper.make_node("Identity", [y], ["answer"], "answer"))
    graph.nodes.append(helper.make_node("Flatten", [kind], ["kind"], "kind"))
    model = helper.make_model(
        helper.make_graph(
            graph.nodes, "tooth reader",
            [helper.make_tensor_value_info("image", TensorProto.FLOAT, [1, 3, HEIGHT, WIDTH])],
            [
                helper.make_tensor_value_info(
                    "answer", TensorProto.FLOAT, [1, CHANNELS, HEIGHT // 2, WIDTH // 2]
                ),
                helper.make_tensor_value_info("kind", TensorProto.FLOAT, [1, len(VIEWS) + 1]),
            ],
            graph.weights,
        ),
        opset_imports=[helper.make_opsetid("", 13)],
        producer_name="dentalsplat",
    )  # fmt: skip
    model.ir_version = 8
    onnx.checker.check_model(model)
    return model


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("weights", type=Path, help="what train.py wrote")
    parser.add_argument("out", type=Path)
    arguments = parser.parse_args()
    net = Reader()
    net.load_state_dict(torch.load(arguments.weights, weights_only=True))
    arguments.out.write_bytes(to_onnx(net.eval()).SerializeToString(deterministic=True))
    print(f"{arguments.out}: {arguments.out.stat().st_size / 1e6:.2f} MB")


if __name__ == "__main__":
    main()
