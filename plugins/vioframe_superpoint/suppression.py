"""Non-maximum suppression, strongest first."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def local_maxima(
    score: NDArray[np.float32], threshold: float, radius_px: int, border_px: int, max_points: int
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """The ``max_points`` strongest pixels of ``score`` (H, W) and their scores: (N, 2) px and (N,), strongest first.

    A pixel above ``threshold`` is kept unless a stronger one that is kept lies within ``radius_px`` in both x and y.
    Those less than ``border_px`` from the border are never kept. Of equals the first in reading order is the stronger.
    """
    height, width = score.shape
    free = score > threshold
    free[:border_px] = free[height - border_px :] = False
    free[:, :border_px] = free[:, width - border_px :] = False
    rows, columns = np.nonzero(free)
    order = np.argsort(-score[rows, columns], kind="stable")
    kept: list[tuple[int, int]] = []
    for row, column in zip(rows[order].tolist(), columns[order].tolist(), strict=True):
        if len(kept) == max_points:
            break
        if free[row, column]:
            kept.append((column, row))
            free[max(row - radius_px, 0) : row + radius_px + 1, max(column - radius_px, 0) : column + radius_px + 1] = (
                False
            )
    xy = np.array(kept, np.int64).reshape(-1, 2)
    return xy.astype(np.float32), score[xy[:, 1], xy[:, 0]]
