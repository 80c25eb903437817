"""From what a network finds to the strongest keypoints that are apart, and their descriptors.

The published network gives a candidate a cell (:func:`select`), the small ones a response a pixel, whose peaks are the
keypoints (:class:`Peaks`).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from math import ceil, isqrt

import numpy as np
from numpy.typing import NDArray

from vioframe.jit import kernel
from vioframe.types import Image
from vioframe_keypointnet.architecture import CELL_PX

OFFSET_PX = 2.0 * (CELL_PX - 1) / 2
"""How far a keypoint may lie from its cell's centre: the network's cross ratio of 2 times half a cell."""

CONTRAST_REACH_PX = 8
"""Half the side of the window in which the image must vary for a keypoint to be there."""

_SQUARES_A_POINT = 6
"""So many squares of 2 x 2 px are looked at for each point that is wanted, before all are."""
_EVERY = 8
"""Of rows and of columns, one in so many is looked at to find the bound that these exceed."""

Array = NDArray[np.float32]


@dataclass(frozen=True, slots=True)
class Rules:
    """Which candidates are keypoints."""

    nms_px: float
    """A candidate goes where a stronger one is nearer than this; the cells reach into each other."""
    min_contrast: int
    """Grey levels by which the image must vary within 8 px of a keypoint."""

    @property
    def reach_cells(self) -> int:
        """How many cells away a candidate may be that is nearer than ``nms_px``."""
        return max(ceil((self.nms_px + 2.0 * OFFSET_PX) / CELL_PX) - 1, 0)

    @property
    def reach_px(self) -> int:
        """How far along either axis a peak has to be the highest."""
        return max(ceil(self.nms_px) - 1, 1)


def padded_to_cells(image: Image) -> Image:
    """``image`` with its last row and column repeated until the sides are multiples of 8; contiguous."""
    rows, columns = (-side % CELL_PX for side in image.shape)
    if rows or columns:
        padded: NDArray[np.uint8] = np.pad(image, ((0, rows), (0, columns)), mode="edge")
        return padded
    return np.ascontiguousarray(image)


def select(heads: Array, image: Image, shape: tuple[int, int], max_points: int, rules: Rules) -> tuple[Array, Array]:
    """``xy`` (N, 2) px and ``score`` (N,) in (0, 1), strongest first, of the candidates ``heads`` (3, h, w).

    ``heads`` are the score, x and y of each cell as the network gives them before sigmoid and tanh; ``image``
    (8 h, 8 w) is what it saw. Not taken: the outermost ring of cells, which sees less than it should, and what
    lies outside the image's first ``shape`` (H, W) pixels, which are not padding.
    """
    scores = heads[0]
    xs, ys = candidate_places(heads)
    order = np.argsort(scores, axis=None)[::-1]
    cells = np.empty(max(min(max_points, scores.size), 0), np.int64)
    radius2, reach = np.float32(rules.nms_px**2), rules.reach_cells
    count = _take_cells(cells, order, scores, xs, ys, image, shape[0], shape[1], radius2, reach, rules.min_contrast)
    taken = cells[:count]
    return np.stack([xs.ravel()[taken], ys.ravel()[taken]], axis=1), sigmoid(scores.ravel()[taken])


def sigmoid(x: Array) -> Array:
    """In (0, 1), and without a warning however negative ``x`` is."""
    one = np.float32(1.0)
    y: Array = one / (one + np.exp(np.minimum(-x, np.float32(80.0))))
    return y


def candidate_places(heads: Array) -> tuple[Array, Array]:
    """Columns and rows (h, w) px of the candidates, within the image that the network saw."""
    h, w = heads.shape[1:]
    offset = np.tanh(heads[1:]) * np.float32(OFFSET_PX)
    offset[0] += np.arange(w, dtype=np.float32) * CELL_PX + np.float32((CELL_PX - 1) / 2)
    offset[1] += (np.arange(h, dtype=np.float32) * CELL_PX + np.float32((CELL_PX - 1) / 2))[:, None]
    return np.clip(offset[0], 0.0, w * CELL_PX - 1.0), np.clip(offset[1], 0.0, h * CELL_PX - 1.0)


@kernel
def _take_cells(
    cells: NDArray[np.int64],
    order: NDArray[np.int64],
    scores: Array,
    xs: Array,
    ys: Array,
    image: Image,
    height: int,
    width: int,
    radius2: np.float32,
    reach: int,
    min_contrast: int,
) -> int:
    """Fill ``cells`` with the keypoints' cells, first those that come first in ``order``; the number found."""
    h, w = scores.shape
    count = 0
    for cell in order:
        if count == len(cells):
            break
        row, column = cell // w, cell % w
        if row == 0 or column == 0 or row == h - 1 or column == w - 1 or not np.isfinite(scores[row, column]):
            continue
        x, y = xs[row, column], ys[row, column]
        if x > width - 1 or y > height - 1:
            continue
        if _suppressed(row, column, scores, xs, ys, radius2, reach):
            continue
        if not varies(image, round(x), round(y), height, width, min_contrast):
            continue
        cells[count] = cell
        count += 1
    return count


