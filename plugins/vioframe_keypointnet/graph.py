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

from vioframe_keypointnet.architecture import FAINT
from vioframe_keypointnet.folding import LEAK, NEUTRAL_GREY, Convolution, FoldedNetwork
from vioframe_keypointnet.optional import needs
from vioframe_keypointnet.tensors import OUT, RESPONSE

_OPSET, _IR = 17, 9

_MIDDLE_GREY = 128
"""The whole number nearest to :data:`NEUTRAL_GREY`, so that an image's own 8 bits can be multiplied."""

_MOST_DEVIATIONS = 6.0
"""Locally normalised images reach that far in 8 bits; what lies farther out is noise on a blank surface."""


def onnx_model(
    network: FoldedNetwork, shape: tuple[int, int], activation_ranges: Mapping[str, float] | None = None
) -> bytes:
    """A serialised ONNX model of ``network`` for images of ``shape`` (H, W), multiples of 8; int8 if given the ranges.

    Takes ``image`` (1, 1, H, W) uint8; gives what :meth:`FoldedNetwork.build` does.
    """
    with needs("onnx", "onnxruntime"):
        from onnx import TensorProto, helper

    graph = _Graph(shape, activation_ranges or {})
    seen = _seeing_integers(network) if activation_ranges and not network.architecture.peaks else network
    outputs = seen.build(graph, "image")
    height, width = shape
    image = helper.make_tensor_value_info("image", TensorProto.UINT8, [1, 1, height, width])
    found = [helper.make_tensor_value_info(name, TensorProto.FLOAT, None) for name in outputs]
    made = helper.make_graph(graph.nodes, "keypointnet", [image], found, graph.constants)
    model = helper.make_model(made, opset_imports=[helper.make_opsetid("", _OPSET)], ir_version=_IR)
    return bytes(model.SerializeToString())


def _seeing_integers(network: FoldedNetwork) -> FoldedNetwork:
    """``network`` for grey levels less a whole number; only what it sees beyond the border differs, by half a level."""
    first, *rest = network.encoder
    shift = first.weight.sum(axis=(1, 2, 3)) * np.float32(_MIDDLE_GREY - NEUTRAL_GREY)
    return replace(network, encoder=(replace(first, bias=first.bias + shift), *rest))


def smoothing(side: int) -> NDArray[np.float32]:
    """(side, side / 4) from means of 4 px to the mean of about 20 px around each pixel: five means, interpolated.

    As :func:`vioframe_keypointnet.network.locally_normalised` has it, along one axis. As a matrix it takes a hundredth
    of the time that the libraries take to interpolate.
    """
    means = np.pad(np.eye(side // 4, dtype=np.float32), ((2, 2), (0, 0)), mode="edge")
    boxes = np.mean([means[k : k + side // 4] for k in range(5)], axis=0)
    at = np.clip((np.arange(side) + 0.5) / 4.0 - 0.5, 0.0, side // 4 - 1.0)
    low = at.astype(np.intp)
    high = np.minimum(low + 1, side // 4 - 1)
    share = (at - low).astype(np.float32)[:, None]
    matrix: NDArray[np.float32] = (1.0 - share) * boxes[low] + share * boxes[high]
    return matrix


class _Graph:
    """Operations of ONNX; a node is the name of its output."""

    def __init__(self, shape: tuple[int, int], activation_ranges: Mapping[str, float]) -> None:
        from onnx import NodeProto, TensorProto

        self.nodes: list[NodeProto] = []
        self.constants: list[TensorProto] = []
        self._smoothing = smoothing(shape[0]), smoothing(shape[1])
        self._ranges = activation_ranges
        self._steps: dict[str, np.float32] = {}
        """Values that have 8 bits, and the step of these."""

    def centred(self, image: str) -> str:
        if self._ranges:
            return self.dequantised(image, np.float32(1.0), _MIDDLE_GREY)
        return self.node("Sub", [self._floats_of(image), self.constant(np.float32(NEUTRAL_GREY))])

    def normalised(self, image: str) -> str:
        grey = self._floats_of(image)
        flat = self.node("Sub", [grey, self._smooth(grey)])
        faint = self.constant(np.float32((255.0 * FAINT) ** 2))
        deviation = self.node("Sqrt", [self.node("Add", [self._smooth(self.node("Mul", [flat, flat])), faint])])
        x = self.node("Div", [flat, deviation])
        return self._quantised(x, np.float32(_MOST_DEVIATIONS / 127.0), _MIDDLE_GREY) if self._ranges else x

    def _smooth(self, x: str) -> str:
        coarse = self.node("AveragePool", [x], kernel_shape=[4, 4], strides=[4, 4])
        rows, columns = (self.constant(matrix) for matrix in (self._smoothing[0], self._smoothing[1].T.copy()))
        return self.node("MatMul", [rows, self.node("MatMul", [coarse, columns])])

    def _floats_of(self, image: str) -> str:
        from onnx import TensorProto

        return self.node("Cast", [image], to=TensorProto.FLOAT)

    def convolve(self, layer: Convolution, x: str) -> str:
        integer = x in self._steps and (layer.name in self._ranges or layer.name in (OUT, RESPONSE))
        weight, bias = self._integers(layer, self._steps[x]) if integer else self._floats(layer)
        y = self.node("Conv", [x, weight, bias], pads=[layer.pad] * 4, strides=[layer.stride] * 2)
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
