"""What a KeypointNet is made of: its layers, and the names and shapes of the tensors that these have."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace

import numpy as np
from numpy.typing import NDArray

from vioframe.errors import ConfigError

CELL_PX = 8
"""Side of the cells of which each gives one candidate keypoint."""
FAINT = 0.02
"""Deviation, of a range of one, that local normalisation takes for noise rather than contrast."""

HEADS, OUT, RESPONSE = "heads", "out", "R"
"""Names of the two layers into which those of score and place are joined to run, and of that of the peaks."""

Tensors = Mapping[str, NDArray[np.float32]]
"""The state of a network by the names of the published checkpoints, without the counters of batches."""


@dataclass(frozen=True, slots=True)
class Architecture:
    """Channels of every layer; the published network by default (Tang et al., ICLR 2020).

    ``blocks`` are the encoder's four, at 1, 1/2, 1/4 and 1/8 of the resolution, each a tuple of the channels that its
    3 x 3 convolutions give. A network of peaks has an empty first block: it folds 2 x 2 pixels into channels instead,
    which loses nothing and saves the costliest layers. ``image_channels`` is 3 (RGB) or 1 (grey).
    """

    name: str = "full"
    image_channels: int = 3
    blocks: tuple[tuple[int, ...], ...] = ((32, 32), (64, 64), (128, 128), (256, 256))
    head: int = 256
    descriptor: int = 256
    peaks: bool = False
    """Whether a keypoint is the peak of a response as fine as the image, which the second block gives, and images are
    freed of local brightness and contrast first. The published network regresses places from its deepest block, which
    takes it days to learn."""
    response_kernel: int = 3
    """Side of the kernel that gives the response of a network of peaks: 3 or 1."""

    def __post_init__(self) -> None:
        channels = (*(c for block in self.blocks for c in block), self.head, self.descriptor)
        if len(self.blocks) != 4 or not all(self.blocks[1:]) or min(channels) < 1 or self.image_channels not in (1, 3):
            raise ConfigError(f"no KeypointNet can be built of {self}: four blocks of channels, the first may be empty")
        if self.response_kernel not in (1, 3):
            raise ConfigError(f"no KeypointNet can be built of {self}: the kernel of the response is 3 or 1")
        if self.peaks != (self.fold > 1):
            raise ConfigError(f"no KeypointNet can be built of {self}: peaks need an empty first block, and only they")

    def widened(self, factor: float) -> Architecture:
        """With ``factor`` times the channels in every layer."""
        if not factor > 0.0:
            raise ConfigError(f"the width of a network must be more than zero, got {factor}")

        def times(channels: int) -> int:
            return max(1, round(factor * channels))

        blocks = tuple(tuple(map(times, block)) for block in self.blocks)
        name, head, descriptor = f"{self.name}-x{factor:g}", times(self.head), times(self.descriptor)
        return replace(self, name=name, blocks=blocks, head=head, descriptor=descriptor)

    @property
    def fold(self) -> int:
        """Side of the squares of pixels that become channels of one place."""
        return 1 if self.blocks[0] else 2

    @property
    def encoder(self) -> tuple[tuple[str, int, int], ...]:
        """Name, channels in and channels out of the encoder's convolutions, in order: ``("1a", 3, 32)`` ..."""
        layers, before = [], self.image_channels * self.fold**2
        for number, block in enumerate(self.blocks, start=1):
            for letter, after in zip("abcdefgh", block, strict=False):
                layers.append((f"{number}{letter}", before, after))
                before = after
        return tuple(layers)

    @property
    def pooled(self) -> frozenset[str]:
        """Names of the convolutions after which the resolution is halved."""
        return frozenset(f"{n}{'abcdefgh'[len(block) - 1]}" for n, block in enumerate(self.blocks[:3], 1) if block)

    def to_json(self) -> str:
        return json.dumps(asdict(self))

    @staticmethod
    def from_json(text: str) -> Architecture:
        """Raises ValueError, TypeError or KeyError where ``text`` is not what :meth:`to_json` wrote."""
        values = json.loads(text)
        blocks = tuple(tuple(map(int, block)) for block in values.pop("blocks"))
        return Architecture(blocks=blocks, **values)


FULL = Architecture()
COMPACT = Architecture("compact", 1, ((), (16, 16, 16), (32,), (64,)), 64, 64, peaks=True)
QUICK = Architecture("quick", 1, ((), (16, 16), (32,), (64,)), 64, 64, peaks=True, response_kernel=1)
ARCHITECTURES = {architecture.name: architecture for architecture in (FULL, COMPACT, QUICK)}


def shapes(architecture: Architecture) -> dict[str, tuple[int, ...]]:
    """Name -> shape of every tensor that :class:`vioframe_keypointnet.network.KeypointNet` needs to run."""
    deepest, skip, head = architecture.blocks[3][-1], architecture.blocks[2][-1], architecture.head
    normalised = [
        *architecture.encoder,
        ("Da", deepest, head),
        *([] if architecture.peaks else [("Pa", deepest, head)]),
        ("Fa", deepest, head),
        ("Fb", head, 4 * skip),
        ("Faa", 2 * skip, head),
    ]
    found: dict[str, tuple[int, ...]] = {}
    for name, before, after in normalised:
        found[f"conv{name}.0.weight"] = (after, before, 3, 3)
        for statistic in ("weight", "bias", "running_mean", "running_var"):
            found[f"conv{name}.1.{statistic}"] = (after,)
    place = ("R", architecture.blocks[1][-1], architecture.fold**2) if architecture.peaks else ("Pb", head, 2)
    for name, before, after in (("Db", head, 1), place, ("Fbb", head, architecture.descriptor)):
        side = architecture.response_kernel if name == "R" else 3
        found[f"conv{name}.weight"] = (after, before, side, side)
        found[f"conv{name}.bias"] = (after,)
    return found


def ranged_layers(architecture: Architecture) -> tuple[str, ...]:
    """Names of the layers whose outputs int8 inference represents in 8 bits: all of the detector's but the last."""
    names = tuple(name for name, *_ in architecture.encoder)
    return tuple(name for name in names if name < "3") if architecture.peaks else (*names, HEADS)


def untrained(architecture: Architecture) -> dict[str, NDArray[np.float32]]:
    """Random tensors, always the same, under which signals neither grow nor fade (He et al., ICCV 2015)."""
    rng = np.random.default_rng(0)
    tensors = {}
    for name, shape in shapes(architecture).items():
        if len(shape) == 4:
            deviation = np.sqrt(2.0 / np.prod(shape[1:]))
            tensors[name] = rng.normal(0.0, deviation, shape).astype(np.float32)
        else:
            ones = name.endswith((".1.weight", "running_var"))
            tensors[name] = np.full(shape, 1.0 if ones else 0.0, np.float32)
    return tensors
