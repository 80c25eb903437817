"""What several cameras see of one landmark, counted for as much as it says."""

from __future__ import annotations

import numpy as np

from vioframe.types import MOST_APART_S, NS_PER_S, Bool, FrameTracks, Int


class Repeats:
    """Has a camera count once in ``every_s`` where it sees landmarks that one ahead of it in the rig sees, too.

    A point is handed on from camera to camera by what its patch looks like. What that is off by stays as long as both
    follow it: all sightings by the second share it, and many of them say hardly more than one. Counted as if each were
    off by something else, they have distances, scale and calibration surer than they are.
    """

    def __init__(self, cameras: int, every_s: float) -> None:
        self._every_ns = round(every_s * NS_PER_S)
        # By camera: when it last saw anything, and what; ids that counted although another saw them, and when, (2, N).
        self._newest: list[tuple[int, Int]] = [(-NS_PER_S, np.empty(0, np.int64))] * cameras
        self._counted: list[Int] = [np.empty((2, 0), np.int64)] * cameras

    def counting(self, tracks: FrameTracks) -> Bool:
        """(N,) which sightings of the next frame count."""
        counts = np.ones(len(tracks.ids), bool)
        if len(self._newest) == 1 or not self._every_ns:
            return counts
        about_now_ns = tracks.t_ns - round(MOST_APART_S * NS_PER_S)  # cameras may take turns
        for c in np.unique(tracks.camera).tolist():
            own = np.flatnonzero(tracks.camera == c)
            ids = tracks.ids[own]
            self._newest[c] = tracks.t_ns, ids
            ahead = [seen for t_ns, seen in self._newest[:c] if t_ns >= about_now_ns]
            shared = np.isin(ids, np.concatenate([ids[:0], *ahead]))
            counted = self._counted[c][:, self._counted[c][1] > tracks.t_ns - self._every_ns]
            repeated = shared & np.isin(ids, counted[0])
            new = ids[shared & ~repeated]
            self._counted[c] = np.hstack([counted, [new, np.full_like(new, tracks.t_ns)]])
            counts[own[repeated]] = False
        return counts
