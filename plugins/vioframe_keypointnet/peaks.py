"""From the response of every pixel to the strongest peaks that are apart: keypoints of a network of peaks."""

from __future__ import annotations

from functools import lru_cache
from math import ceil, isqrt

import numpy as np
from numpy.typing import NDArray

from vioframe.jit import kernel
from vioframe.types import Image
from vioframe_keypointnet.architecture import CELL_PX
from vioframe_keypointnet.selection import Array, Rules, sigmoid, varies


def reach_px(rules: Rules) -> int:
    """How far along either axis a peak has to be the highest."""
    return max(ceil(rules.nms_px) - 1, 1)


class Peaks:
    """Selects among the peaks of responses.

    A peak is the highest within :func:`reach_px` along both axes, of equals the first row by row; its place is that of
    the parabolas through it and its neighbours. Not taken: what :func:`vioframe_keypointnet.selection.select` leaves.
    """

    def __init__(self, rules: Rules) -> None:
        self._rules, self._reach = rules, reach_px(rules)
        # A peak is the highest of its square of 2 x 2 px, and of all squares that it reaches wherever in its own it is.
        side = 2 * ((self._reach - 1) // 2) + 1
        self._squares = np.ones((side, side), np.uint8)
        self._scratch = lru_cache(maxsize=4)(_Scratch)

    def __call__(self, response: Array, image: Image, shape: tuple[int, int], max_points: int) -> tuple[Array, Array]:
        """``xy`` (N, 2) px and ``score`` (N,) in (0, 1), strongest first, of ``response`` (H/f, W/f, f^2).

        In each place there are f x f pixels, row by row, f a power of two.
        """
        import cv2

        f = isqrt(response.shape[2])
        scratch = self._scratch(response.shape[0] * f // 2, response.shape[1] * f // 2)
        _highest_of_four(response, f, scratch.highest)
        cv2.dilate(scratch.highest, self._squares, scratch.around)
        squares = scratch.found[: _find(scratch.found, scratch.highest, scratch.around)]
        squares = squares[_descending(scratch.highest.ravel()[squares])]
        xy = np.empty((max(min(max_points, len(squares)), 0), 2), np.float32)
        score, shift = np.empty(len(xy), np.float32), f.bit_length() - 1
        least = self._rules.min_contrast
        count = _take(xy, score, squares, response, shift, self._reach, image, shape[0], shape[1], least)
        return xy[:count], sigmoid(score[:count])


class _Scratch:
    """Arrays for responses of one size: as new ones each time they would take longer than what fills them."""

    def __init__(self, rows: int, columns: int) -> None:
        self.highest, self.around = (np.empty((rows, columns), np.float32) for _ in range(2))
        self.found = np.empty(rows * columns + 1, np.int32)


def _descending(values: Array) -> NDArray[np.int64]:
    """``np.argsort(-values, kind="stable")``, several times as fast: one sort of whole numbers.

    Each is made of the value's bits, which are in order (negative ones in reverse order), and its index.
    """
    bits = values.view(np.int32)
    ascending = bits ^ ((bits >> 31) & 0x7FFFFFFF)
    keys = (~ascending).astype(np.int64) << 32 | np.arange(len(values))
    keys.sort()
    return np.asarray(keys & 0xFFFFFFFF)


@kernel
def _highest_of_four(response: Array, f: int, highest: Array) -> None:
    """Fill ``highest`` (H/2, W/2) with the maximum of each 2 x 2 px."""
    per = f // 2
    for row in range(highest.shape[0]):
        for k in range(per):
            upper = (row % per) * 2 * f + 2 * k
            for column in range(response.shape[1]):
                four = response[row // per, column]
                a, b = max(four[upper], four[upper + 1]), max(four[upper + f], four[upper + f + 1])
                highest[row, column * per + k] = max(a, b)


@kernel
def _find(squares: NDArray[np.int32], highest: Array, around: Array) -> int:
    """Fill ``squares`` with the indices of those off the border that may hold a peak; their number."""
    rows, columns = highest.shape
    border = CELL_PX // 2
    count = 0
    for row in range(border, rows - border):
        for column in range(border, columns - border):
            if highest[row, column] == around[row, column]:
                squares[count] = row * columns + column
                count += 1
    return count


@kernel
def _take(
    xy: Array,
    score: Array,
    squares: NDArray[np.int32],
    response: Array,
    shift: int,
    reach: int,
    image: Image,
    height: int,
    width: int,
    min_contrast: int,
) -> int:
    """Fill ``xy`` and ``score`` with peaks in the first of ``squares``, where the image is not blank; their number."""
    columns = response.shape[1] << (shift - 1)
    count = 0
    for square in squares:
        if count == len(xy):
            break
        y, x = _peak(response, shift, 2 * (square // columns), 2 * (square % columns), reach)
        if y < 0 or y >= height or x >= width or not varies(image, x, y, height, width, min_contrast):
            continue
        here = _at(response, shift, y, x)
        xy[count, 0] = x + _summit(_at(response, shift, y, x - 1), here, _at(response, shift, y, x + 1))
        xy[count, 1] = y + _summit(_at(response, shift, y - 1, x), here, _at(response, shift, y + 1, x))
        score[count] = here
        count += 1
    return count


@kernel
def _peak(response: Array, shift: int, y: int, x: int, reach: int) -> tuple[int, int]:
    """Row and column of the peak in the 2 x 2 px from (x, y) on; negative if there is none."""
    top, left = y, x
    for r in range(y, y + 2):
        for c in range(x, x + 2):
            if _at(response, shift, r, c) > _at(response, shift, top, left):
                top, left = r, c
    here = _at(response, shift, top, left)
    for r in range(max(top - reach, 0), min(top + reach + 1, response.shape[0] << shift)):
        for c in range(max(left - reach, 0), min(left + reach + 1, response.shape[1] << shift)):
            there = _at(response, shift, r, c)
            if there > here or (there == here and (r < top or (r == top and c < left))):
                return -1, -1
    return top, left


@kernel
def _at(response: Array, shift: int, y: int, x: int) -> np.float32:
    """The response of the pixel (x, y), 1 << ``shift`` of which are folded: divisions would take most of the time."""
    inside = (1 << shift) - 1
    return response[y >> shift, x >> shift, ((y & inside) << shift) + (x & inside)]


@kernel
def _summit(before: float, here: float, after: float) -> float:
    """Where the parabola through three values, a pixel apart, is highest: at most half a pixel from the middle."""
    bend = 2.0 * here - before - after
    return 0.5 * (after - before) / bend if bend > 0.0 else 0.0
