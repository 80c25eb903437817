"""Points that keep a distance from each other."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from vioframe.arrays import Int
from vioframe.jit import kernel


@kernel
def distinct(xy: NDArray[np.floating], distance_px: float, count: int) -> Int:
    """Places of the first ``count`` of ``xy`` (N, 2) px, strongest first, that keep ``distance_px`` from all before."""
    kept = np.empty(min(count, len(xy)), np.int64)
    if len(kept) == 0:
        return kept
    # Cells no smaller than the distance: what is too near lies in the same or in one beside it.
    cell = max(distance_px, 1.0)
    left, right, top, bottom = xy[0, 0], xy[0, 0], xy[0, 1], xy[0, 1]
    for i in range(len(xy)):
        left, right = min(left, xy[i, 0]), max(right, xy[i, 0])
        top, bottom = min(top, xy[i, 1]), max(bottom, xy[i, 1])
    rows, columns = int((bottom - top) / cell) + 1, int((right - left) / cell) + 1
    # The newest point kept of every cell, and the one before it there.
    newest, older = np.full((rows, columns), -1), np.empty(len(kept), np.int64)
    n = 0
    for i in range(len(xy)):
        if n == len(kept):
            break
        row, column = int((xy[i, 1] - top) / cell), int((xy[i, 0] - left) / cell)
        free = True
        for r in range(max(row - 1, 0), min(row + 2, rows)):
            for c in range(max(column - 1, 0), min(column + 2, columns)):
                k = newest[r, c]
                while free and k >= 0:
                    dx, dy = xy[i, 0] - xy[kept[k], 0], xy[i, 1] - xy[kept[k], 1]
                    free = dx * dx + dy * dy >= distance_px * distance_px
                    k = older[k]
        if free:
            kept[n], older[n], newest[row, column] = i, newest[row, column], n
            n += 1
    return kept[:n]
