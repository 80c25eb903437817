"""Checks a detector on images whose corners are known by construction."""

from __future__ import annotations

from typing import Any

import numpy as np

from vioframe.interfaces import Detector, DetectorFactory
from vioframe.testing.require import fail, require
from vioframe.types import Image, Keypoints

_HEIGHT, _WIDTH = 480, 640
# Texture sits in this block only, (x, y, width, height): swapped axes or unscaled coordinates leave it.
_BLOCK = (448, 64, 128, 96)
# As far as a learned detector with cells of 8 px may reach beyond the texture.
_REACH_PX = 16
_SHIFT_PX = (24, 16)
# A detector on an image pyramid finds not quite the same points again; by chance a tenth would be this near.
_MOVED_WITHIN_PX = 2.0
_MOVED_SHARE = 0.6


def check_detector(factory: DetectorFactory, **options: Any) -> None:
    """Check ``factory(**options)`` against :class:`vioframe.interfaces.Detector`.

    Shapes, types, order and number of the keypoints; that they lie where the texture is and move with it; that the same
    image gives the same keypoints; that images of any size and content, also empty ones, are survived.
    """
    detector = factory(**options)
    textured = _textured(_BLOCK)
    found = _detect(detector, textured, 100, "a textured image")
    require(len(found.xy) >= 4, f"found {len(found.xy)} keypoints in a block full of corners, expected some")
    _check_place(found, _BLOCK)
    again = _detect(detector, textured, 100, "a textured image")
    require(np.array_equal(found.xy, again.xy), "the same image gave other keypoints the second time")
    require(len(_detect(detector, textured, 1, "a textured image").xy) <= 1, "max_points = 1 is exceeded")
    _check_moves_with_the_image(detector, found)
    for image, name in (
        (np.zeros((_HEIGHT, _WIDTH), np.uint8), "a black image"),
        (np.full((_HEIGHT, _WIDTH), 255, np.uint8), "a saturated image"),
        (_noise(480, 752), "a 752x480 image"),
        (_noise(120, 160), "a 160x120 image"),
        (np.asarray(_noise(480, 1280)[:, ::2]), "an image that is not contiguous in memory"),
    ):
        _detect(detector, image, 50, name)


def _check_place(found: Keypoints, block: tuple[int, int, int, int]) -> None:
    x, y, width, height = block
    low = np.array([x, y]) - _REACH_PX
    high = np.array([x + width, y + height]) - 1 + _REACH_PX
    outside = ~((found.xy >= low) & (found.xy <= high)).all(axis=1)
    require(
        not outside.any(),
        f"keypoints at {found.xy[outside][:3].tolist()}, but the only texture is at x {x}..{x + width}, "
        f"y {y}..{y + height}: xy must be (x, y) in pixels of the image as given",
    )


def _check_moves_with_the_image(detector: Detector, found: Keypoints) -> None:
    x, y, width, height = _BLOCK
    moved = _detect(detector, _textured((x - _SHIFT_PX[0], y + _SHIFT_PX[1], width, height)), 100, "a moved image")
    expected = found.xy + np.array([-_SHIFT_PX[0], _SHIFT_PX[1]], np.float32)
    distance = np.linalg.norm(expected[:, None] - moved.xy[None], axis=2).min(axis=1, initial=np.inf)
    share = float(np.mean(distance <= _MOVED_WITHIN_PX))
    require(share >= _MOVED_SHARE, f"the image moved by {_SHIFT_PX} px and only {share:.0%} of the keypoints with it")


def _detect(detector: Detector, image: Image, max_points: int, name: str) -> Keypoints:
    image.flags.writeable = False  # as the front-end hands them out
    try:
        found = detector.detect(image, max_points)
    except Exception as error:
        fail(f"detect() raised on {name}: {error!r}")
    require(isinstance(found, Keypoints), f"detect() returned a {type(found).__name__}, not Keypoints")
    n = len(found.xy)
    require(found.xy.shape == (n, 2), f"xy has shape {found.xy.shape}, expected (N, 2)")
    require(found.xy.dtype == np.float32, f"xy is {found.xy.dtype}, expected float32")
    require(found.score.shape == (n,), f"score has shape {found.score.shape} for {n} keypoints")
    require(n <= max_points, f"{n} keypoints on {name}, but max_points is {max_points}")
    require(np.isfinite(found.xy).all() and np.isfinite(found.score).all(), f"xy or score is not finite on {name}")
    limit = np.array(image.shape[::-1]) - 1
    require(((found.xy >= 0) & (found.xy <= limit)).all(), f"keypoints outside the image on {name}")
    require((np.diff(found.score) <= 0).all(), f"keypoints are not in order of falling score on {name}")
    if found.descriptors is not None:
        require(len(found.descriptors) == n, f"{len(found.descriptors)} descriptors for {n} keypoints")
    return found


def _textured(block: tuple[int, int, int, int]) -> Image:
    """Grey, with bright and dark rectangles scattered over a block; they are the same wherever the block is put."""
    x, y, width, height = block
    image = np.full((_HEIGHT, _WIDTH), 128, np.uint8)
    rng = np.random.default_rng(7)
    for _ in range(40):
        w, h = rng.integers(8, 28, 2)
        left, top = x + rng.integers(0, width - w), y + rng.integers(0, height - h)
        image[top : top + h, left : left + w] = rng.choice([10, 30, 60, 190, 220, 240])
    # Neighbours of exactly the same score would suppress one another.
    image[y : y + height, x : x + width] += rng.integers(0, 12, (height, width), dtype=np.uint8)
    return image


def _noise(height: int, width: int) -> Image:
    return np.random.default_rng(3).integers(0, 256, (height, width), dtype=np.uint8)
