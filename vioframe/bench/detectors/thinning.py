"""Leaving out points that crowd around stronger ones."""

from __future__ import annotations

import numpy as np

from vioframe.jit import kernel
from vioframe.types import Float, Int


@kernel
def distinct(xy: Float, distance_px: float, count: int) -> Int:
    """Places of the first ``count`` of ``xy`` (N, 2) px, strongest first, that keep ``distance_px`` from all before."""
    kept = np.empty(min(count, len(xy)), np.int64)
    n = 0
    for i in range(len(xy)):
        if n == len(kept):
            break
        free = True
        for k in range(n):
            dx, dy = xy[i, 0] - xy[kept[k], 0], xy[i, 1] - xy[kept[k], 1]
            if dx * dx + dy * dy < distance_px * distance_px:
                free = False
                break
        if free:
            kept[n] = i
            n += 1
    return kept[:n]
