"""Pairs of views of one image with the homography between them; each drawn from its own number alone."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Self

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from vioframe.types import Float
from vioframe_keypointnet.training.homography import random_affine, random_homography
from vioframe_keypointnet.training.images import Picture
from vioframe_keypointnet.training.lessons import corners, lesson
from vioframe_keypointnet.training.options import TrainingOptions
from vioframe_keypointnet.training.photometric import disturbed

# The first view is taken of the image anywhere between shrunk to fit and this much of its own scale.
_LARGEST_SCALE = 1.2


@dataclass(frozen=True, slots=True)
class Batch:
    """Pairs of views; each field has a row a pair."""

    source: Tensor
    """(B, C, H, W) in [0, 1]."""
    target: Tensor
    homography: Tensor
    """(B, 3, 3) from pixels of the source to pixels of the target."""
    source_lesson: Tensor
    """(B, 3, h, w), see :func:`vioframe_keypointnet.training.lessons.lesson`."""
    target_lesson: Tensor

    def to(self, device: torch.device) -> Self:
        return type(self)(*(getattr(self, field.name).to(device) for field in fields(self)))


@dataclass(frozen=True, slots=True)
class Pair:
    """Two views, (H, W) or (H, W, 3) in [0, 1], the homography (3, 3) between them, and their lessons (3, h, w)."""

    source: NDArray[np.float32]
    target: NDArray[np.float32]
    homography: Float
    source_lesson: NDArray[np.float32]
    target_lesson: NDArray[np.float32]


def batch(pictures: Sequence[Picture], options: TrainingOptions, step: int, *, corners_taught: bool = True) -> Batch:
    """The pairs of a step, made of nothing but the arguments, so that a training resumed is one not interrupted.

    Unless ``corners_taught``, none are looked for, and the lessons name none.
    """
    first = step * options.batch
    numbers = range(first, first + options.batch)
    pairs = [
        pair(pictures[_order(k, len(pictures), options.seed)], options, k, corners_taught=corners_taught)
        for k in numbers
    ]
    return Batch(
        _images([p.source for p in pairs]),
        _images([p.target for p in pairs]),
        torch.from_numpy(np.stack([p.homography for p in pairs]).astype(np.float32)),
        torch.from_numpy(np.stack([p.source_lesson for p in pairs])),
        torch.from_numpy(np.stack([p.target_lesson for p in pairs])),
    )


def pair(picture: Picture, options: TrainingOptions, number: int, *, corners_taught: bool = True) -> Pair:
    """The ``number``-th pair, of ``picture``."""
    import cv2

    rng = np.random.default_rng([options.seed, 1, number])
    width, height = options.size
    fit = max(width / picture.pixels.shape[1], height / picture.pixels.shape[0])
    scale = fit * (max(_LARGEST_SCALE, fit) / fit) ** rng.random()
    shrunk = cv2.resize(picture.pixels, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    room = np.maximum(0, [shrunk.shape[1] - width, shrunk.shape[0] - height])
    crop = np.eye(3)
    crop[:2, 2] = -rng.uniform(0.0, 1.0, 2) * room
    first = random_affine(rng, options.affine_deg, True, options.size) @ crop
    second = random_homography(rng, options.size, options.homography) @ first
    if rng.random() < 0.5:
        first, second = second, first
    between = second @ np.linalg.inv(first)
    points = corners(shrunk) if corners_taught else np.empty((0, 3))
    return Pair(
        disturbed(_view(shrunk, first, options.size), rng, options.photometric),
        disturbed(_view(shrunk, second, options.size), rng, options.photometric),
        between / between[2, 2],
        lesson(points, first, options.size),
        lesson(points, second, options.size),
    )


def _view(pixels: NDArray[np.uint8], H: Float, size: tuple[int, int]) -> NDArray[np.float32]:
    import cv2

    # Reflected beyond its edges, the image is the same plane in every view.
    seen = cv2.warpPerspective(pixels, H, size, flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT_101)
    return np.multiply(seen, 1.0 / 255.0, dtype=np.float32)


def _order(k: int, count: int, seed: int) -> int:
    """Which image comes ``k``-th: every epoch all of them, each time in another order."""
    epoch, place = divmod(k, count)
    return int(np.random.default_rng([seed, 0, epoch]).permutation(count)[place])


def _images(images: Sequence[NDArray[np.float32]]) -> Tensor:
    stacked = np.stack(images)
    return torch.from_numpy(stacked[:, None] if stacked.ndim == 3 else stacked.transpose(0, 3, 1, 2)).contiguous()
