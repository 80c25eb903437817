"""From what a network finds to the strongest keypoints that are apart, and their descriptors.

The published network gives a candidate a cell (:func:`select`), the small ones a response a pixel, whose peaks are the
keypoints (:func:`peaks`).
"""

from __future__ import annotations

from math import ceil
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from vioframe.jit import kernel
from vioframe.types import Image, Int
from vioframe_keypointnet.architecture import CELL_PX, FOLD_PX

OFFSET_PX = 2.0 * (CELL_PX - 1) / 2
"""How far a regressed keypoint may lie from its cell's centre along either axis: 2 half cells, the published cross
ratio, so that neighbours reach into each other."""

CONTRAST_REACH_PX = 8
"""Half the side of the window in which the image as given must vary for a keypoint to be there."""

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
    """``xy`` (N, 2) px and ``score`` (N,) in (0, 1), strongest first, of the peaks of ``found`` (H/4, W/4, 16).

    A peak is the highest of all pixels nearer than ``nms_px`` along both axes, of equals the first row by row; its
    place is that of the parabolas through it and its neighbours. Not taken: what :func:`select` leaves.
    """
    response, reach = by_pixel(found), max(ceil(rules.nms_px) - 1, 1)
    ranked = np.sort(_summits(response, reach))
    xy, height = _first_peaks(response, ranked, reach, image, *shape, rules.min_contrast, rules.within_px, max_points)
    return xy, _sigmoid(height)


def by_pixel(found: Array) -> Array:
    """(H/4, W/4, 4, 4) of what a network of peaks gives, (H/4, W/4, 16): see :func:`response_at`."""
    return found.reshape(*found.shape[:2], FOLD_PX, FOLD_PX)


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
def _summits(response: Array, reach: int) -> Int:
    """The :func:`_rank` (N,) of each square of 2 x 2 px, off the border, that may hold a peak.

    It may where none of the squares around has a higher pixel: whether its highest is a peak :func:`_is_peak` knows.
    For ``response`` see :func:`response_at`.
    """
    rows, places = 2 * len(response), response.shape[1]
    columns = 2 * places
    found, count, border = np.empty(rows * columns, np.int64), 0, CELL_PX // 2
    # Of two rows of pixels the higher ones; of each square the highest, and of three squares beside each other.
    pair, around = np.empty(2 * columns, np.float32), np.empty(columns, np.float32)
    square, three = np.full((3, columns), -np.inf, np.float32), np.full((3, columns), -np.inf, np.float32)
    high = np.empty(columns, np.int64)
    for below in range(border - 1, rows - border + 1):
        new, within = below % 3, 2 * (below & 1)
        for place in range(places):
            pixels = response[below >> 1, place]
            for k in range(FOLD_PX):
                pair[FOLD_PX * place + k] = max(pixels[within, k], pixels[within + 1, k])
        for column in range(columns):
            square[new, column] = max(pair[2 * column], pair[2 * column + 1])
        for column in range(1, columns - 1):
            three[new, column] = max(square[new, column - 1], square[new, column], square[new, column + 1])
        row = below - 1
        if row < border:
            continue
        for column in range(columns):
            # All of the squares around are within 3 px.
            around[column] = max(three[0, column], three[1, column], three[2, column]) if reach >= 3 else -np.inf
        # Which are high no processor can guess: each is noted, and those that are not are overwritten.
        n = 0
        for column in range(border, columns - border):
            high[n] = column
            n += square[row % 3, column] >= around[column]
        for column in high[:n]:
            found[count] = _rank(square[row % 3, column], row, column)
            count += 1
    return found[:count]


@kernel(inlined=True)
def _rank(height: np.float32, row: int, column: int) -> np.int64:
    """A whole number, the lower the higher a square is, and of equals the earlier; its last 32 bits are where it is."""
    # The bits of floats are ordered as they are, but for those below zero.
    bits = np.int64(np.float32(height).view(np.int32))
    ordered = bits if bits >= 0 else bits ^ 0x7FFFFFFF
    return -(ordered << 32) + (row << 16) + column


@kernel(inlined=True)
def response_at(response: Array, row: int, column: int) -> np.float32:
    """That of a pixel, of ``response`` (H/4, W/4, 4, 4), which has that of 4 x 4 px together."""
    value: np.float32 = response[row >> 2, column >> 2, row & 3, column & 3]
    return value


@kernel
def _first_peaks(
    response: Array,
    ranked: Int,
    reach: int,
    image: Image,
    height: int,
    width: int,
    min_contrast: int,
    within_px: int,
    most: int,
) -> tuple[Array, Array]:
    """Of the squares ``ranked`` the first ``most`` with peaks where the image varies: where these are to a part of a
    pixel, (M, 2), and the response there, (M,)."""
    xy, peak = np.empty((min(most, len(ranked)), 2), np.float32), np.empty(min(most, len(ranked)), np.float32)
    count = 0
    for rank in ranked:
        if count == most:
            break
        y, x = _highest(response, (rank >> 16) & 0xFFFF, rank & 0xFFFF)
        if x >= width or y >= height or not _is_peak(response, y, x, reach):
            continue
        if _varies(image, x, y, height, width, min_contrast, within_px):
            here = response_at(response, y, x)
            xy[count, 0] = x + _summit(response_at(response, y, x - 1), here, response_at(response, y, x + 1))
            xy[count, 1] = y + _summit(response_at(response, y - 1, x), here, response_at(response, y + 1, x))
            peak[count] = here
            count += 1
    return xy[:count], peak[:count]


@kernel(inlined=True)
def _highest(response: Array, row: int, column: int) -> tuple[int, int]:
    """Row and column of the highest pixel of a square of 2 x 2, of equals the first."""
    y, x = 2 * row, 2 * column
    for k in range(1, 4):
        r, c = 2 * row + (k >> 1), 2 * column + (k & 1)
        if response_at(response, r, c) > response_at(response, y, x):
            y, x = r, c
    return y, x


@kernel(inlined=True)
def _is_peak(response: Array, row: int, column: int, reach: int) -> bool:
    here = response_at(response, row, column)
    for r in range(max(row - reach, 0), min(row + reach + 1, FOLD_PX * len(response))):
        for c in range(max(column - reach, 0), min(column + reach + 1, FOLD_PX * response.shape[1])):
            there = response_at(response, r, c)
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
