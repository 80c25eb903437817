"""From the response of every pixel to the strongest peaks that are apart: keypoints of a network of peaks."""

from __future__ import annotations

from math import ceil

import numpy as np
from numpy.typing import NDArray

from vioframe.jit import kernel
from vioframe.types import Image
from vioframe_keypointnet.architecture import CELL_PX
from vioframe_keypointnet.selection import Array, Rules, sigmoid, varies


def reach_px(rules: Rules) -> int:
    """How far along either axis a peak has to be the highest."""
    return max(ceil(rules.nms_px) - 1, 1)


def unfolded(response: Array) -> Array:
    """(H, W) of (4, H/2, W/2), 2 x 2 pixels in each place."""
    _, h, w = response.shape
    return response.reshape(2, 2, h, w).transpose(2, 0, 3, 1).reshape(2 * h, 2 * w)


def select_peaks(
    response: Array, image: Image, shape: tuple[int, int], max_points: int, rules: Rules
) -> tuple[Array, Array]:
    """``xy`` (N, 2) px and ``score`` (N,) in (0, 1), strongest first, of the peaks of ``response`` (H, W).

    A peak is the highest within :func:`reach_px` along both axes, of equals the first row by row; its place is that of
    the parabolas through it and its neighbours. Not taken: what :func:`vioframe_keypointnet.selection.select` leaves.
    """
    import cv2

    side = 2 * reach_px(rules) + 1
    highest = cv2.dilate(response, np.ones((side, side), np.uint8))
    pixels = np.empty(response.size // 4 + 1, np.int64)  # no two peaks touch
    found = pixels[: _find(pixels, response, highest, side // 2, shape[0], shape[1])]
    order = np.argsort(-response.ravel()[found], kind="stable")
    xy = np.empty((max(min(max_points, len(found)), 0), 2), np.float32)
    score = np.empty(len(xy), np.float32)
    count = _take(xy, score, found[order], response, image, shape[0], shape[1], rules.min_contrast)
    return xy[:count], sigmoid(score[:count])


@kernel
def _find(pixels: NDArray[np.int64], response: Array, highest: Array, reach: int, height: int, width: int) -> int:
    """Fill ``pixels`` with the indices of all peaks off the border; their number."""
    rows, columns = response.shape
    count = 0
    for y in range(CELL_PX, min(rows - CELL_PX, height)):
        for x in range(CELL_PX, min(columns - CELL_PX, width)):
            if response[y, x] == highest[y, x] and _is_first(response, y, x, reach):
                pixels[count] = y * columns + x
                count += 1
    return count


@kernel
def _is_first(response: Array, y: int, x: int, reach: int) -> bool:
    """Whether nothing before it in its neighbourhood, row by row, is as high."""
    for r in range(max(y - reach, 0), y + 1):
        for c in range(max(x - reach, 0), min(x + reach + 1, response.shape[1])):
            if (r < y or c < x) and response[r, c] == response[y, x]:
                return False
    return True


@kernel
def _take(
    xy: Array,
    score: Array,
    pixels: NDArray[np.int64],
    response: Array,
    image: Image,
    height: int,
    width: int,
    min_contrast: int,
) -> int:
    """Fill ``xy`` and ``score`` with the first of ``pixels`` where the image is not blank; their number."""
    columns = response.shape[1]
    count = 0
    for pixel in pixels:
        if count == len(xy):
            break
        y, x = pixel // columns, pixel % columns
        if not varies(image, x, y, height, width, min_contrast):
            continue
        here = response[y, x]
        xy[count, 0] = x + _summit(response[y, x - 1], here, response[y, x + 1])
        xy[count, 1] = y + _summit(response[y - 1, x], here, response[y + 1, x])
        score[count] = here
        count += 1
    return count


@kernel
def _summit(before: float, here: float, after: float) -> float:
    """Where the parabola through three values, a pixel apart, is highest: at most half a pixel from the middle."""
    bend = 2.0 * here - before - after
    return 0.5 * (after - before) / bend if bend > 0.0 else 0.0
