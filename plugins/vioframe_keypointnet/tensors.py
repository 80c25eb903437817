"""The tensors that a network of an architecture has: their names and shapes, and random ones to measure speed with."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from vioframe_keypointnet.architecture import Architecture

Tensors = Mapping[str, NDArray[np.float32]]
"""The state of a network by the names of the published checkpoints, without the counters of batches."""

HEADS, OUT, RESPONSE = "heads", "out", "R"
"""Names of the two layers into which those of score and location are joined to run, and of that of the peaks."""


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
