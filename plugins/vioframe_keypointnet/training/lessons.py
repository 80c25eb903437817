"""What a network is taught before it teaches itself: the corners of the undisturbed image, wherever views show them.

The published losses only compare two views, and from random weights take days to find what makes a point worth finding.
A corner found once, in the image that both views are of, is the same point in both, however they turn, blur or darken
it: after an hour of such lessons the network is where the published losses can begin to improve it.
"""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import binary_cross_entropy, cross_entropy, pixel_unshuffle

from vioframe.bench.detectors.metrics import warp as warped_by
from vioframe.types import Float
from vioframe_keypointnet.architecture import CELL_PX
from vioframe_keypointnet.network import Detection, describe
from vioframe_keypointnet.training.losses import NEAR_PX, Candidates, warp

_MOST, _QUALITY, _APART_PX, _BLOCK_PX = 600, 0.005, 5.0, 3
_SCORE_WEIGHT = 4.0
_SPOT_PX = 0.7
_TEMPERATURE = 0.1
_WEAKEST = 0.2
"""Score to be given to the weakest corner; the strongest has one, cells without any zero."""


def corners(pixels: NDArray[np.uint8]) -> Float:
    """(N, 3) Shi-Tomasi corners of an image: x and y, px, and the score to learn by rank; strongest first."""
    import cv2

    grey = pixels if pixels.ndim == 2 else cv2.cvtColor(pixels, cv2.COLOR_RGB2GRAY)
    found = cv2.goodFeaturesToTrack(grey, _MOST, _QUALITY, _APART_PX, None, blockSize=_BLOCK_PX)
    if found is None:
        return np.empty((0, 3))
    criteria = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 20, 0.01)
    xy = cv2.cornerSubPix(grey, found, (2, 2), (-1, -1), criteria).reshape(-1, 2)
    return np.column_stack([xy, np.linspace(1.0, _WEAKEST, len(xy))]).astype(np.float64)


def lesson(points: Float, H: Float, size: tuple[int, int]) -> NDArray[np.float32]:
    """(3, h, w) for each cell of a view: x and y, px, and score of the strongest of ``points`` in it; score 0 for none.

    ``H`` (3, 3) takes the image that ``points`` are of to the view of ``size`` (width, height).
    """
    w, h = size[0] // CELL_PX, size[1] // CELL_PX
    out = np.zeros((3, h, w), np.float32)
    xy = warped_by(H, points[:, :2])
    inside = ((xy > -0.5) & (xy < np.array([w, h]) * CELL_PX - 0.5)).all(axis=1)
    xy, score = xy[inside][::-1], points[inside, 2][::-1]
    column, row = ((xy + 0.5) // CELL_PX).astype(int).T
    # Of several in one cell the last written, which is the strongest, stays.
    out[:, row, column] = np.column_stack([xy, score]).T
    return out


def lesson_loss(seen: Detection, wanted: Tensor) -> tuple[Tensor, Tensor]:
    """How far places are from the corners in ``wanted`` (B, 3, h, w), by score, and scores from theirs; off the border.

    Places: the mean distance, px; for a network of peaks the cross entropy from a spot of 0.7 px about the corner, as a
    distance says nothing of which of two peaks is the higher. Scores: cross entropy.
    """
    inner = wanted[:, 2, 1:-1, 1:-1]
    if seen.response is None:
        off = ((seen.xy - wanted[:, :2]).square().sum(dim=1) + 1e-6).sqrt()
    else:
        off = -(_spots(wanted[:, :2]) * torch.log_softmax(seen.response, dim=1)).sum(dim=1)
    place = (off[:, 1:-1, 1:-1] * inner).sum() / inner.sum().clamp(min=1.0)
    score = binary_cross_entropy(seen.score[:, 1:-1, 1:-1].clamp(1e-6, 1.0 - 1e-6), inner)
    return place, score


def matching_loss(a: Detection, b: Detection, homography: Tensor) -> Tensor:
    """Cross entropy of telling each candidate's own place in the target from all others', by descriptors.

    Every other place is a negative, not the hardest alone: that one pulls descriptors that know nothing yet to one
    point, where the published loss leaves them.
    """
    source = Candidates.of(a)
    h, w = a.score.shape[1:]
    warped = warp(homography, source.xy.detach())
    limit = warped.new_tensor([CELL_PX * w - 1.0, CELL_PX * h - 1.0])
    seen = ((warped >= 0.0) & (warped <= limit)).all(dim=-1) & source.off_border
    likeness = describe(a.descriptors, source.xy.detach()) @ describe(b.descriptors, warped).transpose(1, 2)
    itself = torch.eye(h * w, dtype=torch.bool, device=warped.device)
    beside = (torch.cdist(warped, warped) < NEAR_PX) & ~itself
    logits = (likeness / _TEMPERATURE).masked_fill(beside | ~seen[:, None, :], -torch.inf)[seen]
    own = torch.arange(h * w, device=warped.device).expand_as(seen)[seen]
    return cross_entropy(logits, own) if len(own) else likeness.sum() * 0.0


def teach(a: Detection, b: Detection, lesson_a: Tensor, lesson_b: Tensor) -> dict[str, Tensor]:
    """The losses of a step of lessons, mean of both views: ``place`` and, weighted, ``corner``."""
    place, score = (0.5 * (x + y) for x, y in zip(lesson_loss(a, lesson_a), lesson_loss(b, lesson_b), strict=True))
    return {"place": place, "corner": _SCORE_WEIGHT * score}


def _spots(xy: Tensor) -> Tensor:
    """(B, 64, h, w) summing to one over the pixels of each cell, about ``xy`` (B, 2, h, w) px."""
    h, w = xy.shape[-2:]
    rows, columns = torch.meshgrid(torch.arange(CELL_PX * h), torch.arange(CELL_PX * w), indexing="ij")
    pixels = pixel_unshuffle(torch.stack([columns, rows])[:, None].to(xy), CELL_PX)
    squared = (pixels[None, 0] - xy[:, :1]).square() + (pixels[None, 1] - xy[:, 1:]).square()
    return torch.softmax(-squared / (2.0 * _SPOT_PX**2), dim=1)
