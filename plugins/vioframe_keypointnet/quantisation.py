"""How far the outputs of the network's layers reach, which int8 inference has to know."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from vioframe.errors import ConfigError, needs
from vioframe.types import Image
from vioframe_keypointnet.architecture import HEADS
from vioframe_keypointnet.selection import padded_to_cells
from vioframe_keypointnet.weights import Weights

_STEPS = 255
_VALUES_AN_IMAGE = 20_000
_SHARES_OF_MAXIMUM = np.linspace(0.2, 1.0, 81)


def measure_ranges(weights: Weights, images: Iterable[Image]) -> dict[str, float]:
    """Layer -> the largest output that is worth representing, from a few dozen grey ``images`` of any sizes.

    It is the one that loses least in the mean square, of what it cuts off and of what falls between 255 steps, over
    values drawn evenly from each image.
    """
    with needs("torch", "keypointnet", user="measuring ranges for int8"):
        import torch

        from vioframe_keypointnet.network import of_weights

    network = of_weights(weights)
    values: dict[str, list[NDArray[np.float32]]] = {name: [] for name in weights.architecture.ranged}
    for name, found in values.items():

        def keep(_: object, __: object, y: torch.Tensor, found: list[NDArray[np.float32]] = found) -> None:
            # Before LeakyReLU, which leaves what is above zero, as int8 does, as it is.
            flat = y.flatten()
            found.append(flat[:: max(1, len(flat) // _VALUES_AN_IMAGE)].numpy().copy())

        for layer in ("Da", "Pa") if name == HEADS else (name,):
            network.get_submodule(f"conv{layer}").register_forward_hook(keep)
    with torch.inference_mode():
        for image in images:
            network.found(torch.from_numpy(padded_to_cells(image).copy())[None, None] / 255.0, descriptors=False)
    if not all(values.values()):
        raise ConfigError("the range of activations can only be measured on images, and there are none")
    return {name: _best_range(np.concatenate(found)) for name, found in values.items()}


def _best_range(values: NDArray[np.float32]) -> float:
    """Of shares of the largest of ``values``, that which quantises those above zero best."""
    positive = values[values > 0.0]
    if not len(positive):
        return 1.0  # a layer that never fires; any range tells so
    candidates = positive.max() * _SHARES_OF_MAXIMUM
    losses = []
    for most in candidates:
        step = most / _STEPS
        losses.append(np.mean((np.minimum(np.round(positive / step), _STEPS) * step - positive) ** 2))
    return float(candidates[int(np.argmin(losses))])
