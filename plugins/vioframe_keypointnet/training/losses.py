"""The four losses of KeypointNet: location, descriptor, score, and that of the inlier-outlier network.

Equations of Tang et al., ICLR 2020, section 3.2-3.3. N candidates of the source image and N of the target, a homography
between the two: the network is its own teacher.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import relu

from vioframe_keypointnet.network import Detection, InlierOutlierNet, describe

NEAR_PX = 4.0
"""Candidates this close are taken for the same point."""


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


def warp(homography: Tensor, xy: Tensor) -> Tensor:
    """(B, N, 2) px of the target where ``xy`` (B, N, 2) px of the source come by ``homography`` (B, 3, 3)."""
    homogeneous = torch.cat([xy, torch.ones_like(xy[..., :1])], dim=-1) @ homography.transpose(1, 2)
    return homogeneous[..., :2] / homogeneous[..., 2:].clamp(min=1e-6)


def losses(
    source: Detection, target: Detection, homography: Tensor, judge: InlierOutlierNet, top: int = 300
) -> Mapping[str, Tensor]:
    """The four, unweighted: ``location``, ``descriptor``, ``score`` and ``inlier``.

    ``homography`` (B, 3, 3) takes pixels of the source to pixels of the target; both are of the same size.
    """
    a, b = Candidates.of(source), Candidates.of(target)
    h, w = target.score.shape[1:]
    size = a.xy.new_tensor([8.0 * w, 8.0 * h])
    warped = warp(homography, a.xy)
    seen = ((warped >= 0.0) & (warped <= size - 1.0)).all(dim=-1) & a.off_border

    distance, nearest = nearest_candidates(warped, b)
    near = seen & (distance < NEAR_PX)
    scores = a.score[near], b.score.gather(1, nearest)[near]

    descriptors_a = describe(source.descriptors, a.xy.detach())
    descriptors_b = describe(target.descriptors, b.xy.detach())
    positives = describe(target.descriptors, warped.detach())
    return {
        "location": location_loss(distance[near]),
        "descriptor": descriptor_loss(
            descriptors_a, positives, descriptors_b, warped.detach(), b.xy.detach(), seen, margin=0.2
        ),
        "score": score_loss(*scores, distance[near]),
        "inlier": inlier_loss(judge, a, b, warped, descriptors_a, descriptors_b, size, top),
    }


def nearest_candidates(warped: Tensor, target: Candidates) -> tuple[Tensor, Tensor]:
    """Distance (B, N), px, of ``warped`` (B, N, 2) to the nearest candidate off the border, and its index (B, N)."""
    with torch.no_grad():
        distances = torch.cdist(warped, target.xy)
        distances[..., ~target.off_border] = torch.inf
        nearest = distances.argmin(dim=-1)
    at = target.xy.gather(1, nearest[..., None].expand(-1, -1, 2))
    # A gradient at distance zero would be nan.
    return ((warped - at).square().sum(dim=-1) + 1e-12).sqrt(), nearest


def location_loss(distance: Tensor) -> Tensor:
    """Eq. 2: mean distance (K,), px, of points found in both images."""
    return _mean(distance)


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
    margin: float,
) -> Tensor:
    """Eq. 3-4: triplets of unit descriptors with the hardest negative of the other image.

    ``anchors`` and ``positives`` (B, N, D) belong together, at ``warped`` (B, N, 2) px of the target; a negative is the
    nearest of ``candidates`` (B, N, D) at ``xy`` (B, N, 2) outside a box of 4 px about that. Mean over ``seen`` (B, N).
    """
    with torch.no_grad():
        likeness = anchors @ candidates.transpose(1, 2)
        near = torch.cdist(warped, xy, p=torch.inf) <= NEAR_PX
        hardest = likeness.masked_fill(near, -torch.inf).argmax(dim=-1)
    negatives = candidates.gather(1, hardest[..., None].expand_as(anchors))
    return _mean(relu(_apart(anchors, positives) - _apart(anchors, negatives) + margin)[seen])


def inlier_loss(
    judge: InlierOutlierNet,
    a: Candidates,
    b: Candidates,
    warped: Tensor,
    descriptors_a: Tensor,
    descriptors_b: Tensor,
    size: Tensor,
    top: int,
) -> Tensor:
    """Eq. 6: half the squared difference of ``judge`` from +1 (inlier) or -1, over the ``top`` of the source.

    Each is matched to the target's candidate of the most alike descriptor; matches within 4 px are right.
    """
    best = a.score.detach().topk(min(top, a.score.shape[1]), dim=1).indices[..., None]
    chosen = descriptors_a.gather(1, best.expand(-1, -1, descriptors_a.shape[-1]))
    with torch.no_grad():
        match = (chosen @ descriptors_b.transpose(1, 2)).argmax(dim=-1)[..., None]
    apart = _apart(chosen, descriptors_b.gather(1, match.expand_as(chosen)))
    xy_a, xy_b = a.xy.gather(1, best.expand(-1, -1, 2)), b.xy.gather(1, match.expand(-1, -1, 2))
    with torch.no_grad():
        error = (warped.gather(1, best.expand(-1, -1, 2)) - xy_b).norm(dim=-1)
        label = torch.where(error < NEAR_PX, 1.0, -1.0)
    matches = torch.cat([2.0 * xy_a / size - 1.0, 2.0 * xy_b / size - 1.0, apart[..., None]], dim=-1)
    return 0.5 * (judge(matches.transpose(1, 2)) - label).square().mean()


def _apart(a: Tensor, b: Tensor) -> Tensor:
    """Euclidean distance between unit vectors, along the last axis."""
    return ((a - b).square().sum(dim=-1) + 1e-12).sqrt()


def _mean(x: Tensor) -> Tensor:
    """Mean, and zero of nothing."""
    return x.sum() / max(1, x.numel())
