"""What a KeypointNet is made of: its layers, and the names and shapes of the tensors that these have."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, PositiveInt, TypeAdapter

CELL_PX = 8
"""Side of the cells of which each gives one candidate keypoint."""
FOLD_PX = 4
"""Side of the squares of pixels that a network of peaks sees as one place each, pixels as channels."""
FAINT = 0.02
"""Deviation, of a range of one, that local normalisation takes for noise rather than contrast."""
HEADS = "heads"
"""Name of the layer into which the first two of score and place are joined to run."""

Tensors = Mapping[str, NDArray[np.float32]]
"""The state of a network by the names of the published checkpoints, without the counters of batches."""

_Block = Annotated[tuple[PositiveInt, ...], Field(min_length=1)]


@dataclass(frozen=True, slots=True)
class Layer:
    """A convolution padded with zeros so that the size is kept, then a batch norm in place of a bias, if normalised."""

    name: str
    before: int
    after: int
    side: int = 3
    normalised: bool = True

    @property
    def shapes(self) -> dict[str, tuple[int, ...]]:
        """Name -> shape of the tensors that it needs to run."""
        kernel, conv = (self.after, self.before, self.side, self.side), f"conv{self.name}"
        if not self.normalised:
            return {f"{conv}.weight": kernel, f"{conv}.bias": (self.after,)}
        statistics = ("weight", "bias", "running_mean", "running_var")
        return {f"{conv}.0.weight": kernel} | {f"{conv}.1.{statistic}": (self.after,) for statistic in statistics}


@dataclass(frozen=True, slots=True)
class Architecture:
    """Channels of every layer.

    ``blocks`` are the encoder's four, at 1, 1/2, 1/4 and 1/8 of the resolution, each a tuple of the channels that its
    3 x 3 convolutions give. A network of peaks has an empty first block: it folds squares of pixels into channels
    instead, which loses nothing and saves the costliest layers. ``image_channels`` is 3 (RGB) or 1 (grey).
    """

    name: str
    image_channels: Literal[1, 3]
    blocks: tuple[tuple[PositiveInt, ...], _Block, _Block, _Block]
    head: PositiveInt
    descriptor: PositiveInt

    def widened(self, factor: float) -> Architecture:
        """With ``factor`` times the channels in every layer."""

        def times(channels: int) -> int:
            return max(1, round(factor * channels))

        first, second, third, fourth = (tuple(map(times, block)) for block in self.blocks)
        name, head, descriptor = f"{self.name}-x{factor:g}", times(self.head), times(self.descriptor)
        return replace(self, name=name, blocks=(first, second, third, fourth), head=head, descriptor=descriptor)

    @property
    def peaks(self) -> bool:
        """Whether a keypoint is the peak of a response as fine as the image, which the second block gives, and images
        are freed of local brightness and contrast first. The published network regresses places from its deepest block,
        which takes it days to learn."""
        return not self.blocks[0]

    @property
    def fold(self) -> int:
        """Side of the squares of pixels that become channels of one place."""
        return FOLD_PX if self.peaks else 1

    def halves(self, block: int) -> bool:
        """Whether the resolution is halved before the ``block``, or folding has made it as low already."""
        return 1 << (block - 1) > self.fold

    @property
    def encoder(self) -> dict[int, tuple[Layer, ...]]:
        """The convolutions of each block, of those that have any: ``{1: (Layer("1a", 3, 32), ...`` ."""
        before, encoder = self.image_channels * self.fold**2, {}
        for number, block in enumerate(self.blocks, start=1):
            if block:
                channels = (before, *block)
                encoder[number] = tuple(map(Layer, (f"{number}{c}" for c in "abcdefgh"), channels, block))
                before = block[-1]
        return encoder

    @property
    def layers(self) -> tuple[Layer, ...]:
        """All layers in order: the encoder's, then the heads of score (D), place (R or P) and descriptors (F)."""
        _, fine, quarter, deepest = (block[-1] if block else 0 for block in self.blocks)
        if self.peaks:
            place = [Layer("R", fine, self.fold**2, normalised=False)]
        else:
            place = [Layer("Pa", deepest, self.head), Layer("Pb", self.head, 2, normalised=False)]
        return (
            *(layer for block in self.encoder.values() for layer in block),
            Layer("Da", deepest, self.head),
            Layer("Db", self.head, 1, normalised=False),
            *place,
            Layer("Fa", deepest, self.head),
            Layer("Fb", self.head, 4 * quarter),
            Layer("Faa", 2 * quarter, self.head),
            Layer("Fbb", self.head, self.descriptor, normalised=False),
        )

    @property
    def shapes(self) -> dict[str, tuple[int, ...]]:
        """Name -> shape of every tensor that :class:`vioframe_keypointnet.network.KeypointNet` needs to run."""
        return {name: shape for layer in self.layers for name, shape in layer.shapes.items()}

    @property
    def detecting(self) -> tuple[str, ...]:
        """Names of the encoder's layers that keypoints depend on; of a network of peaks those of two blocks."""
        return tuple(la.name for number, block in self.encoder.items() if number <= 2 or not self.peaks for la in block)

    @property
    def ranged(self) -> tuple[str, ...]:
        """Names of the layers whose outputs int8 inference represents in 8 bits: all of the detector's but the last."""
        return self.detecting if self.peaks else (*self.detecting, HEADS)

    def to_json(self) -> str:
        return json.dumps(asdict(self))

    @staticmethod
    def from_json(text: str) -> Architecture:
        """Raises ValueError where ``text`` describes none."""
        return TypeAdapter(Architecture).validate_json(text)


FULL = Architecture("full", 3, ((32, 32), (64, 64), (128, 128), (256, 256)), 256, 256)
"""The published network (Tang et al., ICLR 2020)."""
COMPACT = Architecture("compact", 1, ((), (32, 32), (32,), (64,)), 64, 64)
FAR = Architecture("far", 1, ((), (32,) * 6, (32,), (64,)), 64, 64)
"""Sees 28 px about a pixel, where ``compact`` sees 12: beyond the patch that is followed."""
ARCHITECTURES = {architecture.name: architecture for architecture in (FULL, COMPACT, FAR)}
