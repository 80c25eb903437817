"""The network as OpenVINO's graph: batch norm folded into the convolutions, nothing in it that is not needed.

Made by hand, so that it needs no torch. In int8 it stays a graph of floats, quantised and dequantised where values have
8 bits, which OpenVINO recognises and turns into integer convolutions: outputs of the layers by one range each,
unsigned, weights by one each channel, signed and of seven bits: processors without instructions for dot products add
two products in 16 bits, which larger ones overflow. LeakyReLU becomes ReLU there: most of what it lets through below
zero is less than a step.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from vioframe.errors import needs
from vioframe_keypointnet.architecture import HEADS, Architecture, Tensors
from vioframe_keypointnet.seeing import CONTRAST_STEP, ZERO
from vioframe_keypointnet.weights import Weights

if TYPE_CHECKING:
    from openvino import Model

_OUT = "out"
_LAST = (_OUT, "R")
"""The layers whose outputs are the detector's: in int8 what they see has 8 bits, what they give has not."""
_LEAK = 0.01
"""Slope of LeakyReLU below zero."""
_NEUTRAL_GREY = 127.5
"""The grey that the network sees as 0; also what lies around the image."""
_SCALE = 0.225 / 255.0
_BATCH_NORM_EPSILON = 1e-5
_LARGEST_WEIGHT = np.float32(63.0)
"""In int8; two products with 255 are less than 2^15."""


class _Values(NamedTuple):
    """What a node of the graph gives, in float32, and the step of those that have 8 bits."""

    node: Any
    step: np.float32 | None = None


def import_openvino() -> Any:
    """OpenVINO, without what tells its maker of each import: that forks, in the midst of a run, to send it."""
    told, sys.modules["openvino_telemetry"] = sys.modules.get("openvino_telemetry"), None  # type: ignore[assignment]
    try:
        with needs("OpenVINO", "openvino", user="KeypointNet by OpenVINO"):
            import openvino
    finally:
        del sys.modules["openvino_telemetry"]
        if told is not None:
            sys.modules["openvino_telemetry"] = told
    return openvino


def model(weights: Weights, shape: tuple[int, int], *, descriptors: bool = False, int8: bool = False) -> Model:
    """The graph for grey images of ``shape`` (H, W), multiples of 8.

    It takes (1, h, w, C), what an :class:`~vioframe_keypointnet.seeing.Eye` sees, and gives what
    :meth:`vioframe_keypointnet.network.KeypointNet.found` does, which it equals on R = G = B but for rounding.
    """
    openvino = import_openvino()
    ops = openvino.opset13
    architecture, tensors, f = weights.architecture, weights.tensors, weights.architecture.fold
    ranges: Mapping[str, float] = weights.activation_ranges or {} if int8 else {}
    kind = np.float32 if architecture.peaks and not int8 else np.uint8
    image = ops.parameter([1, shape[0] // f, shape[1] // f, f * f], kind)
    if int8:
        x = _dequantised(image, CONTRAST_STEP if architecture.peaks else np.float32(1.0), ZERO)
    elif architecture.peaks:
        x = _Values(image)
    else:
        x = _Values(ops.subtract(ops.convert(image, np.float32), np.float32(_NEUTRAL_GREY)))
    x = x._replace(node=ops.transpose(x.node, np.array([0, 3, 1, 2])))
    after = dict[int, _Values]()
    for number, layers in architecture.encoder.items():
        if number > 2 and architecture.peaks and not descriptors:
            break
        if architecture.halves(number):
            x = x._replace(node=ops.max_pool(x.node, [2, 2], [1, 1], [0, 0], [0, 0], [2, 2]).output(0))
        for k, layer in enumerate(layers):
            convolution = _convolution(tensors, layer.name)
            if not after and k == 0:
                convolution = _of_what_is_seen(convolution, architecture, int8)
            x = _convolve(convolution, x, ranges)
        after[number] = x
    if architecture.peaks:
        found = ops.transpose(_convolve(_convolution(tensors, "R"), after[2], ranges).node, np.array([0, 2, 3, 1]))
    else:
        hidden, output = _score_and_place(tensors)
        found = _convolve(output, _convolve(hidden, x, ranges), ranges).node
    if not descriptors:
        return openvino.Model([found], [image], "keypointnet")
    for convolution in (_convolution(tensors, "Fa"), _convolution(tensors, "Fb", activated=False)):
        x = _convolve(convolution, x, ranges)
    x = _Values(ops.concat([ops.depth_to_space(x.node, "depth_first", 2), after[3].node], axis=1))
    for convolution in (_convolution(tensors, "Faa"), _convolution(tensors, "Fbb")):
        x = _convolve(convolution, x, ranges)
    return openvino.Model([found, x.node], [image], "keypointnet")


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


def _convolve(layer: _Convolution, x: _Values, ranges: Mapping[str, float]) -> _Values:
    """``layer`` on ``x``: in whole numbers where that has 8 bits and the layer's output has a range, or is the last."""
    from openvino import opset13 as ops

    weight, bias = layer.weight, layer.bias[None, :, None, None]
    if x.step is not None and (layer.name in ranges or layer.name in _LAST):
        # Weights have a step for each channel, the bias that of the products.
        steps = np.maximum(np.abs(weight).max(axis=(1, 2, 3)), np.finfo(np.float32).tiny) / _LARGEST_WEIGHT
        steps = steps[:, None, None, None]
        weight = ops.multiply(ops.convert(ops.constant(np.round(weight / steps).astype(np.int8)), np.float32), steps)
        products = (steps * x.step).reshape(bias.shape)
        whole = np.clip(np.round(bias / products.astype(np.float64)), -(2**31), 2**31 - 1).astype(np.int32)
        bias = whole.astype(np.float32) * products
    around = [layer.weight.shape[2] // 2] * 2
    y = ops.add(ops.convolution(x.node, weight, [1, 1], around, around, [1, 1]), bias)
    if layer.name in ranges:
        step = np.float32(ranges[layer.name] / 255.0)
        top = np.float32(255.0)
        levels = ops.fake_quantize(ops.relu(y), np.float32(0.0), step * top, np.float32(0.0), top, 256)
        return _dequantised(ops.convert(levels, np.uint8), step, 0)
    return _Values(ops.prelu(y, np.array([_LEAK], np.float32)) if layer.activated else y)


def _dequantised(x: Any, step: np.float32, zero: int) -> _Values:
    """The values of ``x`` uint8, of which convolutions may make use as they are."""
    from openvino import opset13 as ops

    levels = ops.subtract(ops.convert(x, np.float32), np.float32(zero)) if zero else ops.convert(x, np.float32)
    return _Values(ops.multiply(levels, step), step)
