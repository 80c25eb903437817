"""What :mod:`selection` does, in torch on the device of the network and without a step whose result has to be awaited.

Everything has a size known beforehand, so that it can be recorded into a CUDA graph.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional

from vioframe_keypointnet.architecture import CELL_PX
from vioframe_keypointnet.network import describe
from vioframe_keypointnet.peaks import reach_px
from vioframe_keypointnet.selection import CONTRAST_REACH_PX, Rules

_NEVER = float("-inf")


class TorchSelection:
    """Selects among the candidates of images of one size; the grid and the masks are made once."""

    def __init__(self, padded: tuple[int, int], shape: tuple[int, int], rules: Rules, device: str) -> None:
        h, w = padded[0] // CELL_PX, padded[1] // CELL_PX
        rows, columns = torch.meshgrid(torch.arange(h), torch.arange(w), indexing="ij")
        self._centres = (torch.stack([columns, rows]) * CELL_PX + (CELL_PX - 1) / 2).to(device, torch.float32)
        self._limits = torch.tensor([w * CELL_PX - 1.0, h * CELL_PX - 1.0], device=device)[:, None, None]
        self._last = torch.tensor([shape[1] - 1.0, shape[0] - 1.0], device=device)[:, None, None]
        self._inner = torch.zeros(h, w, dtype=torch.bool)
        self._inner[1:-1, 1:-1] = True
        self._inner = self._inner.to(device)
        self._rules = rules
        neighbours = (2 * rules.reach_cells + 1) ** 2
        self._first = (torch.arange(neighbours) < neighbours // 2)[:, None].to(device)
        """Of a cell's neighbours, row by row, those before it: they win where scores are equal."""

    def __call__(
        self, score: Tensor, places: Tensor, image: Tensor, descriptors: Tensor | None, max_points: int
    ) -> Tensor:
        """(K, 3 + D): x, y px, score before the sigmoid, descriptor; strongest first, and -inf where there are no more.

        ``score`` (h, w) is before the sigmoid, ``places`` (2, h, w) are x, y px from the cells' centres; ``image``
        (8 h, 8 w) and ``descriptors`` (D, 2 h, 2 w) are floats.
        """
        score = score.masked_fill(~self._inner, _NEVER)
        xy = torch.minimum((self._centres + places).clamp(min=0.0), self._limits)
        barred = self._suppressed(score, xy) | (xy > self._last).any(dim=0) | self._flat(image, xy)
        score = score.masked_fill(barred, _NEVER).flatten()
        best, cells = score.topk(min(max_points, len(score)))
        chosen = xy.flatten(1)[:, cells].T
        found = torch.cat([chosen, best[:, None]], dim=1)
        if descriptors is None:
            return found
        return torch.cat([found, describe(descriptors[None], chosen[None])[0]], dim=1)

    def _suppressed(self, score: Tensor, xy: Tensor) -> Tensor:
        """(h, w) whether a stronger candidate is too near."""
        reach = self._rules.reach_cells
        # Beyond the grid there is nothing that could be stronger, wherever it is said to be.
        around = torch.cat([functional.pad(score[None], [reach] * 4, value=_NEVER), functional.pad(xy, [reach] * 4)])
        others = functional.unfold(around[None], 2 * reach + 1).view(3, -1, score.numel())
        own = torch.cat([score[None], xy]).flatten(1)[:, None]
        stronger = (others[0] > own[0]) | (self._first & (others[0] == own[0]))
        near = (others[1:] - own[1:]).square().sum(dim=0) < self._rules.nms_px**2
        return (stronger & near).any(dim=0).view_as(score)

    def _flat(self, image: Tensor, xy: Tensor) -> Tensor:
        """(h, w) whether grey levels around the candidates hardly differ."""
        column, row = xy.round().long()
        return _range(image)[row, column] < self._rules.min_contrast


class TorchPeaks:
    """Selects among the peaks of a response: what :mod:`peaks` does."""

    def __init__(self, padded: tuple[int, int], shape: tuple[int, int], rules: Rules, device: str) -> None:
        self._inner = torch.zeros(padded, dtype=torch.bool)
        rows, columns = (slice(CELL_PX, min(side - CELL_PX, seen)) for side, seen in zip(padded, shape, strict=True))
        self._inner[rows, columns] = True
        self._inner = self._inner.to(device)
        # Floats tell whole numbers apart up to 2^24, more than there are pixels.
        self._place = torch.arange(padded[0] * padded[1], 0, -1.0, device=device).view(padded)
        self._columns, self._reach, self._rules = padded[1], reach_px(rules), rules

    def __call__(self, response: Tensor, image: Tensor, descriptors: Tensor | None, max_points: int) -> Tensor:
        """(K, 3 + D) as :class:`TorchSelection` gives it, of ``response`` (H, W)."""
        highest = self._highest(response) == response
        first = torch.where(highest, self._place, 0.0)
        peak = highest & (self._highest(first) == first) & self._inner & (_range(image) >= self._rules.min_contrast)
        best, pixels = response.masked_fill(~peak, _NEVER).flatten().topk(min(max_points, response.numel()))
        row, column = pixels // self._columns, pixels % self._columns
        around = functional.pad(response, [1, 1, 1, 1])
        x, y = (
            middle + _summits(around[row + 1 - dy, column + 1 - dx], best, around[row + 1 + dy, column + 1 + dx])
            for middle, dx, dy in ((column, 1, 0), (row, 0, 1))
        )
        found = torch.stack([x, y, best], dim=1)
        if descriptors is None:
            return found
        return torch.cat([found, describe(descriptors[None], found[None, :, :2])[0]], dim=1)

    def _highest(self, x: Tensor) -> Tensor:
        return functional.max_pool2d(x[None], 2 * self._reach + 1, stride=1, padding=self._reach)[0]


def _summits(before: Tensor, here: Tensor, after: Tensor) -> Tensor:
    bend = 2.0 * here - before - after
    return torch.where(bend > 0.0, 0.5 * (after - before) / bend, 0.0)


def _range(image: Tensor) -> Tensor:
    """By how much grey levels of ``image`` (H, W) differ around each pixel."""
    return _spread(image[None])[0] + _spread(-image[None])[0]


def _spread(image: Tensor) -> Tensor:
    """The maximum of ``image`` (1, H, W) around each pixel."""
    side, reach = 2 * CONTRAST_REACH_PX + 1, CONTRAST_REACH_PX
    rows = functional.max_pool2d(image, (side, 1), stride=1, padding=(reach, 0))
    return functional.max_pool2d(rows, (1, side), stride=1, padding=(0, reach))
