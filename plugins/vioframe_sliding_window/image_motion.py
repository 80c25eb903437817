"""How fast tracks move in the image, which a time offset between camera and IMU shows by."""

from __future__ import annotations

import numpy as np

from vioframe.types import NS_PER_S, Float, FrameTracks


class ImageMotion:
    """Velocities of tracks on the z = 1 plane, frame by frame.

    That of a track is taken over the interval *before* the last one: over the last, it would hold the noise of the very
    sighting that it moves, and offsets of half a frame period would seem likely, for they average that noise away.
    """

    def __init__(self) -> None:
        self._tracks: FrameTracks | None = None
        self._velocity: Float = np.empty((0, 2))

    def of(self, tracks: FrameTracks) -> Float:
        """Take in a frame; (N, 2) 1/s, zero for tracks that fewer than two frames before have seen."""
        before, delayed, latest = self._tracks, np.zeros((len(tracks.ids), 2)), np.zeros((len(tracks.ids), 2))
        if before is not None and tracks.t_ns > before.t_ns:
            _, i, j = np.intersect1d(before.ids, tracks.ids, assume_unique=True, return_indices=True)
            delayed[j] = self._velocity[i]
            latest[j] = (tracks.xy_normalised[j] - before.xy_normalised[i]) / (tracks.t_ns - before.t_ns) * NS_PER_S
        self._tracks, self._velocity = tracks, latest
        return delayed
