"""The observation table: one row a track, one column a frame."""

from __future__ import annotations

from typing import Any

import numpy as np

from vioframe.arrays import Bool, Float, Int
from vioframe.types import FrameTracks


class TrackTable:
    """F tracks over K frames, the oldest frame first.

    ``ids`` (F,) ascending, ``seen`` (F, K); ``xy`` (F, K, 2) px and ``xy_normalised`` (F, K, 2) are zero where not
    seen.
    """

    # The arrays with a row a track, and those with a row a track and a column a frame.
    _by_track: tuple[str, ...] = ("ids",)
    _by_sighting: tuple[str, ...] = ("seen", "xy", "xy_normalised")

    def __init__(self) -> None:
        self.ids: Int = np.empty(0, np.int64)
        self.seen: Bool = np.empty((0, 0), dtype=bool)
        self.xy: Float = np.empty((0, 0, 2))
        self.xy_normalised: Float = np.empty((0, 0, 2))

    @property
    def hosts(self) -> Int:
        """(F,) first frame that sees each track."""
        return np.asarray(self.seen.argmax(axis=1))

    def lengths(self) -> Int:
        """(F,) number of frames that see each track."""
        return np.asarray(self.seen.sum(axis=1))

    def add_frame(self, tracks: FrameTracks) -> Int:
        """Append a frame; returns the rows (N,) of its tracks."""
        ids, frames = np.union1d(self.ids, tracks.ids), self.seen.shape[1]
        old, new = np.searchsorted(ids, self.ids), np.searchsorted(ids, tracks.ids)
        for name in self._by_track:
            values = getattr(self, name)
            setattr(self, name, _placed(values, (len(ids), *values.shape[1:]), old))
        for name in self._by_sighting:
            values = getattr(self, name)
            setattr(self, name, _placed(values, (len(ids), frames + 1, *values.shape[2:]), (old, slice(0, frames))))
        self.ids = ids
        self.seen[new, frames] = True
        self.xy[new, frames], self.xy_normalised[new, frames] = tracks.xy, tracks.xy_normalised
        return new

    def drop(self, rows: Int) -> None:
        """Forget whole tracks."""
        keep = np.ones(len(self.ids), dtype=bool)
        keep[rows] = False
        self.keep(keep)

    def drop_frame(self, frame: int) -> None:
        """Forget a frame, and tracks that no other one sees."""
        for name in self._by_sighting:
            setattr(self, name, np.delete(getattr(self, name), frame, axis=1))
        self.keep(np.asarray(self.seen.any(axis=1)))

    def keep(self, keep: Bool) -> None:
        """Only the tracks ``keep`` (F,)."""
        for name in (*self._by_track, *self._by_sighting):
            setattr(self, name, getattr(self, name)[keep])


class LandmarkTable(TrackTable):
    """Tracks with the landmark that each belongs to.

    ``landmarks`` (F, 3) are [x y rho]: the point on the z = 1 plane of the track's host, the first frame that sees it,
    and the inverse depth there, 1/m (Civera, Davison, Montiel, "Inverse Depth Parametrization for Monocular SLAM",
    T-RO 2008). They mean something where ``known`` (F,). ``to_px`` (F, K, 2, 2) are the pixels by residual of each
    sighting.
    """

    _by_track = ("ids", "landmarks", "known")
    _by_sighting = ("seen", "xy", "xy_normalised", "to_px")

    def __init__(self) -> None:
        super().__init__()
        self.landmarks: Float = np.empty((0, 3))
        self.known: Bool = np.empty(0, dtype=bool)
        self.to_px: Float = np.empty((0, 0, 2, 2))

    def drop_frame(self, frame: int) -> None:
        """Forget a frame, and tracks that no other one sees. Landmarks it hosts become unknown."""
        self.known &= self.hosts != frame
        super().drop_frame(frame)


def _placed(values: np.ndarray, shape: tuple[int, ...], at: Any) -> np.ndarray:
    """Zeros of ``shape`` with ``values`` written to the rows, or the rows and columns, ``at``."""
    out = np.zeros(shape, values.dtype)
    out[at] = values
    return out
