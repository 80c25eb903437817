"""Which of a detector's candidates become new tracks."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from vioframe.types import Float, Int

# Rows and columns of the grid whose emptiest cells are refilled first: cells of some 90 px on EuRoC's images.
GRID = (6, 8)


def thin(xy: Float, ids: Int, min_distance_px: float) -> NDArray[np.bool_]:
    """(N,) which tracks stay when of any two closer than ``min_distance_px`` the younger (larger id) goes."""
    order = np.argsort(ids)
    close = np.tril(_squared_distances(xy[order], xy[order]) < min_distance_px**2, -1)
    keep = np.ones(len(xy), bool)
    for younger in np.flatnonzero(close.any(axis=1)):
        keep[younger] = not np.any(close[younger] & keep)
    out = np.empty(len(xy), bool)
    out[order] = keep
    return out


def spread(
    candidates: Float,
    live: Float,
    count: int,
    *,
    size: tuple[int, int],
    min_distance_px: float,
    grid: tuple[int, int] = GRID,
) -> Int:
    """(<= count,) indices of the candidates to take: strongest first from whichever grid cell holds the fewest points.

    ``candidates`` (N, 2) px, strongest first, inside the image of ``size`` (width, height); ``live`` (M, 2) px.
    Everything taken is at least ``min_distance_px`` from ``live`` and from each other.
    """
    rows, columns = grid

    def cell(xy: Float) -> Int:
        column = np.clip(xy[:, 0] * columns / size[0], 0, columns - 1).astype(np.int64)
        row = np.clip(xy[:, 1] * rows / size[1], 0, rows - 1).astype(np.int64)
        return row * columns + column

    limit = min_distance_px**2
    free = ~(_squared_distances(candidates, live) < limit).any(axis=1)
    cells = cell(candidates)
    population = np.bincount(cell(live), minlength=rows * columns)
    taken: list[int] = []
    while len(taken) < count and free.any():
        remaining = np.flatnonzero(free)
        # argmin takes the first of equals, and candidates are sorted: the strongest of the emptiest cells.
        best = remaining[np.argmin(population[cells[remaining]])]
        taken.append(int(best))
        population[cells[best]] += 1
        free &= ((candidates - candidates[best]) ** 2).sum(axis=1) >= limit
        free[best] = False
    return np.array(taken, np.int64)


def _squared_distances(a: Float, b: Float) -> Float:
    """(N, M) between (N, 2) and (M, 2); a coordinate at a time is several times faster than one (N, M, 2) array."""
    squared: Float = np.subtract.outer(a[:, 0], b[:, 0]) ** 2 + np.subtract.outer(a[:, 1], b[:, 1]) ** 2
    return squared
