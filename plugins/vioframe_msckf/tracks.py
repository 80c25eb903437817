"""The window's observations: one row a track, one column a clone."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from vioframe.types import Float, FrameTracks, Int


class ObservationTable:
    """``ids`` (S,) ascending; ``xy`` (S, C, 2) px, ``xy_normalised`` (S, C, 2), ``seen`` (S, C), oldest clone first."""

    def __init__(self) -> None:
        self.ids: Int = np.empty(0, np.int64)
        self.xy: Float = np.empty((0, 0, 2))
        self.xy_normalised: Float = np.empty((0, 0, 2))
        self.seen: NDArray[np.bool_] = np.empty((0, 0), dtype=bool)

    def add_frame(self, tracks: FrameTracks) -> None:
        """Append a column for a new clone."""
        ids = np.union1d(self.ids, tracks.ids)
        old, new = np.searchsorted(ids, self.ids), np.searchsorted(ids, tracks.ids)
        columns = self.seen.shape[1]
        seen = np.zeros((len(ids), columns + 1), dtype=bool)
        xy = np.zeros((len(ids), columns + 1, 2))
        xy_normalised = np.zeros((len(ids), columns + 1, 2))
        seen[old, :columns], xy[old, :columns], xy_normalised[old, :columns] = self.seen, self.xy, self.xy_normalised
        seen[new, columns], xy[new, columns], xy_normalised[new, columns] = True, tracks.xy, tracks.xy_normalised
        self.ids, self.seen, self.xy, self.xy_normalised = ids, seen, xy, xy_normalised

    def drop_oldest_frame(self) -> None:
        """Forget the oldest clone's column, and tracks that were seen only there."""
        self.seen, self.xy, self.xy_normalised = self.seen[:, 1:], self.xy[:, 1:], self.xy_normalised[:, 1:]
        self.drop(np.flatnonzero(~self.seen.any(axis=1)))

    def drop(self, rows: NDArray[np.intp]) -> None:
        """Forget whole tracks."""
        keep = np.ones(len(self.ids), dtype=bool)
        keep[rows] = False
        self.ids, self.seen = self.ids[keep], self.seen[keep]
        self.xy, self.xy_normalised = self.xy[keep], self.xy_normalised[keep]

    def lengths(self) -> Int:
        """(S,) number of observations by track."""
        return self.seen.sum(axis=1)
