"""From what the network says of every cell to the strongest keypoints that are apart."""

from __future__ import annotations

from dataclasses import dataclass
from math import ceil

import numpy as np
from numpy.typing import NDArray

from vioframe.jit import kernel
from vioframe.types import Image
from vioframe_keypointnet.architecture import CELL_PX

OFFSET_PX = 2.0 * (CELL_PX - 1) / 2
"""How far a keypoint may lie from its cell's centre: the network's cross ratio of 2 times half a cell."""

CONTRAST_REACH_PX = 8
"""Half the side of the window in which the image must vary for a keypoint to be there."""

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
    count = _take(cells, order, scores, xs, ys, image, shape[0], shape[1], radius2, reach, rules.min_contrast)
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
def _take(
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
