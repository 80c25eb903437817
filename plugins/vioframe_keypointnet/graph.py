"""The network as one ONNX graph to be run: batch norm folded into the convolutions, nothing in it that is not needed.

Made by hand, so that it needs no torch. In int8 it stays a graph of floats with pairs of QuantizeLinear and
DequantizeLinear where values have 8 bits, which a runtime recognises and turns into integer convolutions: outputs of
the layers by one range each, unsigned, weights by one each channel, signed. LeakyReLU becomes ReLU there: most of what
it lets through below zero is less than a step.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vioframe.errors import needs
from vioframe_keypointnet.architecture import HEADS, Architecture, Tensors
from vioframe_keypointnet.seeing import CONTRAST_STEP, ZERO
from vioframe_keypointnet.weights import Weights

_OPSET, _IR = 17, 9
_OUT = "out"
_LAST = (_OUT, "R")
"""The layers whose outputs are the detector's: in int8 what they see has 8 bits, what they give has not."""
_LEAK = 0.01
"""Slope of LeakyReLU below zero."""
_NEUTRAL_GREY = 127.5
"""The grey that the network sees as 0; also what lies around the image."""
_SCALE = 0.225 / 255.0
_BATCH_NORM_EPSILON = 1e-5


def onnx_model(weights: Weights, shape: tuple[int, int], *, descriptors: bool = False, int8: bool = False) -> bytes:
    """A serialised ONNX model for grey images of ``shape`` (H, W), multiples of 8.

    It takes as ``seen`` (1, C, h, w) what an :class:`~vioframe_keypointnet.seeing.Eye` sees, and gives what
    :meth:`vioframe_keypointnet.network.KeypointNet.found` does, which it equals on R = G = B but for rounding.
    """
    with needs("onnx", "openvino", user="KeypointNet by OpenVINO"):
        from onnx import TensorProto, helper

    architecture, f = weights.architecture, weights.architecture.fold
    graph = _Graph(weights.activation_ranges or {} if int8 else {})
    outputs = _build(graph, weights, descriptors)
    kind = TensorProto.FLOAT if architecture.peaks and not int8 else TensorProto.UINT8
    seen = helper.make_tensor_value_info("seen", kind, [1, f * f, shape[0] // f, shape[1] // f])
    found = [helper.make_tensor_value_info(name, TensorProto.FLOAT, None) for name in outputs]
    made = helper.make_graph(graph.nodes, "keypointnet", [seen], found, graph.constants)
    model = helper.make_model(made, opset_imports=[helper.make_opsetid("", _OPSET)], ir_version=_IR)
    return bytes(model.SerializeToString())


def _build(graph: _Graph, weights: Weights, descriptors: bool) -> tuple[str, ...]:
    """Adds all layers; the names of the outputs."""
    architecture, tensors = weights.architecture, weights.tensors
    x, after = graph.seen("seen", architecture.peaks), dict[int, str]()
    for number, layers in architecture.encoder.items():
        if number > 2 and architecture.peaks and not descriptors:
            break
        if after:
            x = graph.node("MaxPool", [x], kernel_shape=[2, 2], strides=[2, 2])
        for k, layer in enumerate(layers):
            convolution = _convolution(tensors, layer.name)
            if not after and k == 0:
                convolution = _of_what_is_seen(convolution, architecture, graph.int8)
            x = graph.convolve(convolution, x)
        after[number] = x
    if architecture.peaks:
        found = graph.node("Transpose", [graph.convolve(_convolution(tensors, "R"), after[2])], perm=[0, 2, 3, 1])
    else:
        hidden, output = _score_and_place(tensors)
        found = graph.convolve(output, graph.convolve(hidden, x))
    if not descriptors:
        return (found,)
    x = graph.convolve(_convolution(tensors, "Fb", activated=False), graph.convolve(_convolution(tensors, "Fa"), x))
    x = graph.node("DepthToSpace", [x], blocksize=2, mode="CRD")
    x = graph.convolve(_convolution(tensors, "Faa"), graph.node("Concat", [x, after[3]], axis=1))
    return found, graph.convolve(_convolution(tensors, "Fbb"), x)


@dataclass(frozen=True, slots=True)
class _Convolution:
    """A convolution padded with zeros so that the size is kept, then LeakyReLU if activated."""

    name: str
    weight: NDArray[np.float32]
    """(out, in, k, k)."""
    bias: NDArray[np.float32]
    """(out,)."""
    activated: bool = True


def _convolution(tensors: Tensors, name: str, *, activated: bool = True) -> _Convolution:
    """Layer ``name`` and the batch norm behind it in one; those without a batch norm are not activated."""
    if f"conv{name}.weight" in tensors:
        return _Convolution(name, tensors[f"conv{name}.weight"], tensors[f"conv{name}.bias"], activated=False)
    gamma, beta, mean, variance = (
        tensors[f"conv{name}.1.{s}"].astype(np.float64) for s in ("weight", "bias", "running_mean", "running_var")
    )
    gain = gamma / np.sqrt(variance + _BATCH_NORM_EPSILON)
    weight = tensors[f"conv{name}.0.weight"] * gain[:, None, None, None]
    return _Convolution(name, weight.astype(np.float32), (beta - mean * gain).astype(np.float32), activated)


def _of_what_is_seen(first: _Convolution, architecture: Architecture, int8: bool) -> _Convolution:
    """The first layer on one channel in place of all, of local contrast or of grey levels.

    That is (grey level - 127.5) in place of (x / 255 - 0.5) * 0.225. Only the factor may go into the weights: the shift
    has to stay before the padding, whose zeros mean neutral grey. In int8 levels are whole, shifted by 128, and only
    what is seen beyond the border differs.
    """
    weight, bias = (
        first.weight.reshape(len(first.weight), architecture.image_channels, -1, 3, 3).sum(axis=1),
        first.bias,
    )
    if not architecture.peaks:
        weight *= np.float32(_SCALE)
        if int8:
            bias = bias + weight.sum(axis=(1, 2, 3)) * np.float32(ZERO - _NEUTRAL_GREY)
    return replace(first, weight=weight, bias=bias)


def _score_and_place(tensors: Tensors) -> tuple[_Convolution, _Convolution]:
    """Both heads as one: the hidden layers stacked, and the last, each part of it blind to the other's half."""
    score, place = _convolution(tensors, "Da"), _convolution(tensors, "Pa")
    hidden = np.concatenate([score.weight, place.weight]), np.concatenate([score.bias, place.bias])
    score, place = _convolution(tensors, "Db"), _convolution(tensors, "Pb")
    half = score.weight.shape[1]
    weight = np.zeros((3, 2 * half, 3, 3), np.float32)
    weight[:1, :half], weight[1:, half:] = score.weight, place.weight
    last = _Convolution(_OUT, weight, np.concatenate([score.bias, place.bias]), activated=False)
    return _Convolution(HEADS, *hidden), last


class _Graph:
    """Operations of ONNX; a node is the name of its output."""

    def __init__(self, activation_ranges: Mapping[str, float]) -> None:
        from onnx import NodeProto, TensorProto

        self.nodes: list[NodeProto] = []
        self.constants: list[TensorProto] = []
        self.int8 = bool(activation_ranges)
        self._ranges = activation_ranges
        self._steps: dict[str, np.float32] = {}
        """Values that have 8 bits, and the step of these."""

    def seen(self, x: str, peaks: bool) -> str:
        """What comes in, as the first layer wants it."""
        from onnx import TensorProto

        if self.int8:
            return self._dequantised(x, CONTRAST_STEP if peaks else np.float32(1.0), ZERO)
        if peaks:
            return x
        levels = self.node("Cast", [x], to=TensorProto.FLOAT)
        return self.node("Sub", [levels, self._constant(np.float32(_NEUTRAL_GREY))])

    def convolve(self, layer: _Convolution, x: str) -> str:
        integer = x in self._steps and (layer.name in self._ranges or layer.name in _LAST)
        if integer:
            weight, bias = self._integers(layer, self._steps[x])
        else:
            weight, bias = self._constant(layer.weight), self._constant(layer.bias)
        y = self.node("Conv", [x, weight, bias], pads=[layer.weight.shape[2] // 2] * 4)
        if layer.name in self._ranges:
            step = np.float32(self._ranges[layer.name] / 255.0)
            y = self.node("Relu", [y])
            y = self.node("QuantizeLinear", [y, self._constant(step), self._constant(np.uint8(0))])
            return self._dequantised(y, step, 0)
        return self.node("LeakyRelu", [y], alpha=_LEAK) if layer.activated else y

    def node(self, kind: str, inputs: list[str], **attributes: Any) -> str:
        from onnx import helper

        name = f"{kind}_{len(self.nodes)}"
        self.nodes.append(helper.make_node(kind, inputs, [name], name, **attributes))
        if kind == "MaxPool" and inputs[0] in self._steps:
            self._steps[name] = self._steps[inputs[0]]
        return name

    def _dequantised(self, x: str, step: np.float32, zero: int) -> str:
        """The values of ``x`` uint8, of which convolutions may make use as they are."""
        y = self.node("DequantizeLinear", [x, self._constant(step), self._constant(np.uint8(zero))])
        self._steps[y] = step
        return y

    def _integers(self, layer: _Convolution, input_step: np.float32) -> tuple[str, str]:
        """The weights in 8 bits with a step for each channel, the bias in 32 with that of the products."""
        steps = np.maximum(np.abs(layer.weight).max(axis=(1, 2, 3)), np.finfo(np.float32).tiny) / np.float32(127.0)
        weight = np.round(layer.weight / steps[:, None, None, None]).astype(np.int8)
        products = steps * input_step
        bias = np.clip(np.round(layer.bias / products.astype(np.float64)), -(2**31), 2**31 - 1).astype(np.int32)
        return self._of_channels(weight, steps), self._of_channels(bias, products)

    def _of_channels(self, integers: NDArray[np.generic], steps: NDArray[np.float32]) -> str:
        zeros = self._constant(np.zeros(len(steps), integers.dtype))
        return self.node("DequantizeLinear", [self._constant(integers), self._constant(steps), zeros], axis=0)

    def _constant(self, value: NDArray[np.generic] | np.generic) -> str:
        from onnx import numpy_helper

        name = f"constant_{len(self.constants)}"
        self.constants.append(numpy_helper.from_array(np.asarray(value), name))
        return name
