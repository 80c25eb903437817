"""Contrast spread before points are followed and looked for."""

from __future__ import annotations

import math
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from vioframe.jit import kernel
from vioframe.types import Image

Equalisation = Literal["none", "clahe", "histogram"]

# Of CLAHE: tiles in each direction, and how far a grey level may outnumber an even share of a tile's pixels.
_TILES, _CLIP_LIMIT = 8, 3.0

Curves = NDArray[np.float32]


def equalise(image: Image, method: Equalisation) -> Image:
    """``image`` with its contrast spread: over 8 x 8 tiles (clahe, clip limit 3) or as a whole (histogram)."""
    import cv2

    if method == "clahe":
        return clahe(image)
    if method == "histogram":
        return cv2.equalizeHist(image).astype(np.uint8, copy=False)
    return image


def clahe(image: Image) -> Image:
    """Contrast-limited adaptive histogram equalisation (Zuiderveld, Graphics Gems IV, 1994).

    OpenCV's is the same to the last bit, and takes twice the time: it looks up four numbers for a pixel one by one.
    """
    import cv2

    height, width = image.shape
    beyond = 0, 0
    if height % _TILES or width % _TILES:
        beyond = _TILES - height % _TILES, _TILES - width % _TILES
    # A copy also where nothing is beyond: kernels take arrays of one kind.
    whole = np.asarray(cv2.copyMakeBorder(image, 0, beyond[0], 0, beyond[1], cv2.BORDER_REFLECT_101), np.uint8)
    tile = whole.shape[0] // _TILES, whole.shape[1] // _TILES
    limit = max(int(_CLIP_LIMIT * tile[0] * tile[1] / 256), 1)
    return _mixed(whole, _curves(whole, *tile, limit), *tile, height, width)


@kernel
def _curves(image: Image, tile_height: int, tile_width: int, limit: int) -> Curves:
    """(8, 8, 256) the grey level that each becomes in each tile: its share of the darker ones, none beyond ``limit``.

    What is cut off is given to all levels alike.
    """
    out = np.empty((_TILES, _TILES, 256), np.float32)
    scale = np.float32(255.0 / (tile_height * tile_width))
    counts = np.empty((4, 256), np.int32)  # side by side, so that equal neighbours do not wait for one another
    for i in range(_TILES):
        for j in range(_TILES):
            for v in range(256):
                counts[0, v] = counts[1, v] = counts[2, v] = counts[3, v] = 0
            for r in range(i * tile_height, (i + 1) * tile_height):
                for c in range(j * tile_width, (j + 1) * tile_width):
                    counts[c & 3, image[r, c]] += 1
            count, cut = counts[0], 0
            for v in range(256):
                count[v] += counts[1, v] + counts[2, v] + counts[3, v]
                cut += max(count[v] - limit, 0)
                count[v] = min(count[v], limit)
            for v in range(256):
                count[v] += cut // 256
            left = cut % 256
            if left:
                for v in range(0, 256, max(256 // left, 1)):
                    if left:
                        count[v] += 1
                        left -= 1
            below = 0
            for v in range(256):
                below += count[v]
                out[i, j, v] = min(np.rint(np.float32(below) * scale), np.float32(255.0))
    return out


@kernel
def _mixed(image: Image, curves: Curves, tile_height: int, tile_width: int, height: int, width: int) -> Image:
    """The first ``height`` rows and ``width`` columns by the curves of the four tiles about each pixel, bilinearly."""
    half, one = np.float32(0.5), np.float32(1.0)
    # Of each column: its share of the tile on the right. Between two tiles' middles are those from begin to begin.
    share, begin = np.empty(width, np.float32), np.empty(_TILES + 2, np.int64)
    for k in range(_TILES + 2):
        begin[k] = width
    for x in range(width - 1, -1, -1):
        at = np.float32(x) * np.float32(one / np.float32(tile_width)) - half
        left = math.floor(at)
        share[x], begin[int(left) + 1] = at - np.float32(left), x
    for k in range(_TILES, -1, -1):
        begin[k] = min(begin[k], begin[k + 1])
    out, pair, paired = np.empty((height, width), np.uint8), np.empty((_TILES, 256, 2), np.float32), -2
    for y in range(height):
        at = np.float32(y) * np.float32(one / np.float32(tile_height)) - half
        upper = math.floor(at)
        lower_share = at - np.float32(upper)
        upper_share = one - lower_share
        if upper != paired:  # the two curves above each other side by side, to be looked up at once
            for k in range(_TILES):
                for v in range(256):
                    pair[k, v, 0], pair[k, v, 1] = curves[max(upper, 0), k, v], curves[min(upper + 1, _TILES - 1), k, v]
            paired = upper
        for k in range(_TILES + 1):
            on_left, on_right = pair[max(k - 1, 0)], pair[min(k, _TILES - 1)]
            for x in range(np.uint64(begin[k]), np.uint64(begin[k + 1])):
                v, right_share = image[y, x], share[x]
                left_share = one - right_share
                above = on_left[v, 0] * left_share + on_right[v, 0] * right_share
                below = on_left[v, 1] * left_share + on_right[v, 1] * right_share
                out[y, x] = np.uint8(np.rint(above * upper_share + below * lower_share))
    return out


def warm_up() -> None:
    """Compile the kernels, or load them from the cache, so that the first frame does not wait."""
    clahe(np.zeros((64, 64), np.uint8))
