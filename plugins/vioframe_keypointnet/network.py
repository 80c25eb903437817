"""The network in torch, as it is trained; its layers are named as in the published checkpoints, which load as such."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn.functional import avg_pool2d, grid_sample, interpolate, normalize, pad, pixel_shuffle, pixel_unshuffle
from torch.nn.utils.fusion import fuse_conv_bn_eval

from vioframe_keypointnet.architecture import CELL_PX, FAINT, Architecture
from vioframe_keypointnet.selection import OFFSET_PX, reach_cells
from vioframe_keypointnet.weights import Weights

_PEAK_REACH_PX = 2
"""How far along either axis, and in the same cell, pixels count towards the place of a peak."""


@dataclass(frozen=True, slots=True)
class Detection:
    """What the network sees in (B, 1, H, W) images: one candidate a cell of a grid of h x w = H/8 x W/8."""

    score: Tensor
    """(B, h, w) in [0, 1]; 0 in the outermost ring of cells, which sees less than it should.

    Of a network of peaks it serves training alone: peaks ranked by their response are found again more often.
    """
    xy: Tensor
    """(B, 2, h, w) px."""
    descriptors: Tensor
    """(B, D, H/4, W/4), not yet normalised; :func:`describe` samples them. D is 0 where none were asked for."""
    response: Tensor | None = None
    """(B, 64, h, w) for a network of peaks: but for a constant, the logarithm of how likely each pixel is."""


class KeypointNet(nn.Module):
    """Score, place and descriptor of one keypoint a cell of 8 x 8 pixels (Tang et al., ICLR 2020, section 3).

    ``dropout`` is that of whole channels after the second convolution of each block and in each head.
    """

    def __init__(self, architecture: Architecture, dropout: float = 0.2) -> None:
        super().__init__()
        self.architecture = architecture
        for layer in architecture.layers:
            conv = nn.Conv2d(layer.before, layer.after, layer.side, padding=layer.side // 2, bias=not layer.normalised)
            self.add_module(
                f"conv{layer.name}", nn.Sequential(conv, nn.BatchNorm2d(layer.after)) if layer.normalised else conv
            )
        self.fold, self.unfold = nn.PixelUnshuffle(architecture.fold), nn.PixelShuffle(2)
        self.act, self.pool = nn.LeakyReLU(inplace=True), nn.MaxPool2d(2)
        self.dropout = nn.Dropout2d(dropout)

    def forward(self, grey: Tensor, *, descriptors: bool = True) -> Detection:
        """Of ``grey`` (B, 1, H, W) in [0, 1], H and W multiples of 8; for training."""
        after = self._encode(grey)
        score, response = self._regress("D", after[4])[:, 0], None
        if self.architecture.peaks:
            response = cells_of(self._last("R", after[2]))
            score = score + torch.logsumexp(response, dim=1)
            place = peak_places(response)
        else:
            place = offsets(self._regress("P", after[4]))
        # The outermost ring of cells scores 0.
        score = pad(torch.sigmoid(score)[:, 1:-1, 1:-1], (1, 1, 1, 1))
        described = self._describe(after) if descriptors else after[3][:, :0]
        return Detection(score, keypoint_places(place), described, response)

    def found(self, grey: Tensor, *, descriptors: bool) -> tuple[Tensor, ...]:
        """What is needed to choose keypoints of ``grey`` (B, 1, H, W) in [0, 1]; OpenVINO's graph gives the same.

        (B, 3, H/8, W/8), before sigmoid and tanh, the score, x and y of each cell; of a network of peaks
        (B, H/f, W/f, f^2), the response of f x f pixels, row by row. Then, if asked for, (B, D, H/4, W/4) descriptors,
        not normalised.
        """
        peaks = self.architecture.peaks
        after = self._encode(grey, blocks=4 if descriptors or not peaks else 2)
        if peaks:
            first = self._last("R", after[2]).permute(0, 2, 3, 1)
        else:
            first = torch.cat([self._regress("D", after[4]), self._regress("P", after[4])], dim=1)
        return (first, self._describe(after)) if descriptors else (first,)

    def _conv(self, name: str, x: Tensor) -> Tensor:
        out: Tensor = self.get_submodule(f"conv{name}")(x)
        return out

    def _last(self, name: str, x: Tensor) -> Tensor:
        """A layer whose output is the network's: pixels of a large image do not fit into half precision."""
        return self._conv(name, x).float()

    def _encode(self, grey: Tensor, blocks: int = 4) -> dict[int, Tensor]:
        """What each of the first ``blocks`` gives, before the resolution is halved."""
        images = grey.expand(-1, self.architecture.image_channels, -1, -1)
        seen = locally_normalised(images) if self.architecture.peaks else (images - 0.5) * 0.225
        # The convolutions may have half precision; what comes before and after has not.
        x = self.fold(seen).to(next(self.parameters()).dtype)
        after: dict[int, Tensor] = {}
        for number, layers in self.architecture.encoder.items():
            if number > blocks:
                break
            if self.architecture.halves(number):
                x = self.pool(x)
            for layer in layers:
                x = self.act(self._conv(layer.name, x))
                if layer.name.endswith("b"):
                    x = self.dropout(x)
            after[number] = x
        return after

    def _regress(self, head: str, deepest: Tensor) -> Tensor:
        """What the head of the score (D) or of the place (P) gives."""
        hidden = self.dropout(self.act(self._conv(f"{head}a", deepest)))
        return self._last(f"{head}b", hidden)

    def _describe(self, after: dict[int, Tensor]) -> Tensor:
        x = self._conv("Fb", self.dropout(self.act(self._conv("Fa", after[4]))))
        x = self.act(self._conv("Faa", torch.cat([self.unfold(x), after[3]], dim=1)))
        return self._last("Fbb", x)


