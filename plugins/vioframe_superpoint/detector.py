"""The network at work: an image in, the strongest keypoints out."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import pad

from vioframe.errors import ConfigError
from vioframe.types import Image, Keypoints
from vioframe_superpoint.network import CELL_PX, load
from vioframe_superpoint.suppression import local_maxima

_NMS_RADIUS_PX = 4
"""No two keypoints are this near or nearer, in both x and y: as in the authors' demo."""


class SuperPoint:
    """See :func:`vioframe_superpoint.superpoint` for the options."""

    def __init__(self, weights: Path, *, threshold: float, border_px: int, device: str, descriptors: bool) -> None:
        if device == "auto":
            device = "cuda" if torch.cuda.is_available() else "cpu"
        elif device == "cuda" and not torch.cuda.is_available():
            raise ConfigError("superpoint: device=cuda, but PyTorch finds no GPU here; use device=cpu")
        self._device = torch.device(device)
        network = load(weights).to(self._device)
        self._network = network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        self._threshold = threshold
        self._border_px = border_px
        self._descriptors = descriptors

    @torch.inference_mode()
    def detect(self, image: Image, max_points: int) -> Keypoints:
        """At most ``max_points`` keypoints of ``image``, most probable first."""
        height, width = image.shape
        encoded = self._network.encode(self._to_input(image))
        probability = self._network.probability(encoded)[0, :height, :width].cpu().numpy()
        xy, score = local_maxima(probability, self._threshold, _NMS_RADIUS_PX, self._border_px, max_points)
        descriptors = None
        if self._descriptors:
            places = torch.from_numpy(xy)[None].to(self._device)
            descriptors = self._network.describe(encoded, places)[0].cpu().numpy()
        return Keypoints(xy, score, descriptors)

    def _to_input(self, image: Image) -> Tensor:
        """(1, 1, H', W') in [0, 1]; the last row and column are repeated up to whole cells."""
        height, width = image.shape
        pixels = torch.from_numpy(np.array(image))[None, None].to(self._device).float() / 255.0
        return pad(pixels, (0, -width % CELL_PX, 0, -height % CELL_PX), mode="replicate")
