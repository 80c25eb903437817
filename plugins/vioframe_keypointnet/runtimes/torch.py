"""torch on the CPU: the reference that the others must agree with."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from vioframe.types import Image
from vioframe_keypointnet.folding import LEAK, NEUTRAL_GREY, Convolution, FoldedNetwork
from vioframe_keypointnet.optional import needs
from vioframe_keypointnet.seeing import Eye

with needs("torch", "keypointnet"):
    import torch
    from torch import Tensor
    from torch.nn import functional


class TorchOperations:
    """Operations of torch; a node is a tensor, and the layers' tensors are made once, on ``device``."""

    def __init__(self, device: str = "cpu", dtype: torch.dtype = torch.float32) -> None:
        self._device, self._dtype = device, dtype
        self._layers: dict[str, tuple[Tensor, Tensor]] = {}

    def seen(self, x: Tensor, peaks: bool) -> Tensor:
        return (x if peaks else x - NEUTRAL_GREY).to(self._dtype, memory_format=torch.channels_last)

    def convolve(self, layer: Convolution, x: Tensor) -> Tensor:
        if layer.name not in self._layers:
            weight = torch.from_numpy(layer.weight).to(self._device, self._dtype, memory_format=torch.channels_last)
            self._layers[layer.name] = weight, torch.from_numpy(layer.bias).to(self._device, self._dtype)
        weight, bias = self._layers[layer.name]
        y = functional.conv2d(x, weight, bias, padding=layer.pad)
        return functional.leaky_relu(y, LEAK, inplace=True) if layer.activated else y

    def pool(self, x: Tensor) -> Tensor:
        return functional.max_pool2d(x, 2)

    def shuffle(self, x: Tensor) -> Tensor:
        return functional.pixel_shuffle(x, 2)

    def join(self, a: Tensor, b: Tensor) -> Tensor:
        return torch.cat([a, b], dim=1)

    def channels_last(self, x: Tensor) -> Tensor:
        return x.permute(0, 2, 3, 1)


class TorchOnCpu:
    """Runs a network on images of any size; the number of threads, if given, is set for torch as a whole."""

    def __init__(self, network: FoldedNetwork, threads: int, operations: TorchOperations | None = None) -> None:
        if threads:
            torch.set_num_threads(threads)
        self._network, self._operations = network, operations or TorchOperations()
        self._see = Eye(network.architecture, eight_bits=False)

    @torch.inference_mode()
    def __call__(self, image: Image) -> tuple[NDArray[np.float32], ...]:
        # A copy: torch wants no memory that it may not write to.
        x = torch.from_numpy(self._see(image).astype(np.float32))[None]
        outputs = self._network.build(self._operations, x)
        return tuple(output[0].contiguous().numpy() for output in outputs)
