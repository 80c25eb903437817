"""What a network is trained by: the four published losses, and the lessons that come before them.

The four are location, descriptor, score, and that of the inlier-outlier network; equations of Tang et al., ICLR 2020,
section 3.2-3.3. N candidates of the source image and N of the target, a homography between the two: the network is its
own teacher. They only compare two views, and from random weights take days to find what makes a point worth finding.

A corner found once, in the image that both views are of, is the same point in both, however they turn, blur or darken
it: after an hour of such lessons the network is where the published losses can begin to improve it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn.functional import binary_cross_entropy, cross_entropy, pixel_unshuffle, relu

from vioframe.bench.detectors.metrics import warp as warped_by
from vioframe.types import Float
from vioframe_keypointnet.architecture import CELL_PX
from vioframe_keypointnet.network import Detection, describe

NEAR_PX = 4.0
"""Candidates this close are taken for the same point."""
_TOP = 300
"""Strongest points of the source that the inlier-outlier network judges, as published."""
_MARGIN = 0.2
"""Of descriptors: Eq. 4."""

_MOST, _QUALITY, _APART_PX, _BLOCK_PX = 600, 0.005, 5.0, 3
_SCORE_WEIGHT = 4.0
_SPOT_PX = 0.7
_TEMPERATURE = 0.1
_WEAKEST = 0.2
"""Score to be given to the weakest corner; the strongest has one, cells without any zero."""


@dataclass(frozen=True, slots=True)
class Candidates:
    """All candidates of a batch of images, in one row each."""

    xy: Tensor
    """(B, N, 2) px."""
    score: Tensor
    """(B, N)."""
    off_border: Tensor
    """(N,) whether its cell is none of the outermost ring."""

    @staticmethod
    def of(detection: Detection) -> Candidates:
        score = detection.score
        inner = torch.zeros(score.shape[1:], dtype=torch.bool, device=score.device)
        inner[1:-1, 1:-1] = True
        return Candidates(detection.xy.flatten(2).transpose(1, 2), score.flatten(1), inner.flatten())


class InlierOutlierNet(nn.Module):
    """Tells from matched points alone which matches are right: (B, 5, N) to (B, N), positive for an inlier.

    The five are the place in either image, scaled to [-1, 1], and the distance of the descriptors (section 3.3; after
    Brachmann and Rother, ICCV 2019).
    """

    def __init__(self) -> None:
        super().__init__()
        self.first = nn.Sequential(nn.Conv1d(5, 128, 1, bias=False), nn.BatchNorm1d(128), nn.ReLU(inplace=True))
        self.blocks = nn.ModuleList(_residual(128) for _ in range(4))
        self.last = nn.Conv1d(128, 1, 1)

    def forward(self, matches: Tensor) -> Tensor:
        x = self.first(matches)
        for block in self.blocks:
            x = x + block(x)
        out: Tensor = self.last(x)[:, 0]
        return out


def _residual(channels: int) -> nn.Sequential:
    layers: list[nn.Module] = []
    for _ in range(2):
        layers += [
            nn.Conv1d(channels, channels, 1),
            nn.InstanceNorm1d(channels),
            nn.BatchNorm1d(channels),
            nn.ReLU(inplace=True),
        ]
    return nn.Sequential(*layers)


def warp(homography: Tensor, xy: Tensor) -> Tensor:
    """(B, N, 2) px of the target where ``xy`` (B, N, 2) px of the source come by ``homography`` (B, 3, 3)."""
    homogeneous = torch.cat([xy, torch.ones_like(xy[..., :1])], dim=-1) @ homography.transpose(1, 2)
    return homogeneous[..., :2] / homogeneous[..., 2:].clamp(min=1e-6)


def losses(
    source: Detection, target: Detection, homography: Tensor, judge: InlierOutlierNet | None
) -> Mapping[str, Tensor]:
    """The four, unweighted: ``location``, ``score``, ``descriptor`` and ``inlier``; without a ``judge`` the first two,
    which are those that need no descriptors.

    ``homography`` (B, 3, 3) takes pixels of the source to pixels of the target; both are of the same size.
    """
    a, b = Candidates.of(source), Candidates.of(target)
    warped, seen, size = _shown(a, target, homography)
    distance, nearest = nearest_candidates(warped, b)
    near = seen & (distance < NEAR_PX)
    scores = a.score[near], b.score.gather(1, nearest)[near]
    of_detector = {
        "location": _mean(distance[near]),  # Eq. 2
        "score": score_loss(*scores, distance[near]),
    }
    if judge is None:
        return of_detector

    descriptors_a = describe(source.descriptors, a.xy.detach())
    descriptors_b = describe(target.descriptors, b.xy.detach())
    positives = describe(target.descriptors, warped.detach())
    return of_detector | {
        "descriptor": descriptor_loss(descriptors_a, positives, descriptors_b, warped.detach(), b.xy.detach(), seen),
        "inlier": inlier_loss(judge, a, b, warped, descriptors_a, descriptors_b, size),
    }


def _shown(source: Candidates, target: Detection, homography: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Where the source's candidates come in the target (B, N, 2) px, whether it shows them (B, N), and its size, px.

    Those at the border of the source count as not shown.
    """
    h, w = target.score.shape[1:]
    size = source.xy.new_tensor([CELL_PX * w, CELL_PX * h])
    warped = warp(homography, source.xy)
    return warped, ((warped >= 0.0) & (warped <= size - 1.0)).all(dim=-1) & source.off_border, size


