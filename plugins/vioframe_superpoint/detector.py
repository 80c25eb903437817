"""The network at work: an image in, the strongest keypoints out."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import pad

from vioframe.errors import ConfigError
from vioframe.types import Image, Keypoints
from vioframe_superpoint.network import CELL_PX, load

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


def local_maxima(
    score: NDArray[np.float32], threshold: float, radius_px: int, border_px: int, max_points: int
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """The ``max_points`` strongest pixels of ``score`` (H, W) and their scores: (N, 2) px and (N,), strongest first.

    A pixel above ``threshold`` is kept unless a stronger one that is kept lies within ``radius_px`` in both x and y.
    Those less than ``border_px`` from the border are never kept. Of equals the first in reading order is the stronger.
    """
    height, width = score.shape
    free = score > threshold
    free[:border_px] = free[height - border_px :] = False
    free[:, :border_px] = free[:, width - border_px :] = False
    rows, columns = np.nonzero(free)
    order = np.argsort(-score[rows, columns], kind="stable")
    kept: list[tuple[int, int]] = []
    for row, column in zip(rows[order].tolist(), columns[order].tolist(), strict=True):
        if len(kept) == max_points:
            break
        if free[row, column]:
            kept.append((column, row))
            free[max(row - radius_px, 0) : row + radius_px + 1, max(column - radius_px, 0) : column + radius_px + 1] = (
                False
            )
    xy = np.array(kept, np.int64).reshape(-1, 2)
    return xy.astype(np.float32), score[xy[:, 1], xy[:, 0]]
