"""From what a network finds to the strongest keypoints that are apart, and their descriptors.

The published network gives a candidate a cell (:func:`select`), the small ones a response a pixel, whose peaks are the
keypoints (:func:`peaks`).
"""

from __future__ import annotations

from math import ceil, isqrt
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from vioframe.jit import kernel
from vioframe.types import Image, Int
from vioframe_keypointnet.architecture import CELL_PX

OFFSET_PX = 2.0 * (CELL_PX - 1) / 2
"""How far a regressed keypoint may lie from its cell's centre along either axis: 2 half cells, the published cross
ratio, so that neighbours reach into each other."""

CONTRAST_REACH_PX = 8
"""Half the side of the window in which the image as given must vary for a keypoint to be there."""
_SUMMITS_A_POINT = 2
"""So many of the highest that may be peaks are looked at for each point that is wanted, before all are."""

Array = NDArray[np.float32]


class Rules(NamedTuple):
    """What is no keypoint, of all that a network finds; in pixels of the image that it saw."""

    nms_px: float
    """What is nearer than this to a stronger one."""
    min_contrast: int
    """What has grey levels about it that vary by less."""
    within_px: int = CONTRAST_REACH_PX
    """Half the side of the window in which they do."""


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
    (8 h, 8 w) is what it saw. Not taken: the outermost ring of cells, which sees less than it should, what lies outside
    the image's first ``shape`` (H, W) pixels, which are not padding, and what the ``rules`` leave out.
    """
    return first_varied(strongest(heads, rules.nms_px), image, shape, max_points, rules)


def strongest(heads: Array, nms_px: float) -> Array:
    """(N, 3) x, y and score before the sigmoid, strongest first, of the candidates ``heads`` (3, h, w) that are off the
    border and have no stronger one within ``nms_px``; :func:`vioframe_keypointnet.network.strongest` does it in torch.
    """
    x, y = candidate_places(heads)
    found = _strongest(heads[0], x, y, np.float32(nms_px), reach_cells(nms_px))
    return found[np.argsort(-found[:, 2])]


def reach_cells(nms_px: float) -> int:
    """How many cells apart candidates within ``nms_px`` of each other may be, along either axis."""
    return int((2.0 * OFFSET_PX + nms_px) / CELL_PX)


def first_varied(
    found: Array, image: Image, shape: tuple[int, int], max_points: int, rules: Rules
) -> tuple[Array, Array]:
    """Of what :func:`strongest` found, the first that are within ``shape`` and about which the image varies."""
    found = found[: np.count_nonzero(found[:, 2] > -np.inf)]
    kept = found[_first_varied(image, found, *shape, rules.min_contrast, rules.within_px, max_points)]
    return kept[:, :2], _sigmoid(kept[:, 2])


def candidate_places(heads: Array) -> tuple[Array, Array]:
    """Columns and rows (h, w) px of the candidates, within the image that the network saw."""
    h, w = heads.shape[1:]
    offset = np.tanh(heads[1:]) * np.float32(OFFSET_PX)
    offset[0] += np.arange(w, dtype=np.float32) * CELL_PX + np.float32((CELL_PX - 1) / 2)
    offset[1] += (np.arange(h, dtype=np.float32) * CELL_PX + np.float32((CELL_PX - 1) / 2))[:, None]
    return np.clip(offset[0], 0.0, w * CELL_PX - 1.0), np.clip(offset[1], 0.0, h * CELL_PX - 1.0)


def peaks(found: Array, image: Image, shape: tuple[int, int], max_points: int, rules: Rules) -> tuple[Array, Array]:
    """``xy`` (N, 2) px and ``score`` (N,) in (0, 1), strongest first, of the peaks of ``found`` (H/f, W/f, f^2).

    A peak is the highest of all pixels nearer than ``nms_px`` along both axes, of equals the first row by row; its
    place is that of the parabolas through it and its neighbours. Not taken: what :func:`select` leaves.
    """
    levels, reach = isqrt(found.shape[2]).bit_length() - 1, max(ceil(rules.nms_px) - 1, 1)
    response = found.reshape(len(found), -1)
    at, height = _summits(response, levels, reach)
    # The highest nearly always suffice; to sort all takes several times as long.
    for most in (_SUMMITS_A_POINT * max_points, len(height)):
        highest = np.sort(np.argpartition(-height, most)[:most]) if most < len(height) else np.arange(len(height))
        highest = highest[np.argsort(-height[highest], stable=True)]
        xy, taken = _first_peaks(
            response, levels, at[highest], reach, image, *shape, rules.min_contrast, rules.within_px, max_points
        )
        if len(taken) == max_points or len(height) <= most:
            break
    return xy, _sigmoid(height[highest[taken]])


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


def _sigmoid(x: Array) -> Array:
    """In (0, 1), and without a warning however negative ``x`` is."""
    one = np.float32(1.0)
    y: Array = one / (one + np.exp(np.minimum(-x, np.float32(80.0))))
    return y


@kernel
def _strongest(score: Array, x: Array, y: Array, nms_px: np.float32, reach: int) -> Array:
    """(N, 3) x, y and score of the candidates off the border with none stronger within ``nms_px``, row by row.

    Candidates so near each other are at most ``reach`` cells apart; of equals the first row by row is the stronger.
    """
    rows, columns = score.shape
    beaten = np.zeros(score.shape, np.bool_)
    for row in range(1, rows - 1):
        for column in range(1, columns - 1):
            # Each pair once: which of two is the stronger no processor can guess, that they are far apart it can.
            for r in range(row, min(row + reach + 1, rows - 1)):
                first = column + 1 if r == row else max(column - reach, 1)
                for c in range(first, min(column + reach + 1, columns - 1)):
                    dx, dy = x[r, c] - x[row, column], y[r, c] - y[row, column]
                    if dx * dx + dy * dy <= nms_px * nms_px:
                        beaten[row, column] |= score[r, c] > score[row, column]
                        beaten[r, c] |= score[r, c] <= score[row, column]
    found = np.empty((score.size, 3), np.float32)
    count = 0
    for row in range(1, rows - 1):
        for column in range(1, columns - 1):
            if not beaten[row, column] and np.isfinite(score[row, column]):
                found[count] = x[row, column], y[row, column], score[row, column]
                count += 1
    return found[:count]


@kernel
def _summits(response: Array, levels: int, reach: int) -> tuple[Int, Array]:
    """Columns and rows (N, 2) px, and heights (N,), of what may be peaks, two rows after the other, off the border.

    Of each 2 x 2 px that is the highest, of equals the first, if none of the squares around has a higher one: whether
    it is a peak :func:`_is_peak` knows. For ``response`` and its ``levels`` see :func:`response_at`.
    """
    fold, half = 1 << levels, 1 << (levels - 1)
    rows, columns = len(response) * half, response.shape[1] // (2 * fold)
    at, height = np.empty((rows * columns, 2), np.int64), np.empty(rows * columns, np.float32)
    # Of each 2 x 2 px the highest value, and of three such squares beside each other.
    square, three = np.full((3, columns), -np.inf, np.float32), np.full((3, columns), -np.inf, np.float32)
    around = np.empty(columns, np.float32)
    count, border = 0, CELL_PX // 2
    for below in range(border - 1, rows - border + 1):
        new, line = below % 3, response[below >> (levels - 1)]
        for column in range(half):
            k = ((below & (half - 1)) << (levels + 1)) + 2 * column
            for place in range(columns >> (levels - 1)):
                highest = max(max(line[k], line[k + 1]), max(line[k + fold], line[k + fold + 1]))
                square[new, (place << (levels - 1)) + column] = highest
                k += fold << levels
        for column in range(1, columns - 1):
            three[new, column] = max(square[new, column - 1], square[new, column], square[new, column + 1])
        row = below - 1
        if row < border:
            continue
        middle, before = row % 3, (row - 1) % 3
        for left in range(columns):
            around[left] = max(three[before, left], three[middle, left], three[new, left])
        for left in range(border, columns - border):
            highest = square[middle, left]
            # All of the squares around are within 3 px.
            if reach >= 3 and around[left] > highest:
                continue
            for k in range(4):
                y, x = 2 * row + k // 2, 2 * left + k % 2
                if response_at(response, levels, y, x) == highest:
                    at[count] = x, y
                    height[count] = highest
                    count += 1
                    break
    return at[:count], height[:count]


@kernel(inlined=True)
def response_at(response: Array, levels: int, row: int, column: int) -> np.float32:
    """That of a pixel, of ``response`` (H/f, f W): of f x f px, row by row, beside that of the next; f is 2^levels."""
    within = (1 << levels) - 1
    place = ((column >> levels) << 2 * levels) + ((row & within) << levels) + (column & within)
    value: np.float32 = response[row >> levels, place]
    return value


@kernel
def _first_peaks(
    response: Array,
    levels: int,
    at: Int,
    reach: int,
    image: Image,
    height: int,
    width: int,
    min_contrast: int,
    within_px: int,
    most: int,
) -> tuple[Array, Int]:
    """Of the columns and rows ``at`` (N, 2) px the first ``most`` that are peaks where the image varies: where they are
    to a part of a pixel, (M, 2), and which (M,)."""
    xy, taken = np.empty((min(most, len(at)), 2), np.float32), np.empty(min(most, len(at)), np.int64)
    count = 0
    for k in range(len(at)):
        if count == most:
            break
        x, y = at[k]
        if x >= width or y >= height or not _is_peak(response, levels, y, x, reach):
            continue
        if _varies(image, x, y, height, width, min_contrast, within_px):
            here = response_at(response, levels, y, x)
            xy[count, 0] = x + _summit(
                response_at(response, levels, y, x - 1), here, response_at(response, levels, y, x + 1)
            )
            xy[count, 1] = y + _summit(
                response_at(response, levels, y - 1, x), here, response_at(response, levels, y + 1, x)
            )
            taken[count] = k
            count += 1
    return xy[:count], taken[:count]


@kernel(inlined=True)
def _is_peak(response: Array, levels: int, row: int, column: int, reach: int) -> bool:
    here = response_at(response, levels, row, column)
    for r in range(max(row - reach, 0), min(row + reach + 1, len(response) << levels)):
        for c in range(max(column - reach, 0), min(column + reach + 1, response.shape[1] >> levels)):
            there = response_at(response, levels, r, c)
            if there > here or (there == here and (r < row or (r == row and c < column))):
                return False
    return True


@kernel(inlined=True)
def _summit(before: np.float32, here: np.float32, after: np.float32) -> float:
    """Where the parabola through three values, a pixel apart, is highest: at most half a pixel from the middle."""
    bend = 2.0 * np.float64(here) - before - after
    return 0.5 * np.float64(after - before) / bend if bend > 0.0 else 0.0


@kernel
def _first_varied(
    image: Image, at: Int | Array, height: int, width: int, min_contrast: int, within_px: int, most: int
) -> Int:
    """Which of ``at``, (N, 2) px or more columns, are the first ``most`` in the image around which it varies."""
    kept = np.empty(min(most, len(at)), np.int64)
    count = 0
    for k in range(len(at)):
        if count == most:
            break
        x, y = at[k, 0], at[k, 1]
        column, row = int(np.rint(x)), int(np.rint(y))
        if x <= width - 1 and y <= height - 1 and _varies(image, column, row, height, width, min_contrast, within_px):
            kept[count] = k
            count += 1
    return kept[:count]


@kernel(inlined=True)
def _varies(image: Image, x: int, y: int, height: int, width: int, min_contrast: int, within_px: int) -> bool:
    low = high = int(image[y, x])
    if min_contrast <= 0:
        return True
    for r in range(max(y - within_px, 0), min(y + within_px + 1, height)):
        for c in range(max(x - within_px, 0), min(x + within_px + 1, width)):
            low, high = min(low, int(image[r, c])), max(high, int(image[r, c]))
            if high - low >= min_contrast:
                return True
    return False
