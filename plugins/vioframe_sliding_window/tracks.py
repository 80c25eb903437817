"""The window's tracks: one row a track, one column a frame, with the landmark that each belongs to."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from vioframe.types import Float, FrameTracks, Int

Bool = NDArray[np.bool_]
Rows = NDArray[np.intp]


class TrackTable:
    """F tracks over K frames, the oldest frame first.

    ``ids`` (F,) ascending, ``seen`` (F, K). ``xy`` (F, K, 2) on the z = 1 plane is zero where not seen. ``landmarks``
    (F, 3) are [x y rho]: the point on the z = 1 plane of the track's host, the first frame that sees it, and the
    inverse depth there, 1/m (Civera, Davison, Montiel, T-RO 2008). They mean something where ``known`` (F,).
    """

    def __init__(self) -> None:
        self.ids: Int = np.empty(0, np.int64)
        self.seen: Bool = np.empty((0, 0), dtype=bool)
        self.xy: Float = np.empty((0, 0, 2))
        self.to_px: Float = np.empty((0, 0, 2, 2))
        self.landmarks: Float = np.empty((0, 3))
        self.known: Bool = np.empty(0, dtype=bool)

    @property
    def hosts(self) -> Rows:
        """(F,) first frame that sees each track."""
        return self.seen.argmax(axis=1)

    def add_frame(self, tracks: FrameTracks, to_px: Float) -> None:
        """Append a frame with the pixels by residual (N, 2, 2) of its tracks."""
        ids = np.union1d(self.ids, tracks.ids)
        old, new = np.searchsorted(ids, self.ids), np.searchsorted(ids, tracks.ids)
        frames = self.seen.shape[1]
        seen = np.zeros((len(ids), frames + 1), dtype=bool)
        xy, px = np.zeros((len(ids), frames + 1, 2)), np.zeros((len(ids), frames + 1, 2, 2))
        px[old, :frames], px[new, frames] = self.to_px, to_px
        seen[old, :frames], xy[old, :frames] = self.seen, self.xy
        seen[new, frames], xy[new, frames] = True, tracks.xy_normalised
        landmarks, known = np.zeros((len(ids), 3)), np.zeros(len(ids), dtype=bool)
        landmarks[old], known[old] = self.landmarks, self.known
        self.ids, self.seen, self.xy, self.to_px = ids, seen, xy, px
        self.landmarks, self.known = landmarks, known

    def drop_frame(self, frame: int) -> None:
        """Forget a frame, and tracks that no other one sees. Landmarks it hosts become unknown."""
        self.known &= self.hosts != frame
        self.seen = np.delete(self.seen, frame, axis=1)
        self.xy, self.to_px = np.delete(self.xy, frame, axis=1), np.delete(self.to_px, frame, axis=1)
        self.keep(self.seen.any(axis=1))

    def keep(self, keep: Bool) -> None:
        """Only the tracks ``keep`` (F,)."""
        self.ids, self.seen, self.known = self.ids[keep], self.seen[keep], self.known[keep]
        self.xy, self.to_px = self.xy[keep], self.to_px[keep]
        self.landmarks = self.landmarks[keep]
