"""The folded network as an ONNX graph, for onnxruntime and OpenVINO; made by hand, so that it needs no torch.

In int8 the graph stays one of floats with pairs of QuantizeLinear and DequantizeLinear where values have 8 bits, which
the libraries recognise and turn into integer convolutions: outputs of the layers by one range each, unsigned, weights
by one each channel, signed. LeakyReLU becomes ReLU there: most of what it lets through below zero is less than a step.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vioframe_keypointnet.folding import LEAK, NEUTRAL_GREY, Convolution, FoldedNetwork
from vioframe_keypointnet.optional import needs
from vioframe_keypointnet.seeing import CONTRAST_STEP, ZERO
from vioframe_keypointnet.tensors import OUT, RESPONSE

_OPSET, _IR = 17, 9


def onnx_model(
    network: FoldedNetwork, shape: tuple[int, int], activation_ranges: Mapping[str, float] | None = None
) -> bytes:
    """A serialised ONNX model of ``network`` for images of ``shape`` (H, W), multiples of 8; int8 if given the ranges.

    Takes as ``seen`` what an :class:`~vioframe_keypointnet.seeing.Eye` sees, in 8 bits if in int8; gives what
    :meth:`FoldedNetwork.build` does.
    """
    with needs("onnx", "onnxruntime"):
        from onnx import TensorProto, helper

    graph = _Graph(activation_ranges or {})
    peaks, f = network.architecture.peaks, network.architecture.fold
    outputs = (_seeing_integers(network) if activation_ranges and not peaks else network).build(graph, "seen")
    kind = TensorProto.FLOAT if peaks and not activation_ranges else TensorProto.UINT8
    seen = helper.make_tensor_value_info("seen", kind, [1, f * f, shape[0] // f, shape[1] // f])
    found = [helper.make_tensor_value_info(name, TensorProto.FLOAT, None) for name in outputs]
    made = helper.make_graph(graph.nodes, "keypointnet", [seen], found, graph.constants)
    model = helper.make_model(made, opset_imports=[helper.make_opsetid("", _OPSET)], ir_version=_IR)
    return bytes(model.SerializeToString())


def _seeing_integers(network: FoldedNetwork) -> FoldedNetwork:
    """``network`` for grey levels less a whole number; only what it sees beyond the border differs, by half a level."""
    first, *rest = network.encoder
    shift = first.weight.sum(axis=(1, 2, 3)) * np.float32(ZERO - NEUTRAL_GREY)
    return replace(network, encoder=(replace(first, bias=first.bias + shift), *rest))


class _Graph:
    """Operations of ONNX; a node is the name of its output."""

    def __init__(self, activation_ranges: Mapping[str, float]) -> None:
        from onnx import NodeProto, TensorProto

        self.nodes: list[NodeProto] = []
        self.constants: list[TensorProto] = []
        self._ranges = activation_ranges
        self._steps: dict[str, np.float32] = {}
        """Values that have 8 bits, and the step of these."""

    def seen(self, x: str, peaks: bool) -> str:
        from onnx import TensorProto

        if self._ranges:
            return self.dequantised(x, CONTRAST_STEP if peaks else np.float32(1.0), ZERO)
        if peaks:
            return x
        levels = self.node("Cast", [x], to=TensorProto.FLOAT)
        return self.node("Sub", [levels, self.constant(np.float32(NEUTRAL_GREY))])

    def convolve(self, layer: Convolution, x: str) -> str:
        integer = x in self._steps and (layer.name in self._ranges or layer.name in (OUT, RESPONSE))
        weight, bias = self._integers(layer, self._steps[x]) if integer else self._floats(layer)
        y = self.node("Conv", [x, weight, bias], pads=[layer.pad] * 4)
        if layer.name in self._ranges:
            return self._quantised(self.node("Relu", [y]), np.float32(self._ranges[layer.name] / 255.0), 0)
        return self.node("LeakyRelu", [y], alpha=LEAK) if layer.activated else y

    def pool(self, x: str) -> str:
        y = self.node("MaxPool", [x], kernel_shape=[2, 2], strides=[2, 2])
        if x in self._steps:
            self._steps[y] = self._steps[x]
        return y

    def shuffle(self, x: str) -> str:
        return self.node("DepthToSpace", [x], blocksize=2, mode="CRD")

    def join(self, a: str, b: str) -> str:
        return self.node("Concat", [a, b], axis=1)

    def channels_last(self, x: str) -> str:
        return self.node("Transpose", [x], perm=[0, 2, 3, 1])

    def dequantised(self, x: str, step: np.float32, zero: int) -> str:
        """The values of ``x`` uint8, of which convolutions may make use as they are."""
        y = self.node("DequantizeLinear", [x, self.constant(step), self.constant(np.uint8(zero))])
        self._steps[y] = step
        return y

    def node(self, kind: str, inputs: list[str], **attributes: Any) -> str:
        from onnx import helper

        name = f"{kind}_{len(self.nodes)}"
        self.nodes.append(helper.make_node(kind, inputs, [name], name, **attributes))
        return name

    def constant(self, value: NDArray[np.generic] | np.generic) -> str:
        from onnx import numpy_helper

        name = f"constant_{len(self.constants)}"
        self.constants.append(numpy_helper.from_array(np.asarray(value), name))
        return name

    def _quantised(self, x: str, step: np.float32, zero: int) -> str:
        integers = self.node("QuantizeLinear", [x, self.constant(step), self.constant(np.uint8(zero))])
        return self.dequantised(integers, step, zero)

    def _floats(self, layer: Convolution) -> tuple[str, str]:
        return self.constant(layer.weight), self.constant(layer.bias)

    def _integers(self, layer: Convolution, input_step: np.float32) -> tuple[str, str]:
        """The weights in 8 bits with a step for each channel, the bias in 32 with that of the products."""
        steps = np.maximum(np.abs(layer.weight).max(axis=(1, 2, 3)), np.finfo(np.float32).tiny) / np.float32(127.0)
        weight = np.round(layer.weight / steps[:, None, None, None]).astype(np.int8)
        products = steps * input_step
        bias = np.clip(np.round(layer.bias / products.astype(np.float64)), -(2**31), 2**31 - 1).astype(np.int32)
        return self._of_channels(weight, steps), self._of_channels(bias, products)

    def _of_channels(self, integers: NDArray[np.generic], steps: NDArray[np.float32]) -> str:
        zeros = self.constant(np.zeros(len(steps), integers.dtype))
        return self.node("DequantizeLinear", [self.constant(integers), self.constant(steps), zeros], axis=0)