def nearest_candidates(warped: Tensor, target: Candidates) -> tuple[Tensor, Tensor]:
    """Distance (B, N), px, of ``warped`` (B, N, 2) to the nearest candidate off the border, and its index (B, N)."""
    with torch.no_grad():
        distances = torch.cdist(warped, target.xy)
        distances[..., ~target.off_border] = torch.inf
        nearest = distances.argmin(dim=-1)
    at = target.xy.gather(1, nearest[..., None].expand(-1, -1, 2))
    # A gradient at distance zero would be nan.
    return ((warped - at).square().sum(dim=-1) + 1e-12).sqrt(), nearest


def score_loss(score_a: Tensor, score_b: Tensor, distance: Tensor) -> Tensor:
    """Eq. 5: high scores for points found at smaller than the mean distance, and the same score in both; all (K,)."""
    closer = 0.5 * (score_a + score_b) * (distance - _mean(distance))
    return _mean(closer) + _mean((score_a - score_b).square())


def descriptor_loss(
    anchors: Tensor,
    positives: Tensor,
    candidates: Tensor,
    warped: Tensor,
    xy: Tensor,
    seen: Tensor,
) -> Tensor:
    """Eq. 3-4: triplets of unit descriptors with the hardest negative of the other image.

    ``anchors`` and ``positives`` (B, N, D) belong together, at ``warped`` (B, N, 2) px of the target; a negative is the
    nearest of ``candidates`` (B, N, D) at ``xy`` (B, N, 2) outside a box of 4 px about that. Mean over ``seen`` (B, N).
    """
    with torch.no_grad():
        likeness = anchors @ candidates.transpose(1, 2)
        # An axis at a time: cdist with p=inf takes a GPU many times as long as all else here.
        near_x, near_y = ((warped[..., k, None] - xy[:, None, :, k]).abs() <= NEAR_PX for k in range(2))
        hardest = likeness.masked_fill(near_x & near_y, -torch.inf).argmax(dim=-1)
    negatives = candidates.gather(1, hardest[..., None].expand_as(anchors))
    return _mean(relu(_apart(anchors, positives) - _apart(anchors, negatives) + _MARGIN)[seen])


def inlier_loss(
    judge: InlierOutlierNet,
    a: Candidates,
    b: Candidates,
    warped: Tensor,
    descriptors_a: Tensor,
    descriptors_b: Tensor,
    size: Tensor,
) -> Tensor:
    """Eq. 6: half the squared difference of ``judge`` from +1 (inlier) or -1, over the 300 strongest of the source.

    Each is matched to the target's candidate of the most alike descriptor; matches within 4 px are right.
    """
    best = a.score.detach().topk(min(_TOP, a.score.shape[1]), dim=1).indices[..., None]
    chosen = descriptors_a.gather(1, best.expand(-1, -1, descriptors_a.shape[-1]))
    with torch.no_grad():
        match = (chosen @ descriptors_b.transpose(1, 2)).argmax(dim=-1)[..., None]
    apart = _apart(chosen, descriptors_b.gather(1, match.expand_as(chosen)))
    xy_a, xy_b = a.xy.gather(1, best.expand(-1, -1, 2)), b.xy.gather(1, match.expand(-1, -1, 2))
    with torch.no_grad():
        error = (warped.gather(1, best.expand(-1, -1, 2)) - xy_b).norm(dim=-1)
        label = torch.where(error < NEAR_PX, 1.0, -1.0)
    matches = torch.cat([2.0 * xy_a / size - 1.0, 2.0 * xy_b / size - 1.0, apart[..., None]], dim=-1)
    loss: Tensor = 0.5 * (judge(matches.transpose(1, 2)) - label).square().mean()
    return loss


def _apart(a: Tensor, b: Tensor) -> Tensor:
    """Euclidean distance between unit vectors, along the last axis."""
    return ((a - b).square().sum(dim=-1) + 1e-12).sqrt()


def _mean(x: Tensor) -> Tensor:
    """Mean, and zero of nothing."""
    return x.sum() / max(1, x.numel())


def corners(grey: NDArray[np.uint8]) -> Float:
    """(N, 3) Shi-Tomasi corners of an image: x and y, px, and the score to learn by rank; strongest first."""
    import cv2

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
    warped, seen, _ = _shown(source, b, homography)
    warped = warped.detach()
    likeness = describe(a.descriptors, source.xy.detach()) @ describe(b.descriptors, warped).transpose(1, 2)
    itself = torch.eye(seen.shape[1], dtype=torch.bool, device=warped.device)
    beside = (torch.cdist(warped, warped) < NEAR_PX) & ~itself
    logits = (likeness / _TEMPERATURE).masked_fill(beside | ~seen[:, None, :], -torch.inf)[seen]
    own = torch.arange(seen.shape[1], device=warped.device).expand_as(seen)[seen]
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
