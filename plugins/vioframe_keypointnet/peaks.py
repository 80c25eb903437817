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

_SQUARES_A_POINT = 6
"""So many squares of 2 x 2 px are looked at for each point that is wanted, before all are."""
_EVERY = 8
"""Of rows and of columns, one in so many is looked at to find the bound that these exceed."""


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
        self._scratch = lru_cache(maxsize=4)(_Scratch)

    def __call__(self, response: Array, image: Image, shape: tuple[int, int], max_points: int) -> tuple[Array, Array]:
        """``xy`` (N, 2) px and ``score`` (N,) in (0, 1), strongest first, of ``response`` (H/f, W/f, f^2).

        In each place there are f x f pixels, row by row, f a power of two.
        """
        f = isqrt(response.shape[2])
        scratch = self._scratch(response.shape[0] * f // 2, response.shape[1] * f // 2)
        _highest_of_four(response, f, scratch.highest)
        most = min(max(max_points, 0), scratch.highest.size)
        xy, score = np.empty((most, 2), np.float32), np.empty(most, np.float32)
        count, shift, least = 0, f.bit_length() - 1, self._rules.min_contrast
        # The strongest squares nearly always hold enough peaks; to look at and to sort all takes several times as long.
        for above in (_exceeded_by(scratch.highest, _SQUARES_A_POINT * most), -np.inf):
            found = scratch.found[: _find(scratch.found, scratch.highest, np.float32(above), (self._reach - 1) // 2)]
            found = found[_descending(scratch.highest.ravel()[found])]
            count = _take(xy, score, found, response, shift, self._reach, image, shape[0], shape[1], least)
            if count == most:
                break
        return xy[:count], sigmoid(score[:count])


class _Scratch:
    """Arrays for responses of one size: as new ones each time they would take longer than what fills them."""

    def __init__(self, rows: int, columns: int) -> None:
        self.highest = np.empty((rows, columns), np.float32)
        self.found = np.empty(rows * columns, np.int32)


def _exceeded_by(values: Array, count: int) -> float:
    """A bound that about ``count`` of ``values`` (H, W) exceed, from a sample."""
    sample = values[::_EVERY, ::_EVERY].ravel()
    rank = int(len(sample) * (1.0 - count / values.size))
    return float(np.partition(sample, rank)[rank]) if 0 <= rank < len(sample) else -np.inf


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
def _find(found: NDArray[np.int32], highest: Array, above: np.float32, reach: int) -> int:
    """Fill ``found`` with the squares off the border that may hold a peak ``above`` a bound; their number.

    A peak is the highest of its square of 2 x 2 px, and of all squares up to ``reach`` away.
    """
    rows, columns = highest.shape
    border = CELL_PX // 2
    count = 0
    for row in range(border, rows - border):
        for column in range(border, columns - border):
            if highest[row, column] > above and _is_highest(highest, row, column, reach):
                found[count] = row * columns + column
                count += 1
    return count


@kernel
def _is_highest(highest: Array, row: int, column: int, reach: int) -> bool:
    for r in range(max(row - reach, 0), min(row + reach + 1, highest.shape[0])):
        for c in range(max(column - reach, 0), min(column + reach + 1, highest.shape[1])):
            if highest[r, c] > highest[row, column]:
                return False
    return True


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
