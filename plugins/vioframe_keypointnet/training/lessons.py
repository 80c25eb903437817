"""What a network is taught before it teaches itself: the corners of the undisturbed image, wherever views show them.

The published losses only compare two views, and from random weights take days to find what makes a point worth finding.
A corner found once, in the image that both views are of, is the same point in both, however they turn, blur or darken
it: after an hour of such lessons the network is where the published losses can begin to improve it.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import binary_cross_entropy

from vioframe.types import Float
from vioframe_keypointnet.architecture import CELL_PX
from vioframe_keypointnet.network import Detection
from vioframe_keypointnet.training.homography import transfer

_MOST, _QUALITY, _APART_PX, _BLOCK_PX = 2000, 0.001, 4.0, 3
_SCORE_WEIGHT = 4.0
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
    xy = transfer(H, points[:, :2])
    # nan, behind the horizon, is in no view.
    inside = ((xy > -0.5) & (xy < np.array([w, h]) * CELL_PX - 0.5)).all(axis=1)
    xy, score = xy[inside][::-1], points[inside, 2][::-1]
    column, row = ((xy + 0.5) // CELL_PX).astype(int).T
    # Of several in one cell the last written, which is the strongest, stays.
    out[:, row, column] = np.column_stack([xy, score]).T
    return out


def lesson_loss(seen: Detection, wanted: Tensor) -> tuple[Tensor, Tensor]:
    """Mean distance, px, from the corners in ``wanted`` (B, 3, h, w), and cross entropy of scores; off the border."""
    inner = wanted[:, 2, 1:-1, 1:-1]
    distance = ((seen.xy - wanted[:, :2]).square().sum(dim=1) + 1e-6).sqrt()[:, 1:-1, 1:-1]
    there = inner > 0.0
    place = (distance * there).sum() / there.sum().clamp(min=1)
    score = binary_cross_entropy(seen.score[:, 1:-1, 1:-1].clamp(1e-6, 1.0 - 1e-6), inner)
    return place, score


def teach(a: Detection, b: Detection, lesson_a: Tensor, lesson_b: Tensor) -> dict[str, Tensor]:
    """The losses of a step of lessons, over both views: ``place`` (px), ``corner`` and their weighted sum ``total``."""
    place, score = (0.5 * (x + y) for x, y in zip(lesson_loss(a, lesson_a), lesson_loss(b, lesson_b), strict=True))
    return {"place": place, "corner": score, "total": place + _SCORE_WEIGHT * score}
