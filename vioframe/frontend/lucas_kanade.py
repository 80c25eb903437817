"""Where patches of one image are in the next: Lucas-Kanade over image pyramids.

Bouguet, "Pyramidal implementation of the Lucas Kanade feature tracker" (2000). OpenCV finds the same to 0.01 px; called
from Python it builds both pyramids each time, and the gradients of whole images where only patches are looked at.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vioframe.jit import kernel
from vioframe.types import Image

Pixels = NDArray[np.float32]
Weights = tuple[np.float32, np.float32, np.float32, np.float32]
"""Of a pixel, the one beside it, the one below, and the one beside that."""

_ITERATIONS, _EPSILON_PX = 30, 0.01
# Least squared gradient across a patch, in whichever direction has least, (grey levels / px)^2: others slide.
_LEAST_GRADIENT = 0.1
# Columns of a patch go by so many at once, which compilers make one operation; unsigned, as every index is, because of
# signed ones numba asks whether they count from the end.
_GROUP = 16
_LANES = np.uint64(_GROUP)
_ONE, _TWO = np.uint64(1), np.uint64(2)


@dataclass(frozen=True, slots=True)
class Pyramid:
    """An image at full, half, quarter ... size for patches of ``window_px``, each within a border of its reflection."""

    images: tuple[Image, ...]
    border_px: int
    window_px: int

    @staticmethod
    def of(image: Image, levels: int, window_px: int) -> Pyramid:
        """With up to ``levels`` above the image; none that is not larger than a patch."""
        import cv2

        border_px = _width(window_px) + _GROUP + 2
        images: list[Image] = []
        for _ in range(levels + 1):
            b = border_px
            images.append(np.asarray(cv2.copyMakeBorder(image, b, b, b, b, cv2.BORDER_REFLECT_101), np.uint8))
            image = np.asarray(cv2.pyrDown(image), np.uint8)
            if min(image.shape) <= window_px:
                break
        return Pyramid(tuple(images), border_px, window_px)


def search(
    before: Pyramid, after: Pyramid, xy: Pixels, guess: Pixels, levels: int | None = None
) -> tuple[Pixels, NDArray[np.bool_]]:
    """Where patches about ``xy`` (N, 2) px of ``before`` are in ``after``, and which were found (N,).

    Begins at ``guess`` (N, 2) px, ``levels`` above the full images, or all there are.
    """
    most = len(before.images) - 1
    levels = most if levels is None else min(levels, most)
    found, ok = guess * np.float32(0.5 ** (levels + 1)), np.ones(len(xy), np.bool_)
    for level in reversed(range(levels + 1)):
        lost = _search(
            before.images[level],
            after.images[level],
            before.border_px,
            before.window_px,
            _width(before.window_px),
            xy * np.float32(0.5**level),
            found,
        )
        if level == 0:
            ok = ~lost
    return found, ok


def warm_up() -> None:
    """Compile the kernels, or load them from the cache, so that the first frame does not wait."""
    image = np.zeros((64, 64), np.uint8)
    pyramid, xy = Pyramid.of(image, 0, 15), np.full((1, 2), 32.0, np.float32)
    search(pyramid, pyramid, xy, xy.copy())


def _width(window_px: int) -> int:
    """Columns of a patch, rounded up to whole groups."""
    return -(-window_px // _GROUP) * _GROUP


@kernel(reorder_sums=True)
def _search(
    before: Image, after: Image, border: int, side: int, wide: int, xy: Pixels, found: Pixels
) -> NDArray[np.bool_]:
    """One level: ``found`` (N, 2), on the level above at first, becomes where the patches at ``xy`` are on this one.

    Patches have ``side`` rows, and as many columns that count of ``wide`` that are looked at. Returns which of them
    cannot be followed here, as nothing in them can be told apart or they left the image.
    """
    half = 0.5 * (side - 1)
    height, width = before.shape[0] - 2 * border, before.shape[1] - 2 * border
    patch, template = np.empty((side + 2, wide + _GROUP), np.float32), np.empty((side, wide), np.float32)
    by_x, by_y = np.empty((side, wide), np.float32), np.empty((side, wide), np.float32)
    lost = np.zeros(len(xy), np.bool_)
    for n in range(len(xy)):
        found[n, 0], found[n, 1] = np.float32(2.0) * found[n, 0], np.float32(2.0) * found[n, 1]
        x, y = xy[n, 0] - half, xy[n, 1] - half
        if not (-side <= x < width and -side <= y < height):
            lost[n] = True
            continue
        _sample(before, x - 1.0 + border, y - 1.0 + border, patch)
        xx, xy_, yy = _gradients(patch, math.floor(x), math.floor(y), width, height, template, by_x, by_y)
        determinant = xx * yy - xy_ * xy_
        least = 0.5 * (xx + yy - math.sqrt((xx - yy) * (xx - yy) + 4.0 * xy_ * xy_))
        if not (least > _LEAST_GRADIENT * side * side and determinant > 0.0):
            lost[n] = True
            continue
        x, y = found[n, 0] - half, found[n, 1] - half
        before_dx, before_dy = 0.0, 0.0
        for k in range(_ITERATIONS):
            if not (-side <= x < width and -side <= y < height):
                lost[n] = True
                break
            ex, ey = _mismatch(after, x + border, y + border, template, by_x, by_y)
            dx, dy = (xy_ * ey - yy * ex) / determinant, (xy_ * ex - xx * ey) / determinant
            x, y = x + dx, y + dy
            if dx * dx + dy * dy <= _EPSILON_PX * _EPSILON_PX:
                break
            if k and abs(dx + before_dx) < _EPSILON_PX and abs(dy + before_dy) < _EPSILON_PX:
                x, y = x - 0.5 * dx, y - 0.5 * dy  # to and fro about the answer
                break
            before_dx, before_dy = dx, dy
        found[n, 0], found[n, 1] = x + half, y + half
    return lost


@kernel(inlined=True)
def _weights(x: float, y: float) -> Weights:
    """Of the four pixels about a place, by what is beyond the full pixel."""
    a, b = x - math.floor(x), y - math.floor(y)
    return (
        np.float32((1.0 - a) * (1.0 - b)),
        np.float32(a * (1.0 - b)),
        np.float32((1.0 - a) * b),
        np.float32(a * b),
    )


@kernel(inlined=True)
def _between(image: Image, r: np.uint64, c: np.uint64, weights: Weights) -> np.float32:
    """The four pixels that begin at row ``r`` and column ``c``, weighed."""
    below, beside = r + _ONE, c + _ONE
    upper = weights[0] * image[r, c] + weights[1] * image[r, beside]
    value: np.float32 = upper + weights[2] * image[below, c] + weights[3] * image[below, beside]
    return value


@kernel(inlined=True)
def _sample(image: Image, x: float, y: float, patch: Pixels) -> None:
    """``patch`` (H, W) becomes the part of ``image`` whose first pixel is at ``x``, ``y``, bilinearly."""
    weights = _weights(x, y)
    u, v = np.uint64(math.floor(x)), np.uint64(math.floor(y))
    for r in range(np.uint64(patch.shape[0])):
        for first in range(np.uint64(0), np.uint64(patch.shape[1]), _LANES):
            for lane in range(_LANES):
                c = first + lane
                patch[r, c] = _between(image, v + r, u + c, weights)


@kernel(inlined=True)
def _gradients(
    patch: Pixels, x: int, y: int, width: int, height: int, template: Pixels, by_x: Pixels, by_y: Pixels
) -> tuple[float, float, float]:
    """The inner part of ``patch``, its gradients (Scharr's), and sums of their products xx, xy, yy.

    Gradients are zero beyond the image of ``width`` by ``height``, in which the inner part begins at ``x``, ``y``: what
    is reflected moves the wrong way.
    """
    side, wide = template.shape
    three, ten = np.float32(3.0 / 32.0), np.float32(10.0 / 32.0)
    begin, end = np.uint64(max(0, -x)), np.uint64(max(0, min(side, width - x)))
    xx, xy, yy = np.float32(0.0), np.float32(0.0), np.float32(0.0)
    for r in range(np.uint64(side)):
        inside = np.float32(1.0 if 0 <= y + np.int64(r) < height else 0.0)
        at, below = r + _ONE, r + _TWO
        for first in range(np.uint64(0), np.uint64(wide), _LANES):
            for lane in range(_LANES):
                c = first + lane
                m, n = c + _ONE, c + _TWO
                weight = inside if begin <= c and c < end else np.float32(0.0)
                left, right = three * (patch[r, c] + patch[below, c]), three * (patch[r, n] + patch[below, n])
                up, down = three * (patch[r, c] + patch[r, n]), three * (patch[below, c] + patch[below, n])
                dx = weight * (right - left + ten * (patch[at, n] - patch[at, c]))
                dy = weight * (down - up + ten * (patch[below, m] - patch[r, m]))
                template[r, c], by_x[r, c], by_y[r, c] = patch[at, m], dx, dy
                xx += dx * dx
                xy += dx * dy
                yy += dy * dy
    return float(xx), float(xy), float(yy)


@kernel(inlined=True)
def _mismatch(image: Image, x: float, y: float, template: Pixels, by_x: Pixels, by_y: Pixels) -> tuple[float, float]:
    """Sums of what the part of ``image`` at ``x``, ``y`` has beyond ``template``, times its gradients."""
    weights = _weights(x, y)
    u, v = np.uint64(math.floor(x)), np.uint64(math.floor(y))
    along_x, along_y = np.float32(0.0), np.float32(0.0)
    for r in range(np.uint64(template.shape[0])):
        for first in range(np.uint64(0), np.uint64(template.shape[1]), _LANES):
            for lane in range(_LANES):
                c = first + lane
                off = _between(image, v + r, u + c, weights) - template[r, c]
                along_x += off * by_x[r, c]
                along_y += off * by_y[r, c]
    return float(along_x), float(along_y)