@kernel
def _suppressed(row: int, column: int, scores: Array, xs: Array, ys: Array, radius2: np.float32, reach: int) -> bool:
    """Whether a stronger candidate is too near; of equal ones the first in the image is the stronger."""
    h, w = scores.shape
    for r in range(max(row - reach, 1), min(row + reach + 1, h - 1)):
        for c in range(max(column - reach, 1), min(column + reach + 1, w - 1)):
            first = r < row or (r == row and c < column)
            stronger = scores[r, c] > scores[row, column] or (first and scores[r, c] == scores[row, column])
            if stronger and (xs[r, c] - xs[row, column]) ** 2 + (ys[r, c] - ys[row, column]) ** 2 < radius2:
                return True
    return False


@kernel
def varies(image: Image, x: int, y: int, height: int, width: int, min_contrast: int) -> bool:
    """Whether grey levels around (x, y) differ by ``min_contrast``."""
    low = high = int(image[y, x])
    if min_contrast <= 0:
        return True
    for r in range(max(y - CONTRAST_REACH_PX, 0), min(y + CONTRAST_REACH_PX + 1, height)):
        for c in range(max(x - CONTRAST_REACH_PX, 0), min(x + CONTRAST_REACH_PX + 1, width)):
            low, high = min(low, int(image[r, c])), max(high, int(image[r, c]))
            if high - low >= min_contrast:
                return True
    return False


class Peaks:
    """Selects among the peaks of responses.

    A peak is the highest within :attr:`Rules.reach_px` along both axes, of equals the first row by row; its
    place is that of the parabolas through it and its neighbours. Not taken: what :func:`select` leaves.
    """

    def __init__(self, rules: Rules) -> None:
        self._rules, self._reach = rules, rules.reach_px
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
            count = _take_peaks(xy, score, found, response, shift, self._reach, image, shape[0], shape[1], least)
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
def _take_peaks(
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


def describe(descriptors: Array, xy: Array) -> Array:
    """(N, D) unit descriptors at ``xy`` (N, 2) px of the image of which ``descriptors`` (D, H/4, W/4) are.

    Bilinear, corners of the map on the centres of the image's corner pixels, as the network was trained with
    (:func:`vioframe_keypointnet.network.describe` does the same in torch).
    """
    h, w = descriptors.shape[1:]
    x = np.clip(xy[:, 0] * ((w - 1) / (4 * w - 1)), 0.0, w - 1.0)
    y = np.clip(xy[:, 1] * ((h - 1) / (4 * h - 1)), 0.0, h - 1.0)
    left, top = x.astype(np.intp), y.astype(np.intp)
    right, bottom = np.minimum(left + 1, w - 1), np.minimum(top + 1, h - 1)
    dx, dy = x - left, y - top
    upper = descriptors[:, top, left] * (1.0 - dx) + descriptors[:, top, right] * dx
    lower = descriptors[:, bottom, left] * (1.0 - dx) + descriptors[:, bottom, right] * dx
    sampled = (upper * (1.0 - dy) + lower * dy).T
    length = np.linalg.norm(sampled, axis=1, keepdims=True)
    unit: Array = (sampled / np.maximum(length, 1e-12)).astype(np.float32)
    return unit
