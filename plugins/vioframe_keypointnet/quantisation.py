"""How far the outputs of the network's layers reach, which int8 inference has to know."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from vioframe.errors import ConfigError
from vioframe.types import Image
from vioframe_keypointnet.folding import Convolution, fold
from vioframe_keypointnet.optional import needs
from vioframe_keypointnet.runtimes.torch import TorchOnCpu, TorchOperations
from vioframe_keypointnet.selection import padded_to_cells
from vioframe_keypointnet.tensors import ranged_layers
from vioframe_keypointnet.weights import Weights

with needs("torch", "keypointnet"):
    from torch import Tensor

_STEPS = 255
_VALUES_AN_IMAGE = 20_000
_SHARES_OF_MAXIMUM = np.linspace(0.2, 1.0, 81)


def measure_ranges(weights: Weights, images: Iterable[Image]) -> dict[str, float]:
    """Layer -> the largest output that is worth representing, from a few dozen grey ``images`` of any sizes.

    It is the one that loses least in the mean square, of what it cuts off and of what falls between 255 steps, over
    values drawn evenly from each image.
    """
    recorder = _Recorder(ranged_layers(weights.architecture))
    run = TorchOnCpu(fold(weights), threads=0, operations=recorder)
    for image in images:
        run(padded_to_cells(image))
    if not all(recorder.values.values()):
        raise ConfigError("the range of activations can only be measured on images, and there are none")
    return {name: _best_range(np.concatenate(values)) for name, values in recorder.values.items()}


class _Recorder(TorchOperations):
    """Keeps a sample of the outputs of the layers ``names``."""

    def __init__(self, names: Iterable[str]) -> None:
        super().__init__()
        self.values: dict[str, list[NDArray[np.float32]]] = {name: [] for name in names}

    def convolve(self, layer: Convolution, x: Tensor) -> Tensor:
        y = super().convolve(layer, x)
        if layer.name in self.values:
            flat = y.flatten()
            self.values[layer.name].append(flat[:: max(1, len(flat) // _VALUES_AN_IMAGE)].numpy().copy())
        return y


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
