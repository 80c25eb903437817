"""torch on a GPU: one recorded CUDA graph from the image to the selected keypoints."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import cast

import numpy as np

from vioframe.errors import ConfigError
from vioframe.types import Image, Keypoints
from vioframe_keypointnet.folding import FoldedNetwork
from vioframe_keypointnet.optional import needs
from vioframe_keypointnet.runtimes.torch import TorchOperations
from vioframe_keypointnet.selection import OFFSET_PX, Rules, sigmoid
from vioframe_keypointnet.torch_selection import TorchPeaks, TorchSelection

with needs("torch", "keypointnet"):
    import torch
    from torch import Tensor
    from torch.nn.functional import pixel_shuffle, pixel_unshuffle

    from vioframe_keypointnet.network import locally_normalised

_WARM_UP_RUNS = 3


class OnCuda:
    """Keypoints by a GPU. Each size of image and number of points has a graph of its own, recorded at first sight."""

    def __init__(self, network: FoldedNetwork, rules: Rules, precision: str) -> None:
        if not torch.cuda.is_available():
            raise ConfigError("torch finds no CUDA device; leave the option device out, or install torch with CUDA")
        self._dtype = torch.float16 if precision == "float16" else torch.float32
        self._network, self._rules = network, rules
        self._graph = lru_cache(maxsize=4)(self._record)

    def __call__(self, padded: Image, shape: tuple[int, int], max_points: int) -> Keypoints:
        return self._graph(cast(tuple[int, int], padded.shape), shape, max_points)(padded)

    @torch.inference_mode()
    def _record(self, padded: tuple[int, int], shape: tuple[int, int], max_points: int) -> _Graph:
        return _Graph(detection(self._network, self._rules, padded, shape, max_points, self._dtype, "cuda"), padded)


def detection(
    network: FoldedNetwork,
    rules: Rules,
    padded: tuple[int, int],
    shape: tuple[int, int],
    max_points: int,
    dtype: torch.dtype,
    device: str,
) -> Callable[[Tensor], Tensor]:
    """From an image (1, 1, H, W) uint8 on ``device`` to what :class:`TorchSelection` selects; nothing leaves it."""
    operations, architecture, f = TorchOperations(device, dtype), network.architecture, network.architecture.fold
    cells, peaks = TorchSelection(padded, shape, rules, device), TorchPeaks(padded, shape, rules, device)

    def detect(image: Tensor) -> Tensor:
        grey = image.float()
        seen = pixel_unshuffle(locally_normalised(grey / 255.0), f) if architecture.peaks else grey
        found, *rest = (output[0].float() for output in network.build(operations, seen))
        descriptors = rest[0] if rest else None
        if architecture.peaks:
            return peaks(pixel_shuffle(found.permute(2, 0, 1), f)[0], grey[0, 0], descriptors, max_points)
        return cells(found[0], OFFSET_PX * torch.tanh(found[1:]), grey[0, 0], descriptors, max_points)

    return detect


class _Graph:
    """``detect`` recorded for images of ``shape``, with memory of its own on both sides."""

    def __init__(self, detect: Callable[[Tensor], Tensor], shape: tuple[int, int]) -> None:
        self._image = torch.zeros((1, 1, *shape), dtype=torch.uint8, device="cuda")
        self._image_host = torch.zeros((1, 1, *shape), dtype=torch.uint8, pin_memory=True)
        # Libraries choose their algorithms and reserve their memory in the first runs, which must not be recorded.
        stream = torch.cuda.Stream()  # type: ignore[no-untyped-call]
        stream.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(stream):
            for _ in range(_WARM_UP_RUNS):
                detect(self._image)
        torch.cuda.current_stream().wait_stream(stream)
        self._recorded = torch.cuda.CUDAGraph()
        with torch.cuda.graph(self._recorded):
            self._found = detect(self._image)
        self._found_host = torch.empty(self._found.shape, pin_memory=True)

    def __call__(self, image: Image) -> Keypoints:
        np.copyto(self._image_host[0, 0].numpy(), image)
        self._image.copy_(self._image_host, non_blocking=True)
        self._recorded.replay()
        self._found_host.copy_(self._found, non_blocking=True)
        torch.cuda.current_stream().synchronize()
        return keypoints(self._found_host.numpy())


def keypoints(found: np.ndarray[tuple[int, int], np.dtype[np.float32]]) -> Keypoints:
    """Those of the rows (K, 3 + D) that :class:`TorchSelection` gives which are keypoints; copied."""
    taken = found[np.isfinite(found[:, 2])].copy()
    return Keypoints(taken[:, :2], sigmoid(taken[:, 2]), taken[:, 3:] if taken.shape[1] > 3 else None)
