"""The observation table: one row a track, one column a view, which is what one camera sees in one frame."""

from __future__ import annotations

from typing import Any

import numpy as np

from vioframe.arrays import Bool, Float, Int
from vioframe.types import FrameTracks


class TrackTable:
    """F tracks over the V = K N views of K frames by N ``cameras``: the oldest frame first, those of a frame together.

    ``ids`` (F,) ascending; ``in_view`` (F, V), and of that ``seen`` (F, V) what counts; ``xy`` (F, V, 2) px and
    ``xy_normalised`` (F, V, 2) are zero where not in view.
    """

    # The arrays with a row a track, and those with a row a track and a column a view.
    _by_track: tuple[str, ...] = ("ids",)
    _by_sighting: tuple[str, ...] = ("in_view", "seen", "xy", "xy_normalised")

    def __init__(self, cameras: int = 1) -> None:
        self.cameras = cameras
        self.ids: Int = np.empty(0, np.int64)
        self.in_view: Bool = np.empty((0, 0), dtype=bool)
        self.seen: Bool = np.empty((0, 0), dtype=bool)
        self.xy: Float = np.empty((0, 0, 2))
        self.xy_normalised: Float = np.empty((0, 0, 2))

    @property
    def hosts(self) -> Int:
        """(F,) first view of each track."""
        return np.asarray(self.seen.argmax(axis=1))

    def lengths(self) -> Int:
        """(F,) number of views of each track."""
        return np.asarray(self.seen.sum(axis=1))

    def seeing(self) -> Bool:
        """(K, N) which cameras see anything in which frames."""
        return np.asarray(self.in_view.any(axis=0).reshape(-1, self.cameras))

    def taking_part(self) -> Bool:
        """(K, N) which cameras have a part in which frames: those that see anything there, or all where none does."""
        seeing = self.seeing()
        return np.asarray(seeing | ~seeing.any(axis=1, keepdims=True))

    def in_sight(self) -> Bool:
        """(F,) which tracks are in the newest frame.

        A camera that has no part in it, while others do, takes its turn in others: there the newest that it has counts.
        """
        newest = np.arange(-self.cameras, 0)
        if self.cameras > 1 and len(self.ids):
            seeing = self.seeing()
            if seeing[-1].any():
                newest += self.cameras * -seeing[::-1].argmax(axis=0)
        return np.asarray(self.in_view[:, newest].any(axis=1))

    def reach_back(self) -> Bool:
        """(F,) which tracks are in the oldest frame."""
        return np.asarray(self.seen[:, : self.cameras].any(axis=1))

    def add_frame(self, tracks: FrameTracks, counts: Bool | None = None) -> tuple[Int, Int]:
        """Append a frame whose sightings all count, or those ``counts`` (N,); returns the rows and columns of all."""
        ids, views = np.union1d(self.ids, tracks.ids), self.seen.shape[1]
        old, new = np.searchsorted(ids, self.ids), np.searchsorted(ids, tracks.ids)
        for name in self._by_track:
            values = getattr(self, name)
            setattr(self, name, _placed(values, (len(ids), *values.shape[1:]), old))
        for name in self._by_sighting:
            values = getattr(self, name)
            shape = len(ids), views + self.cameras, *values.shape[2:]
            setattr(self, name, _placed(values, shape, (old, slice(0, views))))
        self.ids = ids
        at = new, views + tracks.camera
        self.in_view[at], self.seen[at] = True, True if counts is None else counts
        self.xy[at], self.xy_normalised[at] = tracks.xy, tracks.xy_normalised
        return at

    def drop(self, rows: Int) -> None:
        """Forget whole tracks."""
        keep = np.ones(len(self.ids), dtype=bool)
        keep[rows] = False
        self.keep(keep)

    def drop_frame(self, frame: int) -> None:
        """Forget a frame, and tracks that no other one sees."""
        for name in self._by_sighting:
            views = self.cameras * frame + np.arange(self.cameras)
            setattr(self, name, np.delete(getattr(self, name), views, axis=1))
        self.keep(np.asarray(self.in_view.any(axis=1)))

    def keep(self, keep: Bool) -> None:
        """Only the tracks ``keep`` (F,)."""
        for name in (*self._by_track, *self._by_sighting):
            setattr(self, name, getattr(self, name)[keep])


class LandmarkTable(TrackTable):
    """Tracks with the landmark that each belongs to.

    ``landmarks`` (F, 3) are [x y rho]: the point on the z = 1 plane of the track's host, the first that sees it,
    and the inverse depth there, 1/m (Civera, Davison, Montiel, "Inverse Depth Parametrization for Monocular SLAM",
    T-RO 2008). They mean something where ``known`` (F,). ``to_px`` (F, V, 2, 2) are the pixels by residual of each
    sighting, and ``untold`` (F, V) is the share of each that the prior does not know yet.
    """

    _by_track = ("ids", "landmarks", "known")
    _by_sighting = ("in_view", "seen", "xy", "xy_normalised", "to_px", "untold")

    def __init__(self, cameras: int = 1) -> None:
        super().__init__(cameras)
        self.landmarks: Float = np.empty((0, 3))
        self.known: Bool = np.empty(0, dtype=bool)
        self.to_px: Float = np.empty((0, 0, 2, 2))
        self.untold: Float = np.empty((0, 0))

    def drop_frame(self, frame: int) -> None:
        """Forget a frame, and tracks that no other one sees. Landmarks it hosts become unknown."""
        self.known &= self.hosts // self.cameras != frame
        super().drop_frame(frame)


def _placed(values: np.ndarray, shape: tuple[int, ...], at: Any) -> np.ndarray:
    """Zeros of ``shape`` with ``values`` written to the rows, or the rows and columns, ``at``."""
    out = np.zeros(shape, values.dtype)
    out[at] = values
    return out
