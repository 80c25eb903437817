"""How long feature tracks live, and how well they cover the image."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from vioframe.types import FrameTracks, Int


@dataclass(frozen=True, slots=True)
class Lives:
    """``alive`` (N,) tracks were still there n = 0 .. N - 1 frames after they were born, of ``known`` (N,) tracks that
    were born early enough to be seen for so long."""

    alive: Int
    known: Int

    def share(self, frames: int) -> float | None:
        """Part of the tracks that live for so long; None where nobody can know."""
        if frames >= len(self.known) or not self.known[frames]:
            return None
        return float(self.alive[frames] / self.known[frames])

    @property
    def median(self) -> int | None:
        """Frames after which fewer than half are alive; None where that is never seen."""
        below = np.flatnonzero(2 * self.alive < self.known)
        return int(below[0]) if len(below) else None


def lives(steps: Sequence[FrameTracks]) -> Lives:
    """How long the tracks of successive frames live, one at least.

    An id that is gone does not come back, as :class:`vioframe.frontend.Frontend` promises.
    """
    count = len(steps)
    ids = np.concatenate([step.ids for step in steps])
    frame = np.repeat(np.arange(count), [len(step.ids) for step in steps])
    _, first, lived = np.unique(ids, return_index=True, return_counts=True)
    born = frame[first]  # unique() gives the first place of each id, and frames ascend
    known = np.cumsum(np.bincount(born, minlength=count))[::-1]  # n frames before the end, or earlier
    # Of those that lived n + 1 frames or longer, all were born early enough.
    alive = np.cumsum(np.bincount(lived - 1, minlength=count)[::-1])[::-1]
    return Lives(alive, known)


def coverage(steps: Sequence[FrameTracks], resolution: tuple[int, int], grid: tuple[int, int]) -> float:
    """Share of the cells of a ``grid`` (rows, columns) over the image that hold a point, mean over the frames."""
    rows, columns = grid
    shares = []
    for step in steps:
        cell = np.floor((step.xy + 0.5) / np.array(resolution) * (columns, rows)).astype(np.int64)
        cell = np.clip(cell, 0, (columns - 1, rows - 1))
        shares.append(len(np.unique(cell[:, 1] * columns + cell[:, 0])) / (rows * columns))
    return float(np.mean(shares))