def fill(network: KeypointNet, weights: Weights) -> None:
    """Give ``network`` the ``weights``, which are of its architecture; counters of batches stay as they are."""
    state = {name: torch.from_numpy(np.array(values)) for name, values in weights.tensors.items()}
    network.load_state_dict(state, strict=False)


def of_weights(weights: Weights) -> KeypointNet:
    """The network with ``weights``, ready to run, each batch norm made part of the convolution before it."""
    network = KeypointNet(weights.architecture)
    fill(network, weights)
    network.eval()
    for name, layer in list(network.named_children()):
        if isinstance(layer, nn.Sequential):
            convolution, norm = layer
            assert isinstance(convolution, nn.Conv2d)
            assert isinstance(norm, nn.BatchNorm2d)
            network.add_module(name, fuse_conv_bn_eval(convolution, norm))
    return in_channels_last(network)


def in_channels_last(network: KeypointNet) -> KeypointNet:
    """The ``network`` itself, its weights laid out as convolutions on a processor like them best."""
    network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]  # which torch's stubs do not know
    return network


def locally_normalised(images: Tensor) -> Tensor:
    """``images`` (B, C, H, W) less their mean, over their deviation, of about 20 px around; flat parts stay small."""

    def smooth(x: Tensor) -> Tensor:
        coarse = pad(avg_pool2d(x, 4), (2, 2, 2, 2), mode="replicate")
        return interpolate(avg_pool2d(coarse, 5, stride=1), scale_factor=4.0, mode="bilinear")

    flat = images - smooth(images)
    return flat / (smooth(flat.square()) + FAINT**2).sqrt()


def cells_of(response: Tensor) -> Tensor:
    """(B, 64, h, w), the pixels of each cell row by row, of what ``convR`` gives: (B, f^2, H/f, W/f), f x f px each."""
    return pixel_unshuffle(pixel_shuffle(response, math.isqrt(response.shape[1])), CELL_PX)


def peak_places(response: Tensor) -> Tensor:
    """(B, 2, h, w) px from the cell's centre: the largest of ``response`` (B, 64, h, w) and what is about it, weighted.

    The weights, exp(response), are of pixels at most 2 px away along either axis and in the same cell.
    """
    along = torch.arange(CELL_PX, device=response.device)
    rows, columns = (x.reshape(1, -1, 1, 1) for x in torch.meshgrid(along, along, indexing="ij"))
    peak = response.argmax(dim=1, keepdim=True)
    far = ((rows - peak // CELL_PX).abs() > _PEAK_REACH_PX) | ((columns - peak % CELL_PX).abs() > _PEAK_REACH_PX)
    weights = torch.softmax(response.masked_fill(far, -torch.inf), dim=1)
    return torch.stack([(weights * axis).sum(dim=1) for axis in (columns, rows)], dim=1) - (CELL_PX - 1) / 2


def offsets(place: Tensor) -> Tensor:
    """(B, 2, h, w) px from the centres of the cells, of the ``place`` that a network regresses."""
    return OFFSET_PX * torch.tanh(place)


def keypoint_places(place: Tensor) -> Tensor:
    """(B, 2, h, w) px in the image, and within it, of (B, 2, h, w) px from the centres of the cells."""
    h, w = place.shape[-2:]
    x, y = (torch.arange(n, device=place.device) * CELL_PX + (CELL_PX - 1) / 2 for n in (w, h))
    columns = (place[:, 0] + x).clamp(0.0, w * CELL_PX - 1.0)
    rows = (place[:, 1] + y[:, None]).clamp(0.0, h * CELL_PX - 1.0)
    return torch.stack([columns, rows], dim=1)


def strongest(heads: Tensor, nms_px: float) -> Tensor:
    """(h w, 3) x, y and score before the sigmoid, strongest first, of the candidates ``heads`` (3, h, w).

    Those that :func:`vioframe_keypointnet.selection.strongest` leaves out come last, with a score of -inf: what a CUDA
    graph gives is always of one size.
    """
    x, y = keypoint_places(offsets(heads[None, 1:]))[0]
    inner = pad(heads[:1, 1:-1, 1:-1], (1, 1, 1, 1), value=-torch.inf)
    score = torch.where(inner.isfinite(), inner, -torch.inf)[0]
    reach = reach_cells(nms_px)
    around = pad(torch.stack([x, y, score]), (reach,) * 4, value=-torch.inf)
    side = 2 * reach + 1
    x_near, y_near, score_near = around.unfold(1, side, 1).unfold(2, side, 1).flatten(3)
    # Of equals the first row by row is the stronger.
    earlier = torch.arange(side**2, device=heads.device) < side**2 // 2
    higher = (score_near > score[..., None]) | ((score_near == score[..., None]) & earlier)
    near = (x_near - x[..., None]).square() + (y_near - y[..., None]).square() <= nms_px**2
    score = score.masked_fill((near & higher).any(dim=-1), -torch.inf).flatten()
    order = score.argsort(descending=True, stable=True)
    return torch.stack([x.flatten(), y.flatten(), score], dim=1)[order]


def describe(descriptors: Tensor, xy: Tensor) -> Tensor:
    """(B, N, D) unit descriptors at ``xy`` (B, N, 2) px of the image that ``descriptors`` (B, D, H/4, W/4) are of."""
    h, w = descriptors.shape[-2:]
    size = xy.new_tensor([4.0 * w - 1.0, 4.0 * h - 1.0])
    sampled = grid_sample(descriptors, (2.0 * xy / size - 1.0)[:, :, None], align_corners=True)[..., 0]
    return normalize(sampled, dim=1).transpose(1, 2)
