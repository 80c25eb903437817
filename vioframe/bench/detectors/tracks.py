"""How long feature tracks live, and how well they cover the image."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from vioframe.types import Float, FrameTracks


def survival(steps: Sequence[FrameTracks], frames: int) -> float | None:
    """Share of the tracks that are still alive ``frames`` frames after they were born.

    Of the tracks born early enough to be seen for so long; None where there are none. An id that is gone does not come
    back, as :class:`vioframe.frontend.Frontend` promises.
    """
    curve = survival_curve(steps)
    return float(curve[frames]) if frames < len(curve) and np.isfinite(curve[frames]) else None


def median_life(steps: Sequence[FrameTracks]) -> int | None:
    """Frames after which fewer than half of the tracks are alive; None where that is never seen."""
    below = np.flatnonzero(survival_curve(steps) < 0.5)
    return int(below[0]) if len(below) else None


def survival_curve(steps: Sequence[FrameTracks]) -> Float:
    """(N,) shares alive n = 0 .. N - 1 frames after birth, NaN where no track was born early enough to know."""
    count = len(steps)
    if not count:
        return np.empty(0)
    ids = np.concatenate([step.ids for step in steps])
    frame = np.repeat(np.arange(count), [len(step.ids) for step in steps])
    _, first, lived = np.unique(ids, return_index=True, return_counts=True)
    born = frame[first]  # unique() gives the first place of each id, and frames ascend
    could = np.cumsum(np.bincount(born, minlength=count))[::-1]  # n frames before the end, or earlier
    # Of those that lived n + 1 frames or longer, all were born early enough.
    did = np.cumsum(np.bincount(lived - 1, minlength=count)[::-1])[::-1]
    return np.asarray(np.divide(did, could, out=np.full(count, np.nan), where=could > 0))


def coverage(steps: Sequence[FrameTracks], resolution: tuple[int, int], grid: tuple[int, int]) -> float:
    """Share of the cells of a ``grid`` (rows, columns) over the image that hold a point, mean over the frames."""
    rows, columns = grid
    shares = []
    for step in steps:
        cell = np.floor((step.xy + 0.5) / np.array(resolution) * (columns, rows)).astype(np.int64)
        cell = np.clip(cell, 0, (columns - 1, rows - 1))
        shares.append(len(np.unique(cell[:, 1] * columns + cell[:, 0])) / (rows * columns))
    return float(np.mean(shares))
