"""The network as it is run: batch norm folded into the convolutions, grey images in, nothing that is not needed.

One description, three libraries: :meth:`FoldedNetwork.build` walks the layers and lets an :class:`Operations` make of
each what its library calls it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from vioframe_keypointnet.architecture import Architecture
from vioframe_keypointnet.tensors import HEADS, OUT, RESPONSE, Tensors
from vioframe_keypointnet.weights import Weights

LEAK = 0.01
"""Slope of LeakyReLU below zero."""

NEUTRAL_GREY = 127.5
"""The grey that the network sees as 0; also what lies around the image."""

_SCALE = 0.225 / 255.0
_BATCH_NORM_EPSILON = 1e-5

NodeT = TypeVar("NodeT")


@dataclass(frozen=True, slots=True)
class Convolution:
    """A convolution padded with zeros so that the size is kept, then LeakyReLU if activated."""

    name: str
    weight: NDArray[np.float32]
    """(out, in, k, k)."""
    bias: NDArray[np.float32]
    """(out,)."""
    activated: bool = True

    @property
    def pad(self) -> int:
        return int(self.weight.shape[2]) // 2


class Operations(Protocol[NodeT]):
    """What a library must offer; a node is a tensor, or its name in a graph."""

    def seen(self, x: NodeT, peaks: bool) -> NodeT:
        """What comes in, as the first layer wants it: grey levels less :data:`NEUTRAL_GREY`, or local contrast."""

    def convolve(self, layer: Convolution, x: NodeT) -> NodeT: ...

    def pool(self, x: NodeT) -> NodeT:
        """The maximum of each 2 x 2."""

    def shuffle(self, x: NodeT) -> NodeT:
        """Four channels become 2 x 2 pixels, as torch.nn.PixelShuffle(2) does."""

    def join(self, a: NodeT, b: NodeT) -> NodeT:
        """The channels of ``a``, then those of ``b``."""

    def channels_last(self, x: NodeT) -> NodeT:
        """(B, h, w, C) of (B, C, h, w)."""


@dataclass(frozen=True, slots=True)
class FoldedNetwork:
    """Layers of the detector, for grey images, and those of the descriptors if wanted."""

    architecture: Architecture
    encoder: tuple[Convolution, ...]
    """Of a network of peaks that does not describe, the first two blocks: its response needs no more."""
    heads: tuple[Convolution, ...]
    """Hidden layer and output of score and place; of a network of peaks the one that gives the response."""
    description: tuple[Convolution, ...] = ()
    """Fa, Fb, Faa, Fbb, or nothing."""

    def build(self, operations: Operations[NodeT], seen: NodeT) -> tuple[NodeT, ...]:
        """From (B, C, h, w), what an :class:`~vioframe_keypointnet.seeing.Eye` sees, to what it finds.

        (B, 3, H/8, W/8), before sigmoid and tanh, the score, x and y of each cell; of a network of peaks that folds
        f x f pixels (B, H/f, W/f, f^2), the response. Then, if it describes, (B, D, H/4, W/4) descriptors, not yet
        normalised.
        """
        peaks = self.architecture.peaks
        x = operations.seen(seen, peaks)
        after = {}
        for layer in self.encoder:
            x = after[layer.name[0]] = operations.convolve(layer, x)
            if layer.name in self.architecture.pooled:
                x = operations.pool(x)
        found = after["2"] if peaks else x
        for layer in self.heads:
            found = operations.convolve(layer, found)
        if peaks:
            found = operations.channels_last(found)
        if not self.description:
            return (found,)
        first, second, third, fourth = self.description
        x = operations.shuffle(operations.convolve(second, operations.convolve(first, x)))
        return found, operations.convolve(fourth, operations.convolve(third, operations.join(x, after["3"])))


def fold(weights: Weights, descriptors: bool = False) -> FoldedNetwork:
    """The network of ``weights`` for grey images, which equals the trained one on R = G = B exactly."""
    architecture, tensors = weights.architecture, weights.tensors
    needed = [name for name, *_ in architecture.encoder if descriptors or not architecture.peaks or name < "3"]
    encoder = [_normalised(tensors, name) for name in needed]
    encoder[0] = _on_grey_levels(encoder[0], architecture)
    heads: tuple[Convolution, ...]
    if architecture.peaks:
        heads = (Convolution(RESPONSE, tensors["convR.weight"], tensors["convR.bias"], activated=False),)
    else:
        heads = _stacked(HEADS, [_normalised(tensors, name) for name in ("Da", "Pa")]), _joint_output(tensors)
    description: tuple[Convolution, ...] = ()
    if descriptors:
        first, second, third = (_normalised(tensors, name, name != "Fb") for name in ("Fa", "Fb", "Faa"))
        last = Convolution("Fbb", tensors["convFbb.weight"], tensors["convFbb.bias"], activated=False)
        description = (first, second, third, last)
    return FoldedNetwork(architecture, tuple(encoder), heads, description)


def _normalised(tensors: Tensors, name: str, activated: bool = True) -> Convolution:
    """Convolution ``name`` and the batch norm behind it, in one."""
    gamma, beta, mean, variance = (
        tensors[f"conv{name}.1.{s}"].astype(np.float64) for s in ("weight", "bias", "running_mean", "running_var")
    )
    gain = gamma / np.sqrt(variance + _BATCH_NORM_EPSILON)
    weight = tensors[f"conv{name}.0.weight"] * gain[:, None, None, None]
    return Convolution(name, weight.astype(np.float32), (beta - mean * gain).astype(np.float32), activated)


def _on_grey_levels(first: Convolution, architecture: Architecture) -> Convolution:
    """The first layer on (grey level - 127.5) of one channel, in place of (x / 255 - 0.5) * 0.225 of all.

    For a network of peaks, on the local contrast of one channel, folded, in place of all. Only the factor may go into
    the weights: the shift has to stay before the padding, whose zeros mean neutral grey.
    """
    out = len(first.weight)
    weight = first.weight.reshape(out, architecture.image_channels, -1, 3, 3).sum(axis=1)
    if not architecture.peaks:
        weight *= np.float32(_SCALE)
    return Convolution(first.name, weight, first.bias)


def _stacked(name: str, layers: Sequence[Convolution]) -> Convolution:
    """Layers that see the same, as one."""
    return Convolution(name, np.concatenate([la.weight for la in layers]), np.concatenate([la.bias for la in layers]))


def _joint_output(tensors: Tensors) -> Convolution:
    """Score and place as one convolution of the stacked hidden layers, each blind to the other's half."""
    score, place = tensors["convDb.weight"], tensors["convPb.weight"]
    weight = np.zeros((3, 2 * score.shape[1], 3, 3), np.float32)
    weight[:1, : score.shape[1]], weight[1:, score.shape[1] :] = score, place
    return Convolution(OUT, weight, np.concatenate([tensors["convDb.bias"], tensors["convPb.bias"]]), activated=False)
