"""The network, as described in section 3 of the paper; layer names are those of the published weights."""

from __future__ import annotations

import pickle
from pathlib import Path
from textwrap import shorten

import torch
from torch import Tensor, nn
from torch.nn.functional import grid_sample, max_pool2d, normalize, pixel_shuffle, relu

from vioframe.errors import ConfigError

CELL_PX = 8
"""Side of the cells that the encoder sees an image in."""

_ENCODER = {"1a": 64, "1b": 64, "2a": 64, "2b": 64, "3a": 128, "3b": 128, "4a": 128, "4b": 128}
"""Channels that the encoder's convolutions give."""
_POOLED = ("1b", "2b", "3b")


class SuperPointNet(nn.Module):
    """A shared encoder of 3 x 3 convolutions, and a head each for keypoints and for descriptors."""

    def __init__(self) -> None:
        super().__init__()
        before = 1
        for name, after in _ENCODER.items():
            self.add_module(f"conv{name}", nn.Conv2d(before, after, 3, padding=1))
            before = after
        self.convPa, self.convPb = nn.Conv2d(128, 256, 3, padding=1), nn.Conv2d(256, CELL_PX**2 + 1, 1)
        self.convDa, self.convDb = nn.Conv2d(128, 256, 3, padding=1), nn.Conv2d(256, 256, 1)

    def encode(self, images: Tensor) -> Tensor:
        """(B, 128, H/8, W/8) from ``images`` (B, 1, H, W) in [0, 1], H and W multiples of 8."""
        x = images
        for name in _ENCODER:
            x = relu(self.get_submodule(f"conv{name}")(x))
            if name in _POOLED:
                x = max_pool2d(x, 2)
        return x

    def probability(self, encoded: Tensor) -> Tensor:
        """(B, H, W) of a keypoint at each pixel."""
        logits = self.convPb(relu(self.convPa(encoded)))
        # The last channel stands for "no keypoint in this cell"; the others are the cell's pixels, row by row.
        return pixel_shuffle(logits.softmax(dim=1)[:, :-1], CELL_PX)[:, 0]

    def describe(self, encoded: Tensor, xy: Tensor) -> Tensor:
        """(B, N, 256) unit descriptors at ``xy`` (B, N, 2) px."""
        coarse = normalize(self.convDb(relu(self.convDa(encoded))), dim=1)
        h, w = coarse.shape[-2:]
        # Without align_corners -1 and 1 are the outer edges of the outer cells, hence of the outer pixels.
        place = (2.0 * xy + 1.0) / (CELL_PX * xy.new_tensor([w, h])) - 1.0
        sampled = grid_sample(coarse, place[:, :, None], mode="bicubic", padding_mode="border", align_corners=False)
        return normalize(sampled[..., 0], dim=1).transpose(1, 2)


def load(path: Path) -> SuperPointNet:
    """The network with the weights of ``path``; raises :class:`ConfigError` where they cannot be its own."""
    try:
        # Tensors only: a pickle can do anything.
        weights = torch.load(path, map_location="cpu", weights_only=True)
    except OSError as error:
        raise ConfigError(f"the weights of superpoint, {path}, cannot be read: {error.strerror or error}") from error
    except (pickle.UnpicklingError, RuntimeError, EOFError, ValueError, KeyError) as error:
        raise ConfigError(f"{path} is no file of PyTorch weights; superpoint needs superpoint_v1.pth") from error
    network = SuperPointNet()
    try:
        network.load_state_dict(weights)
    except (RuntimeError, TypeError) as error:
        reason = shorten(str(error), 200)
        raise ConfigError(f"{path} is of another network than superpoint_v1.pth, which is needed: {reason}") from error
    if not all(bool(tensor.isfinite().all()) for tensor in network.parameters()):
        raise ConfigError(f"{path} holds numbers that are not finite; get superpoint_v1.pth anew")
    return network.eval()
