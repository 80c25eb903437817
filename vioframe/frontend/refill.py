"""Which of a detector's candidates become new tracks."""

from __future__ import annotations

import numpy as np

from vioframe.jit import kernel
from vioframe.types import Bool, Float, Int

# Rows and columns of the grid whose emptiest cells are refilled first: cells of some 90 px on EuRoC's images.
GRID = (6, 8)


def thin(xy: Float, ids: Int, min_distance_px: float) -> Bool:
    """(N,) which tracks stay when of any two closer than ``min_distance_px`` the younger (larger id) goes."""
    return _thin(xy, np.argsort(ids), min_distance_px)


@kernel
def _thin(xy: Float, order: Int, min_distance_px: float) -> Bool:
    """The same by the ``order`` (N,) of age, the oldest first."""
    keep = np.empty(len(xy), np.bool_)
    for n in range(len(order)):
        keep[order[n]] = True
        younger = order[n]
        for m in range(n):
            if keep[order[m]] and _are_close(xy[younger], xy[order[m]], min_distance_px):
                keep[younger] = False
                break
    return keep


def spread(
    candidates: Float,
    live: Float,
    count: int,
    *,
    size: tuple[int, int],
    min_distance_px: float,
    grid: tuple[int, int] = GRID,
) -> Int:
    """(<= count,) indices of the candidates to take: each is the first in whichever grid cell holds the fewest points.

    ``candidates`` (N, 2) px inside the image of ``size`` (width, height); ``live`` (M, 2) px. Everything taken is at
    least ``min_distance_px`` from ``live`` and from each other.
    """
    rows, columns = grid

    def cell(xy: Float) -> Int:
        column = np.clip(xy[:, 0] * columns / size[0], 0, columns - 1).astype(np.int64)
        row = np.clip(xy[:, 1] * rows / size[1], 0, rows - 1).astype(np.int64)
        return row * columns + column

    population = np.bincount(cell(live), minlength=rows * columns)
    return _spread(candidates, cell(candidates), live, population, count, min_distance_px)


@kernel
def _spread(candidates: Float, cells: Int, live: Float, population: Int, count: int, min_distance_px: float) -> Int:
    """The same, with the cell of each candidate (N,), and how many points each cell holds, which grows."""
    free = np.empty(len(candidates), np.bool_)
    for n in range(len(candidates)):
        free[n] = True
        for m in range(len(live)):
            if _are_close(candidates[n], live[m], min_distance_px):
                free[n] = False
                break
    taken = np.empty(max(count, 0), np.int64)
    for k in range(count):
        best = -1
        for n in range(len(candidates)):
            if free[n] and (best < 0 or population[cells[n]] < population[cells[best]]):
                best = n
        if best < 0:
            return taken[:k]
        taken[k] = best
        population[cells[best]] += 1
        free[best] = False
        for n in range(len(candidates)):
            if free[n] and _are_close(candidates[n], candidates[best], min_distance_px):
                free[n] = False
    return taken


@kernel(inlined=True)
def _are_close(a: Float, b: Float, distance: float) -> bool:
    dx, dy = a[0] - b[0], a[1] - b[1]
    close: bool = dx * dx + dy * dy < distance * distance
    return close
